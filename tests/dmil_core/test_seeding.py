"""Named streams: the name and the seed are all that matters."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.seeding import named_rng, named_seed

names = st.lists(st.integers() | st.text(max_size=5), max_size=4).map(tuple)
seeds = st.integers(0, 2**63 - 1)


def numbers(seed: int, name: tuple[str | int, ...]) -> list[float]:
    return named_rng(seed, *name).random(4).tolist()


@given(seeds, names)
def test_equal_names_draw_equal_numbers(seed: int, name: tuple[str | int, ...]) -> None:
    assert numbers(seed, name) == numbers(seed, name)
    assert named_seed(seed, *name) == named_seed(seed, *name)
    assert 0 <= named_seed(seed, *name) < 2**31


@given(st.lists(st.tuples(seeds, names), min_size=2, max_size=2, unique=True))
def test_different_names_or_seeds_draw_different_numbers(keys: list[tuple[int, tuple[str | int, ...]]]) -> None:
    assert numbers(*keys[0]) != numbers(*keys[1])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (("a", "b"), ("ab",)),
        (("a", "b"), ("b", "a")),
        (("1",), (1,)),
        ((1, 23), (12, 3)),
        (("a\x1fb",), ("a", "b")),
        (("'a'\x1f'b'",), ("a", "b")),
        ((), ("",)),
    ],
)
def test_names_do_not_run_into_each_other(one: tuple, other: tuple) -> None:
    assert numbers(0, one) != numbers(0, other)


def test_streams_of_neighbouring_slots_are_unrelated() -> None:
    drawn = np.stack([named_rng(0, "batch", iteration, 0).normal(size=4000) for iteration in range(8)])
    assert np.abs(np.corrcoef(drawn) - np.eye(8)).max() < 0.08


def test_numbers_are_the_same_in_every_process_and_release() -> None:
    """A resumed run draws these again: if they change, runs of earlier releases can no longer be repeated."""
    assert named_seed(0, "batch", 3, 1) == 996122336
