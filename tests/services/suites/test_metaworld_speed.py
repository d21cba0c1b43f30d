"""Fast environments against Meta-World's own, over all its tasks: equal to the bit, in whatever order episodes come."""

import math
from typing import Any

import numpy as np
import pytest
from gymnasium import Env
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
from metaworld.policies import ENV_POLICY_MAP
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from metaworld.utils import reward_utils
from scipy.spatial.transform import Rotation

from dmil_core.configs import SuiteConfig
from services.suites.metaworld import MetaWorldSuite, SeededEpisodes
from services.suites.metaworld_speed import fast_environment, quaternion
from tests.services.suites.test_metaworld import each_of

ALL_TASKS = sorted(name.removesuffix("-v3") for name in ENV_POLICY_MAP)
EXPERT_STEPS, TRAILING_STEPS, RANDOM_STEPS = 200, 10, 60


def stock_env(task: str) -> Env:
    env: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"]()
    env._freeze_rand_vec, env.seeded_rand_vec = False, True
    return SeededEpisodes(env)


def bits(observation: np.ndarray) -> bytes:
    assert observation.dtype == np.float64
    return observation.tobytes()


def compare(task: str, envs: list[Env], seed: int, *, with_expert: bool) -> bool:
    """Run one episode in all environments, the first of them Meta-World's own; return whether it was solved.

    The second computes rewards, the others do not.
    """
    expert, rng = ENV_POLICY_MAP[f"{task}-v3"](), np.random.default_rng(seed)
    resets = [env.reset(seed=seed) for env in envs]
    observation = resets[0][0]
    assert {bits(each) for each, _ in resets} == {bits(observation)}
    assert all(info["goal"] == resets[0][1]["goal"] for _, info in resets)
    solved_at = None
    for step in range(EXPERT_STEPS if with_expert else RANDOM_STEPS):
        if with_expert:
            action = np.clip(expert.get_action(observation.copy()), -1, 1).astype(np.float32)
        else:
            action = rng.uniform(-1, 1, 4).astype(np.float32)
        stock, rewarded, *others = (env.step(action) for env in envs)
        observation, reward, terminated, truncated, info = stock
        assert {bits(each[0]) for each in (rewarded, *others)} == {bits(observation)}, f"differs at step {step}"
        assert rewarded[1:] == (reward, terminated, truncated, info), f"differs at step {step}"
        for other in others:
            assert math.isnan(other[1])
            assert other[2:] == (terminated, truncated, {"success": info["success"]}), f"differs at step {step}"
        if info["success"] and solved_at is None:
            solved_at = step
        if with_expert and solved_at is not None and step == solved_at + TRAILING_STEPS:
            break
    return solved_at is not None


@pytest.mark.parametrize("task", each_of(ALL_TASKS), scope="module")
def test_episodes_are_those_of_meta_world_to_the_bit(task: str):
    """Observations, successes and, where asked for, rewards and all else that a step's info holds."""
    suite = MetaWorldSuite(SuiteConfig())
    envs = [stock_env(task), suite.make_env(task, rewards=True), suite.make_env(task)]
    solved = any(compare(task, envs, seed, with_expert=True) for seed in range(3))
    assert solved, "the expert never solves it: the test says nothing of success"
    compare(task, envs, 3, with_expert=False)
    # What went before leaves nothing behind: fresh environments have the episode of used ones.
    compare(task, [*envs, suite.make_env(task)], 1, with_expert=False)


@pytest.mark.parametrize("task", each_of(ALL_TASKS), scope="module")
def test_success_is_judged_alike_wherever_the_object_is(task: str):
    """Episodes cross the border of success at few places; here it is asked for many observations around the goal."""
    stock, fast = stock_env(task), MetaWorldSuite(SuiteConfig()).make_env(task)
    observation, _ = stock.reset(seed=1)
    fast.reset(seed=1)
    rng = np.random.default_rng(0)
    target, action = observation[-3:], np.zeros(4, np.float32)
    judge: list[Any] = [stock.unwrapped, fast.unwrapped]
    for scale in np.repeat([0.01, 0.03, 0.1], 40):
        around = observation.copy()
        for part in (slice(4, 7), slice(11, 14), slice(0, 3)):
            around[part] = target + rng.normal(0, scale, 3)
        verdicts = [env.evaluate_state(around.copy(), action)[1]["success"] for env in judge]
        assert verdicts[0] == verdicts[1]


@pytest.mark.parametrize("task", ["push", "lever-pull", "assembly"])
def test_meta_world_itself_stays_as_it_is(task: str):
    stock = ALL_V3_ENVIRONMENTS[f"{task}-v3"]
    classes = [parent for parent in stock.__mro__ if issubclass(parent, SawyerXYZEnv)]
    before = [dict(vars(parent)) for parent in classes]
    utils, rotation = dict(vars(reward_utils)), dict(vars(Rotation))
    fast = fast_environment(stock)
    fast.reset()
    fast.step(np.zeros(4, np.float32))
    assert [dict(vars(parent)) for parent in classes] == before
    assert (dict(vars(reward_utils)), dict(vars(Rotation))) == (utils, rotation)
    assert isinstance(fast, stock)
    later = stock_env(task)
    later.reset(seed=1)
    _, reward, _, _, info = later.step(np.zeros(4, np.float32))
    assert math.isfinite(float(reward))
    assert len(info) > 1


def test_environments_share_no_model():
    first, second = (fast_environment(ALL_V3_ENVIRONMENTS["door-open-v3"]) for _ in range(2))
    first.seed(1)
    first.reset()
    kept = second.model.body_pos.copy()
    first.seed(2)
    first.reset()
    assert np.array_equal(second.model.body_pos, kept)
    assert not np.array_equal(first.model.body_pos, kept)


def test_an_episode_ends_where_meta_world_ends_it():
    env = fast_environment(ALL_V3_ENVIRONMENTS["reach-v3"])
    env.reset()
    ended = [env.step(np.zeros(4, np.float32))[3] for _ in range(env.max_path_length)]
    assert ended.index(True) == env.max_path_length - 1
    with pytest.raises(ValueError, match="must reset"):
        env.step(np.zeros(4, np.float32))


def test_quaternions_are_those_of_scipy_to_the_bit():
    rng = np.random.default_rng(0)
    turns = [Rotation.from_matrix(matrix) for matrix in (np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1]))]
    turns += [Rotation.from_quat(rng.normal(size=4)) for _ in range(2000)]
    for turn in turns:
        matrix = turn.as_matrix()
        assert quaternion(matrix).tobytes() == Rotation.from_matrix(matrix).as_quat().tobytes()
