"""DMIL as a method: what it draws, its gradient and its adaptation."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dmil_core.demonstrations import Demonstration, TaskBatch, sample_task_batch
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.dmil import adaptation, meta_gradient
from dmil_core.methods.dmil.adaptation import Hierarchy
from dmil_core.methods.dmil.batched import task_gradients as batched_gradients
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.policy import DmilPolicy
from dmil_core.methods.path_context import (
    guide_of,
    initial_path_network,
    with_path,
    with_path_gradient,
    with_path_gradients,
)
from dmil_core.networks import Parameters, initialise


@dataclass(frozen=True)
class Dmil(MetaLearner[DmilConfig, TaskBatch]):
    """DMIL for observations and actions of given sizes."""

    config_type = DmilConfig
    on_gpu = batched = True

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the high level and the bank of sub-skills."""
        hidden, k, scale = self.config.hidden, self.config.sub_skills, self.config.output_scale
        levels = {
            **initialise("high", [self.input_dim, *hidden, k], rng, output_scale=scale),
            **initialise("low", [self.input_dim, *hidden, self.action_dim], rng, copies=k, output_scale=scale),
        }
        return {**levels, **initial_path_network(self, rng)}

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> TaskBatch:
        """Draw τ1 to τ4."""
        batch = sample_task_batch(demonstrations, self.config.trajectories, self.config.window, rng)
        batch = dataclasses.replace(batch, on_labels=iteration < self.config.labels_until)
        return with_path(self, batch, demonstrations, rng)

    def _sets(self, batch: TaskBatch) -> list[Steps]:
        """Return τ1 to τ4."""
        return [Steps.of(demonstrations, self.normalise) for demonstrations in batch.sets]

    def task_gradient(self, parameters: Parameters, batch: TaskBatch) -> TaskGradient:
        """Return the outer gradient of Algorithm 1 for one task."""
        support_high, support_low, query_high, query_low = self._sets(batch)
        gradient = meta_gradient.task_gradient(
            parameters, support_high, support_low, query_high, query_low, self.config, on_labels=batch.on_labels
        )
        return with_path_gradient(self, gradient, parameters, batch)

    def task_gradients(self, parameters: Parameters, batches: Sequence[TaskBatch]) -> list[TaskGradient]:
        """Return the outer gradients of several tasks as one computation."""
        tasks, on_labels = [self._sets(batch) for batch in batches], batches[0].on_labels
        gradients = batched_gradients(parameters, tasks, self.config, on_labels=on_labels)
        return with_path_gradients(self, gradients, parameters, batches)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> DmilPolicy:
        """Run the dual inner loop with the support set as both τ1 and τ2, or both levels' losses down by Adam."""
        steps, hierarchy = self.support_steps(support, fine_tuning), Hierarchy.of(parameters)
        if fine_tuning.optimiser == "adam":
            adapted = adaptation.adapt_by_adam(hierarchy, steps, self.config, fine_tuning)
        else:
            changes = {"inner_learning_rate": fine_tuning.learning_rate, "balance": "none"}
            config = self.config.model_copy(update=changes)
            adapted = adaptation.adapt(hierarchy, steps, steps, config, steps=fine_tuning.steps)
        return DmilPolicy(adapted, self.normalise, guide_of(self, parameters, support))
