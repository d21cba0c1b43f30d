"""Squared errors of sub-skills, the labels that follow from them (equation 3) and L_BC (equation 4)."""

from collections.abc import Callable, Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.networks import Network, mlp


class Steps(NamedTuple):
    """The steps of several trajectories, one after the other."""

    states: Float[Tensor, "steps obs_dim"]
    actions: Float[Tensor, "steps action_dim"]
    lengths: Int[Tensor, " trajectories"]

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], normalise: Normalisation) -> "Steps":
        """Copy demonstrations into fresh tensors: what a worker receives is shared memory and stays untouched.

        On a GPU, torch's default device then, each whole demonstration is copied once and stays there.
        """
        device = torch.get_default_device()
        if device.type != "cpu":
            states, actions = zip(*(_resident(one, normalise, device) for one in demonstrations), strict=True)
            return cls(torch.cat(states), torch.cat(actions), torch.tensor([len(one) for one in demonstrations]))
        observations = np.concatenate([demonstration.observations for demonstration in demonstrations])
        actions = np.concatenate([demonstration.actions for demonstration in demonstrations])
        lengths = [len(demonstration) for demonstration in demonstrations]
        return cls(torch.from_numpy(normalise(observations)), torch.from_numpy(actions), torch.tensor(lengths))


_RESIDENTS: WeakKeyDictionary[Demonstration, tuple[Normalisation, Tensor, Tensor]] = WeakKeyDictionary()
"""States and actions of whole demonstrations on a GPU, for as long as the demonstrations are."""


def _resident(
    one: Demonstration, normalise: Normalisation, device: torch.device
) -> tuple[Float[Tensor, "steps obs_dim"], Float[Tensor, "steps action_dim"]]:
    """Return a demonstration's states and actions on a device; those of a window are a part of the whole one's."""
    whole, start = one.cut_from or (one, 0)
    kept = _RESIDENTS.get(whole)
    if kept is None or kept[0] is not normalise or kept[1].device.type != device.type:
        states, actions = (
            torch.tensor(values, device=device) for values in (normalise(whole.observations), whole.actions)
        )
        kept = _RESIDENTS[whole] = normalise, states, actions
    return kept[1][start : start + len(one)], kept[2][start : start + len(one)]


class OutputLoss(NamedTuple):
    """A loss as a function of a network's outputs, at one point; or that of each of several networks."""

    value: Float[Tensor, "*networks"]
    gradient: Float[Tensor, "*networks steps outputs"]
    curvature: Callable[[Float[Tensor, "*networks steps outputs"]], Float[Tensor, "*networks steps outputs"]]
    """Multiplies by the Hessian."""

    def plus(self, other: "OutputLoss", weight: float) -> "OutputLoss":
        """Return this loss plus `weight` times another of the same outputs."""
        return OutputLoss(
            self.value + weight * other.value,
            self.gradient + weight * other.gradient,
            lambda direction: self.curvature(direction) + weight * other.curvature(direction),
        )


def differentiated(
    loss: Callable[[Float[Tensor, "*networks steps outputs"]], Float[Tensor, "*networks"]],
    outputs: Float[Tensor, "*networks steps outputs"],
) -> OutputLoss:
    """Differentiate a loss automatically; that of one of several networks depends on its own outputs alone."""
    at = outputs.detach().requires_grad_()

    @torch.enable_grad()
    def curvature(direction: Tensor) -> Tensor:
        (gradient,) = torch.autograd.grad(loss(at).sum(), at, create_graph=True)
        # Given the direction itself, torch imports sympy, which takes half a second of every worker's start.
        return torch.autograd.grad((gradient * direction).sum(), at)[0]

    with torch.enable_grad():
        value = loss(at)
        (gradient,) = torch.autograd.grad(value.sum(), at)
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


def behaviour_cloning_loss(
    predictions: Float[Tensor, "steps action_dim"], actions: Float[Tensor, "steps action_dim"]
) -> OutputLoss:
    """Return one sub-skill's squared error ‖π_k(s) − a‖², averaged over its own states (equation 4).

    Each sub-skill has its own average, so one with few states learns as fast as one with many.
    """
    errors, scale = predictions - actions, 2 / len(actions)
    return OutputLoss(errors.square().sum() / len(actions), scale * errors, lambda direction: scale * direction)
