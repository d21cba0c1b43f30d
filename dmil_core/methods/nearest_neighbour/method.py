"""A control that learns nothing: the action of the support set's nearest state.

a = a_j,  j = argmin_i ‖s − s_i‖²  over all steps i of the support demonstrations, in standardised observations.

It is one line of arithmetic, and on a task whose starts and goals hardly differ hard to beat: what a method adds to
copying is measured against it. The appendix does not have it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.losses import Steps
from dmil_core.methods.base import Decision, FineTuning, Flat, Method
from dmil_core.networks import Parameters
from dmil_core.settings import MethodConfig


class NearestNeighbourConfig(MethodConfig):
    """The action of the support set's nearest state."""

    name: Literal["nearest-neighbour"] = "nearest-neighbour"
    """The method."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        size: {"training": {"iterations": 0}} for size in ("paper", "quick", "smoke")
    }


@dataclass(frozen=True)
class NearestNeighbourPolicy(Flat):
    """Does what was done in the nearest state of the support set, the first of equally near ones."""

    support: Steps
    normalise: Normalisation

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action for each episode."""
        states = torch.from_numpy(self.normalise(observations))
        nearest = torch.cdist(states, self.support.states, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
        return Decision(self.support.actions[nearest].numpy(), np.zeros(len(observations), np.int64), memory)


class NearestNeighbour(Method[NearestNeighbourConfig]):
    """The nearest neighbour for observations and actions of given sizes."""

    config_type = NearestNeighbourConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Return none: nothing is learned."""
        return {}

    def adapt(
        self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning
    ) -> NearestNeighbourPolicy:
        """Keep the support set."""
        return NearestNeighbourPolicy(Steps.of(support, self.normalise), self.normalise)
