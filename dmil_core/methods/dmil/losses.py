"""The losses of DMIL's high level: equations 3 and 15 of the paper, and the targets that tie it to the sub-skills."""

from typing import Literal, TypeAlias

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.losses import OutputLoss, differentiated, sub_skill_labels
from dmil_core.methods.dmil.config import DmilConfig

Targets: TypeAlias = Int[Tensor, " steps"] | Float[Tensor, "steps sub_skills"]
"""What the high level should predict at each step: a sub-skill, or a weight for each."""


def soft_labels(
    errors: Float[Tensor, "sub_skills steps"], deviation: float, *, transposed: bool = True
) -> Float[Tensor, "steps sub_skills"]:
    """Return the posterior of each sub-skill, softmax_k(−‖π_k(s_t) − a_t‖² / 2σ²): the E-step of the soft EM (E.6).

    The errors are squared, and σ is `deviation`. Not `transposed`, the matrix is read out row by row into one of the
    wanted shape, as in the authors' released code: a step is then given the weights of other steps, which need not add
    up to 1.
    """
    posterior = (errors / (-2 * deviation**2)).softmax(0)
    return posterior.T if transposed else posterior.reshape(posterior.shape[::-1])


SHARPNESS, ROUNDS = 0.05, 20
"""Entropic regularisation of balanced labels, in units of the mean error, and their rounds of normalisation."""


def balanced_labels(errors: Float[Tensor, "sub_skills steps"]) -> Int[Tensor, " steps"]:
    """Return the sub-skill of each step so that each has about as many: argmax of the Sinkhorn plan (Cuturi 2013).

    The plan gives each step a total weight of one and each sub-skill an equal part of all, at the least total error, as
    SwAV assigns prototypes (Caron et al. 2020).
    """
    plan = errors.T / (-SHARPNESS * errors.mean().clamp_min(1e-12))
    for _ in range(ROUNDS):
        plan = plan - plan.logsumexp(0, keepdim=True)
        plan = plan - plan.logsumexp(1, keepdim=True)
    return plan.argmax(1)


def hard_labels(errors: Float[Tensor, "sub_skills steps"], config: DmilConfig) -> Int[Tensor, " steps"]:
    """Return the sub-skill that should act at each step, balanced or not."""
    return sub_skill_labels(errors) if config.balance == "none" else balanced_labels(errors)


def targets_of(errors: Float[Tensor, "sub_skills steps"], config: DmilConfig, *, inner: bool) -> Targets:
    """Return what the high level should predict; in the outer loop, the reference's labels are hard."""
    if config.em == "hard" or (config.em == "reference_soft" and not inner):
        return hard_labels(errors, config)
    return soft_labels(errors, config.posterior_deviation, transposed=config.em == "soft")


def cross_entropy(logits: Float[Tensor, "steps sub_skills"], targets: Targets) -> OutputLoss:
    """Return the cross-entropy of π_h to the targets, averaged over the steps (equation 3)."""
    log_probabilities, steps = logits.log_softmax(-1), len(targets)
    probabilities = log_probabilities.exp()
    if targets.is_floating_point():
        mass = targets.sum(-1, keepdim=True)
        value, gradient = -(targets * log_probabilities).sum() / steps, (mass * probabilities - targets) / steps
    else:
        mass, value = 1, functional.nll_loss(log_probabilities, targets)
        gradient = probabilities / steps
        gradient[torch.arange(steps, device=targets.device), targets] -= 1 / steps

    def curvature(direction: Tensor) -> Tensor:
        weighted = probabilities * direction
        return mass * (weighted - probabilities * weighted.sum(-1, keepdim=True)) / steps

    return OutputLoss(value, gradient, curvature)


def high_level_loss(
    logits: Float[Tensor, "steps sub_skills"],
    targets: Targets,
    lengths: Int[Tensor, " trajectories"],
    continuity_weight: float,
    continuity: Literal["expected", "reference"] = "expected",
) -> OutputLoss:
    """Return the cross-entropy of π_h to the targets (equation 3) plus λ times the continuity loss (Appendix C).

    The reference's continuity loss counts the switches of the most probable sub-skill and so has no gradient.
    """
    loss = cross_entropy(logits, targets)
    if not continuity_weight:
        return loss
    if continuity == "reference":
        certain = functional.one_hot(logits.argmax(-1), logits.shape[-1]).to(logits.dtype)
        return loss._replace(value=loss.value + continuity_weight * continuity_loss(certain, lengths))
    expected = differentiated(lambda outputs: continuity_loss(outputs.softmax(-1), lengths), logits)
    return loss.plus(expected, continuity_weight)


def switching(probabilities: Float[Tensor, "*tasks steps sub_skills"]) -> Float[Tensor, "*tasks pairs"]:
    """Return the probability that independent draws at two consecutive steps differ: 1 − Σ_k p_t[k]·p_{t+1}[k]."""
    return 1 - (probabilities[..., :-1, :] * probabilities[..., 1:, :]).sum(-1)


def pair_weights(lengths: Int[Tensor, " trajectories"], dtype: torch.dtype) -> Float[Tensor, " pairs"]:
    """Return one by the length of the trajectory that two consecutive steps lie in; zero if they are of two."""
    trajectory = torch.repeat_interleave(torch.arange(len(lengths), device=lengths.device), lengths)
    within = trajectory[1:] == trajectory[:-1]
    return within.to(dtype) / lengths[trajectory[:-1]]


def continuity_loss(
    probabilities: Float[Tensor, "steps sub_skills"], lengths: Int[Tensor, " trajectories"]
) -> Float[Tensor, ""]:
    """Return the expected number of switches per step, averaged over trajectories (equation 15, differentiable).

    Equation 15 counts ẑ_{t+1} ≠ ẑ_t within a trajectory and divides by its length. The count has no gradient; its
    expectation under independent draws from π_h has one, and equals the count when π_h is certain. A pair of steps
    on both sides of a trajectory's end is no switch.
    """
    return (switching(probabilities) * pair_weights(lengths, probabilities.dtype)).sum() / len(lengths)
