"""Demonstrations: what is refused, how batches are drawn, when two data sets are the same."""

import dataclasses
import itertools
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.demonstrations import (
    Demonstration,
    DemonstrationError,
    Normalisation,
    TaskBatch,
    digest,
    sample_task_batch,
)


def zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


def spoiled(value: float) -> np.ndarray:
    values = zeros(5, 2)
    values[3, 1] = value
    return values


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("field", ["observations", "actions"])
@pytest.mark.parametrize(
    ("values", "said"),
    [
        (spoiled(np.nan), "step 3"),
        (spoiled(np.inf), "step 3"),
        (spoiled(-np.inf), "step 3"),
        (zeros(0, 2), r"\(0, 2\)"),
        (zeros(5, 0), r"\(5, 0\)"),
        (zeros(5), r"\(5,\)"),
        (zeros(5, 2, 1), r"\(5, 2, 1\)"),
    ],
    ids=["nan", "inf", "-inf", "no step", "no dimension", "rank 1", "rank 3"],
)
def test_what_cannot_be_learned_from_is_refused_by_name(field: str, values: np.ndarray, said: str) -> None:
    arrays = {"observations": zeros(5, 2), "actions": zeros(5, 2), field: values}
    with pytest.raises(DemonstrationError, match=rf"demonstration d7 of reach: {field} .*{said}.*; wanted .*; drop"):
        Demonstration("d7", "reach", **arrays)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("field", ["observations", "actions"])
@pytest.mark.parametrize("dtype", [np.float64, np.int32, bool, object])
def test_other_numbers_than_float32_are_refused_by_name(field: str, dtype: type) -> None:
    arrays = {"observations": zeros(5, 2), "actions": zeros(5, 2), field: zeros(5, 2).astype(dtype)}
    with pytest.raises(DemonstrationError, match=rf"demonstration d7 of reach: {field} has numbers of the type .*32"):
        Demonstration("d7", "reach", **arrays)


@pytest.mark.usefixtures("unchecked")
def test_unequal_lengths_are_refused_by_name() -> None:
    with pytest.raises(DemonstrationError, match="demonstration d7 of reach: 4 observations for 5 actions"):
        Demonstration("d7", "reach", zeros(4, 2), zeros(5, 2))


def test_a_window_is_a_view_that_says_where_it_was_cut(make_demonstrations) -> None:
    (whole,) = make_demonstrations(0, [9])
    cut = whole.window(3, 4)
    assert (cut.id, cut.task, len(cut)) == ("d0[3:7]", "reach", 4)
    for field in ("observations", "actions"):
        assert np.array_equal(getattr(cut, field), getattr(whole, field)[3:7])
        assert np.shares_memory(getattr(cut, field), getattr(whole, field))


def origins(batch: TaskBatch) -> list[list[str]]:
    return [[demonstration.id.partition("[")[0] for demonstration in drawn] for drawn in batch.sets]


@given(total=st.integers(1, 20), trajectories=st.integers(1, 5), seed=st.integers(0, 2**31))
def test_sets_are_disjoint_where_they_can_be(make_demonstrations, total: int, trajectories: int, seed: int) -> None:
    demonstrations = make_demonstrations(0, [3] * total)
    drawn = origins(sample_task_batch(demonstrations, trajectories, None, np.random.default_rng(seed)))
    assert [len(ids) for ids in drawn] == [trajectories] * 4
    if total >= trajectories:
        assert all(max(Counter(ids).values()) == 1 for ids in drawn)
    if total >= 4 * trajectories:
        assert max(Counter(itertools.chain(*drawn)).values()) == 1


@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=10),
    window=st.none() | st.integers(1, 12),
    seed=st.integers(0, 2**31),
)
def test_windows_lie_inside_their_trajectories(make_demonstrations, lengths, window, seed) -> None:
    demonstrations = make_demonstrations(0, lengths)
    whole = {demonstration.id: demonstration for demonstration in demonstrations}
    batch = sample_task_batch(demonstrations, 2, window, np.random.default_rng(seed))
    for cut in itertools.chain(*batch.sets):
        origin, _, place = cut.id.partition("[")
        start, stop = map(int, place.rstrip("]").split(":")) if place else (0, lengths[int(origin[1:])])
        assert 0 <= start < stop <= len(whole[origin])
        assert stop - start == len(cut) == min(window or 12, len(whole[origin]))
        assert np.array_equal(cut.observations, whole[origin].observations[start:stop])
        assert np.array_equal(cut.actions, whole[origin].actions[start:stop])


def test_every_demonstration_and_every_window_is_drawn(make_demonstrations) -> None:
    demonstrations, rng = make_demonstrations(0, [6] * 9), np.random.default_rng(0)
    batches = [sample_task_batch(demonstrations, 2, 4, rng) for _ in range(100)]
    ids = {cut.id for batch in batches for cut in itertools.chain(*batch.sets)}
    assert ids == {f"d{index}[{start}:{start + 4}]" for index in range(9) for start in range(3)}


def test_the_same_stream_draws_the_same_batch(make_demonstrations) -> None:
    demonstrations = make_demonstrations(0, range(5, 25))

    def ids(seed: int) -> list[str]:
        batch = sample_task_batch(demonstrations, 3, 4, np.random.default_rng(seed))
        return [cut.id for cut in itertools.chain(*batch.sets)]

    assert ids(0) == ids(0) != ids(1)


def test_a_task_without_demonstrations_is_refused() -> None:
    with pytest.raises(DemonstrationError, match="got none"):
        sample_task_batch([], 1, None, np.random.default_rng(0))


def test_standardised_steps_have_zero_mean_and_unit_variance(make_demonstrations) -> None:
    units = np.array([1e-1, 1.0, 50.0, 3.0], np.float32)
    demonstrations = [
        dataclasses.replace(demonstration, observations=demonstration.observations * units + 10 * units)
        for demonstration in make_demonstrations(0, [40, 1, 25])
    ]
    normalise = Normalisation.of(demonstrations)
    before = demonstrations[0].observations.copy()
    steps = np.concatenate([normalise(demonstration.observations) for demonstration in demonstrations])
    assert steps.dtype == np.float32
    np.testing.assert_allclose(steps.mean(0), 0, atol=1e-5)
    np.testing.assert_allclose(steps.std(0), 1, rtol=1e-5)
    assert np.array_equal(demonstrations[0].observations, before)


def test_the_scale_respects_its_floor() -> None:
    observations = np.array([[5.0, 0.0], [5.0, 1.0]], np.float32)
    normalise = Normalisation.of([Demonstration("d0", "reach", observations, zeros(2, 1))], floor=0.25)
    np.testing.assert_allclose(normalise.scale, [0.25, 0.5])
    np.testing.assert_allclose(normalise(observations), [[0, -1], [0, 1]])


def test_identity_leaves_observations_as_they_are(make_demonstrations) -> None:
    (demonstration,) = make_demonstrations(0, [6])
    standardised = Normalisation.identity(4)(demonstration.observations)
    assert np.array_equal(standardised, demonstration.observations)
    assert not np.shares_memory(standardised, demonstration.observations)


@given(which=st.integers(0, 2), field=st.sampled_from(["observations", "actions"]), place=st.integers(0, 10**6))
def test_the_digest_changes_with_any_value(make_demonstrations, which: int, field: str, place: int) -> None:
    demonstrations, changed = make_demonstrations(0, [3, 1, 2]), make_demonstrations(0, [3, 1, 2])
    assert digest(demonstrations) == digest(changed)
    values = getattr(changed[which], field).reshape(-1)
    values[place % values.size] = np.nextafter(values[place % values.size], np.float32(np.inf))
    assert digest(demonstrations) != digest(changed)


def test_the_digest_changes_with_names_order_and_shapes(make_demonstrations) -> None:
    first, second = make_demonstrations(0, [2, 2])
    twelve = np.arange(12, dtype=np.float32)
    variants = [
        [first, second],
        [second, first],
        [first],
        [dataclasses.replace(first, id="d9"), second],
        [dataclasses.replace(first, task="push"), second],
        [dataclasses.replace(first, task="reach/d0", id="x"), second],
        [dataclasses.replace(first, task="reach", id="d0/x"), second],
        [Demonstration("d0", "reach", twelve[:4].reshape(1, 4), twelve[4:].reshape(1, 8))],
        [Demonstration("d0", "reach", twelve[:8].reshape(1, 8), twelve[8:].reshape(1, 4))],
        [Demonstration("d0", "reach", twelve[:8].reshape(2, 4), twelve[8:].reshape(2, 2))],
    ]
    assert len({digest(variant) for variant in variants}) == len(variants)


def test_the_digest_sees_values_not_memory_layout(make_demonstrations) -> None:
    (demonstration,) = make_demonstrations(0, [6])
    fortran = dataclasses.replace(demonstration, observations=np.asfortranarray(demonstration.observations))
    assert digest([fortran]) == digest([demonstration])
