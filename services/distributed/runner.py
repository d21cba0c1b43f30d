"""Runners of an experiment's work, and the one in this process; that of `ray_runner` gives the same bits."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple, Protocol, TypeVar

import torch

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.devices import USUAL, Compute
from dmil_core.methods.base import MetaLearner
from dmil_core.outer_loop import NonfiniteSlot, OuterState, groups, tasks_of
from services.cli.live_view import Workers
from services.cli.stopping import stops_deferred
from services.distributed.adaptation_worker import AdaptationWorker, Block
from services.distributed.learner import Learner
from services.distributed.metrics import Meter
from services.distributed.simulation_worker import ResultOut, SimulationWorker, WorkItem
from services.distributed.timing import Timing
from services.suites.base import TaskSuite

T = TypeVar("T")


class Plan(NamedTuple):
    """What meta-training starts from; only the state changes on the way."""

    method: MetaLearner[Any, Any]
    shapes: Mapping[str, torch.Size]
    """Names and shapes of the parameters, in the order in which they are laid out flat."""
    demonstrations: Mapping[str, Sequence[Demonstration]]
    """The training demonstrations of each meta-training task."""
    state: OuterState
    settings: TrainingConfig
    seed: int
    skip_nonfinite: bool = False
    """Count an iteration as done whose step is not taken because its gradient is not finite."""
    suite: TaskSuite | None = None
    """Where a method that learns from rollouts in meta-training has them."""

    def tasks(self, iteration: int) -> list[str]:
        """Return the task of each slot of an iteration."""
        return tasks_of(iteration, list(self.demonstrations), self.seed, self.settings.tasks_per_iteration)


class Iteration(NamedTuple):
    """The outcome of one iteration."""

    number: int
    """Outer steps done, this one included."""
    slots: list[Mapping[str, float]]
    """The metrics of each slot."""
    nonfinite: list[NonfiniteSlot]
    """Those with a loss or a gradient that is not finite."""
    gradient_norm: float
    """Before clipping."""
    timing: Timing
    device: str = "cpu"
    """What computed its gradients, as rows name it."""

    @property
    def stepped(self) -> bool:
        """Whether the outer step was taken: a gradient that is not finite is skipped."""
        return math.isfinite(self.gradient_norm)


class MetaTraining(Protocol):
    """A learner and its adaptation workers."""

    def iterations(self, count: int) -> Iterator[Iteration]:
        """Run the next `count` iterations. No outer step is taken before its iteration is requested."""
        ...

    def state(self) -> OuterState:
        """Return the learner's state after the last whole iteration."""
        ...

    def close(self) -> None:
        """Stop the learner and the adaptation workers."""


class Simulation(Protocol[ResultOut]):
    """Work items that were submitted, and may still be running."""

    def done(self) -> bool:
        """Return, without waiting, whether all results are there."""
        ...

    def result(self) -> Sequence[ResultOut]:
        """Wait for all results and return them in the order of the items."""
        ...


class Runner(Protocol):
    """Runs the work of an experiment, in this process or elsewhere."""

    @property
    def meter(self) -> Meter:
        """Records the metrics of the work."""
        ...

    @property
    def worker_counts(self) -> Sequence[Workers]:
        """The workers of each kind that there are beside this process."""
        ...

    def share(self, value: T) -> Callable[[], T]:
        """Return a function that returns `value` in any process; in work items it travels to each node once."""
        ...

    def simulate(self, items: Sequence[WorkItem[T]]) -> Iterator[tuple[int, T]]:
        """Run work items on the simulation workers; yield each index and result as they arrive."""
        ...

    def simulate_in_background(self, items: Sequence[WorkItem[T]]) -> Simulation[T]:
        """Start to run work items beside meta-training; in one process, run them now."""
        ...

    def meta_train(self, plan: Plan) -> MetaTraining:
        """Start the learner and the adaptation workers."""
        ...

    def close(self) -> None:
        """Stop everything that was started."""


class LocalRunner:
    """Runs all work in this process: for tests, debuggers and notebooks."""

    meter = Meter()
    worker_counts = ()

    def __init__(self, suite: TaskSuite, compute: Compute = USUAL) -> None:
        """Simulate the tasks of `suite`; until it is closed, torch computes on one thread, as in Ray's workers."""
        self._threads, self._compute = torch.get_num_threads(), compute
        self._worker = SimulationWorker(suite, compute)

    def share(self, value: T) -> Callable[[], T]:
        """Return a function that returns `value`."""
        return lambda: value

    def simulate(self, items: Sequence[WorkItem[T]]) -> Iterator[tuple[int, T]]:
        """Run the items one after the other."""
        return enumerate(map(self._worker.run, items))

    def simulate_in_background(self, items: Sequence[WorkItem[T]]) -> Future[list[T]]:
        """Run the items now."""
        simulation: Future[list[T]] = Future()
        simulation.set_result([self._worker.run(item) for item in items])
        return simulation

    def meta_train(self, plan: Plan) -> "LocalMetaTraining":
        """Return the learner with one adaptation worker."""
        return LocalMetaTraining(plan, self._compute)

    def close(self) -> None:
        """Give torch its threads back."""
        torch.set_num_threads(self._threads)


class LocalMetaTraining:
    """Meta-training in this process, one slot after the other."""

    def __init__(self, plan: Plan, compute: Compute = USUAL) -> None:
        self._plan, self._next = plan, plan.state.iteration
        device = compute.device if plan.method.on_gpu else "cpu"
        self._learner = Learner(plan.state, plan.settings, skip_nonfinite=plan.skip_nonfinite, device=device)
        self._worker = AdaptationWorker(plan.method, plan.shapes, plan.demonstrations, plan.seed, plan.suite, compute)
        self._ready, self._parameters = self._learner.parameters()

    def iterations(self, count: int) -> Iterator[Iteration]:
        """Run the next `count` iterations, with all groups as one block."""
        for _ in range(count):
            block = Block(self._next, self._plan.tasks(self._next), groups(self._plan.settings))
            report, gradient = self._worker.gradient(self._parameters, block)
            with stops_deferred():  # a step of Adam that is interrupted leaves no state to continue from
                stepped, self._parameters = self._learner.step(gradient)
            timing = Timing.of(self._ready, {0: [report.span]}, stepped.span)
            self._next, self._ready = self._next + 1, stepped.span.ended
            norm, slots = stepped.gradient_norm, report.metrics
            yield Iteration(self._next, slots, report.nonfinite, norm, timing, report.device)

    def state(self) -> OuterState:
        """Return the learner's state."""
        return self._learner.state()

    def close(self) -> None:
        """Nothing to stop."""
