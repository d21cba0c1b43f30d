"""The outer loop of Algorithm 1: which task sits in which slot, a group's gradient, and the step of Adam."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.devices import CPU, computing_on
from dmil_core.errors import as_work_error
from dmil_core.methods.base import MetaLearner, OnlineMetaLearner, Policy, TaskGradient
from dmil_core.networks import Adam, Parameters, cosine_rate
from dmil_core.seeding import named_rng, named_seed
from dmil_core.trajectories import Rollout

BLOCKS_PER_WORKER = 4
"""Blocks that each worker should find at least, so that a slow one takes fewer and the others do not wait."""


CollectRollouts: TypeAlias = Callable[[Policy, str, int, int], Sequence[Rollout]]
"""Lets a policy act in a task's environments: policy, task, seed, and steps in all, of whole episodes but the last."""


class NonfiniteSlot(NamedTuple):
    """A slot with a loss or a gradient that is not finite."""

    slot: int
    task: str
    demonstrations: tuple[str, ...]
    """Ids of those that it had drawn."""


class GroupGradient(NamedTuple):
    """The sum of a group's outer gradients, and the metrics of each of its slots."""

    gradient: Float32[np.ndarray, " size"]
    metrics: list[Mapping[str, float]]
    nonfinite: list[NonfiniteSlot]
    """Where there is one, no number of the gradient's is finite."""


class OuterState(NamedTuple):
    """All that the learner knows: after so many iterations, the parameters and both of Adam's moments, flat."""

    iteration: int
    parameters: Float32[np.ndarray, " size"]
    first_moment: Float32[np.ndarray, " size"]
    second_moment: Float32[np.ndarray, " size"]

    @classmethod
    def start(cls, parameters: Float32[np.ndarray, " size"]) -> "OuterState":
        """Return the state before the first iteration."""
        return cls(0, parameters, np.zeros_like(parameters), np.zeros_like(parameters))


def tasks_of(iteration: int, tasks: Sequence[str], seed: int, slots: int) -> list[str]:
    """Return the task of each slot of an iteration: every task once before any comes again."""
    draw = named_rng(seed, "tasks", iteration)
    rounds = -(-slots // len(tasks))
    return [tasks[int(index)] for _ in range(rounds) for index in draw.permutation(len(tasks))][:slots]


def groups(training: TrainingConfig) -> list[range]:
    """Return the slots that are computed and added together, group by group."""
    slots, size = training.tasks_per_iteration, training.slots_per_group
    return [range(first, min(first + size, slots)) for first in range(0, slots, size)]


def blocks(groups: Sequence[range], workers: int) -> list[list[range]]:
    """Return the groups that one worker computes in one call, block by block.

    A block is 2^m consecutive groups that begin at a multiple of 2^m, and so a whole branch of `tree_sum`: its sum is
    the same bits wherever it is made. One worker takes all groups at once.
    """
    size = 1
    while size < len(groups) if workers == 1 else -(-len(groups) // (2 * size)) >= BLOCKS_PER_WORKER * workers:
        size *= 2
    return [list(groups[first : first + size]) for first in range(0, len(groups), size)]


def tree_sum(terms: Sequence[Tensor]) -> Tensor:
    """Add `terms` pairwise, neighbours first: the same bits whoever computed which term, and when."""
    while len(terms) > 1:
        terms = [sum(terms[index + 1 : index + 2], terms[index]) for index in range(0, len(terms), 2)]
    return terms[0]


def add(gradients: Sequence[Float32[np.ndarray, " size"]]) -> Float32[np.ndarray, " size"]:
    """Add gradients in the fixed tree, reading them where they lie: in memory that others may read too."""
    with warnings.catch_warnings():
        # Torch warns of memory that must not be written to; adding does not.
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        return tree_sum([torch.from_numpy(gradient) for gradient in gradients]).numpy()


def group_gradient(
    method: MetaLearner[Any, Any],
    demonstrations: Mapping[str, Sequence[Demonstration]],
    parameters: Parameters,
    seed: int,
    iteration: int,
    tasks: Sequence[str],
    slots: Sequence[int],
    collect_rollouts: CollectRollouts | None = None,
    *,
    batched: bool = False,
) -> GroupGradient:
    """Return the summed outer gradient of some slots of an iteration: a pure function of its arguments.

    `parameters` are θ at the start of the iteration, which counts from 0, on the device that computes. `tasks` are
    those of every slot, see `tasks_of`, and `slots` the ones to compute: all at once if `batched`, see
    `MetaLearner.task_gradients`. `collect_rollouts` lets the policy of an `OnlineMetaLearner` act in a task's
    environments.

    Raises:
        WorkError: for a Python error in one of them, which is named.
    """
    device = next(iter(parameters.values())).device
    batches, results, nonfinite = [], [], []
    for slot in slots:
        task = tasks[slot]
        with (
            as_work_error(slot_label(iteration, slot, task, seed), iteration=iteration, slot=slot),
            computing_on(device),
        ):
            batch = method.sample(demonstrations[task], iteration, named_rng(seed, "batch", iteration, slot))
            if isinstance(method, OnlineMetaLearner) and (steps := method.environment_steps(iteration)):
                assert collect_rollouts is not None
                policy = method.exploration_policy(parameters, batch)
                rollouts = collect_rollouts(policy, task, named_seed(seed, "practice", iteration, slot), steps)
                batch = method.with_rollouts(batch, rollouts)
            batches.append(batch)
            if not batched:
                results.append(method.task_gradient(parameters, batch))
    if batched:
        label = f"iteration {iteration + 1}, slots {', '.join(map(str, slots))} at once, seed {seed}"
        with as_work_error(label, iteration=iteration, slot=slots[0]), computing_on(device):
            results = method.task_gradients(parameters, batches)
    for slot, batch, result in zip(slots, batches, results, strict=True):
        if not _finite(result):
            nonfinite.append(NonfiniteSlot(slot, tasks[slot], tuple(batch.ids)))
    terms = [result.gradient for result in results]
    gradient = torch.full_like(terms[0], torch.nan) if nonfinite else tree_sum(terms)
    return GroupGradient(gradient.cpu().numpy(), [result.metrics for result in results], nonfinite)


def slot_label(iteration: int, slot: int, task: str, seed: int) -> str:
    """Name a slot in messages, where iterations count from 1."""
    return f"iteration {iteration + 1}, slot {slot}, task {task}, seed {seed}"


def _finite(result: TaskGradient) -> bool:
    """Tell whether all is finite; the sum, which nearly always is then, is cheaper to check."""
    gradient = bool(result.gradient.sum().isfinite() or result.gradient.isfinite().all())
    return gradient and all(map(np.isfinite, result.metrics.values()))


class OuterStep:
    """The step by the sum of all slots' gradients, its state to be taken out and put back at any iteration.

    Adam on the flat parameter vector; or, with ``outer_step == "average"``, a plain step by the slots' mean, which
    leaves Adam's moments as they are.
    """

    def __init__(self, state: OuterState, training: TrainingConfig, device: torch.device = CPU) -> None:
        """Continue from `state`, on a device; a fresh start is `OuterState.start`."""
        self._training, self._device = training, device

        def there(values: float | np.ndarray) -> Tensor:
            return torch.tensor(values, device=device)

        self._parameters = torch.nn.Parameter(there(state.parameters))
        self._adam = Adam([self._parameters], training.learning_rate)
        self._adam.steps = [there(float(state.iteration))]
        self._adam.first_moments, self._adam.second_moments = [there(state.first_moment)], [there(state.second_moment)]

    @property
    def parameters(self) -> Float[Tensor, " size"]:
        """The current parameters, flat; the next step changes them in place."""
        return self._parameters.detach()

    def __call__(self, gradient: Float32[np.ndarray, " size"]) -> float:
        """Take one step by the sum of all slots' gradients, and return its norm before clipping.

        Where that is not finite, nothing changes.
        """
        training, total = self._training, torch.tensor(gradient, device=self._device)
        if training.outer_step == "average":
            total /= training.tasks_per_iteration
        self._parameters.grad = total
        limit = float("inf") if training.gradient_clip is None else training.gradient_clip
        norm = torch.nn.utils.clip_grad_norm_([self._parameters], limit)
        if norm.isfinite():
            if training.outer_step == "adam":
                self._adam.learning_rate = self._learning_rate
                self._adam.step()
            else:
                self.parameters.sub_(total, alpha=training.learning_rate)
                self.skip()
        return norm.item()

    @property
    def _learning_rate(self) -> float:
        """Of the next step."""
        training, done = self._training, int(self._adam.steps[0])
        if training.schedule == "constant":
            return training.learning_rate
        return cosine_rate(training.learning_rate, min(done / training.iterations, 1.0))

    def skip(self) -> None:
        """Count an iteration without a step of Adam; parameters and moments stay."""
        self._adam.steps[0] += 1

    @property
    def state(self) -> OuterState:
        """A copy of everything that the next step depends on."""
        (step,), first, second = self._adam.steps, self._adam.first_moments, self._adam.second_moments
        moments = (moment.cpu().numpy().copy() for (moment,) in (first, second))
        return OuterState(int(step), self.parameters.cpu().numpy().copy(), *moments)
