"""Proximal policy optimisation (Schulman et al. 2017) as pure functions of log-probabilities, rewards and values."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["clipped_surrogate", "generalised_advantages", "scaled", "standardised"]

SMALLEST = 1e-8
"""Stands in for a spread of zero."""


def clipped_surrogate(
    log_ratio: Float[Tensor, " draws"], advantages: Float[Tensor, " draws"], clip: float
) -> Float[Tensor, ""]:
    """Return mean min(ρA, clamp(ρ, 1 − ε, 1 + ε)A), to be maximised (Schulman et al. 2017, equation 7).

    Args:
        log_ratio: log ρ, of the policy now to the one that drew.
        advantages: A of each draw.
        clip: ε.
    """
    ratio = log_ratio.exp()
    return torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages).mean()


def generalised_advantages(
    rewards: Float[Tensor, " draws"],
    values: Float[Tensor, " draws"],
    lengths: Int[Tensor, " trajectories"],
    discount: float,
    trace: float,
) -> Float[Tensor, " draws"]:
    """Return A_t = Σ_i (γλ)^i δ_{t+i}, δ_t = r_t + γ V_{t+1} − V_t, within each trajectory (Schulman et al. 2016).

    After a trajectory's end there is nothing: V = 0. With γ = 0 it is r − V.

    Args:
        rewards: of trajectories one after the other.
        values: V of the same draws.
        lengths: of the trajectories.
        discount: γ.
        trace: λ.
    """
    if not discount:
        return rewards - values
    longest = int(lengths.max())
    within = torch.arange(longest) < lengths[:, None]
    reward, value = (
        torch.zeros(within.shape, dtype=rewards.dtype).masked_scatter(within, t) for t in (rewards, values)
    )
    following = torch.cat([value[:, 1:], torch.zeros_like(value[:, :1])], 1)
    advantages = reward + discount * following - value
    for step in reversed(range(longest - 1)):
        advantages[:, step] += discount * trace * advantages[:, step + 1]
    return advantages[within]


def scaled(rewards: Float[Tensor, " draws"]) -> Float[Tensor, " draws"]:
    """Return rewards over their root mean square, so that a value learns as fast in any unit of action."""
    return rewards / rewards.square().mean().sqrt().clamp_min(SMALLEST)


def standardised(advantages: Float[Tensor, " draws"]) -> Float[Tensor, " draws"]:
    """Return advantages with mean 0 and standard deviation 1, or 0 where they are all the same."""
    return (advantages - advantages.mean()) / advantages.std(correction=0).clamp_min(SMALLEST)
