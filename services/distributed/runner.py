"""Where an experiment's work is done: here, or by the actors of `ray_runner`, with the same bits."""

import math
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

import torch

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import MetaLearner
from dmil_core.outer_loop import NonfiniteSlot, OuterState, groups, tasks_of
from services.cli.live_view import Workers
from services.distributed.adaptation_worker import AdaptationWorker, Block
from services.distributed.learner import Learner
from services.distributed.metrics import Meter
from services.distributed.simulation_worker import SimulationWorker
from services.distributed.timing import Timing
from services.suites.base import TaskSuite


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
    """Whether an iteration whose step is not taken, for its gradient was not finite, counts as done."""
    suite: TaskSuite | None = None
    """Where a method that practises does so."""

    def tasks(self, iteration: int) -> list[str]:
        """Return the task of each slot of an iteration."""
        return tasks_of(iteration, list(self.demonstrations), self.seed, self.settings.tasks_per_iteration)


class Iteration(NamedTuple):
    """What came of one iteration."""

    number: int
    """Outer steps done, this one included."""
    slots: list[Mapping[str, float]]
    """The metrics of each slot."""
    nonfinite: list[NonfiniteSlot]
    """Those with a loss or a gradient that is not finite."""
    gradient_norm: float
    """Before clipping."""
    timing: Timing

    @property
    def stepped(self) -> bool:
        """Whether the outer step was taken: by a gradient that is not finite, none is."""
        return math.isfinite(self.gradient_norm)


class MetaTraining(Protocol):
    """A learner and its adaptation workers, from one state to the next."""

    def iterations(self, count: int) -> Iterator[Iteration]:
        """Do the next `count` iterations. No outer step is taken before the iteration that it ends is asked for."""
        ...

    def state(self) -> OuterState:
        """Return the learner's state after the last whole iteration."""
        ...

    def close(self) -> None:
        """Let the learner and the adaptation workers go."""
        ...


class Simulation(Protocol):
    """Calls of a simulation worker that were begun, and may still be under way."""

    def done(self) -> bool:
        """Tell, without waiting, whether all results are there."""
        ...

    def results(self) -> list[Any]:
        """Wait for all results and return them in the order of the calls."""
        ...


class Runner(Protocol):
    """Does an experiment's work, wherever that is."""

    @property
    def meter(self) -> Meter:
        """Takes what is counted and measured of the work."""
        ...

    @property
    def worker_counts(self) -> Sequence[Workers]:
        """The workers that there are beside this process."""
        ...

    @property
    def workers(self) -> int:
        """How many workers of each kind there may be now."""
        ...

    def share(self, value: Any) -> Any:
        """Return what to pass in calls instead of `value`, so that it travels once."""
        ...

    def simulate(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Call a method of the simulation workers with each of `calls`; yield index and result as they come."""
        ...

    def simulate_beside(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Simulation:
        """Begin to do the same beside meta-training; where only one thing can be done at a time, do it now."""
        ...

    def meta_train(self, plan: Plan) -> MetaTraining:
        """Make the learner and the adaptation workers."""
        ...

    def close(self) -> None:
        """Stop everything that was started."""
        ...


class Finished(NamedTuple):
    """A simulation that is over."""

    outcomes: list[Any]

    def done(self) -> bool:
        """Return true."""
        return True

    def results(self) -> list[Any]:
        """Return them."""
        return self.outcomes


class LocalRunner:
    """Does all work in this process: for tests, debuggers and notebooks."""

    workers = 1
    meter = Meter()
    worker_counts = ()

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

    def simulate_beside(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Finished:
        """Make the calls now: they take their turn."""
        return Finished([outcome for _, outcome in self.simulate(method, calls)])

    def meta_train(self, plan: Plan) -> "LocalMetaTraining":
        """Make the learner and one adaptation worker."""
        return LocalMetaTraining(plan)

    def close(self) -> None:
        """Nothing to stop."""


class LocalMetaTraining:
    """Computes all slots one after the other."""

    def __init__(self, plan: Plan) -> None:
        """Start from the plan's state."""
        self._plan, self._next = plan, plan.state.iteration
        self._learner = Learner(plan.state, plan.settings, skip_nonfinite=plan.skip_nonfinite)
        self._worker = AdaptationWorker(plan.method, plan.shapes, plan.demonstrations, plan.seed, plan.suite)
        self._ready, self._parameters = self._learner.parameters()

    def iterations(self, count: int) -> Iterator[Iteration]:
        """Do the next `count` iterations, with all groups as one block."""
        for _ in range(count):
            block = Block(self._next, self._plan.tasks(self._next), groups(self._plan.settings))
            report, gradient = self._worker.gradient(self._parameters, block)
            with _undisturbed():
                stepped, self._parameters = self._learner.step(gradient)
            timing = Timing.of(self._ready, {0: [report.span]}, stepped.span)
            self._next, self._ready = self._next + 1, stepped.span.ended
            yield Iteration(self._next, report.metrics, report.nonfinite, stepped.gradient_norm, timing)

    def state(self) -> OuterState:
        """Return the learner's state."""
        return self._learner.state()

    def close(self) -> None:
        """Nothing to let go."""


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
