"""The outer gradient of Algorithm 1 for one task, and the fixed tree that adds the tasks' gradients."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dmil_core.adaptation import adapt, choose, high_level_objective, label, sub_skill_objective
from dmil_core.configs import DmilConfig
from dmil_core.losses import Steps, continuity_loss
from dmil_core.networks import Parameters, flatten, mlp, part

__all__ = ["TaskGradient", "task_gradient", "tree_sum"]


class TaskGradient(NamedTuple):
    """One task's contribution to the outer step, flat in the parameters' order, and what to show of it."""

    gradient: Float[Tensor, " size"]
    metrics: Mapping[str, float]


def task_gradient(
    parameters: Parameters,
    support_high: Steps,
    support_low: Steps,
    query_high: Steps,
    query_low: Steps,
    config: DmilConfig,
) -> TaskGradient:
    """Return ∇_θ [L_h(λ_h, τ3) + Σ_k L_BC(λ_lk, D_4k)] of one task (Algorithm 1).

    λ_h and λ_l come from the dual inner loop on τ1 and τ2. With ``config.order == "second"`` the gradient is exact,
    through all inner steps; with ``"first"`` it is taken at the adapted parameters (FOMAML, Finn et al. 2017).
    """
    second = config.order == "second"
    origin = {name: tensor.detach().requires_grad_(second) for name, tensor in parameters.items()}
    adapted = adapt(
        origin,
        support_high,
        support_low,
        steps=config.inner_steps,
        learning_rate=config.inner_learning_rate,
        continuity_weight=config.continuity_weight,
        differentiable=second,
    )
    leaves = origin if second else {name: t.detach().requires_grad_() for name, t in adapted.parameters.items()}
    final = adapted.parameters if second else leaves
    high, low = part(final, "high"), part(final, "low")

    labels = label(low, query_high)
    high_loss = high_level_objective(high, query_high, labels, config.continuity_weight)
    chosen = choose(high, query_low.states)
    low_loss = sub_skill_objective(low, query_low, chosen)
    gradients = torch.autograd.grad(high_loss + low_loss, list(leaves.values()))

    with torch.no_grad():
        probabilities = mlp(high, query_high.states).softmax(-1)
        shares = torch.bincount(chosen, minlength=config.sub_skills) / len(chosen)
        metrics = {
            "high_loss_before": adapted.high_losses[0],
            "high_loss_after": high_loss.item(),
            "low_loss_before": adapted.low_losses[0],
            "low_loss_after": low_loss.item(),
            "continuity_loss": continuity_loss(probabilities, query_high.lengths).item(),
            "agreement": (probabilities.argmax(-1) == labels).float().mean().item(),
            **{f"sub_skill_share/{k}": share for k, share in enumerate(shares.tolist())},
        }
    return TaskGradient(flatten(dict(zip(leaves, gradients, strict=True))), metrics)


def tree_sum(terms: Sequence[Tensor]) -> Tensor:
    """Add `terms` pairwise, neighbours first: the same bits whoever computed which term, and when."""
    while len(terms) > 1:
        terms = [sum(terms[index + 1 : index + 2], terms[index]) for index in range(0, len(terms), 2)]
    return terms[0]
