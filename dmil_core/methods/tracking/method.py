"""Tracking as a method."""

from collections.abc import Sequence

import numpy as np

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.methods.base import FineTuning, Method
from dmil_core.methods.tracking.config import TrackingConfig
from dmil_core.methods.tracking.policy import TrackingPolicy
from dmil_core.networks import Parameters


class Tracking(Method[TrackingConfig]):
    """Tracking of the demonstrated path, where a suite declares points."""

    config_type = TrackingConfig
    on_gpu = True

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Return none: nothing is learned."""
        return {}

    def adapt(
        self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning
    ) -> TrackingPolicy:
        """Keep the paths of the support set.

        Raises:
            UserError: where no points are declared.
        """
        if self.points is None:
            raise UserError(
                "suite.points: got none; wanted at least hand, whose path is tracked; see docs/your-own-task.md"
            )
        return TrackingPolicy.of(support, self.points)
