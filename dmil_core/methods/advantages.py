"""What proximal policy optimisation is made of: generalised advantages and the clipped surrogate.

RLlib has both, in ``ray.rllib.utils.postprocessing.value_predictions`` and inside its PPO learner. Its loss works on
RLlib's own batches, modules and connectors, and knows one level of decisions where an option policy has two, each with
advantages of its own; and the science does without Ray. So these are functions of our own; a test holds the advantages
against RLlib's.
"""

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter
from torch import Tensor

__all__ = ["clipped_surrogate", "generalised_advantages"]


def generalised_advantages(
    rewards: Float[np.ndarray, " steps"], values: Float[np.ndarray, " steps+1"], discount: float, smoothing: float
) -> Float[np.ndarray, " steps"]:
    """Return A_t = Σ_l (γλ)^l δ_{t+l}, δ_t = r_t + γ V_{t+1} − V_t (Schulman et al. 2016), of one episode.

    Args:
        rewards: of each step.
        values: V of each state, and of the one after the last step; 0 where there is no going on.
        discount: γ.
        smoothing: λ.
    """
    errors = rewards + discount * values[1:] - values[:-1]
    return np.asarray(lfilter([1.0], [1.0, -discount * smoothing], errors[::-1]))[::-1].copy()


def clipped_surrogate(
    log_ratios: Float[Tensor, " steps"], advantages: Float[Tensor, " steps"], clip: float
) -> Float[Tensor, ""]:
    """Return mean min(ρ A, clip(ρ, 1 − ε, 1 + ε) A), which PPO goes up (Schulman et al. 2017); ρ = π / π_old."""
    ratios = log_ratios.exp()
    return (ratios * advantages).minimum(ratios.clamp(1 - clip, 1 + clip) * advantages).mean()
