"""A pool of actors that replaces those that die or hang; it knows nothing of their work."""

import bisect
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import ray
from ray.exceptions import ObjectLostError, OutOfMemoryError, RayActorError, RayError, RayTaskError

from dmil_core.errors import RunError, UserError
from services.distributed.calls import Call, DeadlyCallError, LostError, PoolListener, Worker, referenced
from services.distributed.stragglers import TIMEOUT_FACTOR, Timeouts

PLACEMENT_TIMEOUT_SECONDS = 120
MAX_DEATHS = 3
"""After so many deaths of workers during one call, the call is suspected to cause them."""
POLL_SECONDS = 0.5
DEATHS = (RayActorError, OutOfMemoryError)
"""What Ray raises for a call whose actor died; the second where it has ended it itself, for the node's memory."""

logger = logging.getLogger(__name__)


class Pool:
    """Stateless actors of one kind; a call whose actor dies is sent again, to whichever has room.

    Calls are sent in the order of their submission, and may depend on the results of others that are still in flight:
    those travel from actor to actor, and the caller need not wait. If a call is lost, all that depend on it fail with
    it, and are sent again too. A call that takes far longer than others of its method is also sent to a backup: the
    first answer counts, for both are equal, and the slower actor is killed.
    """

    def __init__(
        self,
        start_actor: Callable[[], Any],
        size: int,
        max_in_flight: int = 1,
        listener: PoolListener | None = None,
        min_size: int | None = None,
        start_backup: Callable[[], Any] | None = None,
    ) -> None:
        """Start `size` actors and wait until `min_size` are healthy; the others join when the cluster has room.

        An actor that waits for room is what makes an autoscaling cluster grow.

        Args:
            start_actor: returns a new actor.
            size: number of actors.
            max_in_flight: calls sent to an actor at a time. With 2 its next one is at hand when it ends one.
            listener: receives the events of the pool.
            min_size: actors that have room now, all by default.
            start_backup: returns a new actor that waits for no CPU, which the slow one may hold; `start_actor` by
                default.

        Raises:
            UserError: if the cluster cannot place that many.
        """
        self._start_actor, self._max_in_flight, self._listener = start_actor, max_in_flight, listener or PoolListener()
        self._start_backup = start_backup or start_actor
        self._workers: list[Worker] = []
        self._starting: dict[ray.ObjectRef, Worker] = {}
        self._queued: list[Call] = []
        self._running: dict[ray.ObjectRef, Call] = {}
        self._timeouts = Timeouts()
        self._submitted = self._failed_starts = 0
        self._healthy_at = time.monotonic()
        """When a worker was last seen to be healthy."""
        self.grow(size)
        deadline = time.monotonic() + PLACEMENT_TIMEOUT_SECONDS
        while len(self) < (size if min_size is None else min(min_size, size)):
            self._wait([])
            if time.monotonic() > deadline:
                self.close()
                raise _no_room(size)

    def __len__(self) -> int:
        """Return the number of healthy workers."""
        return sum(worker.healthy for worker in self._workers)

    def grow(self, size: int) -> None:
        """Start workers until there are `size`, without waiting for them; each receives calls once it is healthy."""
        for number in range(len(self._workers), size):
            self._workers.append(self._start_worker(number))

    def submit(
        self,
        method: str,
        *arguments: Any,
        returns: int = 1,
        same_worker_as: Call | None = None,
        actor: Any | None = None,
        label: str = "",
    ) -> Call:
        """Queue a call of a method, to be sent as soon as a worker has room.

        Args:
            method: of the actors.
            arguments: values, object references, calls or lists of calls, see `Call`.
            returns: number of results. The first is fetched, the others stay object references.
            same_worker_as: call whose worker is to run it, however busy that is; by default the least busy one does.
            actor: one outside the pool to run it, which is not replaced if it dies.
            label: its name in messages.
        """
        call = Call(self._submitted, method, arguments, returns, same_worker_as, actor, label or method)
        self._submitted += 1
        self._queue(call)
        self._send_queued()
        return call

    def result(self, call: Call) -> Any:
        """Wait until a call is done, and return its first result.

        Raises:
            DeadlyCallError: if three workers die one after the other during one call.
            LostError: if an actor outside the pool is gone, or a result that a call depends on.
            UserError: if no worker is left, and none can be placed.
            Exception: whatever the call raised.
        """
        while not call.done:
            # Queued calls are sent when any call ends; without them, only this call matters.
            self._wait(self._running if self._queued else [*call.references[:1], *call.backup_references[:1]])
        if call.error is not None:
            raise call.error
        return call.value

    def results(self, calls: Sequence[Call]) -> Iterator[tuple[int, Any]]:
        """Yield each call's index and first result as they arrive.

        Raises:
            DeadlyCallError: as `result`, and the others.
        """
        pending = dict(enumerate(calls))
        while pending:
            for index in [index for index, call in pending.items() if call.done]:
                yield index, self.result(pending.pop(index))
            if pending:
                self._wait(self._running)

    def poll(self) -> None:
        """Process what has ended by now, without waiting, and start backups of slow calls."""
        calls = [*self._running, *self._starting]
        if calls:
            ended, _ = ray.wait(calls, num_returns=len(calls), timeout=0, fetch_local=False)
            for reference in ended:
                if reference in self._starting:
                    self._finish_start(reference)
                elif reference in self._running:  # else the call's other attempt ended in this very loop
                    self._finish(reference, self._running.pop(reference))
        self._send_queued()
        self._check_timeouts()

    def retry(self, call: Call) -> None:
        """Queue a call again that was suspected to kill its workers."""
        self._listener.call_resent(call)
        call.deaths = 0
        self._queue(call)
        self._send_queued()

    def discard_calls(self) -> None:
        """Forget all calls; those in flight end with nobody waiting for them."""
        for call in set(self._running.values()):
            self._drop_backup(call)
        self._queued, self._running = [], {}
        for worker in self._workers:
            worker.in_flight = []

    def close(self) -> None:
        """Stop the actors."""
        self.discard_calls()
        for worker in self._workers:
            ray.kill(worker.actor)
            if worker.healthy:
                self._listener.worker_stopped()
        self._workers, self._starting = [], {}

    # Workers

    def _start_worker(self, number: int, start: Callable[[], Any] | None = None) -> Worker:
        worker = Worker(number, (start or self._start_actor)())
        self._starting[worker.actor.__ray_ready__.remote()] = worker
        return worker

    def _finish_start(self, reference: ray.ObjectRef) -> None:
        worker = self._starting.pop(reference)
        try:
            ray.get(reference)
        except DEATHS as error:
            self._failed_starts += 1
            if self._failed_starts == MAX_DEATHS:
                raise RunError(f"workers: {MAX_DEATHS} ended while they started; {_last_line(error)}") from error
            if worker in self._workers:
                self._workers[worker.number] = self._start_worker(worker.number)
            for call in self._running.values():
                if call.backup is worker:
                    call.backup, call.started = None, None
        else:
            self._failed_starts, worker.healthy = 0, True
            if worker in self._workers:
                self._listener.worker_started()

    def _replace(self, worker: Worker) -> None:
        """Kill a worker that is dead, slow or out of reach, put another in its place, and send its calls again."""
        ray.kill(worker.actor)
        if worker.healthy:
            self._listener.worker_lost()
        backups = (call.backup for call in worker.in_flight if call.backup is not None)
        replacement = next(backups, None) or self._start_worker(worker.number)
        replacement.number = worker.number
        self._workers[worker.number] = replacement
        if replacement.healthy:
            self._listener.worker_started()
        for call in worker.in_flight:
            self._running.pop(call.references[0], None)
            if call.backup_references:
                call.worker, call.references, call.started = replacement, call.backup_references, None
                replacement.in_flight.append(call)
            else:
                self._listener.call_resent(call)
                self._queue(call)
            call.backup, call.backup_references = None, []
        worker.in_flight = []

    # Calls

    def _queue(self, call: Call) -> None:
        call.worker, call.references, call.started = None, [], None
        bisect.insort(self._queued, call, key=lambda queued: queued.number)

    def _send_queued(self) -> None:
        for call in list(self._queued):
            if not all(dependency.references for dependency in call.dependencies):
                continue
            if call.actor is None:
                call.worker = self._choose_worker(call)
                if call.worker is None:
                    continue
                call.worker.in_flight.append(call)
            self._queued.remove(call)
            call.references = self._send(call, call.actor if call.worker is None else call.worker.actor)

    def _choose_worker(self, call: Call) -> Worker | None:
        """Return the worker for a call, if one has room."""
        neighbour = call.same_worker_as
        if neighbour is not None and neighbour.worker in self._workers and neighbour.worker.healthy:
            return neighbour.worker
        worker = min((worker for worker in self._workers if worker.healthy), key=lambda one: one.load, default=None)
        has_room = worker is not None and (worker.load < self._max_in_flight or neighbour is not None)
        return worker if has_room else None

    def _send(self, call: Call, actor: Any) -> list[ray.ObjectRef]:
        method = getattr(actor, call.method).options(num_returns=call.returns)
        results = method.remote(*map(referenced, call.arguments))
        references = [results] if call.returns == 1 else results
        self._running[references[0]] = call
        return references

    def _wait(self, references: Iterable[ray.ObjectRef]) -> None:
        """Wait until one of these has ended, a worker has started, or a while has passed; then `poll`."""
        if awaited := [*references, *self._starting]:
            ray.wait(awaited, fetch_local=False, timeout=POLL_SECONDS)
        self.poll()
        if len(self):
            self._healthy_at = time.monotonic()
        elif time.monotonic() - self._healthy_at > PLACEMENT_TIMEOUT_SECONDS:
            raise _no_room(len(self._workers))

    def _finish(self, reference: ray.ObjectRef, call: Call) -> None:
        from_backup = reference in call.backup_references
        try:
            value = ray.get(reference)
        except RayError as error:
            self._fail(call, error, from_backup=from_backup)
            return
        if from_backup and call.worker is not None:
            logger.warning(f"{call.label}: the backup was first; worker {call.worker.number} is replaced")
            self._replace(call.worker)
        self._drop_backup(call)
        if call.started is not None:
            self._timeouts.record(call, time.monotonic() - call.started)
        self._remove_from_worker(call)
        call.value, call.done = value, True
        call.arguments, call.same_worker_as = (), None  # the results it depended on may be freed

    def _fail(self, call: Call, error: RayError, *, from_backup: bool) -> None:
        """Process the failure of a call: its own, its actor's, or that of a dependency."""
        cause, worker = _root_cause(error), call.backup if from_backup else call.worker
        if isinstance(cause, DEATHS):
            if getattr(cause, "actor_id", None) in (None, _id(call.actor if worker is None else worker.actor)):
                self._handle_death(call, worker, cause)
                return
            self._drop_backup(call)
            if not from_backup:  # the dependency is queued again as well
                self._remove_from_worker(call)
                self._queue(call)
            return
        self._drop_backup(call)
        self._remove_from_worker(call)
        if not isinstance(cause, ObjectLostError):
            cause.__cause__ = error  # the traceback of the other process
            call.error, call.done = cause, True
        elif any(call.dependencies):
            raise LostError(f"{call.label}: a result that it depends on is lost with its node") from error
        else:
            self._queue(call)

    def _remove_from_worker(self, call: Call) -> None:
        if call.worker is not None and call in call.worker.in_flight:
            call.worker.in_flight.remove(call)

    def _handle_death(self, call: Call, worker: Worker | None, error: RayError) -> None:
        """Replace a worker that died during a call, and count the death against the call that it was running."""
        why = " for want of memory" if isinstance(error, OutOfMemoryError) else ""
        if worker is None:
            raise LostError(f"{call.label}: its actor died{why}") from error
        if worker is call.backup:
            suspect = call
            self._drop_backup(call)
        else:
            suspect = worker.in_flight[0]
            logger.warning(
                f"worker {worker.number} ended{why} in the course of {suspect.label}; its calls are sent again"
            )
            self._replace(worker)
        suspect.deaths += 1
        if suspect.deaths >= MAX_DEATHS and suspect in self._queued:
            self._queued.remove(suspect)
            raise DeadlyCallError(suspect) from error

    # Stragglers

    def _check_timeouts(self) -> None:
        """Note when each call starts to run, and send those to a backup that run too long."""
        now = time.monotonic()
        outside = [call for call in self._running.values() if call.actor is not None]
        first = [worker.in_flight[0] for worker in self._workers if worker.healthy and worker.in_flight]
        for call in (*first, *outside):
            if call.started is None and all(dependency.done for dependency in call.dependencies):
                call.started = now
            elif call.started is not None and call.backup is None and now - call.started > self._timeouts.seconds(call):
                self._time_out(call, now - call.started)
            elif call.backup is not None and not call.backup_references and call.backup.healthy:
                self._listener.call_resent(call)
                call.backup_references = self._send(call, call.backup.actor)

    def _time_out(self, call: Call, seconds: float) -> None:
        """Start a backup of a slow call; kill its actor where that is outside the pool."""
        if call.actor is not None:
            logger.warning(f"{call.label}: no answer for {seconds:.1f} s; its actor is ended")
            ray.kill(call.actor)
            call.started = None
            return
        assert call.worker is not None
        logger.warning(
            f"worker {call.worker.number} is slow: {call.label} has taken {seconds:.1f} s, over {TIMEOUT_FACTOR} times "
            "the median; a backup runs it too"
        )
        call.backup = self._start_worker(-1, self._start_backup)

    def _drop_backup(self, call: Call) -> None:
        if call.backup is not None:
            ray.kill(call.backup.actor)
            self._starting = {start: worker for start, worker in self._starting.items() if worker is not call.backup}
            for reference in call.backup_references[:1]:
                self._running.pop(reference, None)
            call.backup, call.backup_references, call.started = None, [], None


def _id(actor: Any) -> str:
    return actor._actor_id.hex()


def _root_cause(error: BaseException) -> BaseException:
    """Return the first failure: each call that depends on another adds a layer."""
    while isinstance(error, RayTaskError):
        error = error.cause
    return error


def _last_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip()


def _no_room(size: int) -> UserError:
    return UserError(
        f"workers: got {size}, not all placed after {PLACEMENT_TIMEOUT_SECONDS} s; the cluster has "
        f"{ray.cluster_resources().get('CPU', 0):.0f} CPUs, {ray.available_resources().get('CPU', 0):.0f} "
        "free; ask for fewer or wait for other jobs to end"
    )
