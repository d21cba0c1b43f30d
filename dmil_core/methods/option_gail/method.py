"""OptionGAIL and its offline half as methods: what they draw, their gradients and their adaptation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dmil_core.demonstrations import Demonstration
from dmil_core.losses import Steps
from dmil_core.methods.base import DemonstrationBatch, FineTuning, MetaLearner, OnlineMetaLearner, TaskGradient
from dmil_core.methods.option_gail.adversary import (
    POLICY,
    OptionSteps,
    discriminate,
    discriminator_logits,
    imitation_rewards,
    improve,
    named,
    orthogonal,
    ppo_targets,
)
from dmil_core.methods.option_gail.config import OptionGailConfig, OptionGailOfflineConfig
from dmil_core.methods.option_gail.option_model import (
    Chain,
    OptionModel,
    pairs_of,
    posterior,
    viterbi,
    weighted_log_likelihood,
)
from dmil_core.methods.option_gail.policy import OptionExplorationPolicy, OptionPolicy
from dmil_core.networks import Adam, Parameters, descend, flat_gradient, flatten, initialise, leaves, without_graph
from dmil_core.trajectories import Rollout

Phase = Literal["likelihood", "hard", "adversarial"]


@dataclass(frozen=True)
class OptionBatch(DemonstrationBatch):
    """Whole demonstrations of a task, what is done with them, and what came of acting."""

    phase: Phase
    rollouts: tuple[Rollout, ...] = ()


class _EmLoss(NamedTuple):
    loss: Float[Tensor, ""]
    """To differentiate: its value is the negative log-likelihood for hard EM only."""
    metrics: dict[str, float]
    pairs: Float[Tensor, "steps before options"]


class _Options(MetaLearner[Any, OptionBatch]):
    """What both methods share: one option model, by EM."""

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the option model: σ = 1."""
        hidden, k, scale = self.config.hidden, self.config.sub_skills, self.config.output_scale
        return {
            **initialise("high", [self.input_dim, *hidden, (k + 1) * k], rng, output_scale=scale),
            **initialise("low", [self.input_dim, *hidden, self.action_dim], rng, copies=k, output_scale=scale),
            "log_deviations": torch.zeros(k, self.action_dim),
        }

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> OptionPolicy:
        """Take steps of Adam up the complete-data log-likelihood of the support set, relabelled before each."""
        policy = {name: tensor for name, tensor in parameters.items() if name.startswith(POLICY)}
        adapted = leaves(policy, copy=True)
        descent = Adam(adapted.values(), fine_tuning.learning_rate)
        steps = Steps.of(support, self.normalise)
        for _ in range(fine_tuning.steps):
            descend(descent, self._em_loss(adapted, steps, "hard").loss)
        return OptionPolicy(self._model(without_graph(adapted)), self.normalise)

    def _model(self, parameters: Parameters) -> OptionModel:
        return OptionModel.of(parameters, self.config.least_log_deviation)

    def _draw(self, demonstrations: Sequence[Demonstration], phase: Phase, rng: np.random.Generator) -> OptionBatch:
        """Draw a slot's demonstrations, each at most once."""
        count = min(self.config.trajectories, len(demonstrations))
        chosen = rng.choice(len(demonstrations), count, replace=False)
        return OptionBatch(tuple(demonstrations[index] for index in chosen), int(rng.integers(2**63)), phase)

    def _em_loss(self, parameters: Parameters, steps: Steps, phase: Phase) -> _EmLoss:
        """Return what EM goes down, per step: the E-step's weights are held fixed."""
        model, count = self._model(parameters), len(steps.states)
        log_high, log_low = model.log_high(steps.states), model.log_low(steps.states, steps.actions)
        chain = Chain.of(log_high.detach(), log_low.detach(), steps.lengths)
        if phase == "likelihood":
            log_likelihoods, pairs = posterior(chain)
            value = -log_likelihoods.sum().item() / count
        else:
            pairs, value = pairs_of(viterbi(chain), steps.lengths, model.options), None
        loss = -weighted_log_likelihood(log_high, log_low, pairs) / count
        within = pairs[:, : model.options]
        metrics = {
            "loss": loss.item() if value is None else value,
            "switches": 1 - (within.diagonal(dim1=1, dim2=2).sum() / within.sum().clamp(min=1)).item(),
            "deviation": model.log_deviations.detach().exp().mean().item(),
            **{f"sub_skill_share/{k}": share for k, share in enumerate(pairs.mean(0).sum(0).tolist())},
        }
        return _EmLoss(loss, metrics, pairs)


class OptionGailOffline(_Options):
    """Maximum likelihood, then hard EM, for observations and actions of given sizes."""

    config_type = OptionGailOfflineConfig

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> OptionBatch:
        """Draw whole demonstrations."""
        phase = "likelihood" if iteration < self.config.likelihood_iterations else "hard"
        return self._draw(demonstrations, phase, rng)

    def task_gradient(self, parameters: Parameters, batch: OptionBatch) -> TaskGradient:
        """Return the gradient of −log p per step: of the actions, or of the actions and Viterbi's labels."""
        free = leaves(parameters)
        em = self._em_loss(free, Steps.of(batch.demonstrations, self.normalise), batch.phase)
        return TaskGradient(flat_gradient(em.loss, free), em.metrics)


class OptionGail(_Options, OnlineMetaLearner[Any, OptionBatch]):
    """OptionGAIL for observations and actions of given sizes."""

    config_type = OptionGailConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the option model, the critic V_L(s, o) and the discriminator."""
        k, critic, units = self.config.sub_skills, self.config.critic_units, self.config.discriminator_units
        return {
            **super().initial_parameters(rng),
            **orthogonal("critic", [self.input_dim, critic, critic, k], rng),
            **orthogonal("discriminator", [self.input_dim + self.action_dim, units, units, (k + 1) * k], rng),
        }

    def environment_steps(self, iteration: int) -> int:
        """Return none before the adversarial iterations."""
        return 0 if iteration < self.config.offline_iterations else self.config.environment_steps

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> OptionBatch:
        """Draw whole demonstrations."""
        if iteration >= self.config.offline_iterations:
            return self._draw(demonstrations, "adversarial", rng)
        phase = "likelihood" if iteration < self.config.likelihood_iterations else "hard"
        return self._draw(demonstrations, phase, rng)

    def exploration_policy(self, parameters: Parameters, batch: OptionBatch) -> OptionExplorationPolicy:
        """Return the option model, which acts at random."""
        model = self._model(without_graph(parameters))
        return OptionExplorationPolicy(model, self.normalise, batch.seed)

    def with_rollouts(self, batch: OptionBatch, rollouts: Sequence[Rollout]) -> OptionBatch:
        """Keep the rollouts that have a step."""
        return replace(batch, rollouts=tuple(rollout for rollout in rollouts if len(rollout.actions)))

    def task_gradient(self, parameters: Parameters, batch: OptionBatch) -> TaskGradient:
        """Return the way that the slot's own steps of Adam went, before minus after."""
        moved = leaves(parameters, copy=True)
        demonstrated = Steps.of(batch.demonstrations, self.normalise)
        if batch.phase == "adversarial":
            metrics = self._adversarial_round(moved, demonstrated, batch)
        else:
            metrics = self._offline_steps(moved, demonstrated, batch.phase)
        with torch.no_grad():
            return TaskGradient(flatten({name: parameters[name] - moved[name] for name in moved}), metrics)

    def _offline_steps(self, moved: dict[str, Tensor], demonstrated: Steps, phase: Phase) -> dict[str, float]:
        """Descend in place, and return the metrics before."""
        descent = Adam(named(moved, POLICY), self.config.offline_learning_rate)
        metrics = []
        for _ in range(self.config.offline_steps):
            em = self._em_loss(moved, demonstrated, phase)
            metrics.append(em.metrics)
            descend(descent, em.loss)
        return metrics[0]

    def _adversarial_round(self, moved: dict[str, Tensor], demonstrated: Steps, batch: OptionBatch) -> dict[str, float]:
        """Relabel, discriminate and improve in place, and return the metrics."""
        generator, rollouts = torch.Generator().manual_seed(batch.seed), batch.rollouts
        with torch.no_grad():
            labelled = self._em_loss(moved, demonstrated, "hard")
        start = self.config.sub_skills
        expert = OptionSteps.of(demonstrated, labelled.pairs.sum(1).argmax(-1), start)
        rollout_steps = OptionSteps.of_rollouts(rollouts, self.normalise, start)
        discriminator_metrics = discriminate(moved, rollout_steps, expert, self.config, generator)
        with torch.no_grad():
            rewards = imitation_rewards(discriminator_logits(moved, rollout_steps, start))
        last = np.stack([rollout.observations[-1] for rollout in rollouts])
        targets = ppo_targets(moved, rollout_steps, rewards, torch.from_numpy(self.normalise(last)), self.config)
        return {
            **labelled.metrics,
            **discriminator_metrics,
            "reward": rewards.mean().item(),
            **improve(moved, rollout_steps, targets, self.config, generator),
            "environment_steps": float(len(rollout_steps.options)),
            "practice_success": float(np.mean([rollout.success for rollout in rollouts])),
        }
