"""What proximal policy optimisation is made of: generalised advantages and the clipped surrogate.

RLlib has both, in ``ray.rllib.utils.postprocessing.value_predictions`` and inside its PPO learner. Its loss works on
RLlib's own batches, modules and connectors, and knows one level of decisions where an option policy has two, each with
advantages of its own; and the science does without Ray. So these are functions of our own; a test holds the advantages
against RLlib's.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

SMALLEST = 1e-8
"""Stands in for a spread of zero."""


def clipped_surrogate(
    log_ratio: Float[Tensor, " draws"], advantages: Float[Tensor, " draws"], clip: float
) -> Float[Tensor, ""]:
    """Return mean min(ρA, clamp(ρ, 1 − ε, 1 + ε)A), to be maximised (Schulman et al. 2017, equation 7).

    ρ is of the policy now to the one that drew, and ε is `clip`.
    """
    ratio = log_ratio.exp()
    return torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages).mean()


def generalised_advantages(
    rewards: Float[np.ndarray, " steps"], values: Float[np.ndarray, " steps+1"], discount: float, trace: float
) -> Float[np.ndarray, " steps"]:
    """Return A_t = Σ_l (γλ)^l δ_{t+l}, δ_t = r_t + γ V_{t+1} − V_t (Schulman et al. 2016), of one episode.

    `values` are V of each state, and of the one after the last step: 0 where there is no going on. γ is `discount`, and
    λ `trace`.
    """
    advantages = rewards + discount * values[1:] - values[:-1]
    for step in reversed(range(len(advantages) - 1)):
        advantages[step] += discount * trace * advantages[step + 1]
    return advantages


def trajectory_advantages(
    rewards: Float[Tensor, " draws"],
    values: Float[Tensor, " draws"],
    lengths: Int[Tensor, " trajectories"],
    discount: float,
    trace: float,
    last_values: Float[Tensor, " trajectories"] | None = None,
) -> Float[Tensor, " draws"]:
    """Return the `generalised_advantages` within each of several trajectories, which lie one after the other.

    `last_values` are V of the states after each one's last step: 0 if there is no going on. With a discount of 0 the
    advantages are r − V.
    """
    if not discount:
        return rewards - values
    cuts = lengths.tolist()
    ends = np.zeros(len(cuts)) if last_values is None else last_values.numpy()
    each = [
        generalised_advantages(reward.numpy(), np.append(value.numpy(), end), discount, trace)
        for reward, value, end in zip(rewards.split(cuts), values.split(cuts), ends, strict=True)
    ]
    return torch.from_numpy(np.concatenate(each)).to(rewards.dtype)


def scaled(rewards: Float[Tensor, " draws"]) -> Float[Tensor, " draws"]:
    """Return rewards over their root mean square, so that a value learns as fast in any unit of action."""
    return rewards / rewards.square().mean().sqrt().clamp_min(SMALLEST)


def normalised(advantages: Float[Tensor, " draws"]) -> Float[Tensor, " draws"]:
    """Return advantages with mean 0 and standard deviation 1, or 0 where they are all the same."""
    return (advantages - advantages.mean()) / advantages.std(correction=0).clamp_min(SMALLEST)
