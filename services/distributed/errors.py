"""What goes wrong with actors, without Ray: who catches it need not import it."""

from dmil_core.errors import RunError
from services.distributed.calls import Call


class DeadlyCallError(RunError):
    """A call during which one worker after the other died; `Pool.retry` sends it again."""

    def __init__(self, call: Call) -> None:
        """Name the call."""
        super().__init__(f"{call.label}: {call.deaths} workers ended in the course of it, one after the other")
        self.call = call


class LostError(RunError):
    """An actor outside the pool is gone, or a result that a call depends on: both can be made again."""
