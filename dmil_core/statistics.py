"""Success rates and scores with their intervals, and how evenly sub-skills are used."""

from collections.abc import Sequence
from math import isnan, nan, sqrt
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import entr, ndtri, stdtrit  # scipy.stats takes a second to import


class Mean(NamedTuple):
    """A mean over episodes with its interval."""

    mean: float
    low: float
    """Lower end of the interval; NaN for a single score, which has no interval."""
    high: float
    episodes: int
    deviation: float = nan
    """Standard deviation of several scores over episodes."""

    @property
    def reach(self) -> tuple[float, float]:
        """How far the interval reaches below and above the mean; nowhere if there is none."""
        return (0.0, 0.0) if isnan(self.low) else (max(0.0, self.mean - self.low), max(0.0, self.high - self.mean))


def interval_text(low: float | None, high: float | None, digits: int, sign: str = "") -> str:
    """Return an interval as text, empty if there is none; with `sign` "+" both ends have their sign."""
    return "" if low is None or high is None or isnan(low) else f"{low:{sign}.{digits}f} to {high:{sign}.{digits}f}"


def success_rate(outcomes: Sequence[bool], confidence: float = 0.95) -> Mean:
    """Return the success rate of `outcomes` with its Wilson score interval (Wilson, JASA 1927).

    Raises:
        ValueError: without a single episode: a rate needs a denominator.
    """
    if not outcomes:
        raise ValueError("outcomes: got no episode; a success rate needs at least one")
    n, successes = len(outcomes), sum(map(bool, outcomes))
    z, rate = float(ndtri((1 + confidence) / 2)), successes / n
    whole = 2 * (n + z**2)
    centre, half = (2 * n * rate + z**2) / whole, z / whole * sqrt(4 * n * rate * (1 - rate) + z**2)
    return Mean(rate, centre - half if successes else 0.0, centre + half if successes < n else 1.0, n)


def mean_score(scores: Sequence[float], confidence: float = 0.95) -> Mean:
    """Return the mean of `scores` with Student's interval.

    Raises:
        ValueError: without a single episode.
    """
    if not scores:
        raise ValueError("scores: got no episode; a mean needs at least one")
    mean, episodes = float(np.mean(scores)), len(scores)
    if episodes == 1:
        return Mean(mean, nan, nan, 1)
    deviation = float(np.std(scores, ddof=1))
    half = float(stdtrit(episodes - 1, (1 + confidence) / 2)) * deviation / episodes**0.5
    return Mean(mean, mean - half, mean + half, episodes, deviation)


def share_entropy(shares: Float[np.ndarray, " sub_skills"]) -> float:
    """Return the entropy of sub-skill usage as a fraction of its maximum: 0 is collapse, 1 an even use of all.

    One sub-skill alone has no choice to make; its entropy is 0.
    """
    return float(entr(shares / shares.sum()).sum() / np.log(len(shares))) if len(shares) > 1 else 0.0


BOOTSTRAP_DRAWS = 2000
"""Resamples behind an interval."""


def stratified_bootstrap(
    outcomes: Float[np.ndarray, "seeds tasks episodes"], rng: np.random.Generator, confidence: float = 0.95
) -> Mean:
    """Return the mean outcome with its percentile bootstrap interval (Efron and Tibshirani 1993).

    Seeds are resampled with replacement, and then, for each of them, the episodes of each task. So the interval covers
    the randomness of training and of episodes, while every task keeps its weight. An outcome may also be the difference
    of two paired episodes.
    """
    seeds, tasks, episodes = outcomes.shape
    means = np.zeros((BOOTSTRAP_DRAWS, seeds))
    for place in range(seeds):
        chosen = outcomes[rng.integers(seeds, size=BOOTSTRAP_DRAWS)]
        again = rng.integers(episodes, size=(BOOTSTRAP_DRAWS, tasks, episodes))
        means[:, place] = np.take_along_axis(chosen, again, axis=2).mean((1, 2))
    low, high = np.quantile(means.mean(1), [(1 - confidence) / 2, (1 + confidence) / 2])
    return Mean(float(outcomes.mean()), float(low), float(high), outcomes.size)


def nested_bootstrap(
    outcomes: Sequence[Sequence[Sequence[float]]], rng: np.random.Generator, confidence: float = 0.95
) -> Mean:
    """Return the mean outcome with its percentile bootstrap interval, resampling tasks, support sets, then episodes.

    `outcomes` are lists by task, support set and episode; one may also be the difference of two paired episodes.
    """
    means = []
    for _ in range(BOOTSTRAP_DRAWS):
        of_tasks = []
        for task in rng.integers(len(outcomes), size=len(outcomes)):
            sets = outcomes[task]
            drawn = [np.array(sets[number]) for number in rng.integers(len(sets), size=len(sets))]
            again = [episodes[rng.integers(len(episodes), size=len(episodes))] for episodes in drawn]
            of_tasks.append(np.concatenate(again).mean())
        means.append(np.mean(of_tasks))
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    every = [float(np.mean(np.concatenate([np.array(episodes) for episodes in sets]))) for sets in outcomes]
    count = sum(len(episodes) for sets in outcomes for episodes in sets)
    return Mean(float(np.mean(every)), float(low), float(high), count)


def interquartile_mean(values: Sequence[float]) -> float:
    """Return the mean of the middle half of `values` (Agarwal et al., NeurIPS 2021: of all runs on all tasks)."""
    cut = len(values) // 4
    return float(np.mean(np.sort(values)[cut : len(values) - cut]))


def performance_profile(
    runs: Float[np.ndarray, "*draws seeds tasks"], thresholds: Float[np.ndarray, " thresholds"]
) -> Float[np.ndarray, "*draws thresholds"]:
    """Return the fraction of runs, one a seed and task, above each threshold (Agarwal et al., NeurIPS 2021)."""
    return (runs[..., None] > thresholds).mean((-3, -2))


def profile_band(
    runs: Float[np.ndarray, "seeds tasks"],
    thresholds: Float[np.ndarray, " thresholds"],
    rng: np.random.Generator,
    confidence: float = 0.95,
) -> tuple[Float[np.ndarray, " thresholds"], Float[np.ndarray, " thresholds"]]:
    """Return the lower and upper end of a profile's percentile band, threshold by threshold.

    Seeds are resampled with replacement, each with its runs on all tasks: one training serves them all. Agarwal et al.
    resample the runs of each task separately, for there each run is a training of its own.
    """
    again = runs[rng.integers(len(runs), size=(BOOTSTRAP_DRAWS, len(runs)))]
    # Threshold by threshold: all at once would be draws x runs x thresholds numbers.
    profiles = np.stack([performance_profile(again, thresholds[i : i + 1])[:, 0] for i in range(len(thresholds))], 1)
    low, high = np.quantile(profiles, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return low, high
