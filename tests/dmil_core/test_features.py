"""Features are differences: the same wherever the scene stands."""

import numpy as np
import pytest

from dmil_core.errors import UserError
from dmil_core.features import RelativeFeatures
from dmil_core.methods.base import FineTuning
from dmil_core.methods.behaviour_cloning.config import BehaviourCloningConfig
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.nearest_neighbour.config import NearestNeighbourConfig
from dmil_core.methods.nearest_neighbour.method import NearestNeighbour
from dmil_core.points import Points
from services.suites.metaworld import MetaWorldSuite
from tests.dmil_core.carrying import POINTS, demonstrate

PLACES = [0, 1, 4, 5, 7, 8, 11, 12, 14, 15]
"""The horizontal numbers of all positions, those of the step before too."""


def test_they_are_the_same_wherever_the_scene_stands() -> None:
    observations = demonstrate(0, 1).observations
    moved = observations.copy()
    moved[:, PLACES] += np.tile([0.3, -0.2], len(PLACES) // 2).astype(np.float32)
    features = RelativeFeatures(POINTS)
    np.testing.assert_allclose(features(moved), features(observations), atol=2e-4)
    absolute = RelativeFeatures(POINTS, absolute=True)
    assert np.abs(absolute(moved) - absolute(observations)).max() > 0.5


def test_each_number_is_a_difference_at_three_scales() -> None:
    observation = np.zeros((1, 17), np.float32)
    observation[0, [0, 4, 14]] = 0.1, 0.13, 0.05  # the hand, the object and the goal along x
    features = RelativeFeatures(POINTS)(observation)[0]
    differences = np.array([0.03, 0, 0, -0.05, 0, 0, -0.08, 0, 0])
    np.testing.assert_allclose(features[:9], differences / 0.2, atol=1e-6)
    np.testing.assert_allclose(features[9:18], np.tanh(differences / 0.1), atol=1e-6)
    np.testing.assert_allclose(features[18:27], np.tanh(differences / 0.02), atol=1e-6)


def test_a_point_that_is_all_zeros_is_absent() -> None:
    rng, points = np.random.default_rng(0), MetaWorldSuite.points
    observations = rng.normal(size=(2, 39)).astype(np.float32)
    assert points.second_object is not None
    observations[1] = observations[0]
    observations[1, list(points.second_object)] = 0
    there, absent = RelativeFeatures(points)(observations)
    assert absent[9:15].tolist() == [0] * 6
    assert there[9:15].all()
    np.testing.assert_array_equal(there[:9], absent[:9])


def test_the_nearest_neighbour_measures_distance_in_them() -> None:
    """The same scene elsewhere: by the raw numbers another state is nearer."""
    near, far = demonstrate(0, 1), demonstrate(0, 2)
    moved = near.observations.copy()
    moved[:, PLACES] += 1.0
    for config, equal in ((NearestNeighbourConfig(features="relative"), True), (NearestNeighbourConfig(), False)):
        method = NearestNeighbour.prepared(config, 4, [near, far], POINTS)
        policy = method.adapt({}, [near, far], FineTuning(0, 0.1))
        assert np.array_equal(policy.act(moved, policy.start(len(moved))).actions, near.actions) is equal


@pytest.mark.parametrize("points", [None, Points(size=17, hand=(0, 1, 2))])
def test_without_an_object_there_are_none(points: Points | None) -> None:
    with pytest.raises(UserError, match=r"method\.features: got relative .* wanted suite\.points"):
        BehaviourCloning.prepared(BehaviourCloningConfig(features="relative"), 4, [demonstrate(0, 1)], points)


def test_a_method_comes_back_from_its_constants() -> None:
    config = BehaviourCloningConfig(features="relative", hidden_units=8, hidden_layers=1)
    demonstration = demonstrate(0, 1)
    method = BehaviourCloning.prepared(config, 4, [demonstration], POINTS)
    again = BehaviourCloning.restored(config, 4, method.constants(), POINTS)
    seen = method.normalise(demonstration.observations)
    assert np.array_equal(again.normalise(demonstration.observations), seen)
    assert (again.obs_dim, again.input_dim) == (17, seen.shape[1])
    np.testing.assert_allclose(seen.mean(0), 0, atol=1e-3)
