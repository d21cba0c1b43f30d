"""A policy of one network, its first weights and its fine-tuning."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from dmil_core.demonstrations import Normalisation
from dmil_core.fine_tuning import fixed, free, mean_error, on_batches
from dmil_core.losses import Steps
from dmil_core.methods.base import Decision, NormalisedPolicy
from dmil_core.methods.path_context import PathGuide
from dmil_core.networks import Network, Parameters, descend, initialise, mlp
from dmil_core.settings import FineTuning, NetworkConfig


@dataclass(frozen=True)
class NetworkPolicy(NormalisedPolicy):
    """One network acts: a = π(s)."""

    network: Network
    normalise: Normalisation
    guide: PathGuide | None = None
    """What sees the demonstrations while the policy acts, if anything does."""

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes memory_dim"]
    ) -> Decision:
        """Choose one action for each episode."""
        decision = super().act(observations, memory)
        if self.guide is None:
            return decision
        return decision._replace(actions=self.guide.blend(torch.from_numpy(decision.actions), observations).numpy())

    def actions(self, states: Float32[Tensor, "episodes obs_dim"]) -> Float32[Tensor, "episodes action_dim"]:
        """Return the network's action in each normalised state."""
        return mlp(self.network, states)


def initial_network(config: NetworkConfig, obs_dim: int, action_dim: int, rng: np.random.Generator) -> Parameters:
    """Draw the parameters ``policy.*`` of one network π(a|s)."""
    return initialise("policy", [obs_dim, *config.hidden, action_dim], rng, output_scale=config.output_scale)


def fine_tuned(policy: Network, steps: Steps, optimiser: type[torch.optim.Optimizer], tuning: FineTuning) -> Network:
    """Return a copy of a network after `tuning.steps` steps of an optimiser down L_BC."""
    layers = free(policy)
    if tuning.optimiser == "adam":
        on_batches([layers], lambda batch: mean_error(mlp(layers, batch.states), batch.actions), steps, tuning)
        return fixed(layers)
    descent = optimiser([tensor for layer in layers for tensor in layer], lr=tuning.learning_rate)  # pyright: ignore[reportCallIssue]
    for _ in range(tuning.steps):
        descend(descent, mean_error(mlp(layers, steps.states), steps.actions))
    return fixed(layers)
