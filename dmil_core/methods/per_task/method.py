"""Behaviour cloning from fresh weights on the support set alone."""

from collections.abc import Sequence

import numpy as np
import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import FineTuning, Method
from dmil_core.methods.behaviour_cloning.policy import NetworkPolicy, fine_tuned, initial_network
from dmil_core.methods.per_task.config import PerTaskConfig
from dmil_core.networks import Parameters, network


class PerTask(Method[PerTaskConfig]):
    """Behaviour cloning from fresh weights on the support set alone."""

    config_type = PerTaskConfig
    on_gpu = True

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the network."""
        return initial_network(self.config, self.input_dim, self.action_dim, rng)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> NetworkPolicy:
        """Take steps of Adam on the support set."""
        steps = self.support_steps(support, fine_tuning)
        return NetworkPolicy(
            fine_tuned(network(parameters, "policy"), steps, torch.optim.Adam, fine_tuning), self.normalise
        )
