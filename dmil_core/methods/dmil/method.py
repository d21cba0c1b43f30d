"""DMIL as a method: what it draws, its gradient and its adaptation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dmil_core.demonstrations import Demonstration, TaskBatch, sample_task_batch
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.dmil import adaptation, meta_gradient
from dmil_core.methods.dmil.adaptation import Hierarchy
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.policy import DmilPolicy
from dmil_core.networks import Parameters, initialise


@dataclass(frozen=True)
class Dmil(MetaLearner[DmilConfig, TaskBatch]):
    """DMIL for observations and actions of given sizes."""

    config_type = DmilConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the high level and the bank of sub-skills."""
        hidden, k, scale = self.config.hidden, self.config.sub_skills, self.config.output_scale
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
        return DmilPolicy(adapted, self.normalise)
