"""Tracking the demonstrated path, shifted by object and goal."""

import numpy as np
import pytest

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError
from dmil_core.methods.base import FineTuning, MetaLearner, Policy
from dmil_core.methods.tracking.config import TrackingConfig
from dmil_core.methods.tracking.method import Tracking
from dmil_core.points import Points
from services.rollouts.episodes import rollout
from services.suites.metaworld import MetaWorldSuite
from tests.dmil_core.carrying import POINTS, demonstrate, success


def tracking(*seeds: int, points: Points | None = POINTS) -> Policy:
    support = [demonstrate(2, seed) for seed in seeds]
    method = Tracking.prepared(TrackingConfig(), 4, support, points)
    assert not isinstance(method, MetaLearner)
    return method.adapt({}, support, FineTuning(0, 0.1))


def test_one_demonstration_does_where_everything_is_elsewhere() -> None:
    assert all(success(tracking(7), seed) for seed in range(20, 30))


def test_without_the_shift_it_does_not() -> None:
    """The same path where it was: the hand's points alone are declared."""
    policy = tracking(7, points=Points(size=17, hand=(0, 1, 2)))
    assert success(policy, 7), "in the same place"
    assert sum(success(policy, seed) for seed in range(20, 30)) <= 2


def test_the_nearest_demonstration_is_tracked() -> None:
    policy = tracking(7, 8, 9)
    observations = np.stack([demonstrate(2, seed).observations[0] for seed in (8, 9, 7)])
    assert policy.act(observations, policy.start(3)).memory[:, 0].tolist() == [1, 2, 0]


def test_without_points_there_is_no_path() -> None:
    with pytest.raises(UserError, match=r"suite\.points: got none; wanted at least hand"):
        tracking(7, points=None)


def test_a_door_is_closed_from_one_demonstration() -> None:
    from services.rollouts.episodes import demonstrate as attempt

    suite = MetaWorldSuite(SuiteConfig(name="ml10"))
    env, expert = suite.make_env("door-close"), suite.expert("door-close")
    from dmil_core.configs import DemonstrationConfig
    from dmil_core.demonstrations import Demonstration

    shown = attempt(expert, env, 1, suite.horizon, DemonstrationConfig())
    support = [Demonstration("1", "door-close", shown.observations[: len(shown.actions)], shown.actions)]
    policy = Tracking.prepared(TrackingConfig(), 4, support, suite.points).adapt({}, support, FineTuning(0, 0.1))
    assert [episode.success for episode in rollout(policy, [env], [50], suite.horizon)] == [True]
