"""A demonstration with object and goal elsewhere."""

import numpy as np
import pytest

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.paths import contact, displaced, goal_weight, with_copies
from dmil_core.points import Points
from tests.dmil_core.carrying import POINTS, REACH, demonstrate

HAND, OBJECT, BEFORE, GOAL = slice(0, 3), slice(4, 7), slice(7, 10), slice(14, 17)


@pytest.mark.parametrize("seed", range(4))
def test_the_path_follows_the_object_and_then_the_goal(seed: int) -> None:
    one = demonstrate(1, 3)
    other = displaced(one, POINTS, np.random.default_rng(seed))
    change = other.observations - one.observations
    by_object, by_goal = change[0, OBJECT], change[0, GOAL]
    assert np.abs([by_object, by_goal]).max() <= 0.1
    assert (by_object[2], by_goal[2]) == (0, 0)
    assert not change[0, HAND].any(), "the hand begins where it did"
    begun = contact(one, POINTS)
    np.testing.assert_allclose(change[begun - 1, HAND], by_object, atol=1e-6)
    np.testing.assert_allclose(change[-1, HAND], by_goal, atol=1e-6)
    np.testing.assert_allclose(change[-1, OBJECT], by_goal, atol=1e-6)
    np.testing.assert_allclose(change[1:, BEFORE], change[:-1, HAND], atol=1e-7)
    moves = np.diff(change[:, HAND], axis=0) / REACH
    np.testing.assert_allclose(other.actions[:-1, :3], np.clip(one.actions[:-1, :3] + moves, -1, 1), atol=1e-5)
    assert np.array_equal(other.actions[:, 3], one.actions[:, 3])
    assert not change[:, 3].any()


def test_where_the_object_never_moves_the_path_goes_to_the_goal() -> None:
    one = demonstrate(1, 3)
    still = one.observations.copy()
    still[:, OBJECT] = still[0, OBJECT]
    alone = Demonstration("still", "reach", still, one.actions)
    assert contact(alone, POINTS) == len(alone)
    weight = goal_weight(alone, POINTS)
    assert weight[0] == 0
    assert weight[-1] == 1
    assert not goal_weight(alone, Points(size=17, hand=(0, 1, 2), object=(4, 5, 6))).any()


def test_copies_are_the_same_each_time_and_about_as_many_as_asked_for() -> None:
    support = [demonstrate(1, seed) for seed in (3, 4, 5)]
    assert with_copies(support, None, 0) is support
    copies = with_copies(support, POINTS, 10)
    assert len(copies) == 4 * 3 + 3 * 4
    again = with_copies(support, POINTS, 10)
    assert all(np.array_equal(a.observations, b.observations) for a, b in zip(copies, again, strict=True))
    with pytest.raises(UserError, match=r"evaluation\.displaced: got 10 .* or 0"):
        with_copies(support, None, 10)
