"""Success rates against the closed form of their interval, and the entropy of sub-skill usage."""

from math import sqrt
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.statistics import share_entropy, success_rate


@given(st.lists(st.booleans(), min_size=1, max_size=200), st.sampled_from([0.8, 0.95, 0.99]))
def test_interval_is_wilsons(outcomes: list[bool], confidence: float) -> None:
    n, z = len(outcomes), NormalDist().inv_cdf((1 + confidence) / 2)
    p = outcomes.count(True) / n
    centre, half = p + z**2 / (2 * n), z * sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    got = success_rate(outcomes, confidence)
    assert (got.successes, got.episodes, got.rate) == (outcomes.count(True), n, p)
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
