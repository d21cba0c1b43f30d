"""Statistics of timelines, against cases worked by hand and against what is slow and plain."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from services.reporting.choices import Segment, segments, statistics


def timeline(*sub_skills: int) -> np.ndarray:
    return np.array(sub_skills, np.int64)


TIMELINES = st.lists(st.lists(st.integers(0, 3), max_size=12), min_size=1, max_size=4)


def test_a_case_by_hand():
    use = statistics([timeline(0, 0, 1, 1, 1, 0), timeline(1, 2)], 4)
    assert (use.episodes, use.steps) == (2, 8)
    np.testing.assert_allclose(use.shares, [3 / 8, 4 / 8, 1 / 8, 0])
    np.testing.assert_allclose(use.dwell, [3 / 2, 4 / 2, 1, np.nan])
    assert use.switches == 3 / 2
    assert use.transitions.tolist() == [[1, 1, 0, 0], [1, 2, 1, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(use.followed[:2], [[1 / 2, 1 / 2, 0, 0], [1 / 4, 1 / 2, 1 / 4, 0]])
    assert np.isnan(use.followed[2:]).all()


def test_stretches_by_hand():
    assert segments(timeline(2, 2, 0, 2)) == [Segment(0, 2, 2), Segment(2, 1, 0), Segment(3, 1, 2)]
    assert segments(timeline(1)) == [Segment(0, 1, 1)]
    assert segments(timeline()) == []


def test_a_collapse_has_one_share_and_no_switch():
    use = statistics([timeline(*[1] * 30)] * 3, 3)
    assert use.shares.tolist() == [0, 1, 0]
    assert use.switches == 0
    assert use.dwell[1] == 30


def test_an_episode_does_not_go_over_into_the_next():
    assert statistics([timeline(0), timeline(1)], 2).transitions.sum() == 0


def test_nothing_at_all_has_no_share_of_anything():
    use = statistics([], 2)
    assert (use.episodes, use.steps, use.switches, use.shares.tolist()) == (0, 0, 0.0, [0.0, 0.0])


@given(TIMELINES)
def test_it_agrees_with_counting_step_by_step(episodes: list[list[int]]):
    use = statistics([timeline(*episode) for episode in episodes], 4)
    every = [k for episode in episodes for k in episode]
    pairs = [pair for episode in episodes for pair in pairwise(episode)]
    for k in range(4):
        assert use.shares[k] == (every.count(k) / len(every) if every else 0)
        begun = sum(
            k == after and before != k
            for episode in episodes
            for before, after in zip([-1, *episode], episode, strict=False)
        )
        assert np.isnan(use.dwell[k]) if not begun else use.dwell[k] == every.count(k) / begun
        for after in range(4):
            assert use.transitions[k, after] == pairs.count((k, after))
    assert use.switches == sum(one != other for one, other in pairs) / len(episodes)


@given(st.lists(st.integers(0, 3), max_size=30))
def test_stretches_laid_end_to_end_are_the_timeline(steps: list[int]):
    found = segments(timeline(*steps))
    assert [k for segment in found for k in [segment.sub_skill] * segment.steps] == steps
    assert all(one.sub_skill != other.sub_skill for one, other in pairwise(found))
    assert [segment.start for segment in found] == np.cumsum([0, *(s.steps for s in found)])[:-1].tolist()
