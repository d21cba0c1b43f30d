"""What goes wrong with actors, told without Ray: who catches it need not import it."""

from typing import TYPE_CHECKING

from dmil_core.errors import RunError, UserError

if TYPE_CHECKING:
    from services.distributed.calls import Call


class NoRoomError(UserError):
    """More actors were asked for than the cluster has room for."""


class DeadlyCallError(RunError):
    """A call in whose course one actor after the other ended; it is not made again unless `Pool.retry` is told to."""

    def __init__(self, call: "Call") -> None:
        """Name the call."""
        super().__init__(f"{call.label}: {call.deaths} workers ended in the course of it, one after the other")
        self.call = call


class LostError(RunError):
    """An actor of one's own is gone, or what a call is built upon is: whoever made them can make them again."""
