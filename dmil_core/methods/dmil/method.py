"""Dual Meta Imitation Learning (Gao et al. 2022): both levels of a hierarchical policy are meta-learned.

A high-level network π_h(z|s) picks one of K sub-skills π_k(a|s) at each step. Per task, the inner loop (Algorithm 1)
alternates
    θ_h ← θ_h − α ∇[CE(π_h, argmin_k ‖π_k(s) − a‖²) + λ L_aux]        on τ1 (equations 3 and 15),
    θ_k ← θ_k − α ∇ mean ‖π_k(s) − a‖² over {s : argmax π_h(s) = k}    on τ2 (equation 4),
and the outer loop descends the same losses at the adapted parameters on τ3 and τ4. The paper's variants are settings:
DMIL-High and DMIL-Low (F.3) adapt one level only, DMIL_nc (E.5) has λ = 0, DMIL_soft (E.6) a soft target for π_h.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, Normalisation, TaskBatch, sample_task_batch
from dmil_core.losses import Steps
from dmil_core.methods.base import Decision, FineTuning, Memoryless, MetaLearner, SubSkillUse, TaskGradient
from dmil_core.methods.dmil import adaptation, meta_gradient
from dmil_core.methods.dmil.adaptation import Hierarchy
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.networks import Parameters, initialise


@dataclass(frozen=True)
class DmilPolicy(Memoryless):
    """The most probable sub-skill acts: a = π_k(s), k = argmax π_h(s)."""

    hierarchy: Hierarchy
    normalise: Normalisation

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action and its sub-skill for each episode."""
        actions, chosen = adaptation.act(self.hierarchy, torch.from_numpy(self.normalise(observations)))
        return Decision(actions.numpy(), chosen.numpy(), memory)

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return the high level's choice and the argmin label (equation 3) at each step."""
        steps = Steps.of([demonstration], self.normalise)
        chosen = adaptation.choose(self.hierarchy.high, steps.states)
        return SubSkillUse(chosen.numpy(), adaptation.label(self.hierarchy.low, steps).numpy())


@dataclass(frozen=True)
class Dmil(MetaLearner[DmilConfig, TaskBatch]):
    """DMIL for observations and actions of given sizes."""

    config_type = DmilConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the high level and the bank of sub-skills."""
        hidden = [self.config.hidden_units] * self.config.hidden_layers
        k, scale = self.config.sub_skills, self.config.output_scale
        return {
            **initialise("high", [self.obs_dim, *hidden, k], rng, output_scale=scale),
            **initialise("low", [self.obs_dim, *hidden, self.action_dim], rng, copies=k, output_scale=scale),
        }

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> TaskBatch:
        """Draw τ1 to τ4."""
        return sample_task_batch(demonstrations, self.config.trajectories, self.config.window, rng)

    def task_gradient(self, parameters: Parameters, batch: TaskBatch) -> TaskGradient:
        """Return the outer gradient of Algorithm 1 for one task."""
        support_high, support_low, query_high, query_low = (
            Steps.of(demonstrations, self.normalise) for demonstrations in batch.sets
        )
        return meta_gradient.task_gradient(parameters, support_high, support_low, query_high, query_low, self.config)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> DmilPolicy:
        """Run the dual inner loop with the support set as both τ1 and τ2."""
        steps = Steps.of(support, self.normalise)
        config = self.config.model_copy(update={"inner_learning_rate": fine_tuning.learning_rate})
        adapted = adaptation.adapt(Hierarchy.of(parameters), steps, steps, config, steps=fine_tuning.steps)
        return DmilPolicy(adapted.hierarchy, self.normalise)
