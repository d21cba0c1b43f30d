"""The dual inner loop of Algorithm 1: the high level first, then the sub-skills under the adapted high level."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmil_core.losses import Steps, behaviour_cloning_loss, high_level_loss, sub_skill_labels
from dmil_core.networks import Parameters, bank, bank_each, mlp, own_states, part

__all__ = ["Adapted", "adapt", "choose", "high_level_objective", "label", "sub_skill_objective"]


class Adapted(NamedTuple):
    """Adapted parameters, and each level's loss before each inner step."""

    parameters: Parameters
    high_losses: tuple[float, ...]
    low_losses: tuple[float, ...]


@torch.no_grad()
def label(low: Parameters, steps: Steps) -> Int[Tensor, " steps"]:
    """Return for each step the sub-skill that explains its action best, the target of equation 3."""
    return sub_skill_labels(bank(low, steps.states), steps.actions)


@torch.no_grad()
def choose(high: Parameters, states: Float[Tensor, "steps obs_dim"]) -> Int[Tensor, " steps"]:
    """Return for each step the sub-skill that the high level takes: argmax_k π_h(k|s)."""
    return mlp(high, states).argmax(-1)


def high_level_objective(
    high: Parameters, steps: Steps, labels: Int[Tensor, " steps"], continuity_weight: float
) -> Float[Tensor, ""]:
    """Return L_h of the high level on `steps` (equation 3 with Appendix C's term)."""
    return high_level_loss(mlp(high, steps.states), labels, steps.lengths, continuity_weight)


def sub_skill_objective(low: Parameters, steps: Steps, chosen: Int[Tensor, " steps"]) -> Float[Tensor, ""]:
    """Return Σ_k L_BC of the sub-skills, each run only on the states the high level gave it (equation 4)."""
    own = own_states(chosen, next(iter(low.values())).shape[0])
    predictions = bank_each(low, [steps.states[index] for index in own])
    return behaviour_cloning_loss(predictions, [steps.actions[index] for index in own])


def adapt(
    parameters: Parameters,
    support_high: Steps,
    support_low: Steps,
    *,
    steps: int,
    learning_rate: float,
    continuity_weight: float,
    differentiable: bool = False,
) -> Adapted:
    """Run the dual inner loop of Algorithm 1 and return the adapted parameters; `parameters` stay as they are.

    Args:
        parameters: of the high level (``high.*``) and of the sub-skills (``low.*``).
        support_high: τ1, which adapts the high level; its labels come from the current sub-skills.
        support_low: τ2, which adapts each sub-skill on the states that the adapted high level gives it. At test
            both are the support set.
        steps: of gradient descent on each level.
        learning_rate: α.
        continuity_weight: λ of Appendix C.
        differentiable: keep the graph through all steps, for the exact second-order meta-gradient.
    """
    high, low = part(parameters, "high"), part(parameters, "low")
    high_losses, low_losses = [], []
    for _ in range(steps):
        labels = label(low, support_high)
        high = _trainable(high, differentiable)
        objective = high_level_objective(high, support_high, labels, continuity_weight)
        high = _descend(high, objective, learning_rate, differentiable)
        high_losses.append(objective.item())

        chosen = choose(high, support_low.states)
        low = _trainable(low, differentiable)
        objective = sub_skill_objective(low, support_low, chosen)
        low = _descend(low, objective, learning_rate, differentiable)
        low_losses.append(objective.item())
    adapted = {**high, **low}
    return Adapted({name: adapted[name] for name in parameters}, tuple(high_losses), tuple(low_losses))


def _trainable(parameters: Parameters, differentiable: bool) -> Parameters:
    """Return `parameters`, cut from the steps before unless the whole loop is to be differentiated."""
    return parameters if differentiable else {name: t.detach().requires_grad_() for name, t in parameters.items()}


def _descend(parameters: Parameters, objective: Tensor, learning_rate: float, differentiable: bool) -> Parameters:
    """Return the parameters after one step of gradient descent."""
    gradients = torch.autograd.grad(objective, list(parameters.values()), create_graph=differentiable)
    with torch.set_grad_enabled(differentiable):
        steps = zip(parameters.items(), gradients, strict=True)
        return {name: torch.sub(tensor, gradient, alpha=learning_rate) for (name, tensor), gradient in steps}
