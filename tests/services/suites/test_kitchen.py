"""The kitchen's episodes follow from their seeds, its score is gymnasium-robotics' own, and its expert works."""

from typing import Any

import mujoco as compiled_mujoco
import numpy as np
import pytest
from gymnasium_robotics.envs.franka_kitchen import kitchen_env

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.errors import UserError
from services.rollouts.episodes import demonstrate
from services.rollouts.verification import verify
from services.suites.inverse_kinematics import Arm, Pose, bounded_least_squares, pose_error
from services.suites.kitchen import NAMES, SPLITS, KitchenSuite, KitchenTask, chains, replay
from services.suites.kitchen_expert import SUB_TASKS, kitchen_model

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it

SUITE = KitchenSuite(SuiteConfig(name="kitchen"))
PAPER = ("microwave-kettle-topburner-light", "microwave-bottomburner-light-slide", "microwave-kettle-hinge-slide")


@pytest.fixture(scope="module")
def env() -> KitchenTask:
    return KitchenTask(("microwave", "kettle"))


def episode(env: KitchenTask, seed: int, steps: int) -> tuple[np.ndarray, list[float]]:
    observation, info = env.reset(seed=seed)
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, 9))
    return np.array([observation, *(env.step(action)[0] for action in actions)]), info["goal"]


def test_an_episode_follows_from_its_seed_alone(env):
    first, goal = episode(env, 1, 20)
    other, other_goal = episode(env, 2, 20)
    again, same_goal = episode(env, 1, 20)
    elsewhere, goal_elsewhere = episode(KitchenTask(("microwave", "kettle")), 1, 20)
    assert np.array_equal(first, again)
    assert np.array_equal(first, elsewhere)
    assert goal == same_goal == goal_elsewhere
    assert goal != other_goal
    assert not np.array_equal(first[0], other[0])


def test_the_state_is_the_positions_of_robot_and_objects(env):
    observation, info = env.reset(seed=5)
    assert observation.shape == env.observation_space.shape == (SUITE.obs_dim,)
    assert env.action_space.shape == (SUITE.action_dim,)
    data = env._env.data
    assert np.allclose(observation, data.qpos, atol=2e-3)
    assert np.allclose(data.qpos[[*range(7), 23, 24]], env._rest[[*range(7), 23, 24]] + info["goal"])
    assert np.abs(info["goal"][:7]).max() <= 0.05
    assert np.abs(info["goal"][7:]).max() <= 0.01


def test_the_model_is_shared_and_gymnasium_robotics_stays_as_it_is(env):
    assert env.model is kitchen_model()
    assert kitchen_env.FrankaRobot.__module__.startswith("gymnasium_robotics.")


def test_a_sub_task_counts_once_and_stays_counted(env):
    env.reset(seed=0)
    hinge = env._env.model.joint("microwave").qposadr[0]
    scores, rewards = [], []
    for angle in (0.0, -0.7, 0.0, -0.7):
        env._env.data.qpos[hinge] = angle
        _, reward, terminated, truncated, info = env.step(np.zeros(9))
        scores.append((info["score"], info["completed"], info["success"]))
        rewards.append(reward)
        assert not terminated
        assert not truncated
    assert scores == [(0, [], False)] + [(1, ["microwave"], False)] * 3
    assert rewards == [0, 1, 0, 0]
    env._env.data.qpos[24] = 0.75
    assert env.step(np.zeros(9))[4]["success"]
    assert env.reset(seed=0)[1]["score"] == 0


def test_the_splits_hold_a_sub_task_out():
    assert len(SPLITS) == 4
    for name, (train, test) in SPLITS.items():
        held_out = name.removeprefix("kitchen-")
        assert len(set(train)) == len(train) == 15
        assert all(held_out not in task.split("-") and len(task.split("-")) == 4 for task in train)
        assert all(held_out in task.split("-") for task in test)
        assert KitchenSuite(SuiteConfig(name=name)).name == name
    assert set(PAPER) == {task for _, test in SPLITS.values() for task in test}
    assert set(PAPER) <= set(chains(without=""))
    assert set(NAMES) == set(SUB_TASKS)


@pytest.mark.parametrize("task", ["microwave-toaster", "kettle-kettle", ""])
def test_an_unknown_chain_is_named(task):
    with pytest.raises(UserError, match="wanted some of microwave"):
        SUITE.expert(task)
    with pytest.raises(UserError, match=r"suite\.test_tasks"):
        KitchenSuite(SuiteConfig(name="kitchen", test_tasks=(task,)))


def test_an_unknown_split_is_named():
    with pytest.raises(UserError, match="got ml10; wanted kitchen or kitchen-topburner"):
        KitchenSuite(SuiteConfig())


def test_settings_of_meta_worlds_are_refused():
    for settings, said in (({"protocol": "benchmark"}, "protocol: got benchmark"), ({"goal_visible": False}, "goal_")):
        with pytest.raises(UserError, match=said):
            KitchenSuite(SuiteConfig.model_validate({"name": "kitchen"} | settings))


def test_the_state_is_found_in_what_others_record():
    recorded = np.arange(2 * 93, dtype=np.float32).reshape(2, 93)
    own = recorded[:, -59:]
    for observations, wanted in (
        (recorded[:, :30], recorded[:, :30]),
        (recorded[:, :60], recorded[:, :30]),
        (own, np.concatenate((own[:, :9], own[:, 18:39]), axis=1)),
        (recorded, np.concatenate((own[:, :9], own[:, 18:39]), axis=1)),
    ):
        assert np.array_equal(SUITE.state_of(observations), wanted)
    with pytest.raises(DemonstrationError, match="got 45 numbers; wanted the 30"):
        SUITE.state_of(recorded[:, :45])


def test_the_expert_remembers_nothing():
    expert, fresh = SUITE.expert(PAPER[0]), SUITE.expert(PAPER[0])
    env = SUITE.make_env(PAPER[0])
    observations = [env.reset(seed=seed)[0] for seed in range(3)]
    actions = [expert.get_action(observation) for observation in observations]
    assert np.array_equal(actions[0], fresh.get_action(observations[0]))
    assert np.array_equal(actions[0], expert.get_action(observations[0]))
    assert not np.array_equal(actions[0], actions[1])


@pytest.mark.parametrize("sub_task", NAMES)
def test_the_expert_does_each_sub_task(sub_task):
    for noise in (0.0, 0.1):
        rows = verify(SUITE, sub_task, range(2), noise)
        assert [(row.success, row.score) for row in rows] == [(True, 1)] * 2, rows
        assert all(row.steps < 150 for row in rows), rows


@pytest.mark.thorough
@pytest.mark.parametrize("task", PAPER)
def test_the_expert_does_the_papers_chains(task):
    rows = verify(SUITE, task, range(2), 0.1)
    assert [(row.success, row.score) for row in rows] == [(True, 4)] * 2, rows


def test_a_replayed_demonstration_does_what_it_did():
    env = SUITE.make_env("microwave")
    attempt = demonstrate(
        SUITE.expert("microwave"), env, 3, SUITE.horizon, DemonstrationConfig(noise=0, trailing_steps=0)
    )
    made_up = Demonstration("000", "microwave", attempt.observations[:-1], attempt.actions)
    assert replay(made_up) == ("microwave",)
    still = Demonstration("001", "microwave", made_up.observations[:20], np.zeros((20, 9), np.float32))
    assert replay(still) == ()


def test_the_jacobian_is_that_of_finite_differences():
    model = kitchen_model()
    arm, random = Arm(model, "end_effector", 7), np.random.default_rng(0)
    qpos, step = mujoco.MjData(model).qpos.copy(), 1e-6
    for _ in range(3):
        qpos[:7] = random.uniform(*arm.limits)
        arm.place(qpos)
        jacobian, before = arm.jacobian(), arm.hand()
        for joint in range(7):
            moved = qpos.copy()
            moved[joint] += step
            arm.place(moved)
            assert np.allclose(pose_error(arm.hand(), before) / step, jacobian[:, joint], atol=1e-4)


def test_gravity_is_what_holds_the_arm():
    model = kitchen_model()
    data = mujoco.MjData(model)
    data.qpos[:7] = [0.1, -1.7, 1.8, -2.4, 0.3, 0.7, 1.6]
    mujoco.mj_forward(model, data)
    arm = Arm(model, "end_effector", 7)
    arm.place(data.qpos)
    assert np.allclose(arm.gravity(), data.qfrc_bias[:7])


def test_least_squares_keep_their_bounds():
    random = np.random.default_rng(1)
    for _ in range(50):
        matrix, target = random.normal(size=(9, 4)), random.normal(size=9)
        free = np.linalg.lstsq(matrix, target, rcond=None)[0]
        wide, narrow = np.full(4, 10.0), np.full(4, 0.1)
        assert np.allclose(bounded_least_squares(matrix, target, -wide, wide), free)
        bounded = bounded_least_squares(matrix, target, -narrow, narrow)
        assert (np.abs(bounded) <= 0.1).all()
        clipped = np.clip(free, -0.1, 0.1)
        assert np.linalg.norm(matrix @ bounded - target) <= np.linalg.norm(matrix @ clipped - target) + 1e-9


def test_a_pose_is_no_way_from_itself():
    pose = Pose(np.ones(3), np.eye(3))
    assert not pose_error(pose, pose).any()
