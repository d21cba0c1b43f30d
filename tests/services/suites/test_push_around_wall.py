"""Push-around-wall: the expert solves it; every way to the goal but the one around the wall is no success."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import SawyerPickPlaceWallV3Policy, SawyerPushV3Policy

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from services.rollouts.episodes import demonstrate
from services.suites.base import Environment, Expert
from services.suites.metaworld import MetaWorldSuite, SeededEpisodes
from services.suites.metaworld_speed import fast_environment
from services.suites.push_around_wall import GOAL_RADIUS, STILL_STEPS, CubePath, PushAroundWallEnv, PushAroundWallExpert

TASK = "push-around-wall"
HORIZON = 300


def make_env(*, rewards: bool = False) -> Environment:
    return MetaWorldSuite(SuiteConfig(test_tasks=(TASK,))).make_env(TASK, rewards=rewards)


def stock_env() -> Environment:
    """Build the environment without what makes it fast, as Meta-World builds its own that show the goal."""
    env: Any = PushAroundWallEnv()
    env._partially_observable = False
    del env.sawyer_observation_space
    env._set_task_called, env._freeze_rand_vec, env.seeded_rand_vec = True, False, True
    return SeededEpisodes(env)


@pytest.fixture(scope="module")
def env() -> Environment:
    return make_env()


def run(env: Environment, policy: Expert, seed: int, steps: int = HORIZON) -> tuple[bool, np.ndarray]:
    """Run an episode to its end; return whether it was ever a success, and all observations."""
    observation, _ = env.reset(seed=seed)
    seen, success = [observation], False
    for _ in range(steps):
        action = np.clip(policy.get_action(seen[-1].copy()), -1, 1).astype(np.float32)
        observation, _, _, _, info = env.step(action)
        seen.append(observation)
        success |= bool(info["success"])
    return success, np.array(seen)


def distance(observation: np.ndarray) -> float:
    return float(np.linalg.norm(observation[4:7] - observation[-3:]))


# What the expert does


def solved(env: Environment, seeds: range, noise: float) -> int:
    config = DemonstrationConfig(noise=noise)
    attempts = [demonstrate(PushAroundWallExpert(), env, seed, HORIZON, config) for seed in seeds]
    return sum(attempt.solved_at is not None for attempt in attempts)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_expert_solves_it(env, noise):
    assert solved(env, range(5), noise) == 5


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_expert_solves_38_of_40_seeds(env, noise):
    assert solved(env, range(40), noise) >= 38


def test_the_expert_has_no_memory(env):
    """Two that act in turn do what one alone does."""
    one, other = PushAroundWallExpert(), PushAroundWallExpert()
    success, seen = run(env, one, seed=1)
    assert success
    for observation in seen[::7]:
        assert np.array_equal(one.get_action(observation.copy()), other.get_action(observation.copy()))
        other.get_action(seen[50].copy())


def test_the_expert_takes_the_cube_around_the_left_end_and_lets_go_of_it(env):
    _, seen = run(env, PushAroundWallExpert(), seed=2)
    cube = seen[:, 4:7]
    crossing = np.argmax(cube[:, 1] > 0.75)
    assert cube[crossing, 0] < -0.02
    assert cube[crossing, 2] < 0.12
    assert seen[-1, 3] > 0.9
    assert cube[-1, 2] == pytest.approx(0.02, abs=0.002)


# Other ways to the goal


@pytest.mark.parametrize("seed", range(3))
def test_a_straight_push_is_stopped_by_the_wall(env, seed):
    success, seen = run(env, SawyerPushV3Policy(), seed)
    assert seen[-1, 5] > seen[0, 5] + 0.02, "it does not push the cube: the test says nothing"
    assert (seen[:, 5] < 0.75).all()
    assert not success


@pytest.mark.parametrize("seed", range(3))
def test_lifting_the_cube_over_the_wall_is_no_success(env, seed):
    success, seen = run(env, SawyerPickPlaceWallV3Policy(), seed, steps=400)
    assert distance(seen[-1]) <= GOAL_RADIUS, "the cube does not come to the goal: the test says nothing"
    assert not success


def put(env: Environment, cube: np.ndarray) -> None:
    unwrapped: Any = env.unwrapped
    unwrapped._set_obj_xyz(cube)


def rest(env: Environment, steps: int = 30) -> tuple[bool, float]:
    """Hold the hand still; return whether that is ever a success, and how far the cube is from the goal."""
    success, observation = False, np.zeros(39)
    for _ in range(steps):
        observation, _, _, _, info = env.step(np.array((0, 0, 0, -1), np.float32))
        success |= bool(info["success"])
    return success, distance(observation)


def test_putting_the_cube_to_the_goal_is_no_success(env):
    observation, _ = env.reset(seed=1)
    put(env, observation[-3:])
    success, away = rest(env)
    assert away <= GOAL_RADIUS
    assert not success


def test_putting_the_cube_from_way_point_to_way_point_is_no_success(env):
    observation, _ = env.reset(seed=1)
    for x, y in ((-0.1, 0.65), (-0.1, 0.85), observation[-3:-1]):
        put(env, np.array((x, y, 0.02)))
        assert not rest(env, 3)[0]
    success, away = rest(env)
    assert away <= GOAL_RADIUS
    assert not success


def test_a_cube_that_is_moved_around_the_wall_little_by_little_has_gone_around_it(env):
    """The counterpart of the two above, and the other end of the wall."""
    observation, _ = env.reset(seed=1)
    cube = observation[4:7]
    for stop in ((0.28, 0.65), (0.28, 0.85), observation[-3:-1]):
        for x, y in np.linspace(cube[:2], stop, 20):
            cube = np.array((x, y, 0.02))
            put(env, cube)
            assert not rest(env, 1)[0]
    assert rest(env)[0]


def test_only_a_reset_begins_anew(env):
    observation, _ = env.reset(seed=1)
    put(env, observation[-3:])
    env.step(np.zeros(4, np.float32))
    put(env, observation[4:7])
    for _ in range(200):
        action = np.clip(PushAroundWallExpert().get_action(observation), -1, 1)
        observation, _, _, _, info = env.step(action)
        assert not info["success"]
    assert distance(observation) <= GOAL_RADIUS
    assert run(env, PushAroundWallExpert(), seed=1)[0]


# The rule by itself

START, GOAL = (0.06, 0.62, 0.02), (0.06, 0.86, 0.02)
LEFT_BEFORE, LEFT_BEHIND = (-0.1, 0.62, 0.02), (-0.1, 0.86, 0.02)
RIGHT_BEFORE, RIGHT_BEHIND = (0.3, 0.62, 0.02), (0.3, 0.86, 0.02)
UP_BEFORE, UP_BEHIND = (0.06, 0.62, 0.15), (0.06, 0.86, 0.15)
LEFT = (LEFT_BEFORE, LEFT_BEHIND)


def follow(*stops: tuple[float, float, float], longest: float = 0.01, still: int = STILL_STEPS) -> CubePath:
    """Return the path from `START` over all stops, in moves of a hand, and at rest in the end."""
    path = CubePath(START)
    for start, end in pairwise((START, *stops)):
        moves = int(np.ceil(np.linalg.norm(np.subtract(end, start)) / longest))
        for position in np.linspace(start, end, moves + 1)[1:]:
            path = path.to(position)
    for _ in range(still):
        path = path.to(np.array(stops[-1]))
    return path


@pytest.mark.parametrize(
    ("stops", "done"),
    {
        "left": ((*LEFT, GOAL), True),
        "right": ((RIGHT_BEFORE, RIGHT_BEHIND, GOAL), True),
        "lifted, but lower than the wall": (((-0.1, 0.62, 0.11), (-0.1, 0.86, 0.11), GOAL), True),
        "left after a look at the right": ((RIGHT_BEFORE, *LEFT, GOAL), True),
        "around and all along the wall": ((*LEFT, RIGHT_BEHIND, GOAL), True),
        "around, back and around again": ((*LEFT, GOAL, *reversed(LEFT), *LEFT, GOAL), True),
        "around and back": ((*LEFT, GOAL, *reversed(LEFT), START), False),
        "all around and over to the goal": ((*LEFT, RIGHT_BEHIND, RIGHT_BEFORE, UP_BEFORE, UP_BEHIND, GOAL), False),
        "through": ((GOAL,), False),
        "over": ((UP_BEFORE, UP_BEHIND, GOAL), False),
        "over, beside the wall": (((-0.1, 0.62, 0.15), (-0.1, 0.86, 0.15), GOAL), False),
        "over and back, then left": ((UP_BEFORE, UP_BEHIND, UP_BEFORE, *LEFT, GOAL), False),
        "nowhere": ((LEFT_BEFORE, START), False),
    }.values(),
)
def test_only_the_way_around_counts(stops, done):
    assert follow(*stops).done is done


@pytest.mark.parametrize(("longest", "done"), [(0.049, True), (0.06, False)])
def test_a_jump_is_no_way(longest, done):
    assert follow(*LEFT, GOAL, longest=longest).done is done


@pytest.mark.parametrize("position", [(np.nan, 0.62, 0.02), (0.06, np.inf, 0.02)])
def test_a_broken_simulation_is_no_way(position):
    path = CubePath(START).to(np.array(position))
    assert path.spoiled
    assert not path.to(np.array(GOAL)).done


@pytest.mark.parametrize(("still", "done"), [(STILL_STEPS - 1, False), (STILL_STEPS, True)])
def test_the_cube_must_rest(still, done):
    assert follow(*LEFT, GOAL, still=still).done is done


def test_a_cube_that_moves_on_does_not_rest():
    assert not follow(*LEFT, GOAL).to(np.add(GOAL, (0.001, 0, 0))).done


# One of Meta-World's kind


def test_an_episode_follows_from_its_seed_alone(env):
    first, again, other = run(env, PushAroundWallExpert(), 1), run(env, PushAroundWallExpert(), 1), make_env()
    assert np.array_equal(first[1], again[1])
    assert np.array_equal(first[1], run(other, PushAroundWallExpert(), 1)[1])
    goals = [env.reset(seed=seed)[1]["goal"] for seed in (1, 2)]
    assert goals[0] != goals[1]
    starts = np.array([env.reset(seed=seed)[0] for seed in range(30)])
    assert (starts[:, [4, 5, -3, -2]].std(axis=0) > 0.01).all(), "cubes and goals are hardly random"


def test_the_wall_is_between_every_cube_and_its_goal(env):
    space: Any = vars(env.unwrapped)["_random_reset_space"]
    cube_and_goal_x = np.stack((space.low[[0, 3]], space.high[[0, 3]]))
    assert cube_and_goal_x.min() > -0.02 + 0.02, "a cube of 4 cm could pass the left end on a straight way"
    assert cube_and_goal_x.max() < 0.22 - 0.02


def test_the_cube_is_a_cube(env):
    unwrapped: Any = env.unwrapped
    geom = unwrapped.model.geom("objGeom")
    assert geom.type == 6  # mjGEOM_BOX
    assert geom.size.tolist() == [0.02, 0.02, 0.02]


def test_observation_action_reward_and_info_are_like_those_of_its_siblings():
    env = make_env(rewards=True)
    sibling = SeededEpisodes(fast_environment(ALL_V3_ENVIRONMENTS["push-wall-v3"], rewards=True))
    (observation, _), (theirs, _) = (each.reset(seed=0) for each in (env, sibling))
    assert (observation.shape, observation.dtype) == (theirs.shape, theirs.dtype)
    assert env.action_space == sibling.action_space
    target = vars(env.unwrapped)["_target_pos"]
    assert np.array_equal(observation[-3:], target)
    rewards = []
    expert = PushAroundWallExpert()
    info: dict[str, Any] = {}
    for _ in range(200):
        observation, reward, terminated, _, info = env.step(np.clip(expert.get_action(observation), -1, 1))
        rewards.append(float(reward))
        assert not terminated
        assert info["unscaled_reward"] == reward
    _, _, _, _, their_info = sibling.step(np.zeros(4, np.float32))
    assert list(info) == list(their_info)
    assert min(rewards) > 0
    assert max(rewards) == rewards[-1] == 10
    quarters = [np.mean(part) for part in np.split(np.array(rewards[:140]), 4)]
    assert quarters == sorted(quarters), "the reward does not lead to the goal"


def test_a_spoiled_path_earns_no_more_than_its_grasp():
    env = make_env(rewards=True)
    observation, _ = env.reset(seed=1)
    put(env, observation[-3:])
    for _ in range(20):
        _, reward, _, _, info = env.step(np.array((0, 0, 0, -1), np.float32))
        assert reward == 2 * info["grasp_reward"]


def test_the_fast_environment_is_equal_to_the_bit():
    stock, rewarded, fast = envs = stock_env(), make_env(rewards=True), make_env()
    solved = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        observations = [env.reset(seed=seed)[0] for env in envs]
        successes = 0
        for _ in range(180):
            action = PushAroundWallExpert().get_action(observations[0].copy())
            noisy = action + rng.normal(0, 0.1, 4) if seed < 3 else rng.uniform(-1, 1, 4)
            steps = [env.step(np.clip(noisy, -1, 1).astype(np.float32)) for env in (stock, rewarded, fast)]
            observations = [step[0] for step in steps]
            assert len({observation.tobytes() for observation in observations}) == 1
            assert steps[0][1:] == steps[1][1:]
            assert steps[2][4] == {"success": steps[0][4]["success"]}
            successes += steps[0][4]["success"] > 0
        solved.append(successes > 0)
    assert solved == [True, True, True, False]
