"""Where an experiment's work is done: in this process, or by Ray actors; both end with the same bits."""

import logging
import os
import secrets
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import torch

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import MetaLearner
from dmil_core.outer_loop import OuterState, groups
from services.actors.adaptation import AdaptationWorker
from services.actors.learner import Learner
from services.actors.simulation import SimulationWorker
from services.suites.base import TaskSuite

__all__ = ["LocalRunner", "MetaTraining", "RayRunner", "Runner"]

OBJECT_STORE_BYTES = 500_000_000


class MetaTraining(NamedTuple):
    """What meta-training starts from; only the state changes on the way."""

    method: MetaLearner[Any]
    shapes: Mapping[str, torch.Size]
    """Names and shapes of the parameters, in the order in which they are laid out flat."""
    demonstrations: Mapping[str, Sequence[Demonstration]]
    """The training demonstrations of each meta-training task."""
    state: OuterState
    settings: TrainingConfig
    seed: int


class Runner(Protocol):
    """Does an experiment's work, wherever that is."""

    workers: int

    def share(self, value: Any) -> Any:
        """Return what to pass in calls instead of `value`, so that it travels once."""
        ...

    def simulate(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Call a method of the simulation workers with each of `calls`; yield index and result as they come."""
        ...

    def start_training(self, plan: MetaTraining) -> None:
        """Make the learner and the adaptation workers."""
        ...

    def iterate(self, iteration: int, tasks: Sequence[str]) -> tuple[list[Mapping[str, float]], float]:
        """Do one iteration; return the metrics of each slot and the gradient's norm before clipping."""
        ...

    def state(self) -> OuterState:
        """Return the learner's state after the last whole iteration."""
        ...

    def end_training(self) -> None:
        """Let the learner and the adaptation workers go."""
        ...

    def close(self) -> None:
        """Stop everything that was started."""
        ...


class LocalRunner:
    """Does all work in this process: for tests, debuggers and notebooks."""

    workers = 1

    def __init__(self, suite: TaskSuite) -> None:
        """Work on the tasks of `suite`."""
        self._simulation = SimulationWorker(suite)

    def share(self, value: Any) -> Any:
        """Return `value`."""
        return value

    def simulate(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Make the calls one after the other."""
        for index, call in enumerate(calls):
            yield index, getattr(self._simulation, method)(*call)

    def start_training(self, plan: MetaTraining) -> None:
        """Make the learner and one adaptation worker."""
        self._groups = groups(plan.settings)
        self._learner = Learner(plan.state, plan.settings)
        self._worker = AdaptationWorker(plan.method, plan.shapes, plan.demonstrations, plan.seed)
        self._parameters = self._learner.parameters()

    def iterate(self, iteration: int, tasks: Sequence[str]) -> tuple[list[Mapping[str, float]], float]:
        """Compute the groups one after the other."""
        results = [self._worker.gradient(self._parameters, iteration, tasks, slots) for slots in self._groups]
        with _undisturbed():
            norm, self._parameters = self._learner.step(*(gradient for _, gradient in results))
        return [metrics for group, _ in results for metrics in group], norm

    def state(self) -> OuterState:
        """Return the learner's state."""
        return self._learner.state()

    def end_training(self) -> None:
        """Nothing to let go."""

    def close(self) -> None:
        """Nothing to stop."""


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
        self._simulation: Pool | None = None
        self._adaptation: Pool | None = None

    def share(self, value: Any) -> Any:
        """Put `value` into the object store."""
        return self._ray.put(value)

    def simulate(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Spread the calls over the simulation workers."""
        remote = self._ray.remote(num_cpus=1)(SimulationWorker)
        pool = self._pool(lambda: remote.remote(self._suite), min(self.workers, len(calls)))
        try:
            yield from pool.map(method, calls)
        finally:
            pool.close()

    def start_training(self, plan: MetaTraining) -> None:
        """Start the learner and the adaptation workers; the demonstrations travel to each node once."""
        self._groups = groups(plan.settings)
        self._learner: Any = self._ray.remote(num_cpus=0)(Learner).remote(plan.state, plan.settings)
        self._parameters = self._learner.parameters.remote()
        remote = self._ray.remote(num_cpus=1)(AdaptationWorker)
        shared = self._ray.put(plan.demonstrations)
        self._adaptation = self._pool(
            lambda: remote.remote(plan.method, plan.shapes, shared, plan.seed), min(self.workers, len(self._groups))
        )

    def iterate(self, iteration: int, tasks: Sequence[str]) -> tuple[list[Mapping[str, float]], float]:
        """Spread the groups over the workers; their gradients go from there to the learner."""
        assert self._adaptation is not None
        calls = [(self._parameters, iteration, tasks, slots) for slots in self._groups]
        results = dict(self._adaptation.map("gradient", calls, returns=2))
        gradients = [results[group][1] for group in range(len(calls))]
        norm, self._parameters = self._learner.step.options(num_returns=2).remote(*gradients)
        return [metrics for group in range(len(calls)) for metrics in results[group][0]], self._ray.get(norm)

    def state(self) -> OuterState:
        """Fetch the learner's state."""
        return self._ray.get(self._learner.state.remote())

    def end_training(self) -> None:
        """Stop the learner and the adaptation workers."""
        if self._adaptation is not None:
            self._adaptation.close()
            self._ray.kill(self._learner)
            self._adaptation = None

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM wait: a step of Adam cut in the middle is no state to go on from."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    before = {
        number: signal.signal(number, lambda number, frame: waiting.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in waiting:
            signal.raise_signal(number)


def _secure_local_cluster() -> None:
    """Bind Ray to loopback, ask for a token that only this process's children know, send no usage statistics.

    Ray reads these when it is imported.
    """
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
