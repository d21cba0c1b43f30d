"""The runner that works in Ray actors."""

import logging
import os
import secrets
import signal
import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from dmil_core.outer_loop import OuterState, blocks, groups
from services.actors.adaptation import AdaptationWorker, BlockReport
from services.actors.learner import Learner, StepReport
from services.actors.simulation import SimulationWorker
from services.runners import Iteration, Plan
from services.suites.base import TaskSuite
from services.timing import Span, Timing

if TYPE_CHECKING:
    from services.actors.pool import Call, Pool

__all__ = ["FAN_IN", "RayMetaTraining", "RayRunner"]

OBJECT_STORE_BYTES = 500_000_000
FAN_IN = 8
"""Gradients that one worker adds at a time, a power of two; it does not change the result."""
POLITENESS = 10
"""How far a simulation beside meta-training stands back, see `os.nice`."""


class RayRunner:
    """Does the work in Ray actors: those of the cluster this process belongs to, or of one on this machine alone."""

    def __init__(self, suite: TaskSuite, workers: int | None) -> None:
        """Join the cluster that ``RAY_ADDRESS`` names, as in a Ray job, or start one that listens on loopback only.

        Args:
            suite: whose tasks are worked on.
            workers: of each kind; `None` takes one for each CPU of the cluster.
        """
        if "RAY_ADDRESS" not in os.environ:
            _secure_local_cluster()
        # Ray would print every error of a call that the pool made again.
        os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")
        import ray

        self._ray = ray
        on_termination = signal.getsignal(signal.SIGTERM)
        if "RAY_ADDRESS" in os.environ:
            ray.init(logging_level=logging.WARNING)
        else:
            ray.init(
                address="local",
                num_cpus=max(os.cpu_count() or 1, workers or 0),
                include_dashboard=False,
                object_store_memory=OBJECT_STORE_BYTES,
                logging_level=logging.WARNING,
                log_to_driver=False,
                _node_ip_address="127.0.0.1",
            )
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, on_termination)  # Ray puts its own there, which ends at once
        from services.actors.pool import Pool

        self._pool = Pool
        self.workers = workers or int(ray.cluster_resources().get("CPU", 1))
        self._suite = ray.put(suite)
        self._beside: Pool | None = None
        self._training: RayMetaTraining | None = None

    def share(self, value: Any) -> Any:
        """Put `value` into the object store."""
        return self._ray.put(value)

    def simulate(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Spread the calls over the simulation workers."""
        # While meta-training pauses, its workers keep their CPUs: the simulation's must not wait for one.
        remote = self._ray.remote(num_cpus=0 if self._meta_training() else 1)(SimulationWorker)
        pool = self._pool(lambda: remote.remote(self._suite), min(self.workers, len(calls)))
        try:
            yield from pool.map(method, calls)
        finally:
            pool.close()

    def simulate_beside(self, method: str, calls: Sequence[tuple[Any, ...]]) -> "RaySimulation":
        """Let one more worker make the calls, which gives way to meta-training and takes no CPU from its count."""
        if self._beside is None:
            remote = self._ray.remote(num_cpus=0)(PoliteSimulationWorker)
            self._beside = self._pool(lambda: remote.remote(self._suite), 1, ahead=len(calls))
        return RaySimulation(self._beside, method, calls)

    def meta_train(self, plan: Plan) -> "RayMetaTraining":
        """Start the learner and the adaptation workers."""
        self._training = RayMetaTraining(plan, self.workers)
        return self._training

    def _meta_training(self) -> bool:
        return self._training is not None and self._training.alive

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


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
        self._calls = [pool.submit(method, *arguments) for arguments in calls]

    def done(self) -> bool:
        """Tell, without waiting, whether all results are there."""
        self._pool.take_note()
        return all(call.done for call in self._calls)

    def results(self) -> list[Any]:
        """Wait for all results and return them in the order of the calls."""
        return [self._pool.result(call) for call in self._calls]


class RayMetaTraining:
    """A learner and adaptation workers as actors.

    An iteration is a graph of calls: gradients of blocks, a tree of sums, the outer step. The calls of one iteration
    take the results of others by reference, from actor to actor, and the next gradients already wait at the workers
    for the parameters when those are made. So between two outer steps no worker waits for this process.
    """

    def __init__(self, plan: Plan, workers: int, fan_in: int = FAN_IN) -> None:
        """Start the actors; the demonstrations travel to each node once.

        Args:
            plan: what to do.
            workers: adaptation workers; no more than there are groups are started.
            fan_in: gradients that a worker adds at a time, a power of two.
        """
        import ray

        from services.actors.pool import Pool

        self._ray, self._plan, self._next, self._fan_in = ray, plan, plan.state.iteration, fan_in
        all_groups = groups(plan.settings)
        workers = min(workers, len(all_groups))
        self.blocks = blocks(all_groups, workers)
        # Out of order, so that the state can be had while a step waits for its gradients. One step waits at a time.
        learner: Any = ray.remote(num_cpus=0)(Learner).options(allow_out_of_order_execution=True)
        self._learner = learner.remote(plan.state, plan.settings)
        remote, shared = ray.remote(num_cpus=1)(AdaptationWorker), ray.put(plan.demonstrations)
        self._pool = Pool(lambda: remote.remote(plan.method, plan.shapes, shared, plan.seed), size=workers, ahead=2)
        self._parameters = self._pool.submit("parameters", returns=2, on=self._learner)
        self._ready: float = self._pool.result(self._parameters)
        self.alive = True

    def __len__(self) -> int:
        return len(self._pool)

    @property
    def restarts(self) -> int:
        """How many workers died and were replaced."""
        return self._pool.restarts

    def iterations(self, count: int) -> Iterator[Iteration]:
        """Do the next `count` iterations."""
        gradients = self._gradients(self._next) if count else []
        for left in reversed(range(count)):
            total = self._add(gradients)
            step = self._parameters = self._pool.submit("step", total, returns=2, on=self._learner)
            ahead = self._gradients(self._next + 1) if left else []
            yield self._finish(step, gradients)
            gradients = ahead

    def _gradients(self, iteration: int) -> list["Call"]:
        """Have the gradient of each block computed."""
        tasks = self._plan.tasks(iteration)
        calls: list[Call] = []
        for index, block in enumerate(self.blocks):
            part = calls[index - index % self._fan_in :] if self._one_block_each else []
            last = len(part) == self._fan_in - 1 or index == len(self.blocks) - 1
            before = part if last else []
            calls.append(self._pool.submit("gradient", self._parameters, iteration, tasks, block, before, returns=2))
        return calls

    @property
    def _one_block_each(self) -> bool:
        """Whether all blocks are computed side by side: then the last of each few adds the others itself.

        That saves a hop. Where blocks wait for a worker, none should stand and wait for another's gradient.
        """
        return len(self.blocks) <= len(self)

    def _add(self, gradients: Sequence["Call"]) -> "Call":
        """Have gradients added by the workers that computed the last of each few, until one is left."""
        if self._one_block_each:
            gradients = [*gradients[self._fan_in - 1 : -1 : self._fan_in], gradients[-1]]
        while len(gradients) > 1:
            parts = [gradients[first : first + self._fan_in] for first in range(0, len(gradients), self._fan_in)]
            gradients = [
                self._pool.submit("add", *part, returns=2, beside=part[-1]) if len(part) > 1 else part[0]
                for part in parts
            ]
        return gradients[0]

    def _finish(self, step: "Call", gradients: Sequence["Call"]) -> Iteration:
        """Wait for an outer step, and put together what is told of its iteration."""
        stepped: StepReport = self._pool.result(step)
        reports: list[BlockReport] = [self._pool.result(call) for call in gradients]
        work: dict[int, list[Span]] = defaultdict(list)
        for call, report in zip(gradients, reports, strict=True):
            work[call.worker or 0].append(report.span)
        timing = Timing.of(self._ready, work, stepped.span)
        self._next, self._ready = self._next + 1, stepped.span.ended
        slots = [metrics for report in reports for metrics in report.metrics]
        return Iteration(self._next, slots, stepped.gradient_norm, timing)

    def state(self) -> OuterState:
        """Fetch the learner's state."""
        return self._ray.get(self._learner.state.remote())

    def close(self) -> None:
        """Stop the actors."""
        if self.alive:
            self._pool.close()
            self._ray.kill(self._learner)
            self.alive = False


def _secure_local_cluster() -> None:
    """Bind Ray to loopback, ask for a token that only this process's children know, send no usage statistics.

    Ray reads these when it is imported.
    """
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
