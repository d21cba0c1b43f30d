"""Keeps a pool of actors busy and alive; knows nothing of their work."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import ray
from ray.exceptions import ActorDiedError, ActorUnavailableError, GetTimeoutError

from dmil_core.errors import UserError

__all__ = ["NoRoomError", "Pool"]

PLACEMENT_SECONDS = 120
DEATHS_ALLOWED = 3
"""A call that ends so many actors is given up: it is the call that kills them."""


class NoRoomError(UserError):
    """More actors were asked for than the cluster has room for."""


class Pool:
    """Stateless actors of one kind. A call whose actor dies is made again on its replacement."""

    def __init__(self, make: Callable[[], Any], size: int) -> None:
        """Start `size` actors and wait until all are up.

        Raises:
            NoRoomError: if the cluster cannot place them.
        """
        self._make = make
        self._actors = [make() for _ in range(size)]
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

    def map(self, method: str, calls: Sequence[tuple[Any, ...]], returns: int = 1) -> Iterator[tuple[int, Any]]:
        """Call `method` once with each tuple of arguments; yield each call's index and result as they come.

        With more than one of `returns`, the first is fetched and the others stay object references: a result is
        then a tuple.

        Raises:
            ActorDiedError: if a call ends three actors one after the other.
        """
        waiting = list(reversed(range(len(calls))))
        idle = list(range(len(self._actors)))
        deaths: Counter[int] = Counter()
        running: dict[ray.ObjectRef, tuple[int, int, list[ray.ObjectRef]]] = {}
        while waiting or running:
            while waiting and idle:
                call, slot = waiting.pop(), idle.pop()
                remote = getattr(self._actors[slot], method).options(num_returns=returns)
                refs = remote.remote(*calls[call])
                refs = [refs] if returns == 1 else refs
                running[refs[0]] = call, slot, refs
            (done, *_), _ = ray.wait(list(running))
            call, slot, refs = running.pop(done)
            try:
                first = ray.get(done)
            except (ActorDiedError, ActorUnavailableError):
                ray.kill(self._actors[slot])  # one that is only out of reach would keep its place
                self._actors[slot] = self._make()
                self.restarts += 1
                deaths[call] += 1
                if deaths[call] == DEATHS_ALLOWED:
                    raise
                waiting.append(call)
            else:
                yield call, first if returns == 1 else (first, *refs[1:])
            idle.append(slot)

    def close(self) -> None:
        """Stop the actors."""
        for actor in self._actors:
            ray.kill(actor)
        self._actors = []
