"""The runner that works in Ray actors."""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from dmil_core.errors import WorkError
from services.cli.live_view import Workers
from services.distributed.cluster import cpus, joined
from services.distributed.errors import DeadlyCallError
from services.distributed.metrics import Meter, RayMeter, WorkerCounter
from services.distributed.ray_meta_training import RayMetaTraining
from services.distributed.runner import Plan
from services.distributed.simulation_worker import SimulationWorker, piece_of_call
from services.suites.base import TaskSuite

if TYPE_CHECKING:
    from services.distributed.actor_pool import Pool
    from services.distributed.calls import Call

POLITENESS = 10
"""How far a simulation beside meta-training stands back, see `os.nice`."""

logger = logging.getLogger(__name__)


class RayRunner:
    """Does the work in Ray actors: those of the cluster this process belongs to, or of one on this machine alone."""

    def __init__(self, suite: TaskSuite, workers: int | None, gpus: float = 0.0) -> None:
        """Join a cluster, or start one, see `services.distributed.cluster`.

        Args:
            suite: whose tasks are worked on.
            workers: of each kind; `None` takes one for each CPU of the cluster. Those that the cluster has no CPU for
                join when it has: a cluster that grows by itself grows for them.
            gpus: that each adaptation worker has to itself, which may be less than one.
        """
        self._cluster = ExitStack()
        self._cluster.enter_context(joined(workers))
        import ray

        from services.distributed.actor_pool import Pool

        self._ray, self._pool = ray, Pool
        self._asked_for, self._gpus = workers, gpus
        if workers is not None and workers > cpus():
            logger.info(f"--workers {workers}: the cluster has {cpus()} CPUs now; further workers join as it grows")
        self.meter: Meter = RayMeter(suite.name)
        self._counter = WorkerCounter("simulation", self.meter)
        self._suite = ray.put(suite)
        self._beside: Pool | None = None
        self._training: RayMetaTraining | None = None

    @property
    def workers(self) -> int:
        """How many workers of each kind there may be now: nodes come and go."""
        return min(self._wanted, cpus())

    @property
    def _wanted(self) -> int:
        """How many there are to be, some of them when the cluster has grown."""
        return self._asked_for or cpus()

    @property
    def worker_counts(self) -> list[Workers]:
        """The workers of each kind that there are, or were."""
        counters = [self._counter] if self._training is None else [self._training.counter, self._counter]
        return [counter.count for counter in counters if counter.count != (counter.count.kind, 0, 0)]

    def share(self, value: Any) -> Any:
        """Put `value` into the object store."""
        return self._ray.put(value)

    def simulate(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Spread the calls over the simulation workers."""
        # While meta-training pauses, its workers keep their CPUs: the simulation's must not wait for one.
        pausing = self._meta_training()
        remote = self._ray.remote(num_cpus=0 if pausing else 1)(SimulationWorker)
        size = min(self.workers if pausing else self._wanted, len(calls))
        pool = self._pool(lambda: remote.remote(self._suite), size, listener=self._counter, min_size=self.workers)
        try:
            with naming_the_deadly():
                yield from pool.results(_submitted(pool, method, calls))
        finally:
            pool.close()

    def simulate_beside(self, method: str, calls: Sequence[tuple[Any, ...]]) -> "RaySimulation":
        """Let one more worker make the calls, which gives way to meta-training and takes no CPU from its count."""
        if self._beside is None:
            remote = self._ray.remote(num_cpus=0)(PoliteSimulationWorker)
            self._beside = self._pool(
                lambda: remote.remote(self._suite), 1, max_in_flight=len(calls), listener=self._counter
            )
        return RaySimulation(self._beside, method, calls)

    def meta_train(self, plan: Plan) -> "RayMetaTraining":
        """Start the learner and the adaptation workers."""
        self._training = RayMetaTraining(
            plan, lambda: self._wanted, gpus=self._gpus, meter=self.meter, min_workers=self.workers
        )
        return self._training

    def _meta_training(self) -> bool:
        return self._training is not None and self._training.alive

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        if self._beside is not None:
            self._beside.close()
        self._cluster.close()


class PoliteSimulationWorker(SimulationWorker):
    """A simulation worker that gives way to whatever else the machine has to do."""

    def __init__(self, suite: TaskSuite) -> None:
        """Simulate the tasks of `suite`."""
        os.nice(POLITENESS)
        super().__init__(suite)


class RaySimulation:
    """Calls that one simulation worker makes, one after the other, while others do something else."""

    def __init__(self, pool: "Pool", method: str, calls: Sequence[tuple[Any, ...]]) -> None:
        """Begin to make the calls."""
        self._pool = pool
        self._calls = _submitted(pool, method, calls)

    def done(self) -> bool:
        """Tell, without waiting, whether all results are there."""
        with naming_the_deadly():
            self._pool.poll()
        return all(call.done for call in self._calls)

    def results(self) -> list[Any]:
        """Wait for all results and return them in the order of the calls."""
        with naming_the_deadly():
            return [self._pool.result(call) for call in self._calls]


def _submitted(pool: "Pool", method: str, calls: Sequence[tuple[Any, ...]]) -> list["Call"]:
    return [pool.submit(method, *arguments, label=piece_of_call(method, arguments)[0]) for arguments in calls]


@contextmanager
def naming_the_deadly() -> Iterator[None]:
    """Tell of a simulation that ends one worker after the other as of an error in it.

    Raises:
        WorkError: names it.
    """
    try:
        yield
    except DeadlyCallError as error:
        _, piece = piece_of_call(error.call.method, error.call.arguments)
        raise WorkError(error.call.label, str(error), str(error), piece) from error
