"""A policy acts step by step, in one episode or several, and is the same to the bit after it was saved."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import dmil_core as dmil
from dmil_core.checkpoint import Range
from tests.dmil_core.old_models import METHODS, old_model, recorded


def policy_of(method: str = "dmil") -> dmil.AdaptedPolicy:
    model = old_model(method)
    return model.adapt(recorded(model, 2), steps=2)


@pytest.mark.parametrize("method", METHODS)
def test_a_saved_policy_acts_to_the_bit_as_before(method: str, tmp_path: Path):
    policy = policy_of(method)
    policy.save(tmp_path / "peg")
    again = dmil.load_policy(tmp_path / "peg")
    for observation in policy.support[0].observations:
        np.testing.assert_array_equal(again(observation), policy(observation))
        assert again.sub_skill == policy.sub_skill
    assert [(one.task, one.id) for one in again.support] == [("demonstrated", "000"), ("demonstrated", "001")]
    np.testing.assert_array_equal(again.support[1].actions, policy.support[1].actions)
    assert again.nbytes == policy.nbytes
    again.save(tmp_path / "copy")
    assert (tmp_path / "copy" / "policy.json").read_bytes() == (tmp_path / "peg" / "policy.json").read_bytes()


@pytest.mark.parametrize("method", METHODS)
def test_several_episodes_at_once_are_as_each_alone(method: str):
    policy = policy_of(method)
    episodes = np.stack([one.observations for one in policy.support])
    together = [(policy(states), policy.sub_skill) for states in episodes.swapaxes(0, 1)]
    for number, episode in enumerate(episodes):
        policy.reset()
        assert policy.sub_skill is None
        for (actions, sub_skills), observation in zip(together, episode, strict=True):
            np.testing.assert_allclose(policy(observation), actions[number], atol=1e-6)
            assert isinstance(sub_skills, np.ndarray)
            assert policy.sub_skill == sub_skills[number]


def test_actions_are_clipped_to_the_action_space():
    model = old_model()
    model.checkpoint.actions = Range(low=(-0.01,) * 4, high=(0.0, 0.01, 0.01, 0.01))
    with pytest.warns(dmil.UnlikeTrainingWarning, match="action: number 0"):
        policy = model.adapt(demonstrations := recorded(model), steps=2)
    actions = policy(demonstrations[0][0])
    assert (actions.min(0) == -0.01).all() or (actions.max(0) == [0, 0.01, 0.01, 0.01]).all()
    assert actions.min() >= np.float32(-0.01)
    assert actions[:, 0].max() <= 0


def test_an_observation_that_cannot_be_acted_on_is_refused_and_forgotten():
    policy, undisturbed = policy_of("mlsh"), policy_of("mlsh")
    observation = policy.support[0].observations[0]
    for wrong, says in (
        (observation[:-1], r"observation: got the shape \(38,\); wanted \(39,\), or \(episodes, 39\)"),
        (np.where(np.arange(39) == 7, np.nan, observation), r"not finite in the numbers \[7\]; .* stop the robot"),
        (np.zeros((2, 3, 39)), r"got the shape \(2, 3, 39\)"),
        (np.zeros((0, 39)), r"got the shape \(0, 39\)"),
        ("an image", "observation: got an array of <U8"),
    ):
        policy.reset()
        with pytest.raises(dmil.UserError, match=says):
            policy(wrong)
    policy.reset()
    for step in range(12):
        if step == 5:
            with pytest.raises(dmil.UserError, match=r"the shape \(2, 39\) after \(39,\).*; call reset\(\)"):
                policy(np.stack([observation] * 2))
        np.testing.assert_array_equal(policy(observation), undisturbed(observation))


POINTS = dmil.Points(size=8, hand=(0, 1), object=(2, 3), goal=(6, 7), reach=0.05)


def reaching() -> tuple[np.ndarray, np.ndarray]:
    """Return a demonstration of a hand that goes straight to its object, 0.05 a step by an action of 1."""
    hand, object_ = np.zeros(2), np.array([0.5, 0.25])
    observations, actions = [], []
    for _ in range(14):
        action = np.clip((object_ - hand) / 0.05, -1, 1)
        observations.append([*hand, *object_, 0.3, 0.3, 0, 0])
        actions.append(action)
        hand = hand + 0.05 * action
    return np.array(observations), np.array(actions)


def test_a_demonstrated_path_is_tracked_without_a_checkpoint(tmp_path: Path):
    policy = dmil.track([reaching()], points=POINTS)
    policy.save(tmp_path / "reach")
    for one in (policy, dmil.load_policy(tmp_path / "reach")):
        hand, object_ = np.array([0.1, -0.1]), np.array([0.3, 0.3])
        for _ in range(40):
            hand = hand + 0.05 * one([*hand, *object_, 0.3, 0.3, 0, 0])
        np.testing.assert_allclose(hand, object_, atol=0.02)
    with pytest.warns(dmil.UnlikeTrainingWarning, match=r"action: number 0 .*, wanted -0.5 to 0.5"):
        assert dmil.track([reaching()], points=POINTS, low=-0.5, high=0.5)(reaching()[0][0]).max() <= 0.5
    with pytest.raises(dmil.DemonstrationError, match=r"got the shape \(14, 7\); wanted \(steps, 8\), as points"):
        dmil.track([(reaching()[0][:, :7], reaching()[1])], points=POINTS)


def test_what_is_no_policys_folder_is_refused(tmp_path: Path):
    policy_of().save(whole := tmp_path / "peg")
    with pytest.raises(dmil.UserError, match=r"folder: got .*peg, which is there already; wanted a new name"):
        policy_of().save(whole)
    with pytest.raises(dmil.UserError, match=r"without a policy.json; wanted what the save"):
        dmil.load_policy(tmp_path)
    for path in sorted(whole.iterdir()):
        shutil.copytree(whole, copy := tmp_path / path.name.replace(".", "-"))
        (copy / path.name).write_bytes(path.read_bytes()[:-3])
        with pytest.raises(dmil.UserError, match=rf"{path.stem}\.\w+: got .*; wanted .*; use another"):
            dmil.load_policy(copy)


def test_a_policys_page_says_what_it_came_from(tmp_path: Path):
    policy_of().save(tmp_path / "peg")
    source = json.loads((tmp_path / "peg" / "policy.json").read_text())
    assert (source["fine_tuning_steps"], source["learning_rate"]) == (2, 0.01)
    assert source["model"]["config"]["method"]["name"] == "dmil"
    assert source["model"]["actions"] == {"low": [-1.0] * 4, "high": [1.0] * 4}
    assert sorted(source["files"]) == ["constants.safetensors", "demonstrations.safetensors", "policy.safetensors"]
