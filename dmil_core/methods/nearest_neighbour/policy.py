"""The policy of the nearest neighbour."""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from dmil_core.demonstrations import Normalisation
from dmil_core.losses import Steps
from dmil_core.methods.base import NormalisedPolicy


@dataclass(frozen=True)
class NearestNeighbourPolicy(NormalisedPolicy):
    """Does what was done in the nearest state of the support set, the first of equally near ones."""

    support: Steps
    normalise: Normalisation

    def actions(self, states: Float32[Tensor, "episodes obs_dim"]) -> Float32[Tensor, "episodes action_dim"]:
        """Return the action in each normalised state."""
        nearest = torch.cdist(states, self.support.states, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
        return self.support.actions[nearest]
