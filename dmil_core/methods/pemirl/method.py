"""PEMIRL as a method: what it draws, its gradient and its adaptation."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.methods.base import FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.behaviour_cloning.policy import NetworkPolicy
from dmil_core.methods.pemirl.config import PemirlConfig
from dmil_core.methods.pemirl.losses import BOUND, Transitions, infer, losses_of
from dmil_core.networks import Layer, Parameters, flat_gradient, initialise, leaves, network


@dataclass(frozen=True)
class ContextBatch:
    """What one slot of an iteration learns from."""

    contexts: tuple[Demonstration, ...]
    """Those that m is inferred from."""
    explained: tuple[Demonstration, ...]
    """Those that the policy should explain with it."""
    seed: int
    """Of all that is drawn later."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of the demonstrations in it."""
        return tuple(demonstration.id for demonstration in (*self.contexts, *self.explained))


class Pemirl(MetaLearner[PemirlConfig, ContextBatch]):
    """PEMIRL for observations and actions of given sizes."""

    config_type = PemirlConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the four models; only σ is set."""
        config = self.config
        of_policy, of_reward = (
            [config.hidden_units] * layers for layers in (config.hidden_layers, config.reward_layers)
        )
        with_action, with_context = self.input_dim + self.action_dim, self.input_dim + config.context_dim
        sizes = {
            "encoder": [with_action, *of_policy, 2 * config.context_dim],
            "policy": [with_context, *of_policy, self.action_dim],
            "reward": [with_context, *of_reward, 1],
            "potential": [with_context, *of_reward, 1],
        }
        parameters: dict[str, torch.Tensor] = {}
        for prefix, units in sizes.items():
            parameters |= initialise(prefix, units, rng, output_scale=config.output_scale)
        raw = BOUND * math.atanh(math.log(config.initial_deviation) / BOUND)
        return {**parameters, "log_deviation": torch.full((self.action_dim,), raw)}

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> ContextBatch:
        """Draw the trajectories, all different where the task has as many, and name what is drawn later by a seed.

        Raises:
            DemonstrationError: if there is no demonstration.
        """
        if not demonstrations:
            raise DemonstrationError("demonstrations: got none for this task; wanted at least one; collect some first")
        contexts, wanted = self.config.contexts, self.config.contexts + self.config.trajectories
        order = [rng.permutation(len(demonstrations)) for _ in range(-(-wanted // len(demonstrations)))]
        chosen = [demonstrations[index] for index in np.concatenate(order)[:wanted]]
        return ContextBatch(tuple(chosen[:contexts]), tuple(chosen[contexts:]), int(rng.integers(2**63)))

    def task_gradient(self, parameters: Parameters, batch: ContextBatch) -> TaskGradient:
        """Return the gradient of the weighted sum of all losses."""
        config, generator = self.config, torch.Generator().manual_seed(batch.seed)
        contexts, explained = (
            Transitions.of(demonstrations, self.normalise).thinned(config.steps_per_trajectory, generator)
            for demonstrations in (batch.contexts, batch.explained)
        )
        free = leaves(parameters)
        losses = losses_of(free, contexts, explained, config.discount, config.negatives, generator)
        total = (
            losses.likelihood
            + config.divergence_weight * losses.divergence
            + config.information_weight * (losses.information + losses.information_surrogate)
            + losses.discriminator
            + config.policy_weight * losses.policy
        )
        metrics = {
            "loss": total.item(),
            "likelihood_loss": losses.likelihood.item(),
            "context_divergence": losses.divergence.item(),
            "information_loss": losses.information.item(),
            "discriminator_loss": losses.discriminator.item(),
            **losses.metrics,
        }
        return TaskGradient(flat_gradient(total, free), metrics)

    def context(self, parameters: Parameters, support: Sequence[Demonstration]) -> torch.Tensor:
        """Return m of a support set: the mean of q_ψ's means over its demonstrations."""
        return infer(parameters, Transitions.of(support, self.normalise)).mean.mean(0)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> NetworkPolicy:
        """Infer m; its part of the first layer's input is the same in every state, and so goes into the bias."""
        first, *others = network(parameters, "policy")
        of_states, of_context = first.weight.split([self.input_dim, self.config.context_dim], 1)
        conditioned = Layer(of_states, first.bias + of_context @ self.context(parameters, support))
        return NetworkPolicy((conditioned, *others), self.normalise)
