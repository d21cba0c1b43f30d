"""Two controls without hierarchy: behaviour cloning on all tasks, then fine-tuned; and on the support set alone.

One network π(a|s) goes down L_BC = mean ‖π(s) − a‖² (Pomerleau 1989):

- ``behaviour-cloning`` on the demonstrations of all meta-training tasks, the same that DMIL would draw as τ1 to τ4,
  and at test on the support set with DMIL's own steps and learning rate. What it lacks of DMIL's success is what the
  hierarchy and meta-learning add.
- ``per-task`` from fresh weights, with Adam (Kingma & Ba 2015), on the support set: what the demonstrations of the new
  task are worth by themselves. It has no meta-training.

The appendix has neither; both are there to measure the others by. Their networks have the size of one of DMIL's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, Normalisation, TaskBatch, sample_task_batch
from dmil_core.losses import Steps, behaviour_cloning_loss
from dmil_core.methods.base import Decision, FineTuning, Flat, MetaLearner, Method, TaskGradient
from dmil_core.networks import Layer, Network, Parameters, initialise, mlp, network, unflatten
from dmil_core.settings import Count, MethodConfig, Positive, Size
from dmil_core.slopes import slope

PREFIX = "policy"


class _NetworkConfig(MethodConfig):
    hidden_layers: Size = 4
    """Layers of ReLU units, as in each network of DMIL (F.2)."""
    hidden_units: Size = 512
    """Units in each hidden layer (F.2)."""
    output_scale: Positive = 1.0
    """Scale of the output layer's first weights, against He's."""


class BehaviourCloningConfig(_NetworkConfig):
    """Behaviour cloning on all meta-training tasks, fine-tuned on the support set."""

    name: Literal["behaviour-cloning"] = "behaviour-cloning"
    """The method."""
    trajectories: Size = 16
    """Trajectories in each of the four sets of a task (Table 9)."""
    window: Count | None = None
    """Cut each trajectory to so many steps at a random place; none takes it whole."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "method": {
                "hidden_layers": 3,
                "hidden_units": 256,
                "output_scale": 0.07,
                "trajectories": 4,
                "window": 24,
            }
        },
        "smoke": {"method": {"hidden_layers": 2, "hidden_units": 32, "trajectories": 2, "window": 24}},
    }


class PerTaskConfig(_NetworkConfig):
    """Behaviour cloning from fresh weights on the support set alone."""

    name: Literal["per-task"] = "per-task"
    """The method."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"training": {"iterations": 0}, "evaluation": {"fine_tuning_steps": 1000, "learning_rate": 1e-3}},
        "quick": {
            "method": {"hidden_layers": 3, "hidden_units": 256},
            "training": {"iterations": 0},
            "evaluation": {"fine_tuning_steps": 1000, "learning_rate": 1e-3},
        },
        "smoke": {"method": {"hidden_layers": 2, "hidden_units": 32}, "training": {"iterations": 0}},
    }


@dataclass(frozen=True)
class NetworkPolicy(Flat):
    """One network acts: a = π(s)."""

    network: Network
    normalise: Normalisation

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action for each episode."""
        actions = mlp(self.network, torch.from_numpy(self.normalise(observations)))
        return Decision(actions.numpy(), np.zeros(len(observations), np.int64), memory)


def fine_tuned(policy: Network, steps: Steps, optimiser: type[torch.optim.Optimizer], tuning: FineTuning) -> Network:
    """Return a network after so many steps of an optimiser down L_BC; the given one stays as it is."""
    layers = tuple(Layer(*(tensor.detach().clone().requires_grad_() for tensor in layer)) for layer in policy)
    descent = optimiser([tensor for layer in layers for tensor in layer], lr=tuning.learning_rate)  # pyright: ignore[reportCallIssue]
    for _ in range(tuning.steps):
        descent.zero_grad()
        (mlp(layers, steps.states) - steps.actions).square().sum(-1).mean().backward()
        descent.step()
    return tuple(Layer(*(tensor.detach() for tensor in layer)) for layer in layers)


class _OneNetwork(Method[Any]):
    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the network."""
        hidden = [self.config.hidden_units] * self.config.hidden_layers
        sizes = [self.obs_dim, *hidden, self.action_dim]
        return initialise(PREFIX, sizes, rng, output_scale=self.config.output_scale)

    def _adapted(
        self,
        parameters: Parameters,
        support: Sequence[Demonstration],
        optimiser: type[torch.optim.Optimizer],
        tuning: FineTuning,
    ) -> NetworkPolicy:
        steps = Steps.of(support, self.normalise)
        return NetworkPolicy(fine_tuned(network(parameters, PREFIX), steps, optimiser, tuning), self.normalise)


class BehaviourCloning(_OneNetwork, MetaLearner[Any, TaskBatch]):
    """Behaviour cloning for observations and actions of given sizes."""

    config_type = BehaviourCloningConfig

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> TaskBatch:
        """Draw what DMIL would draw."""
        return sample_task_batch(demonstrations, self.config.trajectories, self.config.window, rng)

    def task_gradient(self, parameters: Parameters, batch: TaskBatch) -> TaskGradient:
        """Return ∇ L_BC on all that was drawn."""
        steps = Steps.of([drawn for demonstrations in batch.sets for drawn in demonstrations], self.normalise)
        of_policy = slope(
            network(parameters, PREFIX), steps.states, lambda outputs: behaviour_cloning_loss(outputs, steps.actions)
        )
        gradient = torch.zeros(sum(tensor.numel() for tensor in parameters.values()))
        shapes = {name: tensor.shape for name, tensor in parameters.items()}
        of_policy.add_gradient(network(unflatten(gradient, shapes), PREFIX))
        return TaskGradient(gradient, {"loss": of_policy.loss.value.item()})

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> NetworkPolicy:
        """Take plain gradient steps on the support set, as DMIL's inner loop does."""
        return self._adapted(parameters, support, torch.optim.SGD, fine_tuning)


class PerTask(_OneNetwork):
    """Behaviour cloning from scratch for observations and actions of given sizes."""

    config_type = PerTaskConfig

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> NetworkPolicy:
        """Take steps of Adam on the support set."""
        return self._adapted(parameters, support, torch.optim.Adam, fine_tuning)
