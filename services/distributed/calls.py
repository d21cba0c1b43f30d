"""Calls of actors' methods, the workers that execute them, the listener of a pool, and what goes wrong: without Ray."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from dmil_core.errors import RunError

if TYPE_CHECKING:
    from ray import ObjectRef


@dataclass(eq=False)
class Call:
    """One call of an actor's method: where it runs, and its result.

    Among the arguments of another call it stands for its last result, which may still be pending. In a list among them
    it stands for the reference to that result: the other call starts without it, and fetches it when it needs it.
    """

    number: int
    """Calls are sent in the order of their numbers."""
    method: str
    arguments: tuple[Any, ...]
    returns: int
    """How many results it has. The first is fetched, the others stay object references."""
    same_worker_as: "Call | None"
    actor: Any | None
    """An actor outside the pool that it runs on."""
    label: str
    worker: "Worker | None" = None
    """The pool's worker that it is sent to."""
    references: list["ObjectRef"] = field(default_factory=list)
    """References to its results, once it is sent."""
    started: float | None = None
    """When it was first seen to run: first in its worker's queue, with all its dependencies done."""
    done: bool = False
    value: Any = None
    """Its first result, once it is done."""
    error: BaseException | None = None
    """What it raised in place of results; the calls that depend on it raise the same."""
    deaths: int = 0
    """Workers that died while it ran."""
    backup: "Worker | None" = None
    """A second worker for it, where its own is slow."""
    backup_references: list["ObjectRef"] = field(default_factory=list)
    """References to the backup's results."""

    @property
    def dependencies(self) -> Iterator["Call"]:
        """The calls among its arguments."""
        for argument in self.arguments:
            parts = argument if isinstance(argument, list) else [argument]
            yield from (part for part in parts if isinstance(part, Call))


@dataclass(eq=False)
class Worker:
    """A place in the pool: its actor is replaced after a death, its number stays."""

    number: int
    actor: Any
    healthy: bool = False
    """Whether its actor has started."""
    in_flight: list[Call] = field(default_factory=list)
    """Calls sent to it that have not ended, in their order."""

    @property
    def load(self) -> int:
        """How many of its calls could have been sent to any worker."""
        return sum(call.same_worker_as is None for call in self.in_flight)


def referenced(argument: Any) -> Any:
    """Return what is sent for an argument of a call: for a call, the reference to its last result."""
    if isinstance(argument, Call):
        return argument.references[-1]
    return [referenced(part) for part in argument] if isinstance(argument, list) else argument


class PoolListener:
    """Receives the events of a pool, and ignores them."""

    def worker_started(self) -> None:
        """A worker started, and receives calls."""

    def worker_lost(self) -> None:
        """A worker that had started died, or was killed for slowness."""

    def worker_stopped(self) -> None:
        """A worker was stopped, for the pool is closed."""

    def call_resent(self, call: Call) -> None:
        """A call that was sent to a worker is sent to another."""


class DeadlyCallError(RunError):
    """A call during which one worker after the other died; `Pool.retry` sends it again."""

    def __init__(self, call: Call) -> None:
        super().__init__(f"{call.label}: {call.deaths} workers ended in the course of it, one after the other")
        self.call = call


class LostError(RunError):
    """An actor outside the pool is gone, or a result that a call depends on: both can be made again."""
