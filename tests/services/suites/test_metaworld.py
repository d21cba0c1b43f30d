"""Meta-World's episodes follow from their seeds, its goals are shown or hidden, its splits are the published ones."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ALL_V3_ENVIRONMENTS_GOAL_HIDDEN, ML1_V3, ML10_V3, ML45_V3
from metaworld.evaluation import evaluation
from metaworld.sawyer_xyz_env import SawyerXYZEnv

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from dmil_core.errors import UserError
from dmil_core.seeding import named_seed
from services.rollouts.episodes import demonstrate
from services.suites.metaworld import (
    SPLITS,
    TASKS,
    HiddenGoal,
    MetaWorldSuite,
    SeededEpisodes,
)

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
SMOKE_TASKS = ("door-close", "drawer-close", "push", "reach")


def each_of(tasks: Iterable[str]) -> list[Any]:
    """Return tasks as cases, of which `make test` takes those of the preset smoke."""
    return [task if task in SMOKE_TASKS else pytest.param(task, marks=pytest.mark.thorough) for task in tasks]


# The five of the paper's Table 5 to 8 and of the authors' code; their meta-training tasks are Meta-World's other 45.
REFERENCE_ML45_TEST = ["bin-picking", "box-close", "hand-insert", "door-lock", "door-unlock"]


def names(environments: dict[str, Any]) -> list[str]:
    return [name.removesuffix("-v3") for name in environments]


@pytest.mark.parametrize(("name", "split"), [("ml10", OFFICIAL), ("ml10-reference", REFERENCE)])
def test_the_splits_are_the_published_ones(name, split):
    suite = MetaWorldSuite(SuiteConfig(name=name))
    assert [list(suite.train_tasks), list(suite.test_tasks)] == list(split)
    assert suite.name == name


@pytest.mark.parametrize(("name", "benchmark"), [("ml10", ML10_V3), ("ml45", ML45_V3)])
def test_the_benchmark_splits_are_those_of_the_package(name, benchmark):
    assert [list(tasks) for tasks in SPLITS[name]] == [names(benchmark["train"]), names(benchmark["test"])]


def test_ml45_of_the_authors_is_that_of_the_benchmark():
    train, test = SPLITS["ml45"]
    assert list(test) == REFERENCE_ML45_TEST
    assert sorted((*train, *test)) == sorted(names(ALL_V3_ENVIRONMENTS))


def test_there_is_an_ml1_of_every_task_of_meta_world():
    found = {name.removeprefix("ML1-"): split for name, split in SPLITS.items() if name.startswith("ML1-")}
    assert found == {task: ((task,), (task,)) for task in names(ML1_V3["train"])}
    assert len(found) == 50


@pytest.mark.parametrize("name", ["ML1-reach", "ml1-reach", "ML1-REACH"])
def test_a_suite_is_found_in_large_and_small_letters(name):
    assert MetaWorldSuite(SuiteConfig(name=name)).name == "ML1-reach"


def test_goals_of_meta_testing_are_unseen_in_meta_training():
    """In an ML1 too, where both have the one task: evaluation's episodes and demonstrations have other seeds."""
    env = MetaWorldSuite(SuiteConfig(name="ML1-reach")).make_env("reach")

    def goals(*key: str) -> set[tuple[float, ...]]:
        return {tuple(env.reset(seed=named_seed(0, *key, "reach", index))[1]["goal"]) for index in range(25)}

    seen, unseen = goals("demonstration"), goals("evaluation")
    assert len(seen) == len(unseen) == 25
    assert seen.isdisjoint(unseen)


def test_the_new_task_is_met_after_ml10():
    suite = MetaWorldSuite(SuiteConfig(name="push-around-wall"))
    assert [list(suite.train_tasks), list(suite.test_tasks)] == [OFFICIAL[0], ["push-around-wall"]]


@pytest.mark.parametrize("name", ["ml10", "ml45", "ML1-reach"])
def test_any_suite_may_list_the_new_task(name):
    suite = MetaWorldSuite(SuiteConfig(name=name, test_tasks=("push-around-wall",)))
    env = suite.make_env("push-around-wall")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (suite.obs_dim,)
    assert suite.expert("push-around-wall").get_action(observation).shape == (suite.action_dim,)


@pytest.mark.parametrize("name", ["ml11", "ML1", "ML1-fly", "reach"])
def test_an_unknown_suite_is_named_with_the_known_ones(name):
    with pytest.raises(UserError) as error:
        MetaWorldSuite(SuiteConfig(name=name))
    message = str(error.value)
    assert message.startswith(f"suite.name: got {name}; wanted ml10, ml10-reference, ml45, push-around-wall, kitchen-")
    assert all(task in message for task in ALL_TASKS)


def test_a_setting_of_the_kitchen_s_is_refused():
    with pytest.raises(UserError, match=r"suite\.start_noise: got 2; that is the kitchen's"):
        MetaWorldSuite(SuiteConfig(start_noise=2))


# Protocols


@pytest.mark.parametrize(
    ("settings", "steps", "protocol"),
    [
        ({}, 300, "goal visible; success at any step within 300"),
        ({"horizon": 150}, 150, "goal visible; success at any step within 150"),
        ({"goal_visible": False}, 300, "goal hidden; success at any step within 300"),
        ({"protocol": "benchmark"}, 500, "Meta-World's evaluation; goal visible; success at any step within 500"),
        (
            {"protocol": "benchmark", "goal_visible": False, "horizon": 200},
            200,
            "Meta-World's evaluation; goal hidden; success at any step within 200",
        ),
    ],
)
def test_the_protocol_says_what_counts(settings, steps, protocol):
    suite = MetaWorldSuite(SuiteConfig.model_validate(settings))
    assert (suite.horizon, suite.protocol) == (steps, protocol)


def test_the_benchmark_has_meta_worlds_own_horizon():
    assert MetaWorldSuite(SuiteConfig(protocol="benchmark")).horizon == SawyerXYZEnv.max_path_length


class _OneStep:
    """Stands for Meta-World's vector of one environment: solved in the middle of an episode, and not at its end."""

    num_envs = 1

    def __init__(self) -> None:
        self.terminates, self.at = False, 0

    def get_attr(self, name: str) -> list[Any]:
        return ["SawyerReachEnvV3"] if name == "task_name" else [self.terminates]

    def call(self, _: str, on: bool) -> None:
        self.terminates = on

    def reset(self) -> tuple[np.ndarray, dict]:
        self.at = 0
        return np.zeros((1, 39)), {}

    def step(self, _: np.ndarray) -> tuple[Any, ...]:
        self.at += 1
        success = self.at == 2
        ended = np.array([success and self.terminates])
        last = np.array([self.at == 4])
        info = {"final_info": {"episode": {"r": [0.0]}, "success": [success]}}
        if ended[0] or last[0]:
            self.at = 0
        return np.zeros((1, 39)), None, ended, last, info


class _Idle:
    def eval_action(self, observations: np.ndarray) -> np.ndarray:
        return np.zeros((len(observations), 4))

    def reset(self, env_mask: np.ndarray) -> None: ...


def test_meta_worlds_own_evaluation_counts_success_at_any_step():
    envs: Any = _OneStep()
    rate, *_ = evaluation(_Idle(), envs, num_episodes=3)
    assert rate == 1.0


# Hidden goals


@pytest.mark.parametrize("task", ["reach", "push", "door-close", "lever-pull", "push-around-wall"])
def test_a_hidden_goal_is_zero_and_the_rest_is_equal(task):
    visible, hidden = (MetaWorldSuite(SuiteConfig(goal_visible=shown)).make_env(task) for shown in (True, False))
    (seen, info), (unseen, hidden_info) = (env.reset(seed=3) for env in (visible, hidden))
    assert info["goal"] == hidden_info["goal"]
    rng = np.random.default_rng(0)
    for _ in range(30):
        assert unseen.shape == seen.shape
        assert np.array_equal(unseen[:-3], seen[:-3])
        assert not unseen[-3:].any()
        assert seen[-3:].any()
        assert np.array_equal(hidden_info["full_observation"], seen)
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        seen, *_, info = visible.step(action)
        unseen, *_, hidden_info = hidden.step(action)
        assert hidden_info["success"] == info["success"]


@pytest.mark.parametrize("task", each_of(task for task in TASKS if task != "push-around-wall"), scope="module")
def test_hidden_goals_are_hidden_as_meta_world_hides_them(task):
    stock: Any = ALL_V3_ENVIRONMENTS_GOAL_HIDDEN[f"{task}-v3-goal-hidden"]()
    stock._freeze_rand_vec, stock.seeded_rand_vec = False, True
    theirs = SeededEpisodes(stock)
    ours = MetaWorldSuite(SuiteConfig(goal_visible=False)).make_env(task)
    rng = np.random.default_rng(0)
    (one, _), (other, _) = (env.reset(seed=4) for env in (theirs, ours))
    for _ in range(20):
        assert np.array_equal(one, other)
        action = rng.uniform(-1, 1, 4).astype(np.float32)
        (one, *_), (other, *_) = (env.step(action) for env in (theirs, ours))


def test_the_expert_sees_the_hidden_goal_and_its_demonstration_does_not():
    visible, hidden = (MetaWorldSuite(SuiteConfig(goal_visible=shown)) for shown in (True, False))
    config = DemonstrationConfig()
    shown, kept = (demonstrate(s.expert("push"), s.make_env("push"), 5, 300, config) for s in (visible, hidden))
    assert isinstance(hidden.make_env("push"), HiddenGoal)
    assert kept.solved_at == shown.solved_at is not None
    assert np.array_equal(kept.actions, shown.actions)
    assert np.array_equal(kept.observations[:, :-3], shown.observations[:, :-3])
    assert not kept.observations[:, -3:].any()


@pytest.mark.parametrize("task", each_of(ALL_TASKS), scope="module")
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


@pytest.mark.parametrize("task", each_of(ALL_TASKS), scope="module")
def test_the_goal_is_visible(task: str):
    env = MetaWorldSuite(SuiteConfig()).make_env(task)
    observation, _ = env.reset(seed=3)
    target = vars(env.unwrapped)["_target_pos"]
    assert observation.shape == (39,)
    assert np.abs(target).sum() > 0
    assert np.array_equal(observation[-3:], target)


@pytest.mark.parametrize("field", ["train_tasks", "test_tasks"])
def test_an_unknown_task_is_named_with_the_known_ones(field: str):
    with pytest.raises(UserError) as error:
        MetaWorldSuite(SuiteConfig.model_validate({field: ("reach", "fly")}))
    message = str(error.value)
    assert message.startswith(f"suite.{field}: got fly; wanted some of ")
    assert all(task in message for task in ALL_TASKS)


def test_a_part_of_the_split_is_no_longer_called_by_its_name():
    suite = MetaWorldSuite(SuiteConfig(train_tasks=("reach",)))
    assert (suite.name, suite.train_tasks) == ("ml10-part", ("reach",))
    assert list(suite.test_tasks) == OFFICIAL[1]
