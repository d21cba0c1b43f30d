"""Calls of actors' methods, and the actors of a pool that make them."""

from collections.abc import Iterator
from typing import Any

import ray


class Call:
    """One call of an actor's method: where it runs, and what came of it.

    Among the arguments of another call it stands for its last result, which need not be there yet. In a list among them
    it stands for the reference to that: the other call begins without it, and fetches it when it needs it.
    """

    def __init__(
        self,
        number: int,
        method: str,
        arguments: tuple[Any, ...],
        returns: int,
        beside: "Call | None",
        on: Any | None,
        label: str,
    ) -> None:
        """See `Pool.submit`."""
        self.number, self.method, self.arguments, self.returns = number, method, arguments, returns
        self.beside, self.on, self.label = beside, on, label
        self.worker: Worker | None = None
        """The pool's actor that it runs on; none if that is an actor of one's own, or it is not sent yet."""
        self.references: list[ray.ObjectRef] = []
        """Of its results, once it is under way."""
        self.began: float | None = None
        """When it was seen to be at work: first in its actor's queue, with all that it is built upon."""
        self.done = False
        self.value: Any = None
        """Its first result, once it is done."""
        self.error: BaseException | None = None
        """What it ended with in the place of results; so do all that are built upon it."""
        self.deaths = 0
        self.spare: Worker | None = None
        """An actor that does the same, where its own is slow."""
        self.twin: list[ray.ObjectRef] = []
        """References to the spare's results."""

    @property
    def built_upon(self) -> Iterator["Call"]:
        """The calls among its arguments."""
        parts = (part for given in self.arguments for part in (given if isinstance(given, list) else [given]))
        return (part for part in parts if isinstance(part, Call))


class Worker:
    """One of the pool's actors: the process may be another one after a death, the number stays."""

    def __init__(self, number: int, actor: Any) -> None:
        """Take an actor that was just started."""
        self.number, self.actor = number, actor
        self.up = False
        self.calls: list[Call] = []
        """Sent and not ended, in their order."""

    @property
    def load(self) -> int:
        """How many of its calls were put here because there was room."""
        return sum(call.beside is None for call in self.calls)


def now(given: Any) -> Any:
    """Return what is sent for an argument of a call: for a call a reference to its last result."""
    if isinstance(given, Call):
        return given.references[-1]
    return [now(part) for part in given] if isinstance(given, list) else given
