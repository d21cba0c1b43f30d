"""Who is told what becomes of a pool's actors and calls."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.distributed.calls import Call


class Witness:
    """Keeps nothing of what it is told."""

    def joined(self) -> None:
        """An actor is up and gets calls."""

    def lost(self) -> None:
        """An actor that was up died, or was ended for slowness."""

    def left(self) -> None:
        """An actor that was up is ended, for the pool is closed."""

    def again(self, call: "Call") -> None:
        """A call that was sent to an actor is to be made by another."""
