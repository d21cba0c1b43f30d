"""Behaviour cloning on all meta-training tasks."""

from collections.abc import Sequence

import numpy as np
import torch

from dmil_core.demonstrations import Demonstration, TaskBatch, sample_task_batch
from dmil_core.loss_gradients import loss_gradient
from dmil_core.losses import Steps, behaviour_cloning_loss
from dmil_core.methods.base import FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.behaviour_cloning.config import BehaviourCloningConfig
from dmil_core.methods.behaviour_cloning.policy import NetworkPolicy, fine_tuned, initial_network
from dmil_core.methods.path_context import guide_of, initial_path_network, with_path, with_path_gradient
from dmil_core.networks import Parameters, network, zeros_like


class BehaviourCloning(MetaLearner[BehaviourCloningConfig, TaskBatch]):
    """Behaviour cloning on all meta-training tasks."""

    config_type = BehaviourCloningConfig
    on_gpu = True

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the network."""
        return {
            **initial_network(self.config, self.input_dim, self.action_dim, rng),
            **initial_path_network(self, rng),
        }

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> TaskBatch:
        """Draw what DMIL would draw."""
        batch = sample_task_batch(demonstrations, self.config.trajectories, self.config.window, rng)
        return with_path(self, batch, demonstrations, rng)

    def task_gradient(self, parameters: Parameters, batch: TaskBatch) -> TaskGradient:
        """Return ∇ L_BC on the whole batch."""
        steps = Steps.of([demonstration for part in batch.sets for demonstration in part], self.normalise)
        of_policy = loss_gradient(
            network(parameters, "policy"), steps.states, lambda outputs: behaviour_cloning_loss(outputs, steps.actions)
        )
        gradient, views = zeros_like(parameters)
        of_policy.add_to(network(views, "policy"))
        result = TaskGradient(gradient, {"loss": of_policy.loss.value.item()})
        return with_path_gradient(self, result, parameters, batch)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> NetworkPolicy:
        """Take plain gradient steps on the support set, as DMIL's inner loop does, or Adam's on batches."""
        steps = self.support_steps(support, fine_tuning)
        adapted = fine_tuned(network(parameters, "policy"), steps, torch.optim.SGD, fine_tuning)
        return NetworkPolicy(adapted, self.normalise, guide_of(self, parameters, support))
