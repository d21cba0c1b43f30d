"""The runner whose workers are Ray actors, and the choice between it and the one in this process."""

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from dmil_core.devices import USUAL, Compute, device_of
from dmil_core.errors import UserError, WorkError
from dmil_core.methods.base import Method
from services.cli.live_view import Workers
from services.distributed.calls import Call, DeadlyCallError
from services.distributed.cluster import RunnerKind, cpus, joined, named_address
from services.distributed.gpus import SHARES, cluster_gpus, gpus_of_each
from services.distributed.metrics import Meter, RayMeter, WorkerCounter
from services.distributed.ray_meta_training import RayMetaTraining
from services.distributed.runner import LocalRunner, Plan, Runner
from services.distributed.simulation_worker import SimulationWorker, WorkItem
from services.storage.redaction import error_line
from services.suites.base import TaskSuite

if TYPE_CHECKING:
    from services.distributed.actor_pool import Pool

NICENESS = 10
"""Of the simulation worker in the background, see `os.nice`."""

logger = logging.getLogger(__name__)
T = TypeVar("T")


@contextmanager
def open_runner(
    kind: RunnerKind,
    suite: TaskSuite,
    workers: int | None,
    compute: Compute = USUAL,
    gpus: float | None = None,
) -> Iterator[Runner]:
    """Open a runner and close it in the end, whatever happens.

    Raises:
        UserError: if there is nobody to work, or no GPU where there must be one.
    """
    if workers is not None and workers < 1:
        raise UserError(f"--workers: got {workers}; wanted at least 1; leave it out for one for each CPU")
    local = kind == "local"
    runner: Runner = LocalRunner(suite, compute) if local else RayRunner(suite, workers, gpus, compute)
    try:
        yield runner
    finally:
        runner.close()


def check_compute(kind: RunnerKind, compute: Compute, method: type[Method[Any]], gpus: float | None = None) -> None:
    """Refuse, before there is any folder, what a method or this machine does not have.

    Raises:
        UserError: for a device, a path or a part of a GPU that cannot be.
    """
    compute.check(method)
    if gpus is not None and (kind == "local" or not 0 < gpus <= 1):
        where = " with --runner local" if kind == "local" else ""
        raise UserError(f"--gpus: got {gpus}{where}; wanted above 0 and at most 1 of each of Ray's workers, or none")
    if kind == "ray" and compute.wants_gpu and compute.device != "cuda":
        raise UserError(f"--device: got {compute.device} with Ray, which picks a worker's GPU; wanted cuda")
    if kind == "local" or named_address() is None:  # Ray is started on this machine
        device_of(compute.device)


class RayRunner:
    """Runs all work in Ray actors, of the cluster that this process belongs to or of one on this machine."""

    def __init__(
        self, suite: TaskSuite, workers: int | None, gpus: float | None = None, compute: Compute = USUAL
    ) -> None:
        """Join a cluster, or start one, see `services.distributed.cluster`.

        There are so many workers of each kind, by default one for each CPU of the cluster. Those that have no CPU yet
        join when they have: an autoscaling cluster grows for them. Each has `gpus`, at most one; if not given none, or
        an equal part of the cluster's if there must be one.

        Raises:
            UserError: if there must be a GPU, and the cluster has none.
        """
        with ExitStack() as opening:
            opening.enter_context(joined(workers))
            import ray

            from services.distributed.actor_pool import Pool

            self._ray, self._pool = ray, Pool
            self._requested, self._compute = workers, compute
            if workers is not None and workers > cpus():
                logger.info(f"--workers {workers}: the cluster has {cpus()} CPUs now; further workers join as it grows")
            self.meter: Meter = RayMeter(suite.name)
            self._counter = WorkerCounter("simulation", self.meter)
            self._gpus = gpus_of_each(compute, gpus, self._wanted_workers)
            self._suite = put_suite(suite, ray.put)
            self._cluster = opening.pop_all()
        self._background: Pool | None = None
        self._training: RayMetaTraining | None = None

    @property
    def workers(self) -> int:
        """How many workers of each kind there may be now: nodes come and go."""
        room = max(1, int(cluster_gpus() / self._gpus + 1e-6)) if self._gpus else self._wanted_workers
        return min(self._wanted_workers, cpus(), room)

    @property
    def _wanted_workers(self) -> int:
        """How many workers of each kind there are once the cluster has grown."""
        return self._requested or cpus()

    @property
    def worker_counts(self) -> list[Workers]:
        """The workers of each kind that there are, or were."""
        counters = [self._counter] if self._training is None else [self._training.counter, self._counter]
        return [counter.count for counter in counters if counter.count != (counter.count.kind, 0, 0)]

    def share(self, value: T) -> Callable[[], T]:
        """Put `value` into the object store, and return a function that fetches it."""
        return partial(self._ray.get, self._ray.put(value))

    def simulate(self, items: Sequence[WorkItem[T]]) -> Iterator[tuple[int, T]]:
        """Spread the items over the simulation workers."""
        # While meta-training pauses, its workers keep their CPUs: the simulation's must not wait for one.
        pausing = self._training is not None and self._training.alive
        size = min(self.workers if pausing else self._wanted_workers, len(items))

        def start(cpus: int) -> Any:
            share = self._gpus * SHARES["simulation"]
            return self._ray.remote(num_cpus=cpus, num_gpus=share)(SimulationWorker).remote(self._suite, self._compute)

        pool = self._pool(
            lambda: start(0 if pausing else 1),
            size,
            listener=self._counter,
            min_size=self.workers,
            start_backup=lambda: start(0),
        )
        try:
            with _naming_deadly_items():
                yield from results_tried_again(pool, _submit(pool, items), set())
        finally:
            pool.close()

    def simulate_in_background(self, items: Sequence[WorkItem[T]]) -> "RaySimulation[T]":
        """Run the items on one more worker, which gives way to meta-training and takes no CPU from its count."""
        if self._background is None:
            share = self._gpus * SHARES["background"]
            remote = self._ray.remote(num_cpus=0, num_gpus=share)(BackgroundSimulationWorker)
            self._background = self._pool(
                lambda: remote.remote(self._suite, self._compute), 1, max_in_flight=len(items), listener=self._counter
            )
        return RaySimulation(self._background, items)

    def meta_train(self, plan: Plan) -> RayMetaTraining:
        """Start the learner and the adaptation workers."""
        self._training = RayMetaTraining(
            plan,
            lambda: self._wanted_workers,
            gpus=self._gpus,
            meter=self.meter,
            min_workers=self.workers,
            compute=self._compute,
        )
        return self._training

    def close(self) -> None:
        """Leave the cluster; one that was started here is stopped."""
        if self._background is not None:
            self._background.close()
        self._cluster.close()


class BackgroundSimulationWorker(SimulationWorker):
    """A simulation worker of low priority."""

    def __init__(self, suite: TaskSuite, compute: Compute = USUAL) -> None:
        os.nice(NICENESS)
        super().__init__(suite, compute)


class RaySimulation(Generic[T]):
    """Work items that one simulation worker runs in the background."""

    def __init__(self, pool: "Pool", items: Sequence[WorkItem[T]]) -> None:
        self._pool, self._calls = pool, _submit(pool, items)
        self._suspects = set[int]()

    def done(self) -> bool:
        """Return, without waiting, whether all results are there."""
        with _naming_deadly_items():
            try:
                self._pool.poll()
            except DeadlyCallError as error:
                try_again(self._pool, error, self._suspects)
        return all(call.done for call in self._calls)

    def result(self) -> list[T]:
        """Wait for all results and return them in the order of the items."""
        with _naming_deadly_items():
            found = dict(results_tried_again(self._pool, self._calls, self._suspects))
        return [found[index] for index in range(len(self._calls))]


def put_suite(suite: TaskSuite, put: Callable[[object], T]) -> T:
    """Return what `put`, as Ray's, makes of a suite that travels to workers.

    Raises:
        UserError: names the members that cannot, in place of Ray's own parts.
    """

    def refusal(value: object) -> str:
        try:
            put(value)
        except Exception as error:  # noqa: BLE001  an object may raise anything when it is pickled
            return error_line(error)
        return ""

    try:
        return put(suite)
    except Exception as error:
        members = {name: why for name, value in vars(suite).items() if (why := refusal(value))}
        raise UserError(
            f"{suite.name}: {', '.join(members) or 'the suite'}: got what cannot be pickled "
            f"({next(iter(members.values()), error_line(error))}); wanted a suite that travels to workers, see "
            "docs/your-own-task.md: make it in make_env, or give --runner local"
        ) from error


def _submit(pool: "Pool", items: Sequence[WorkItem[Any]]) -> list[Call]:
    return [pool.submit("run", item, label=item.label) for item in items]


def results_tried_again(pool: "Pool", calls: Sequence[Call], suspects: set[int]) -> Iterator[tuple[int, Any]]:
    """Yield each call's index and result as they arrive; one that seems to kill its workers is tried once more.

    Raises:
        DeadlyCallError: as `try_again`.
    """
    left = dict(enumerate(calls))
    while left:
        indices = list(left)
        try:
            for position, value in pool.results(list(left.values())):
                del left[indices[position]]
                yield indices[position], value
        except DeadlyCallError as error:
            try_again(pool, error, suspects)


def try_again(pool: "Pool", error: DeadlyCallError, suspects: set[int]) -> None:
    """Try a call once more during which workers ended: who ended them for another reason hardly ends so many again.

    Raises:
        DeadlyCallError: if it was tried again already, and so is among the suspects.
    """
    if error.call.number in suspects:
        raise error
    suspects.add(error.call.number)
    logger.warning(f"{error}; it is tried once more")
    pool.retry(error.call)


@contextmanager
def _naming_deadly_items() -> Iterator[None]:
    """Raise a `WorkError` for an item during which one worker after the other died."""
    try:
        yield
    except DeadlyCallError as error:
        (item,) = error.call.arguments
        raise WorkError(item.label, str(error), str(error), item.key) from error
