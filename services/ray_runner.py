"""The runner that works in Ray actors."""

import logging
import os
import secrets
import signal
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from dmil_core.errors import WorkError
from dmil_core.outer_loop import OuterState, blocks, groups, slot_in_words
from services.actors.adaptation import AdaptationWorker, BlockReport
from services.actors.faults import DeadlyCallError, LostError, NoRoomError
from services.actors.learner import Learner, StepReport
from services.actors.simulation import SimulationWorker, piece_of_call
from services.progress import console
from services.runners import Iteration, Plan
from services.suites.base import TaskSuite
from services.timing import Span, Timing

if TYPE_CHECKING:
    from services.actors.calls import Call
    from services.actors.pool import Pool


__all__ = ["FAN_IN", "RayMetaTraining", "RayRunner"]

OBJECT_STORE_BYTES = 500_000_000
FAN_IN = 8
"""Gradients that one worker adds at a time, a power of two; it does not change the result."""
LOSSES_ALLOWED = 10
"""So often may the learner, or a result that others build upon, be lost without an iteration more done."""
SUSPICIONS_ALLOWED = 3
"""So often may a block of slots be suspected to end its workers, while each of its slots alone ends none."""
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
        self._asked_for = workers
        if workers is not None and workers > self._cpus():
            ray.shutdown()
            raise NoRoomError(f"--workers: got {workers}; the cluster has {self._cpus()} CPUs; ask for at most as many")
        self._suite = ray.put(suite)
        self._beside: Pool | None = None
        self._training: RayMetaTraining | None = None

    @property
    def workers(self) -> int:
        """How many workers of each kind there may be now: nodes come and go."""
        cpus = self._cpus()
        return min(self._asked_for or cpus, cpus)

    def _cpus(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def share(self, value: Any) -> Any:
        """Put `value` into the object store."""
        return self._ray.put(value)

    def simulate(self, method: str, calls: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        """Spread the calls over the simulation workers."""
        # While meta-training pauses, its workers keep their CPUs: the simulation's must not wait for one.
        remote = self._ray.remote(num_cpus=0 if self._meta_training() else 1)(SimulationWorker)
        pool = self._pool(lambda: remote.remote(self._suite), min(self.workers, len(calls)), say=console.print)
        try:
            with naming_the_deadly():
                yield from pool.results(_submitted(pool, method, calls))
        finally:
            pool.close()

    def simulate_beside(self, method: str, calls: Sequence[tuple[Any, ...]]) -> "RaySimulation":
        """Let one more worker make the calls, which gives way to meta-training and takes no CPU from its count."""
        if self._beside is None:
            remote = self._ray.remote(num_cpus=0)(PoliteSimulationWorker)
            self._beside = self._pool(lambda: remote.remote(self._suite), 1, ahead=len(calls), say=console.print)
        return RaySimulation(self._beside, method, calls)

    def meta_train(self, plan: Plan) -> "RayMetaTraining":
        """Start the learner and the adaptation workers."""
        self._training = RayMetaTraining(plan, lambda: self.workers)
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
        self._calls = _submitted(pool, method, calls)

    def done(self) -> bool:
        """Tell, without waiting, whether all results are there."""
        with naming_the_deadly():
            self._pool.take_note()
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


class Gradients(NamedTuple):
    """The calls for the gradients of one iteration."""

    blocks: list["Call"]
    """Of each block."""
    terms: list["Call"]
    """Those whose results add up to the whole: some hold the sum of several blocks."""


class RayMetaTraining:
    """A learner and adaptation workers as actors.

    An iteration is a graph of calls: gradients of blocks, a tree of sums, the outer step. The calls of one iteration
    take the results of others by reference, from actor to actor, and the next gradients already wait at the workers
    for the parameters when those are made. So between two outer steps no worker waits for this process.

    Workers may die, hang or join at any time, see `Pool`. If the learner is lost, another one takes the state that was
    last asked for, a checkpoint's, and does the iterations since again: they give the same bits.
    """

    def __init__(self, plan: Plan, workers: int | Callable[[], int], fan_in: int = FAN_IN) -> None:
        """Start the actors; the demonstrations travel to each node once.

        Args:
            plan: what to do.
            workers: adaptation workers, or what tells at any time how many there may be by then; no more than there
                are groups are started.
            fan_in: gradients that a worker adds at a time, a power of two.
        """
        import ray

        from services.actors.pool import Pool

        self._ray, self._plan, self._fan_in = ray, plan, fan_in
        self._groups = groups(plan.settings)
        self._workers: Callable[[], int] = workers if callable(workers) else lambda: workers
        remote, shared = ray.remote(num_cpus=1)(AdaptationWorker), ray.put(plan.demonstrations)
        self._pool = Pool(
            lambda: remote.remote(plan.method, plan.shapes, shared, plan.seed),
            size=self._wanted,
            ahead=2,
            say=console.print,
        )
        self._kept, self._done, self._told = plan.state, plan.state.iteration, plan.state.iteration
        self._losses: Counter[int] = Counter()
        self._suspicions: Counter[int] = Counter()
        self._ahead: Gradients | None = None
        self._start_learner()
        try:
            self._resume()
        except LostError as error:
            self._recover(error)
        self.alive = True

    def __len__(self) -> int:
        return len(self._pool)

    @property
    def restarts(self) -> int:
        """How many workers were replaced."""
        return self._pool.restarts

    @property
    def blocks(self) -> list[list[range]]:
        """The groups that one worker computes in one call, for the workers that are up."""
        return blocks(self._groups, max(1, len(self)))

    @property
    def _wanted(self) -> int:
        return min(self._workers(), len(self._groups))

    def iterations(self, count: int) -> Iterator[Iteration]:
        """Do the next `count` iterations."""
        end = self._told + count
        while self._told < end:
            for iteration in self._run(end):
                if iteration.number > self._told:
                    self._told = iteration.number
                    yield iteration

    def _run(self, end: int) -> Iterator[Iteration]:
        """Do iterations up to `end`, those again that were lost with the learner."""
        while self._done < end:
            try:
                while self._done < end:
                    yield self._iteration(ahead=self._done + 1 < end)
            except LostError as error:
                self._recover(error)

    def _iteration(self, *, ahead: bool) -> Iteration:
        gradients = self._ahead or self._gradients(self._done)
        total = self._add(gradients.terms)
        step = self._parameters = self._pool.submit(
            "step", total, returns=2, on=self._learner, label=f"the step of iteration {self._done + 1}"
        )
        self._ahead = self._gradients(self._done + 1) if ahead else None
        return self._finish(step, gradients.blocks)

    def _gradients(self, iteration: int) -> "Gradients":
        """Have the gradient of each block computed, by all workers that there are by now.

        Where all blocks are computed side by side, the last of each few adds the others itself: that saves a hop. Where
        blocks wait for a worker, none should stand and wait for another's gradient.
        """
        self._pool.grow(self._wanted)
        tasks, found, few = self._plan.tasks(iteration), self.blocks, self._fan_in
        side_by_side = len(found) <= len(self)
        calls: list[Call] = []
        for index, block in enumerate(found):
            is_last_of_few = index % few == few - 1 or index == len(found) - 1
            before = calls[index - index % few :] if side_by_side and is_last_of_few else []
            slots = ", ".join(str(slot) for group in block for slot in group)
            label = f"iteration {iteration + 1}, slots {slots}"
            calls.append(
                self._pool.submit("gradient", self._parameters, iteration, tasks, block, before, returns=2, label=label)
            )
        return Gradients(calls, [*calls[few - 1 : -1 : few], calls[-1]] if side_by_side else calls)

    def _add(self, gradients: Sequence["Call"]) -> "Call":
        """Have gradients added by the workers that computed the last of each few, until one is left."""
        while len(gradients) > 1:
            parts = [gradients[first : first + self._fan_in] for first in range(0, len(gradients), self._fan_in)]
            gradients = [
                self._pool.submit("add", *part, returns=2, beside=part[-1], label="the sum of gradients")
                if len(part) > 1
                else part[0]
                for part in parts
            ]
        return gradients[0]

    def _finish(self, step: "Call", gradients: Sequence["Call"]) -> Iteration:
        """Wait for an outer step, and put together what is told of its iteration."""
        stepped: StepReport = self._result(step)
        reports: list[BlockReport] = [self._result(call) for call in gradients]
        work: dict[int, list[Span]] = defaultdict(list)
        for call, report in zip(gradients, reports, strict=True):
            work[call.worker.number if call.worker else 0].append(report.span)
        timing = Timing.of(self._ready, work, stepped.span)
        self._done, self._ready = self._done + 1, stepped.span.ended
        slots = [metrics for report in reports for metrics in report.metrics]
        spoilt = [slot for report in reports for slot in report.spoilt]
        return Iteration(self._done, slots, spoilt, stepped.gradient_norm, timing)

    def state(self) -> OuterState:
        """Fetch the learner's state."""
        while True:
            try:
                for _ in self._run(self._told):
                    pass
                self._kept = self._result(self._pool.submit("state", on=self._learner))
                return self._kept
            except LostError as error:
                self._recover(error)

    # What is lost

    def _result(self, call: "Call") -> Any:
        """Wait for a call's result, and look into the slots of one in whose course one worker after the other ended.

        Raises:
            RunError: names the slot that ends them; if none does it by itself, somebody else ended them.
        """
        while True:
            try:
                return self._pool.result(call)
            except DeadlyCallError as error:
                self._blame(error)

    def _blame(self, error: DeadlyCallError) -> None:
        call = error.call
        self._suspicions[call.number] += 1
        if call.method != "gradient" or self._suspicions[call.number] > SUSPICIONS_ALLOWED:
            raise error
        parameters, iteration, tasks, block, _ = call.arguments
        for slot in (slot for group in block for slot in group):
            where = slot_in_words(iteration, slot, tasks[slot], self._plan.seed)
            alone = self._pool.submit("gradient", parameters, iteration, tasks, [[slot]], returns=2, label=where)
            try:
                self._pool.result(alone)
            except DeadlyCallError as own:
                problem = f"{own.call.deaths} workers ended in the course of it, one after the other"
                raise WorkError(where, problem, str(own), {"iteration": iteration, "slot": slot}) from own
        self._pool.retry(call)

    def _start_learner(self) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(self._ray.get_runtime_context().get_node_id(), soft=True)
        # Out of order, so that the state can be had while a step waits for its gradients. One step waits at a time.
        learner: Any = self._ray.remote(num_cpus=0, scheduling_strategy=here)(Learner).options(
            allow_out_of_order_execution=True
        )
        self._learner = learner.remote(self._kept, self._plan.settings, skip_nonfinite=self._plan.skip_nonfinite)

    def _resume(self) -> None:
        """Go on from the learner's state."""
        self._parameters = self._pool.submit("parameters", returns=2, on=self._learner)
        self._ready: float = self._pool.result(self._parameters)

    def _recover(self, error: LostError) -> None:
        """Begin the lost iterations again, from the learner's state, or that of another learner in its place."""
        lost = error
        while True:
            self._losses[self._told] += 1
            if self._losses[self._told] > LOSSES_ALLOWED:
                raise lost
            self._pool.drop()
            self._ahead = None
            try:
                state: OuterState = self._pool.result(self._pool.submit("state", on=self._learner))
                if state.iteration > self._told:  # a step further than its iteration was told of
                    self._start_learner()
                else:
                    self._kept = state
                self._resume()
                break
            except LostError as again:
                lost = again
                self._start_learner()
        self._done = self._kept.iteration
        console.print(f"{error}; going on from the state after iteration {self._done}")

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
