"""The policy of MIL."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Normalisation
from dmil_core.methods.base import Decision, Flat
from dmil_core.methods.mil.transformer import Cache, decode
from dmil_core.networks import Parameters


@dataclass(frozen=True)
class MilPolicy(Flat):
    """The decoder acts, with the adapted encoder's view of the support set at hand: a = f_θ'(s | D)."""

    parameters: Parameters
    cache: Cache
    normalise: Normalisation

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action for each episode."""
        actions = decode(self.parameters, torch.from_numpy(self.normalise(observations)), self.cache)
        return Decision(actions.numpy(), np.zeros(len(observations), np.int64), memory)
