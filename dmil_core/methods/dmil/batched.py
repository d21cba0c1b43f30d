"""The outer gradients of a group of tasks as one computation: each product is one of all tasks and sub-skills.

On a GPU the loop over tasks, sub-skills and layers costs more in launches than in arithmetic. Here tasks, or tasks x
sub-skills, are the first axis of every tensor. Tasks with fewer steps than others are padded, and so are sub-skills
with fewer states; what is padded weighs nothing. The result is that of `meta_gradient.task_gradient` but for rounding.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from dmil_core.loss_gradients import LossGradient, loss_gradient
from dmil_core.losses import OutputLoss, Steps, differentiated
from dmil_core.methods.base import TaskGradient
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.losses import hard_labels, pair_weights, switching, targets_of
from dmil_core.networks import Network, Parameters, each_tensor, mlp, network, parameters_of, without_graph


class TaskSteps(NamedTuple):
    """One set of demonstrations of each task, padded to the longest."""

    states: Float[Tensor, "tasks steps obs_dim"]
    actions: Float[Tensor, "tasks steps action_dim"]
    weights: Float[Tensor, "tasks steps"]
    """One by the number of the task's steps; zero where there is none."""
    pair_weights: Float[Tensor, "tasks pairs"]
    """Of two consecutive steps in the continuity loss; zero where there is none."""
    counts: tuple[int, ...]
    """Steps of each task."""

    @classmethod
    def of(cls, sets: Sequence[Steps]) -> "TaskSteps":
        """Stack one set of each task."""
        states, actions = (pad_sequence([getattr(one, of) for one in sets], True) for of in ("states", "actions"))
        counts = tuple(len(one.states) for one in sets)
        weights = [one.states.new_full((count,), 1 / count) for one, count in zip(sets, counts, strict=True)]
        pairs = [pair_weights(one.lengths, one.states.dtype) / len(one.lengths) for one in sets]
        return cls(states, actions, pad_sequence(weights, True), pad_sequence(pairs, True), counts)


class Own(NamedTuple):
    """The steps that each sub-skill of each task was given, padded to the most."""

    states: Float[Tensor, "networks steps obs_dim"]
    actions: Float[Tensor, "networks steps action_dim"]
    weights: Float[Tensor, "networks steps"]
    """One by the number of the sub-skill's steps; zero where there is none."""
    counts: Int[Tensor, "tasks sub_skills"]


class Levels(NamedTuple):
    """The networks of both levels of all tasks."""

    high: Network
    """One a task."""
    low: Network
    """A task's sub-skills side by side."""

    @classmethod
    def of(cls, parameters: Parameters, tasks: int) -> "Levels":
        """Copy both levels for each task."""
        parameters = without_graph(parameters)
        high, low = (network(parameters, level) for level in ("high", "low"))
        return cls(
            each_tensor(high, lambda tensor: tensor.repeat(tasks, *[1] * tensor.ndim)),
            each_tensor(low, lambda tensor: tensor.repeat(tasks, *[1] * (tensor.ndim - 1))),
        )

    def flat(self, tasks: int, like: Parameters) -> Float[Tensor, "tasks size"]:
        """Return each task's numbers as `dmil_core.networks.flatten` has them; zeros for parameters of other names."""
        parts, named = [], {**parameters_of(self.high, "high"), **parameters_of(self.low, "low")}
        for name, parameter in like.items():
            tensor = named.get(name)
            if tensor is None:
                parts.append(parameter.new_zeros(tasks, parameter.numel()))
            else:
                parts.append((tensor.mT if name.endswith(".weight") else tensor).reshape(tasks, -1))
        return torch.cat(parts, 1)


class InnerStep(NamedTuple):
    """One step of the dual inner loop of all tasks."""

    high: LossGradient
    low: LossGradient


def task_gradients(
    parameters: Parameters, tasks: Sequence[Sequence[Steps]], config: DmilConfig, *, on_labels: bool = False
) -> list[TaskGradient]:
    """Return what `meta_gradient.task_gradient` does for each of several tasks, each given as its τ1 to τ4."""
    second, k, rate = config.order == "second", config.sub_skills, config.inner_learning_rate
    one, two, three, four = map(TaskSteps.of, zip(*tasks, strict=True))
    levels, path = Levels.of(parameters, len(tasks)), list[InnerStep]()
    for _ in range(config.inner_steps):
        step, levels = _inner_step(levels, one, two, config, keep=second, on_labels=on_labels)
        path.append(step)

    errors = _errors(levels.low, three, k)
    of_high = _high_level_gradient(levels.high, three, _targets(errors, three.counts, config, inner=False), config)
    chosen = mlp(levels.high, four.states).argmax(-1)
    given = _labels(_errors(levels.low, four, k), four.counts, config) if on_labels else chosen
    of_low = _sub_skill_gradient(levels.low, _own_steps(four, given, k))

    vector = Levels(*(each_tensor(level, torch.zeros_like) for level in levels))
    of_high.add_to(vector.high)
    of_low.add_to(vector.low)
    if second:
        for step in reversed(path):
            if config.adapted != "low":
                step.high.jacobian_product(vector.high, rate)
            if config.adapted != "high":
                step.low.jacobian_product(vector.low, rate)
    gradients = vector.flat(len(tasks), parameters)
    metrics = _metrics(path[0], InnerStep(of_high, of_low), errors, chosen, three, four)
    return [TaskGradient(gradient, of) for gradient, of in zip(gradients, metrics, strict=True)]


def _inner_step(
    levels: Levels, support_high: TaskSteps, support_low: TaskSteps, config: DmilConfig, *, keep: bool, on_labels: bool
) -> tuple[InnerStep, Levels]:
    """Return a step of the dual inner loop, and where it leads; without `keep` it overwrites the networks."""
    high, low = levels
    errors = _errors(low, support_high, config.sub_skills)
    targets = _targets(errors, support_high.counts, config, inner=True)
    of_high = _high_level_gradient(high, support_high, targets, config)
    if config.adapted != "low":
        high = of_high.descend(config.inner_learning_rate, in_place=not keep)
    if on_labels:
        given = _labels(_errors(low, support_low, config.sub_skills), support_low.counts, config)
    else:
        given = mlp(high, support_low.states).argmax(-1)
    of_low = _sub_skill_gradient(low, _own_steps(support_low, given, config.sub_skills))
    if config.adapted != "high":
        low = of_low.descend(config.inner_learning_rate, in_place=not keep)
    return InnerStep(of_high, of_low), Levels(high, low)


def _errors(low: Network, steps: TaskSteps, sub_skills: int) -> Float[Tensor, "tasks sub_skills steps"]:
    """Return ‖π_k(s_t) − a_t‖² of every sub-skill at every step of its task."""
    predictions = mlp(low, steps.states.repeat_interleave(sub_skills, 0)).unflatten(0, (-1, sub_skills))
    return (predictions - steps.actions[:, None]).square().sum(-1)


def _labels(
    errors: Float[Tensor, "tasks sub_skills steps"], counts: Sequence[int], config: DmilConfig
) -> Int[Tensor, "tasks steps"]:
    """Return the hard labels of each task's steps."""
    if config.balance == "none":
        return errors.argmin(1)
    return pad_sequence([hard_labels(of[:, :count], config) for of, count in zip(errors, counts, strict=True)], True)


def _targets(
    errors: Float[Tensor, "tasks sub_skills steps"], counts: Sequence[int], config: DmilConfig, *, inner: bool
) -> Float[Tensor, "tasks steps sub_skills"]:
    """Return the weight that the high level should give to each sub-skill."""
    if config.em == "hard" or (config.em == "reference_soft" and not inner):
        labels = _labels(errors, counts, config)
        return (labels[..., None] == torch.arange(config.sub_skills, device=labels.device)).to(errors.dtype)
    each = [targets_of(of[:, :count], config, inner=inner) for of, count in zip(errors, counts, strict=True)]
    return pad_sequence(each, True)


def _high_level_gradient(
    high: Network, steps: TaskSteps, targets: Float[Tensor, "tasks steps sub_skills"], config: DmilConfig
) -> LossGradient:
    """Return L_h of each task's high level: cross-entropy and continuity, as `losses.high_level_loss` has them."""

    def loss(logits: Float[Tensor, "tasks steps sub_skills"]) -> OutputLoss:
        entropy = _cross_entropy(logits, targets, steps.weights[..., None])
        if not config.continuity_weight:
            return entropy
        if config.continuity == "reference":
            certain = (logits.argmax(-1, keepdim=True) == torch.arange(logits.shape[-1], device=logits.device)).to(
                logits
            )
            value = entropy.value + config.continuity_weight * _continuity(certain, steps)
            return entropy._replace(value=value)
        expected = differentiated(lambda outputs: _continuity(outputs.softmax(-1), steps), logits)
        return entropy.plus(expected, config.continuity_weight)

    return loss_gradient(high, steps.states, loss)


def _cross_entropy(
    logits: Float[Tensor, "tasks steps sub_skills"],
    targets: Float[Tensor, "tasks steps sub_skills"],
    weights: Float[Tensor, "tasks steps 1"],
) -> OutputLoss:
    """Return the weighted cross-entropy of each task's high level to its targets."""
    log_probabilities, mass = logits.log_softmax(-1), targets.sum(-1, keepdim=True)
    probabilities = log_probabilities.exp()

    def curvature(direction: Float[Tensor, "tasks steps sub_skills"]) -> Float[Tensor, "tasks steps sub_skills"]:
        weighted = probabilities * direction
        return mass * (weighted - probabilities * weighted.sum(-1, keepdim=True)) * weights

    value = -(targets * log_probabilities * weights).sum((1, 2))
    return OutputLoss(value, (mass * probabilities - targets) * weights, curvature)


def _continuity(probabilities: Float[Tensor, "tasks steps sub_skills"], steps: TaskSteps) -> Float[Tensor, " tasks"]:
    """Return the continuity loss of each task, see `losses.continuity_loss`."""
    return (switching(probabilities) * steps.pair_weights).sum(1)


def _own_steps(steps: TaskSteps, given: Int[Tensor, "tasks steps"], sub_skills: int) -> Own:
    """Return the steps that each sub-skill is given, in their order."""
    real: Bool[Tensor, "tasks steps"] = steps.weights > 0
    given = torch.where(real, given, sub_skills)
    counts = (given[:, None] == torch.arange(sub_skills, device=given.device)[:, None]).sum(-1)
    places = torch.arange(max(1, int(counts.max())), device=given.device)
    first = counts.cumsum(1) - counts
    index = (first[..., None] + places).clamp_max(given.shape[1] - 1).flatten(1)
    rows = given.argsort(dim=1, stable=True).gather(1, index)
    tasks = torch.arange(len(given), device=given.device)[:, None]
    states, actions = (
        of[tasks, rows].unflatten(1, (sub_skills, -1)).flatten(0, 1) for of in (steps.states, steps.actions)
    )
    weights = (places < counts[..., None]).to(states.dtype) / counts[..., None].clamp_min(1)
    return Own(states, actions, weights.flatten(0, 1), counts)


def _sub_skill_gradient(low: Network, own: Own) -> LossGradient:
    """Return L_BC of each sub-skill of each task on its own steps; zero where it has none."""
    weights = own.weights[..., None]

    def loss(predictions: Float[Tensor, "networks steps action_dim"]) -> OutputLoss:
        errors = predictions - own.actions
        value = (errors.square() * weights).sum((1, 2))
        return OutputLoss(value, 2 * weights * errors, lambda direction: 2 * weights * direction)

    return loss_gradient(low, own.states, loss)


def _metrics(
    first: InnerStep,
    outer: InnerStep,
    errors: Float[Tensor, "tasks sub_skills steps"],
    chosen: Int[Tensor, "tasks query_steps"],
    query_high: TaskSteps,
    query_low: TaskSteps,
) -> list[dict[str, float]]:
    """Return each task's metrics, by one copy from the device."""
    tasks, k = errors.shape[:2]
    probabilities = outer.high.outputs.softmax(-1)
    agreeing = (probabilities.argmax(-1) == errors.argmin(1)) * query_high.weights
    taken = (chosen[..., None] == torch.arange(k, device=chosen.device)) * query_low.weights[..., None]
    low_before, low_after = (step.low.loss.value.view(tasks, k).sum(1) for step in (first, outer))
    values = {
        "loss": outer.high.loss.value + low_after,
        "high_loss_before": first.high.loss.value,
        "high_loss_after": outer.high.loss.value,
        "low_loss_before": low_before,
        "low_loss_after": low_after,
        "continuity_loss": _continuity(probabilities, query_high),
        "agreement": agreeing.sum(1),
        **{f"sub_skill_share/{index}": share for index, share in enumerate(taken.sum(1).unbind(1))},
    }
    return [dict(zip(values, row, strict=True)) for row in torch.stack(list(values.values()), 1).tolist()]
