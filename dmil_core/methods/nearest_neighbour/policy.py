"""The policy of the nearest neighbour."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Normalisation
from dmil_core.losses import Steps
from dmil_core.methods.base import Decision, Flat


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
