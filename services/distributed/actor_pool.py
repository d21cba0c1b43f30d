"""Keeps a pool of actors busy and alive; knows nothing of their work."""

import bisect
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import ray
from ray.exceptions import ObjectLostError, RayActorError, RayError, RayTaskError

from dmil_core.errors import RunError
from services.distributed.calls import Call, Worker, now
from services.distributed.errors import DeadlyCallError, LostError, NoRoomError
from services.distributed.pool_events import Witness
from services.distributed.stragglers import SLOWNESS, Patience

PLACEMENT_SECONDS = 120
DEATHS_ALLOWED = 3
"""A call in whose course so many actors ended is suspected to end them."""
WATCH_SECONDS = 0.5


class Pool:
    """Stateless actors of one kind. A call whose actor dies is made again, on whichever actor has room.

    Calls are sent in the order in which they are submitted, and may build upon the results of others that are still
    under way: those go from actor to actor, and whoever submits need not wait. If a call is lost, all that build upon
    it fail with it, and are made again too. A call that takes far longer than its like is also given to a spare actor:
    the first answer counts, for they are equal, and whoever was slower is ended.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        size: int,
        ahead: int = 1,
        say: Callable[[str], None] = lambda words: None,
        witness: Witness | None = None,
        enough: int | None = None,
    ) -> None:
        """Start `size` actors and wait until `enough` are up; the others join whenever there is room for them.

        An actor that waits for room is what makes a cluster grow, if it does so by itself.

        Args:
            make: starts one.
            size: how many.
            ahead: calls that an actor may hold at a time. With 2 it has its next one at hand when it ends one.
            say: is told of actors lost, slow and replaced, in words.
            witness: is told so too, to count them.
            enough: how many have room now; all by default.

        Raises:
            NoRoomError: if the cluster cannot place that many.
        """
        self._make, self._ahead, self._say, self._witness = make, ahead, say, witness or Witness()
        self._workers: list[Worker] = []
        self._starting: dict[ray.ObjectRef, Worker] = {}
        self._waiting: list[Call] = []
        self._running: dict[ray.ObjectRef, Call] = {}
        self._patience = Patience()
        self._submitted = self._failed_starts = 0
        self._manned = time.monotonic()
        """When an actor was last seen to be up."""
        self.restarts = 0
        """How many actors died or were ended for slowness, and replaced."""
        self.grow(size)
        until = time.monotonic() + PLACEMENT_SECONDS
        while len(self) < (size if enough is None else min(enough, size)):
            self._settle([])
            if time.monotonic() > until:
                self.close()
                raise _no_room(size)

    def __len__(self) -> int:
        """How many actors are up."""
        return sum(worker.up for worker in self._workers)

    def grow(self, size: int) -> None:
        """Start actors until there are `size`, without waiting for them; they get calls as soon as they are up."""
        for number in range(len(self._workers), size):
            self._workers.append(self._start(number))

    def submit(
        self,
        method: str,
        *arguments: Any,
        returns: int = 1,
        beside: Call | None = None,
        on: Any | None = None,
        label: str = "",
    ) -> Call:
        """Have a method called, as soon as there is an actor for it.

        Args:
            method: of the actors.
            arguments: values, object references, calls or lists of calls, see `Call`.
            returns: how many results it has. The first is fetched, the others stay object references.
            beside: the call on whose actor it is to run, however busy that is; by default the least busy one.
            on: an actor that is not the pool's, and is not replaced if it dies.
            label: what it is, in messages.
        """
        call = Call(self._submitted, method, arguments, returns, beside, on, label or method)
        self._submitted += 1
        self._queue(call)
        self._send_waiting()
        return call

    def result(self, call: Call) -> Any:
        """Wait until a call is done, and return its first result.

        Raises:
            DeadlyCallError: if three actors end one after the other in the course of some call.
            LostError: if an actor of one's own is gone, or a result that a call is built upon.
            NoRoomError: if no actor is left, and none can be placed.
            Exception: whatever the call raised.
        """
        while not call.done:
            # Those that wait want to be sent as soon as any call ends; else only this one matters.
            self._settle(self._running if self._waiting else [*call.references[:1], *call.twin[:1]])
        if call.error is not None:
            raise call.error
        return call.value

    def results(self, calls: Sequence[Call]) -> Iterator[tuple[int, Any]]:
        """Yield each call's index and first result as they come.

        Raises:
            DeadlyCallError: as `result`, and the others.
        """
        left = dict(enumerate(calls))
        while left:
            for index in [index for index, call in left.items() if call.done]:
                yield index, self.result(left.pop(index))
            if left:
                self._settle(self._running)

    def map(
        self, method: str, calls: Iterable[tuple[Any, ...]], label: Callable[..., str] = lambda *arguments: ""
    ) -> Iterator[tuple[int, Any]]:
        """Call `method` once with each tuple of arguments; yield each call's index and result as they come.

        Args:
            method: of the actors.
            calls: the arguments of each call.
            label: says of its arguments what a call is, in messages.

        Raises:
            DeadlyCallError: as `result`, and the others.
        """
        yield from self.results([self.submit(method, *arguments, label=label(*arguments)) for arguments in calls])

    def take_note(self) -> None:
        """Take note of all that has ended by now, without waiting, and see to what goes on too long."""
        watched = [*self._running, *self._starting]
        if watched:
            ended, _ = ray.wait(watched, num_returns=len(watched), timeout=0, fetch_local=False)
            for reference in ended:
                if reference in self._starting:
                    self._is_up(reference)
                elif reference in self._running:  # else a call's other attempt has ended before, in this very loop
                    self._end(reference, self._running.pop(reference))
        self._send_waiting()
        self._watch()

    def retry(self, call: Call) -> None:
        """Have a call made again that was suspected to end its actors."""
        self._witness.again(call)
        call.deaths = 0
        self._queue(call)
        self._send_waiting()

    def drop(self) -> None:
        """Forget all calls; what is under way comes to its end unheeded."""
        for call in set(self._running.values()):
            self._let_spare_go(call)
        self._waiting, self._running = [], {}
        for worker in self._workers:
            worker.calls = []

    def close(self) -> None:
        """Stop the actors."""
        self.drop()
        for worker in self._workers:
            ray.kill(worker.actor)
            if worker.up:
                self._witness.left()
        self._workers, self._starting = [], {}

    # Actors

    def _start(self, number: int) -> Worker:
        worker = Worker(number, self._make())
        self._starting[worker.actor.__ray_ready__.remote()] = worker
        return worker

    def _is_up(self, reference: ray.ObjectRef) -> None:
        worker = self._starting.pop(reference)
        try:
            ray.get(reference)
        except RayActorError as error:
            self._failed_starts += 1
            if self._failed_starts == DEATHS_ALLOWED:
                raise RunError(f"workers: {DEATHS_ALLOWED} ended while they started; {_last_line(error)}") from error
            if worker in self._workers:
                self._workers[worker.number] = self._start(worker.number)
            for call in self._running.values():
                if call.spare is worker:
                    call.spare, call.began = None, None
        else:
            self._failed_starts, worker.up = 0, True
            if worker in self._workers:
                self._witness.joined()

    def _replace(self, worker: Worker) -> None:
        """End an actor that is dead, slow or out of reach; its calls are queued again, and another takes its place."""
        ray.kill(worker.actor)
        self.restarts += 1
        if worker.up:
            self._witness.lost()
        heir = next((call.spare for call in worker.calls if call.spare is not None), None) or self._start(-1)
        heir.number = worker.number
        self._workers[worker.number] = heir
        if heir.up:
            self._witness.joined()
        for call in worker.calls:
            self._running.pop(call.references[0], None)
            if call.twin:
                call.worker, call.references, call.began = heir, call.twin, None
                heir.calls.append(call)
            else:
                self._witness.again(call)
                self._queue(call)
            call.spare, call.twin = None, []
        worker.calls = []

    # Calls

    def _queue(self, call: Call) -> None:
        call.worker, call.references, call.began = None, [], None
        bisect.insort(self._waiting, call, key=lambda waiting: waiting.number)

    def _send_waiting(self) -> None:
        for call in list(self._waiting):
            if not all(part.references for part in call.built_upon):
                continue
            if call.on is None:
                call.worker = self._choose(call)
                if call.worker is None:
                    continue
                call.worker.calls.append(call)
            self._waiting.remove(call)
            call.references = self._send(call, call.on if call.worker is None else call.worker.actor)

    def _choose(self, call: Call) -> Worker | None:
        """Return the actor for a call, if one has room."""
        if call.beside is not None and call.beside.worker in self._workers and call.beside.worker.up:
            return call.beside.worker
        worker = min((worker for worker in self._workers if worker.up), key=lambda one: one.load, default=None)
        return worker if worker is not None and (worker.load < self._ahead or call.beside is not None) else None

    def _send(self, call: Call, actor: Any) -> list[ray.ObjectRef]:
        made = getattr(actor, call.method).options(num_returns=call.returns).remote(*map(now, call.arguments))
        references = [made] if call.returns == 1 else made
        self._running[references[0]] = call
        return references

    def _settle(self, awaited: Iterable[ray.ObjectRef]) -> None:
        """Wait until one of these has ended or an actor is up, or for a while, and take note of all that has."""
        if references := [*awaited, *self._starting]:
            ray.wait(references, fetch_local=False, timeout=WATCH_SECONDS)
        self.take_note()
        if any(worker.up for worker in self._workers):
            self._manned = time.monotonic()
        elif time.monotonic() - self._manned > PLACEMENT_SECONDS:
            raise _no_room(len(self._workers))

    def _end(self, reference: ray.ObjectRef, call: Call) -> None:
        of_twin = bool(call.twin) and reference == call.twin[0]
        try:
            value = ray.get(reference)
        except RayError as error:
            self._failed(call, error, of_twin=of_twin)
            return
        if of_twin and call.worker is not None:
            self._say(f"{call.label}: the other worker was first; worker {call.worker.number} is replaced")
            self._replace(call.worker)
        self._let_spare_go(call)
        if call.began is not None:
            self._patience.took(call, time.monotonic() - call.began)
        self._take_from_worker(call)
        call.value, call.done = value, True
        call.arguments, call.beside = (), None  # what it was built upon may go

    def _failed(self, call: Call, error: RayError, *, of_twin: bool) -> None:
        """See to a call that failed: by itself, with its actor, or with something that it is built upon."""
        cause, actor = _root(error), call.spare if of_twin else call.worker
        if isinstance(cause, RayActorError):
            if cause.actor_id in (None, _id(call.on if actor is None else actor.actor)):
                self._actor_died(call, actor, cause)
            elif of_twin:
                self._let_spare_go(call)
            else:  # what it is built upon is queued again as well
                self._let_spare_go(call)
                self._take_from_worker(call)
                self._queue(call)
            return
        self._let_spare_go(call)
        self._take_from_worker(call)
        if not isinstance(cause, ObjectLostError):
            cause.__cause__ = error  # the traceback of the other process
            call.error, call.done = cause, True
        elif any(call.built_upon):
            raise LostError(f"{call.label}: what it builds upon is lost with the node it was on") from error
        else:
            self._queue(call)

    def _take_from_worker(self, call: Call) -> None:
        if call.worker is not None and call in call.worker.calls:
            call.worker.calls.remove(call)

    def _actor_died(self, call: Call, worker: Worker | None, error: RayActorError) -> None:
        if worker is None:
            raise LostError(f"{call.label}: the process that was to do it ended") from error
        if worker is call.spare:
            suspect = call
            self._let_spare_go(call)
        else:
            suspect = worker.calls[0]
            self._say(f"worker {worker.number} ended in the course of {suspect.label}; its work is done again")
            self._replace(worker)
        suspect.deaths += 1
        if suspect.deaths >= DEATHS_ALLOWED and suspect in self._waiting:
            self._waiting.remove(suspect)
            raise DeadlyCallError(suspect) from error

    # Slowness

    def _watch(self) -> None:
        """Start the clock of each call that is at work, and give those to a spare actor that take too long."""
        now = time.monotonic()
        own = [call for call in self._running.values() if call.on is not None]
        first = [worker.calls[0] for worker in self._workers if worker.up and worker.calls]
        for call in (*first, *own):
            if call.began is None and all(part.done for part in call.built_upon):
                call.began = now
            elif call.began is not None and call.spare is None and now - call.began > self._patience.with_call(call):
                self._rescue(call, now - call.began)
            elif call.spare is not None and not call.twin and call.spare.up:
                self._witness.again(call)
                call.twin = self._send(call, call.spare.actor)

    def _rescue(self, call: Call, seconds: float) -> None:
        if call.on is not None:
            self._say(f"{call.label}: no answer for {seconds:.1f} s; its actor is ended")
            ray.kill(call.on)
            call.began = None
            return
        number = None if call.worker is None else call.worker.number
        self._say(
            f"worker {number} is slow: {call.label} has taken {seconds:.1f} s, over {SLOWNESS} times what "
            "its like take; it is also given to another"
        )
        call.spare = self._start(-1)

    def _let_spare_go(self, call: Call) -> None:
        if call.spare is not None:
            ray.kill(call.spare.actor)
            self._starting = {up: worker for up, worker in self._starting.items() if worker is not call.spare}
            for reference in call.twin[:1]:
                self._running.pop(reference, None)
            call.spare, call.twin, call.began = None, [], None


def _id(actor: Any) -> str:
    return actor._actor_id.hex()


def _root(error: BaseException) -> BaseException:
    """Return what went wrong at first: each call built upon another adds a layer."""
    while isinstance(error, RayTaskError):
        error = error.cause
    return error


def _last_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip()


def _no_room(size: int) -> NoRoomError:
    return NoRoomError(
        f"workers: got {size}, not all placed after {PLACEMENT_SECONDS} s; the cluster has "
        f"{ray.cluster_resources().get('CPU', 0):.0f} CPUs, {ray.available_resources().get('CPU', 0):.0f} "
        "free; ask for fewer or wait for other jobs to end"
    )
