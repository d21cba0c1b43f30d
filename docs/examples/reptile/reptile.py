"""Reptile (Nichol et al. 2018): go some way to where a few steps on one task lead, task after task.

θ ← θ + ε · mean over tasks of (θ_task − θ),  θ_task = θ after some steps of SGD down mean ‖π(s) − a‖² on the task.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.behaviour_cloning.policy import NetworkPolicy, fine_tuned
from dmil_core.networks import Network, Parameters, flatten, initialise, mlp, network
from dmil_core.settings import Count, MethodConfig, Positive, Size


class ReptileConfig(MethodConfig):
    """Reptile."""

    name: Literal["reptile"] = "reptile"
    """The method."""
    hidden_units: Size = 256
    """Units in each of two hidden layers."""
    trajectories: Size = 4
    """Trajectories of a task in a batch."""
    inner_steps: Count = 5
    """Steps of SGD on them."""
    inner_learning_rate: Positive = 0.02
    """Of these steps."""

    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"training": {"outer_step": "average", "learning_rate": 0.5}},
        "quick": {"training": {"outer_step": "average", "learning_rate": 0.5, "gradient_clip": None}},
        "smoke": {"training": {"outer_step": "average", "learning_rate": 0.5}, "method": {"hidden_units": 32}},
    }


class Batch(NamedTuple):
    """What one slot of an iteration learns from."""

    demonstrations: tuple[Demonstration, ...]

    @property
    def ids(self) -> list[str]:
        """The ids of the demonstrations."""
        return [demonstration.id for demonstration in self.demonstrations]


class Reptile(MetaLearner[ReptileConfig, Batch]):
    """Reptile for observations and actions of given sizes."""

    config_type = ReptileConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the network."""
        units = self.config.hidden_units
        return initialise("policy", [self.input_dim, units, units, self.action_dim], rng, output_scale=0.1)

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> Batch:
        """Draw some demonstrations of the task: all that is random in an iteration is drawn here."""
        chosen = rng.choice(len(demonstrations), min(self.config.trajectories, len(demonstrations)), replace=False)
        return Batch(tuple(demonstrations[index] for index in chosen))

    def task_gradient(self, parameters: Parameters, batch: Batch) -> TaskGradient:
        """Return how far the task's own steps went, the other way round."""
        before, steps = network(parameters, "policy"), Steps.of(batch.demonstrations, self.normalise)
        after = self._descend(before, steps, FineTuning(self.config.inner_steps, self.config.inner_learning_rate))
        loss = (mlp(after, steps.states) - steps.actions).square().sum(-1).mean().item()
        way = [old - new for one, other in zip(before, after, strict=True) for old, new in zip(one, other, strict=True)]
        return TaskGradient(flatten(dict(zip(parameters, way, strict=True))), {"loss": loss})

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> NetworkPolicy:
        """Take the same steps on the support set."""
        steps = Steps.of(support, self.normalise)
        return NetworkPolicy(self._descend(network(parameters, "policy"), steps, fine_tuning), self.normalise)

    def _descend(self, policy: Network, steps: Steps, tuning: FineTuning) -> Network:
        return fine_tuned(policy, steps, torch.optim.SGD, tuning)
