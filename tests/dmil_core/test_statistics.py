"""Success rates against the closed form of their interval, and the entropy of sub-skill usage."""

import itertools
from math import sqrt
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.statistics import (
    interquartile_mean,
    nested_bootstrap,
    performance_profile,
    profile_band,
    share_entropy,
    stratified_bootstrap,
    success_rate,
)


@given(st.lists(st.booleans(), min_size=1, max_size=200), st.sampled_from([0.8, 0.95, 0.99]))
def test_interval_is_wilsons(outcomes: list[bool], confidence: float) -> None:
    n, z = len(outcomes), NormalDist().inv_cdf((1 + confidence) / 2)
    p = outcomes.count(True) / n
    centre, half = p + z**2 / (2 * n), z * sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    got = success_rate(outcomes, confidence)
    assert (got.episodes, got.mean) == (n, p)
    assert got.low == pytest.approx((centre - half) / (1 + z**2 / n), abs=1e-9)
    assert got.high == pytest.approx((centre + half) / (1 + z**2 / n), abs=1e-9)
    assert 0 <= got.low <= p <= got.high <= 1


def test_a_rate_needs_an_episode() -> None:
    with pytest.raises(ValueError, match="outcomes: got no episode"):
        success_rate([])


@given(st.lists(st.integers(0, 100), min_size=1, max_size=10).filter(any))
def test_share_entropy_lies_between_collapse_and_even_use(counts: list[int]) -> None:
    shares = np.array(counts) / sum(counts)
    got = share_entropy(shares)
    assert 0 <= got <= 1 + 1e-12
    assert (got > 1e-12) == (np.count_nonzero(counts) > 1)
    assert share_entropy(shares[::-1]) == pytest.approx(got, abs=1e-12)


@pytest.mark.parametrize("sub_skills", [2, 3, 10])
def test_share_entropy_at_its_ends(sub_skills: int) -> None:
    assert share_entropy(np.eye(sub_skills)[0]) == 0
    assert share_entropy(np.full(sub_skills, 1 / sub_skills)) == pytest.approx(1)


def test_share_entropy_known_values() -> None:
    assert share_entropy(np.ones(1)) == 0
    assert share_entropy(np.array([0.5, 0.5, 0.0, 0.0])) == pytest.approx(0.5)


def test_bootstrap_of_certain_outcomes_is_certain() -> None:
    got = stratified_bootstrap(np.full((3, 2, 5), 0.25), np.random.default_rng(0))
    assert got[:3] == (0.25, 0.25, 0.25)


def test_bootstrap_of_one_seed_is_as_wide_as_its_episodes_say() -> None:
    """Four tasks of 50 episodes: the standard error of the stratified mean, and the normal's quantiles."""
    outcomes = np.array([[[1.0] * solved + [0.0] * (50 - solved) for solved in (5, 25, 40, 50)]])
    got = stratified_bootstrap(outcomes, np.random.default_rng(0))
    error = np.sqrt((outcomes.var(2) / 50).sum()) / 4
    assert got.mean == pytest.approx(0.6)
    assert got.high - got.low == pytest.approx(2 * 1.96 * error, rel=0.08)


def test_bootstrap_of_several_seeds_is_as_wide_as_the_seeds_say() -> None:
    """Where episodes of a seed are all alike, what is left is the bootstrap of three seeds' means."""
    outcomes = np.array([0.0, 0.5, 1.0])[:, None, None] * np.ones((3, 2, 10))
    got = stratified_bootstrap(outcomes, np.random.default_rng(0))
    assert got[:3] == (0.5, 0.0, 1.0), "all three draws are the worst seed in one of 27 cases, which is more than 2.5%"
    half = stratified_bootstrap(outcomes, np.random.default_rng(0), confidence=0.5)
    means = [np.mean(draw) for draw in itertools.product([0.0, 0.5, 1.0], repeat=3)]
    assert (half.low, half.high) == pytest.approx((np.quantile(means, 0.25), np.quantile(means, 0.75)))


def test_bootstrap_keeps_every_task_its_weight() -> None:
    """Tasks of certain outcome add no spread, however different they are."""
    outcomes = np.stack([np.zeros((3, 20)), np.ones((3, 20))], axis=1)
    assert stratified_bootstrap(outcomes, np.random.default_rng(0))[:3] == (0.5, 0.5, 0.5)


def test_bootstrap_covers_the_truth_about_as_often_as_it_says() -> None:
    rng, covered = np.random.default_rng(1), 0
    for _ in range(200):
        rates = rng.beta(20, 10, size=(8, 1, 1))
        outcomes = (rng.random((8, 3, 10)) < rates).astype(float)
        got = stratified_bootstrap(outcomes, rng)
        covered += got.low <= 2 / 3 <= got.high
    assert 170 <= covered <= 200


def test_interquartile_mean_leaves_out_the_ends() -> None:
    assert interquartile_mean([100.0, 1.0, 2.0, -50.0]) == 1.5
    assert interquartile_mean([0.3]) == pytest.approx(0.3)


def test_a_profile_is_the_fraction_of_runs_above_each_threshold() -> None:
    runs = np.random.default_rng(0).integers(0, 5, (3, 7)) / 4
    thresholds = np.array([-0.1, 0.0, 0.25, 0.3, 1.0])
    wanted = [sum(rate > threshold for rate in runs.ravel()) / 21 for threshold in thresholds]
    np.testing.assert_allclose(performance_profile(runs, thresholds), wanted)
    assert wanted[0] == 1
    assert wanted[-1] == 0, "above is not at"


def test_a_profiles_band_is_that_of_all_draws_of_seeds() -> None:
    """Against all 27 draws of three seeds; each extreme one has more than 2.5%, so the band reaches to it."""
    runs = np.random.default_rng(1).integers(0, 21, (3, 6)) / 20
    thresholds = np.linspace(0, 1, 11)
    profiles = [
        [np.mean(runs[list(seeds)] > threshold) for threshold in thresholds]
        for seeds in itertools.product(range(3), repeat=3)
    ]
    low, high = profile_band(runs, thresholds, np.random.default_rng(2))
    np.testing.assert_allclose(low, np.quantile(profiles, 0.025, axis=0, method="inverted_cdf"))
    np.testing.assert_allclose(high, np.quantile(profiles, 0.975, axis=0, method="inverted_cdf"))
    assert (low < high).any()


def test_a_band_of_one_seed_has_no_width() -> None:
    runs, thresholds = np.array([[0.0, 0.5, 1.0]]), np.array([0.0, 0.5])
    for end in profile_band(runs, thresholds, np.random.default_rng(0)):
        np.testing.assert_allclose(end, performance_profile(runs, thresholds))


def test_a_nested_interval_covers_tasks_support_sets_and_episodes() -> None:
    """Where episodes of a support set are alike and sets differ, more episodes do not narrow it."""
    rng = np.random.default_rng(0)
    sets = rng.integers(0, 2, (6, 10))
    few, many = (
        nested_bootstrap([[[float(value)] * count for value in task] for task in sets], np.random.default_rng(1))
        for count in (2, 20)
    )
    assert few.mean == many.mean == pytest.approx(sets.mean())
    assert (few.episodes, many.episodes) == (120, 1200)
    assert many.high - many.low == pytest.approx(few.high - few.low, abs=0.03)
    wilson = success_rate([bool(value) for value in np.repeat(sets, 20)])
    assert many.high - many.low > 2 * (wilson.high - wilson.low)
    same = nested_bootstrap([[[0.5, 0.5]], [[0.5]]], np.random.default_rng(0))
    assert same[:3] == (0.5, 0.5, 0.5)
