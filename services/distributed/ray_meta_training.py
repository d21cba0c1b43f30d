"""Meta-training in Ray actors: a learner, and workers that compute the gradients."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from dmil_core.errors import WorkError
from dmil_core.outer_loop import OuterState, blocks, groups, slot_label
from services.cli.progress import console
from services.distributed.adaptation_worker import AdaptationWorker, BlockReport
from services.distributed.errors import DeadlyCallError, LostError
from services.distributed.learner import Learner, StepReport
from services.distributed.metrics import Crew, Meter
from services.distributed.runner import Iteration, Plan
from services.distributed.timing import Span, Timing

if TYPE_CHECKING:
    from services.distributed.calls import Call

FAN_IN = 8
"""Gradients that one worker adds at a time, a power of two; it does not change the result."""
LOSSES_ALLOWED = 10
"""So often may the learner, or a result that others build upon, be lost without an iteration more done."""
SUSPICIONS_ALLOWED = 3
"""So often may a block of slots be suspected to end its workers, while each of its slots alone ends none."""


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

    def __init__(
        self,
        plan: Plan,
        workers: int | Callable[[], int],
        fan_in: int = FAN_IN,
        gpus: float = 0.0,
        meter: Meter | None = None,
        enough: int | None = None,
    ) -> None:
        """Start the actors; the demonstrations travel to each node once.

        Args:
            plan: what to do.
            workers: adaptation workers, or what tells at any time how many there may be by then; no more than there
                are groups are started.
            fan_in: gradients that a worker adds at a time, a power of two.
            gpus: of each adaptation worker.
            meter: is told of iterations, workers, and slots that are done again.
            enough: workers to begin with; the others join when there is room for them.
        """
        import ray

        from services.distributed.actor_pool import Pool

        self._ray, self._plan, self._fan_in = ray, plan, fan_in
        self._groups = groups(plan.settings)
        self._meter = meter or Meter()
        self.crew = Crew("adaptation", self._meter)
        """Counts the workers."""
        self._workers: Callable[[], int] = workers if callable(workers) else lambda: workers
        remote, shared = ray.remote(num_cpus=1, num_gpus=gpus)(AdaptationWorker), ray.put(plan.demonstrations)
        self._pool = Pool(
            lambda: remote.remote(plan.method, plan.shapes, shared, plan.seed, plan.suite),
            size=self._wanted,
            ahead=2,
            say=console.print,
            witness=self.crew,
            enough=enough,
        )
        self._kept, self._done, self._told = plan.state, plan.state.iteration, plan.state.iteration
        self._begun = self._done
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
                    self._meter.iteration(iteration.timing)
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
        if iteration < self._begun:  # it was lost with the learner
            self.crew.redone(len(tasks))
        self._begun = max(self._begun, iteration + 1)
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
        nonfinite = [slot for report in reports for slot in report.nonfinite]
        return Iteration(self._done, slots, nonfinite, stepped.gradient_norm, timing)

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
            where = slot_label(iteration, slot, tasks[slot], self._plan.seed)
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
