"""Meta-World's episodes follow from their seeds, its goals are visible, and its splits are the published ones."""

import numpy as np
import pytest

from dmil_core.configs import SuiteConfig
from services.suites.metaworld import MetaWorldSuite, UnknownTaskError

OFFICIAL = (
    ["reach", "push", "pick-place", "door-open", "drawer-close", "button-press-topdown", "peg-insert-side",
     "window-open", "sweep", "basketball"],
    ["drawer-open", "door-close", "shelf-place", "sweep-into", "lever-pull"],
)  # fmt: skip
REFERENCE = (
    ["basketball", "button-press", "dial-turn", "drawer-close", "peg-insert-side", "reach", "push", "pick-place",
     "sweep-into", "window-open"],
    ["door-close", "drawer-open", "lever-pull", "shelf-place", "sweep"],
)  # fmt: skip
ALL_TASKS = sorted({*OFFICIAL[0], *OFFICIAL[1], *REFERENCE[0], *REFERENCE[1]})


@pytest.mark.parametrize(("name", "split"), [("ml10", OFFICIAL), ("ml10-reference", REFERENCE)])
def test_the_splits_are_the_published_ones(name, split):
    suite = MetaWorldSuite(SuiteConfig(name=name))
    assert [list(suite.train_tasks), list(suite.test_tasks)] == list(split)
    assert suite.name == name


@pytest.mark.parametrize("task", ALL_TASKS)
def test_an_episode_follows_from_its_seed_alone(task: str):
    suite = MetaWorldSuite(SuiteConfig())
    used, fresh = suite.make_env(task), suite.make_env(task)
    expert = suite.expert(task)

    def episode(env, seed: int, steps: int):
        observation, info = env.reset(seed=seed)
        seen = [observation]
        for _ in range(steps):
            seen.append(env.step(np.clip(expert.get_action(seen[-1]), -1, 1).astype(np.float32))[0])
        return np.array(seen), info["goal"]

    first, goal = episode(used, 1, 20)
    other, other_goal = episode(used, 2, 60)
    again, same_goal = episode(used, 1, 20)
    elsewhere, goal_elsewhere = episode(fresh, 1, 20)
    assert np.array_equal(first, again)
    assert np.array_equal(first, elsewhere)
    assert goal == same_goal == goal_elsewhere
    assert goal != other_goal
    assert not np.array_equal(first[0], other[0])


@pytest.mark.parametrize("task", ALL_TASKS)
def test_the_goal_is_visible(task: str):
    env = MetaWorldSuite(SuiteConfig()).make_env(task)
    observation, _ = env.reset(seed=3)
    target = vars(env.unwrapped)["_target_pos"]
    assert observation.shape == (39,)
    assert np.abs(target).sum() > 0
    assert np.array_equal(observation[-3:], target)


@pytest.mark.parametrize("field", ["train_tasks", "test_tasks"])
def test_an_unknown_task_is_named_with_the_known_ones(field: str):
    with pytest.raises(UnknownTaskError) as error:
        MetaWorldSuite(SuiteConfig.model_validate({field: ("reach", "fly")}))
    message = str(error.value)
    assert message.startswith(f"suite.{field}: got fly; wanted some of ")
    assert all(task in message for task in ALL_TASKS)


def test_a_part_of_the_split_is_no_longer_called_by_its_name():
    suite = MetaWorldSuite(SuiteConfig(train_tasks=("reach",)))
    assert (suite.name, suite.train_tasks) == ("ml10-part", ("reach",))
    assert list(suite.test_tasks) == OFFICIAL[1]
