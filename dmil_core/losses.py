"""The losses of DMIL: equations 3, 4 and 15 of the paper, and the labels that tie its two levels together."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.networks import Network, mlp

Targets: TypeAlias = Int[Tensor, " steps"] | Float[Tensor, "steps sub_skills"]
"""What the high level should predict at each step: a sub-skill, or a weight for each."""


class Steps(NamedTuple):
    """The steps of several trajectories, one after the other."""

    states: Float[Tensor, "steps obs_dim"]
    actions: Float[Tensor, "steps action_dim"]
    lengths: Int[Tensor, " trajectories"]

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], normalise: Normalisation) -> "Steps":
        """Copy demonstrations into fresh tensors: what a worker receives is shared memory and stays untouched."""
        observations = np.concatenate([demonstration.observations for demonstration in demonstrations])
        actions = np.concatenate([demonstration.actions for demonstration in demonstrations])
        lengths = [len(demonstration) for demonstration in demonstrations]
        return cls(torch.from_numpy(normalise(observations)), torch.from_numpy(actions), torch.tensor(lengths))


class OutputLoss(NamedTuple):
    """A loss as a function of a network's outputs, at one point."""

    value: Float[Tensor, ""]
    gradient: Float[Tensor, "steps outputs"]
    curvature: Callable[[Float[Tensor, "steps outputs"]], Float[Tensor, "steps outputs"]]
    """Multiplies by the Hessian."""

    def plus(self, other: "OutputLoss", weight: float) -> "OutputLoss":
        """Return this loss plus `weight` times another of the same outputs."""
        return OutputLoss(
            self.value + weight * other.value,
            self.gradient + weight * other.gradient,
            lambda direction: self.curvature(direction) + weight * other.curvature(direction),
        )


def differentiated(
    loss: Callable[[Float[Tensor, "steps outputs"]], Float[Tensor, ""]], outputs: Float[Tensor, "steps outputs"]
) -> OutputLoss:
    """Differentiate a loss automatically."""
    at = outputs.detach().requires_grad_()

    @torch.enable_grad()
    def curvature(direction: Tensor) -> Tensor:
        (gradient,) = torch.autograd.grad(loss(at), at, create_graph=True)
        return torch.autograd.grad(gradient, at, direction)[0]

    with torch.enable_grad():
        value = loss(at)
    (gradient,) = torch.autograd.grad(value, at)
    return OutputLoss(value.detach(), gradient, curvature)


def squared_errors(
    predictions: Float[Tensor, "steps action_dim"], actions: Float[Tensor, "steps action_dim"]
) -> Float[Tensor, " steps"]:
    """Return ‖π_k(s_t) − a_t‖² for each step."""
    return (predictions - actions).square().sum(-1)


def bank_errors(networks: Sequence[Network], steps: Steps) -> Float[Tensor, "sub_skills steps"]:
    """Return ‖π_k(s_t) − a_t‖² of every network at every step."""
    return torch.stack([squared_errors(mlp(network, steps.states), steps.actions) for network in networks])


def sub_skill_labels(errors: Float[Tensor, "sub_skills steps"]) -> Int[Tensor, " steps"]:
    """Return the sub-skill with the least squared error for each step: the E-step of the hard EM (equation 3)."""
    return errors.argmin(0)


def soft_labels(
    errors: Float[Tensor, "sub_skills steps"], deviation: float, *, transposed: bool = True
) -> Float[Tensor, "steps sub_skills"]:
    """Return the posterior of each sub-skill, softmax_k(−‖π_k(s_t) − a_t‖² / 2σ²): the E-step of the soft EM (E.6).

    Args:
        errors: squared, of each sub-skill at each step.
        deviation: σ.
        transposed: without it the matrix is read out row by row into one of the wanted shape, as in the authors'
            released code: a step is then given the weights of other steps, which need not add up to 1.
    """
    posterior = (errors / (-2 * deviation**2)).softmax(0)
    return posterior.T if transposed else posterior.reshape(posterior.shape[::-1])


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


def behaviour_cloning_loss(
    predictions: Float[Tensor, "steps action_dim"], actions: Float[Tensor, "steps action_dim"]
) -> OutputLoss:
    """Return one sub-skill's squared error ‖π_k(s) − a‖², averaged over its own states (equation 4).

    Each sub-skill has its own average, so one with few states learns as fast as one with many.
    """
    errors, scale = predictions - actions, 2 / len(actions)
    return OutputLoss(errors.square().sum() / len(actions), scale * errors, lambda direction: scale * direction)


def switching(probabilities: Float[Tensor, "steps sub_skills"]) -> Float[Tensor, " pairs"]:
    """Return the probability that independent draws at two consecutive steps differ: 1 − Σ_k p_t[k]·p_{t+1}[k]."""
    return 1 - (probabilities[:-1] * probabilities[1:]).sum(-1)


def continuity_loss(
    probabilities: Float[Tensor, "steps sub_skills"], lengths: Int[Tensor, " trajectories"]
) -> Float[Tensor, ""]:
    """Return the expected number of switches per step, averaged over trajectories (equation 15, differentiable).

    Equation 15 counts ẑ_{t+1} ≠ ẑ_t within a trajectory and divides by its length. The count has no gradient; its
    expectation under independent draws from π_h has one, and equals the count when π_h is certain. A pair of steps
    on both sides of a trajectory's end is no switch.
    """
    trajectory = torch.repeat_interleave(torch.arange(len(lengths)), lengths)
    within = trajectory[1:] == trajectory[:-1]
    weight = within.to(probabilities.dtype) / lengths[trajectory[:-1]]
    return (switching(probabilities) * weight).sum() / len(lengths)
