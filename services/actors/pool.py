"""Keeps a pool of actors busy and alive; knows nothing of their work."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import ray
from ray.exceptions import ActorDiedError, ActorUnavailableError, GetTimeoutError

from dmil_core.errors import UserError

__all__ = ["Call", "NoRoomError", "Pool"]

PLACEMENT_SECONDS = 120
DEATHS_ALLOWED = 3
"""A call that ends so many actors is given up: it is the call that kills them."""


class NoRoomError(UserError):
    """More actors were asked for than the cluster has room for."""


class Call:
    """One call of an actor's method: where it runs, and what came of it.

    Among the arguments of another call it stands for its last result, which need not be there yet. In a list among them
    it stands for the reference to that: the other call begins without it, and fetches it when it needs it.
    """

    def __init__(
        self, method: str, arguments: tuple[Any, ...], returns: int, beside: "Call | None", actor: Any | None
    ) -> None:
        """See `Pool.submit`."""
        self.method, self.arguments, self.returns = method, arguments, returns
        self.beside = beside
        self.actor: Any = actor
        self.worker: int | None = None
        """The number of the pool's actor that it runs on; none if that is an actor of one's own."""
        self.references: list[ray.ObjectRef] = []
        """Of its results, once it is under way."""
        self.done = False
        self.value: Any = None
        """Its first result, once it is done."""
        self.deaths = 0

    @property
    def can_begin(self) -> bool:
        """Whether all that it builds upon is under way."""
        calls = (call for given in self.arguments for call in (given if isinstance(given, list) else [given]))
        return all(call.references for call in calls if isinstance(call, Call))


class Pool:
    """Stateless actors of one kind. A call whose actor dies is made again on its replacement.

    Calls are sent in the order in which they are submitted, and may build upon the results of others that are still
    under way: those go from actor to actor, and whoever submits need not wait. If a call is lost, all that build upon
    it fail with it, and are made again too.
    """

    def __init__(self, make: Callable[[], Any], size: int, ahead: int = 1) -> None:
        """Start `size` actors and wait until all are up.

        Args:
            make: starts one.
            size: how many.
            ahead: calls that an actor may hold at a time. With 2 it has its next one at hand when it ends one.

        Raises:
            NoRoomError: if the cluster cannot place them.
        """
        self._make, self._ahead = make, ahead
        self._actors = [make() for _ in range(size)]
        self._held = [0] * size
        self._waiting: deque[Call] = deque()
        self._running: dict[ray.ObjectRef, Call] = {}
        self.restarts = 0
        try:
            ray.get([actor.__ray_ready__.remote() for actor in self._actors], timeout=PLACEMENT_SECONDS)
        except GetTimeoutError as error:
            self.close()
            raise NoRoomError(
                f"workers: got {size}, not all placed after {PLACEMENT_SECONDS} s; the cluster has "
                f"{ray.cluster_resources().get('CPU', 0):.0f} CPUs, {ray.available_resources().get('CPU', 0):.0f} "
                "free; ask for fewer or wait for other jobs to end"
            ) from error

    def __len__(self) -> int:
        return len(self._actors)

    def submit(
        self, method: str, *arguments: Any, returns: int = 1, beside: Call | None = None, on: Any | None = None
    ) -> Call:
        """Have a method called, as soon as there is an actor for it.

        Args:
            method: of the actors.
            arguments: values, object references, calls or lists of calls, see `Call`.
            returns: how many results it has. The first is fetched, the others stay object references.
            beside: the call on whose actor it is to run, however busy that is; by default the least busy one.
            on: an actor that is not the pool's, and is not replaced if it dies.
        """
        call = Call(method, arguments, returns, beside, on)
        self._waiting.append(call)
        self._send_waiting()
        return call

    def result(self, call: Call) -> Any:
        """Wait until a call is done, and return its first result.

        Raises:
            ActorDiedError: if a call ends three actors one after the other, or an actor of one's own.
        """
        while not call.done:
            # Those that wait want to be sent as soon as any call ends; else only this one matters.
            self._settle(self._running if self._waiting else call.references[:1])
        return call.value

    def results(self, calls: Sequence[Call]) -> Iterator[tuple[int, Any]]:
        """Yield each call's index and first result as they come.

        Raises:
            ActorDiedError: as `result`.
        """
        left = dict(enumerate(calls))
        while left:
            for index in [index for index, call in left.items() if call.done]:
                yield index, left.pop(index).value
            if left:
                self._settle(self._running)

    def map(self, method: str, calls: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Call `method` once with each tuple of arguments; yield each call's index and result as they come.

        Raises:
            ActorDiedError: as `result`.
        """
        yield from self.results([self.submit(method, *arguments) for arguments in calls])

    def take_note(self) -> None:
        """Take note of all that has ended by now, without waiting."""
        if self._running:
            ended, _ = ray.wait(list(self._running), num_returns=len(self._running), timeout=0, fetch_local=False)
            for reference in ended:
                self._end(self._running.pop(reference))
            self._send_waiting()

    def close(self) -> None:
        """Stop the actors."""
        for actor in self._actors:
            ray.kill(actor)
        self._actors = []

    def _settle(self, awaited: Iterable[ray.ObjectRef]) -> None:
        """Wait until one of these has ended, and take note of all that have."""
        ray.wait(list(awaited), fetch_local=False)
        self.take_note()

    def _send_waiting(self) -> None:
        while self._waiting and self._waiting[0].can_begin:
            call = self._waiting[0]
            if call.beside is not None:
                call.worker = call.beside.worker
            elif call.actor is None:
                worker = min(range(len(self._actors)), key=self._held.__getitem__)
                if self._held[worker] == self._ahead:
                    return
                call.worker = worker
                self._held[worker] += 1
            self._send(self._waiting.popleft())

    def _send(self, call: Call) -> None:
        if call.worker is not None:
            call.actor = self._actors[call.worker]
        references = (
            getattr(call.actor, call.method).options(num_returns=call.returns).remote(*map(_now, call.arguments))
        )
        call.references = [references] if call.returns == 1 else references
        self._running[call.references[0]] = call

    def _end(self, call: Call) -> None:
        try:
            call.value = ray.get(call.references[0])
        except (ActorDiedError, ActorUnavailableError) as error:
            # The error of a call that it builds upon comes here too; that one was sent again before.
            if error.actor_id in (None, call.actor._actor_id.hex()):
                self._replace(call, error)
            self._send(call)
            return
        if call.worker is not None and call.beside is None:
            self._held[call.worker] -= 1
        call.done = True
        call.arguments, call.beside = (), None  # what it was built upon may go

    def _replace(self, call: Call, error: Exception) -> None:
        call.deaths += 1
        if call.worker is None or call.deaths == DEATHS_ALLOWED:
            raise error
        if self._actors[call.worker] is call.actor:  # else another call that it held has found out before
            ray.kill(call.actor)  # one that is only out of reach would keep its place
            self._actors[call.worker] = self._make()
            self.restarts += 1


def _now(given: Any) -> Any:
    """Return what is sent for an argument."""
    if isinstance(given, Call):
        return given.references[-1]
    return [_now(part) for part in given] if isinstance(given, list) else given
