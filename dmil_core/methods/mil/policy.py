"""The policy of MIL."""

from dataclasses import dataclass

from jaxtyping import Float32
from torch import Tensor

from dmil_core.demonstrations import Normalisation
from dmil_core.methods.base import NormalisedPolicy
from dmil_core.methods.mil.transformer import Cache, decode
from dmil_core.networks import Parameters


@dataclass(frozen=True)
class MilPolicy(NormalisedPolicy):
    """The decoder acts, with the adapted encoder's view of the support set at hand: a = f_θ'(s | D)."""

    parameters: Parameters
    cache: Cache
    normalise: Normalisation

    def actions(self, states: Float32[Tensor, "episodes obs_dim"]) -> Float32[Tensor, "episodes action_dim"]:
        """Return the action in each normalised state."""
        return decode(self.parameters, states, self.cache)
