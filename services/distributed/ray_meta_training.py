"""Meta-training in Ray actors: a learner, and workers that compute the gradients."""

import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from dmil_core.devices import USUAL, Compute
from dmil_core.errors import WorkError
from dmil_core.outer_loop import OuterState, blocks, groups, slot_label
from services.distributed.adaptation_worker import AdaptationWorker, Block, BlockReport
from services.distributed.calls import Call, DeadlyCallError, LostError
from services.distributed.gpus import SHARES
from services.distributed.learner import Learner, StepReport
from services.distributed.metrics import Meter, WorkerCounter
from services.distributed.runner import Iteration, Plan
from services.distributed.timing import Span, Timing

FAN_IN = 8
"""Gradients that one worker adds at a time, a power of two; it does not change the result."""
MAX_LOSSES = 10
"""Losses of the learner, or of a result that others depend on, without progress in between."""
MAX_SUSPICIONS = 3
"""Suspicions against one block that it kills its workers, while each of its slots alone kills none."""

logger = logging.getLogger(__name__)


class Gradients(NamedTuple):
    """The calls for the gradients of one iteration."""

    blocks: list[Call]
    """Of each block."""
    terms: list[Call]
    """Those whose results add up to the whole: some hold the sum of several blocks."""


class RayMetaTraining:
    """A learner and adaptation workers as actors.

    An iteration is a graph of calls: gradients of blocks, a tree of sums, the outer step. The calls of one iteration
    take the results of others by reference, from actor to actor, and the next gradients already wait at the workers
    for the parameters when those are made. So between two outer steps no worker waits for this process.

    Workers may die, hang or join at any time, see `Pool`. If the learner is lost, a new one continues from the state
    that was fetched last, for a checkpoint, and repeats the iterations since: they give the same bits.
    """

    def __init__(
        self,
        plan: Plan,
        workers: int | Callable[[], int],
        fan_in: int = FAN_IN,
        gpus: float = 0.0,
        meter: Meter | None = None,
        min_workers: int | None = None,
        compute: Compute = USUAL,
    ) -> None:
        """Start the actors; the demonstrations travel to each node once.

        At most one adaptation worker is started for each group of slots, of `workers`, a number or a function that
        returns it as the cluster changes: `min_workers` to begin with, all by default, and the others when there is
        room for them. Each adds `fan_in` gradients at a time, a power of two. The actors have the shares of `SHARES` of
        each worker's `gpus`. The meter records iterations, workers, and slots that are computed again.
        """
        import ray

        from services.distributed.actor_pool import Pool

        self._ray, self._plan, self._fan_in = ray, plan, fan_in
        self._groups = groups(plan.settings)
        self._learner_gpus = gpus * SHARES["learner"]
        self._learner_device = compute.device if plan.method.on_gpu else "cpu"
        self._meter = meter or Meter()
        self.counter = WorkerCounter("adaptation", self._meter)
        self._workers: Callable[[], int] = workers if callable(workers) else lambda: workers
        shared = ray.put(plan.demonstrations)

        def start(cpus: int) -> Any:
            remote = ray.remote(num_cpus=cpus, num_gpus=gpus * SHARES["adaptation"])(AdaptationWorker)
            return remote.remote(plan.method, plan.shapes, shared, plan.seed, plan.suite, compute)

        self._pool = Pool(
            lambda: start(1),
            size=self._wanted_workers,
            max_in_flight=2,
            listener=self.counter,
            min_size=min_workers,
            start_backup=lambda: start(0),
        )
        self._state = plan.state
        """The state that a new learner starts from."""
        self._done = self._yielded = self._submitted = plan.state.iteration
        self._losses: Counter[int] = Counter()
        self._suspicions: Counter[int] = Counter()
        self._next: Gradients | None = None
        """The gradients of the next iteration, where they are submitted already."""
        self._start_learner()
        try:
            self._fetch_parameters()
        except LostError as error:
            self._recover(error)
        self.alive = True

    def __len__(self) -> int:
        """Return the number of healthy adaptation workers."""
        return len(self._pool)

    @property
    def blocks(self) -> list[list[range]]:
        """The groups that one worker computes in one call, for the workers that are healthy."""
        return blocks(self._groups, max(1, len(self)))

    @property
    def _wanted_workers(self) -> int:
        return min(self._workers(), len(self._groups))

    def iterations(self, count: int) -> Iterator[Iteration]:
        """Run the next `count` iterations."""
        end = self._yielded + count
        while self._yielded < end:
            for iteration in self._run(end):
                if iteration.number > self._yielded:
                    self._yielded = iteration.number
                    self._meter.iteration(iteration.timing)
                    yield iteration

    def _run(self, end: int) -> Iterator[Iteration]:
        """Run iterations up to `end`, and again those that were lost with the learner."""
        while self._done < end:
            try:
                while self._done < end:
                    yield self._iteration(is_last=self._done + 1 == end)
            except LostError as error:
                self._recover(error)

    def _iteration(self, *, is_last: bool) -> Iteration:
        gradients = self._next or self._submit_gradients(self._done)
        total = self._submit_sums(gradients.terms)
        step = self._parameters = self._pool.submit(
            "step", total, returns=2, actor=self._learner, label=f"the step of iteration {self._done + 1}"
        )
        self._next = None if is_last else self._submit_gradients(self._done + 1)
        return self._finish(step, gradients.blocks)

    def _submit_gradients(self, iteration: int) -> Gradients:
        """Submit the gradient of each block, to all workers that there are by now.

        Where all blocks are computed side by side, the last of each `fan_in` adds the others itself, which saves a hop.
        Where blocks wait for a worker, none should stand and wait for another's gradient.
        """
        self._pool.grow(self._wanted_workers)
        tasks, fan_in = self._plan.tasks(iteration), self._fan_in
        if iteration < self._submitted:  # it was lost with the learner
            self.counter.slots_redone(len(tasks))
        self._submitted = max(self._submitted, iteration + 1)
        all_blocks = [Block(iteration, tasks, block) for block in self.blocks]
        side_by_side = len(all_blocks) <= len(self)
        calls: list[Call] = []
        for index, block in enumerate(all_blocks):
            adds = side_by_side and (index % fan_in == fan_in - 1 or index == len(all_blocks) - 1)
            previous = calls[index - index % fan_in :] if adds else []
            label = f"iteration {iteration + 1}, slots {', '.join(map(str, block.slots))}"
            calls.append(self._pool.submit("gradient", self._parameters, block, previous, returns=2, label=label))
        return Gradients(calls, [*calls[fan_in - 1 : -1 : fan_in], calls[-1]] if side_by_side else calls)

    def _submit_sums(self, gradients: Sequence[Call]) -> Call:
        """Submit a tree of sums; a worker that computed the last term of a sum adds it up."""
        while len(gradients) > 1:
            parts = [gradients[first : first + self._fan_in] for first in range(0, len(gradients), self._fan_in)]
            gradients = [
                self._pool.submit("add", *part, returns=2, same_worker_as=part[-1], label="the sum of gradients")
                if len(part) > 1
                else part[0]
                for part in parts
            ]
        return gradients[0]

    def _finish(self, step: Call, gradients: Sequence[Call]) -> Iteration:
        """Wait for an outer step, and return its iteration."""
        stepped: StepReport = self._result(step)
        reports: list[BlockReport] = [self._result(call) for call in gradients]
        work: dict[int, list[Span]] = defaultdict(list)
        for call, report in zip(gradients, reports, strict=True):
            work[call.worker.number if call.worker else 0].append(report.span)
        timing = Timing.of(self._ready, work, stepped.span)
        self._done, self._ready = self._done + 1, stepped.span.ended
        slots = [metrics for report in reports for metrics in report.metrics]
        nonfinite = [slot for report in reports for slot in report.nonfinite]
        return Iteration(self._done, slots, nonfinite, stepped.gradient_norm, timing, reports[0].device)

    def state(self) -> OuterState:
        """Fetch the learner's state."""
        while True:
            try:
                for _ in self._run(self._yielded):
                    pass
                self._state = self._result(self._pool.submit("state", actor=self._learner))
                return self._state
            except LostError as error:
                self._recover(error)

    # Losses

    def _result(self, call: Call) -> Any:
        """Wait for a call's result; where a block kills its workers, find the slot that does it."""
        while True:
            try:
                return self._pool.result(call)
            except DeadlyCallError as error:
                self._examine_slots(error)

    def _examine_slots(self, error: DeadlyCallError) -> None:
        """Run each slot of a deadly block alone, and the block again if none of them is deadly."""
        call = error.call
        self._suspicions[call.number] += 1
        if call.method != "gradient" or self._suspicions[call.number] > MAX_SUSPICIONS:
            raise error
        parameters, block, _ = call.arguments
        for slot in block.slots:
            label = slot_label(block.iteration, slot, block.tasks[slot], self._plan.seed)
            alone = self._pool.submit("gradient", parameters, block._replace(groups=[[slot]]), returns=2, label=label)
            try:
                self._pool.result(alone)
            except DeadlyCallError as deadly:
                problem = f"{deadly.call.deaths} workers ended in the course of it, one after the other"
                raise WorkError(label, problem, str(deadly), {"iteration": block.iteration, "slot": slot}) from deadly
        self._pool.retry(call)

    def _start_learner(self) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(self._ray.get_runtime_context().get_node_id(), soft=True)
        # Out of order, so that the state can be fetched while a step waits for its gradients. One step waits at a time.
        learner: Any = self._ray.remote(num_cpus=0, num_gpus=self._learner_gpus, scheduling_strategy=here)(
            Learner
        ).options(allow_out_of_order_execution=True)
        self._learner = learner.remote(
            self._state, self._plan.settings, skip_nonfinite=self._plan.skip_nonfinite, device=self._learner_device
        )

    def _fetch_parameters(self) -> None:
        """Continue from the learner's parameters."""
        self._parameters = self._pool.submit("parameters", returns=2, actor=self._learner)
        self._ready: float = self._pool.result(self._parameters)

    def _recover(self, error: LostError) -> None:
        """Go back to the learner's state, or to that of a new learner in its place."""
        lost = error
        while True:
            self._losses[self._yielded] += 1
            if self._losses[self._yielded] > MAX_LOSSES:
                raise lost
            self._pool.discard_calls()
            self._next = None
            try:
                state: OuterState = self._pool.result(self._pool.submit("state", actor=self._learner))
                if state.iteration > self._yielded:  # a step further than what was yielded
                    self._start_learner()
                else:
                    self._state = state
                self._fetch_parameters()
                break
            except LostError as again:
                lost = again
                self._start_learner()
        self._done = self._state.iteration
        logger.warning(f"{error}; going on from the state after iteration {self._done}")

    def close(self) -> None:
        """Stop the actors."""
        if self.alive:
            self._pool.close()
            self._ray.kill(self._learner)
            self.alive = False
