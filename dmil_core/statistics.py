"""Success rates with their intervals, and how evenly sub-skills are used."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import binomtest, entropy

__all__ = ["Rate", "share_entropy", "success_rate"]


class Rate(NamedTuple):
    """A success rate with its denominator and interval, all as fractions of one."""

    successes: int
    episodes: int
    rate: float
    low: float
    high: float


def success_rate(outcomes: Sequence[bool], confidence: float = 0.95) -> Rate:
    """Return the success rate of `outcomes` with its Wilson score interval (Wilson, JASA 1927).

    Raises:
        ValueError: without a single episode: a rate needs a denominator.
    """
    if not outcomes:
        raise ValueError("outcomes: got no episode; a success rate needs at least one")
    successes = sum(map(bool, outcomes))
    interval = binomtest(successes, len(outcomes)).proportion_ci(confidence, method="wilson")
    return Rate(successes, len(outcomes), successes / len(outcomes), float(interval.low), float(interval.high))


def share_entropy(shares: Float[np.ndarray, " sub_skills"]) -> float:
    """Return the entropy of sub-skill usage as a fraction of its maximum: 0 is collapse, 1 an even use of all.

    One sub-skill alone has no choice to make; its entropy is 0.
    """
    return float(entropy(shares) / np.log(len(shares))) if len(shares) > 1 else 0.0
