"""A policy of one network, its first weights and its fine-tuning."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from dmil_core.demonstrations import Normalisation
from dmil_core.losses import Steps, squared_errors
from dmil_core.methods.base import FineTuning, NormalisedPolicy
from dmil_core.networks import Layer, Network, Parameters, descend, initialise, mlp
from dmil_core.settings import NetworkConfig


@dataclass(frozen=True)
class NetworkPolicy(NormalisedPolicy):
    """One network acts: a = π(s)."""

    network: Network
    normalise: Normalisation

    def actions(self, states: Float32[Tensor, "episodes obs_dim"]) -> Float32[Tensor, "episodes action_dim"]:
        """Return the action in each normalised state."""
        return mlp(self.network, states)


def initial_network(config: NetworkConfig, obs_dim: int, action_dim: int, rng: np.random.Generator) -> Parameters:
    """Draw the parameters ``policy.*`` of one network π(a|s)."""
    return initialise("policy", [obs_dim, *config.hidden, action_dim], rng, output_scale=config.output_scale)


def fine_tuned(policy: Network, steps: Steps, optimiser: type[torch.optim.Optimizer], tuning: FineTuning) -> Network:
    """Return a copy of a network after `tuning.steps` steps of an optimiser down L_BC."""
    layers = tuple(Layer(*(tensor.detach().clone().requires_grad_() for tensor in layer)) for layer in policy)
    descent = optimiser([tensor for layer in layers for tensor in layer], lr=tuning.learning_rate)  # pyright: ignore[reportCallIssue]
    for _ in range(tuning.steps):
        descend(descent, squared_errors(mlp(layers, steps.states), steps.actions).mean())
    return tuple(Layer(*(tensor.detach() for tensor in layer)) for layer in layers)
