import re
from collections.abc import Sequence

import numpy as np
import pytest

from services.reporting.bands import POINTS, curve_of, curves
from services.reporting.drawing import colour_of


def seed(values: Sequence[float], name: str = "loss") -> list[dict[str, float]]:
    return [{"iteration": i, name: value} for i, value in enumerate(values, 1)]


def test_the_line_is_the_mean_over_seeds_and_the_band_their_range() -> None:
    found = curve_of([seed([1, 2, 3]), seed([3, 2, 7])], "loss")
    assert found is not None
    assert [list(part) for part in found] == [[1, 2, 3], [2, 2, 5], [1, 2, 3], [3, 2, 7]]


def test_neighbouring_iterations_are_drawn_as_their_mean() -> None:
    values = np.arange(2 * POINTS + 1, dtype=float)
    found = curve_of([seed(list(values))], "loss")
    assert found is not None
    assert len(found.mean) <= POINTS
    assert list(found.mean[:2]) == [1, 4]
    assert list(found.iterations[:2]) == [3, 6]
    assert found.iterations[-1] == len(values)
    assert found.mean[-1] == values[-1]
    np.testing.assert_array_equal(found.low, found.mean)


def test_one_seeds_rate_has_its_interval() -> None:
    rows = [
        {"iteration": i, "success_rate/x": 0.5, "success_rate_low/x": 0.4, "success_rate_high/x": 0.7} for i in (5, 9)
    ]
    found = curve_of([rows, seed([1])], "success_rate/x")
    assert found is not None
    assert (list(found.low), list(found.high)) == ([0.4, 0.4], [0.7, 0.7])


def test_only_iterations_that_all_seeds_have_are_drawn() -> None:
    found = curve_of([seed([1, 2, 3]), seed([1, 2])], "loss")
    assert found is not None
    assert list(found.iterations) == [1, 2]
    assert curve_of([seed([1])], "other") is None


def test_a_panel_for_each_metric_and_one_legend_for_all() -> None:
    rows = {"none": [], "DMIL": [seed([4, 2]), seed([6, 4])], "MIL": [seed([9, 8], "inner_loss")]}
    found = curves("Losses", rows, {"loss": "loss", "inner loss": "inner_loss", "absent": "absent"})
    assert found is not None
    texts = re.findall(r">([^<>]+)</text>", found.svg)
    assert [texts.count(word) for word in ("loss", "inner loss", "absent", "iteration", "DMIL", "MIL")] == [
        1, 1, 0, 2, 1, 1
    ]  # fmt: skip
    assert found.description == "loss: DMIL from 5 to 3; inner loss: MIL from 9 to 8."
    assert colour_of(1) in found.svg
    assert colour_of(2) in found.svg
    assert colour_of(0) not in found.svg


@pytest.mark.parametrize(("values", "ticks"), [([1, 0.001], "0.01"), ([1, -1], "0.0")])
def test_a_loss_that_falls_far_is_drawn_by_its_logarithm(values: list[float], ticks: str) -> None:
    found = curves("Losses", {"DMIL": [seed(values)]}, {"loss": "loss"})
    assert found is not None
    assert ticks in re.findall(r">([^<>]+)</text>", found.svg)


def test_a_single_point_is_no_curve() -> None:
    assert curves("Losses", {"DMIL": [seed([1])]}, {"loss": "loss"}) is None
