"""The nearest neighbour as a method."""

from collections.abc import Sequence

import numpy as np

from dmil_core.demonstrations import Demonstration
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, Method
from dmil_core.methods.nearest_neighbour.config import NearestNeighbourConfig
from dmil_core.methods.nearest_neighbour.policy import NearestNeighbourPolicy
from dmil_core.networks import Parameters


class NearestNeighbour(Method[NearestNeighbourConfig]):
    """The nearest neighbour for observations and actions of given sizes."""

    config_type = NearestNeighbourConfig
    on_gpu = True

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Return none: nothing is learned."""
        return {}

    def adapt(
        self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning
    ) -> NearestNeighbourPolicy:
        """Keep the support set."""
        return NearestNeighbourPolicy(Steps.of(support, self.normalise), self.normalise)
