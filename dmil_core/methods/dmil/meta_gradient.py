"""The outer gradient of Algorithm 1 for one task."""

import itertools
from collections.abc import Mapping

import torch

from dmil_core.loss_gradients import LossGradient
from dmil_core.losses import Steps, bank_errors, sub_skill_labels
from dmil_core.methods.base import TaskGradient
from dmil_core.methods.dmil.adaptation import Hierarchy, choose, high_level_gradient, inner_loop, sub_skill_gradients
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.losses import continuity_loss, hard_labels, targets_of
from dmil_core.networks import Parameters, zeros_like


def task_gradient(
    parameters: Parameters,
    support_high: Steps,
    support_low: Steps,
    query_high: Steps,
    query_low: Steps,
    config: DmilConfig,
    *,
    on_labels: bool = False,
) -> TaskGradient:
    """Return ∇_θ [L_h(λ_h, τ3) + Σ_k L_BC(λ_lk, D_4k)] of one task (Algorithm 1).

    λ_h and λ_l come from the dual inner loop on τ1 and τ2; of a level that it does not adapt they are θ. With
    ``config.order == "first"`` the gradient is taken at the adapted parameters (FOMAML, Finn et al. 2017). With
    ``"second"`` it is exact: each inner step's Jacobian I − αH pulls it back to θ, the last step first. Targets and
    choices have no gradient, so each network's steps are a chain of their own. With `on_labels` D_4k are the states
    with the label k.
    """
    second, rate = config.order == "second", config.inner_learning_rate
    loop = inner_loop(Hierarchy.of(parameters), support_high, support_low, config, keep=second, on_labels=on_labels)
    path = list(itertools.islice(loop, config.inner_steps))
    high, low = path[-1].adapted

    errors = bank_errors(low, query_high)
    of_high = high_level_gradient(high, query_high, targets_of(errors, config, inner=False), config)
    chosen = choose(high, query_low.states)
    own = hard_labels(bank_errors(low, query_low), config) if on_labels else chosen
    of_low = sub_skill_gradients(low, query_low, own)

    gradient, views = zeros_like(parameters)
    vector = Hierarchy.of(views)
    of_high.add_to(vector.high)
    for k, outer in of_low.items():
        outer.add_to(vector.low[k])
    if second:
        for step in reversed(path):
            if config.adapted != "low":
                step.high.jacobian_product(vector.high, rate)
            if config.adapted != "high":
                for k in step.low.keys() & of_low.keys():
                    step.low[k].jacobian_product(vector.low[k], rate)

    probabilities = of_high.outputs.softmax(-1)
    shares = torch.bincount(chosen, minlength=config.sub_skills) / len(chosen)
    high_loss, low_loss = of_high.loss.value.item(), _total(of_low)
    metrics = {
        "loss": high_loss + low_loss,
        "high_loss_before": path[0].high.loss.value.item(),
        "high_loss_after": high_loss,
        "low_loss_before": _total(path[0].low),
        "low_loss_after": low_loss,
        "continuity_loss": continuity_loss(probabilities, query_high.lengths).item(),
        "agreement": (probabilities.argmax(-1) == sub_skill_labels(errors)).float().mean().item(),
        **{f"sub_skill_share/{k}": share for k, share in enumerate(shares.tolist())},
    }
    return TaskGradient(gradient, metrics)


def _total(gradients: Mapping[int, LossGradient]) -> float:
    """Return Σ_k L_BC."""
    return sum(of_sub_skill.loss.value.item() for of_sub_skill in gradients.values())
