"""Meta-World's ML1, ML10 and ML45 (Yu et al. 2019), and other splits of its tasks; episodes follow from their seed."""

import warnings
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float64
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError, nearest
from dmil_core.points import Points
from services.suites.base import Environment, Expert, Measure
from services.suites.metaworld_speed import fast_environment
from services.suites.push_around_wall import PushAroundWallEnv, PushAroundWallExpert
from services.suites.rendering import View

HORIZONS = {"paper": 300, "benchmark": 500}
"""Steps in an episode, by protocol."""
GOAL_DIM = 3
"""The last numbers of an observation are the goal's position, in metres."""

TASKS = (*sorted(name.removesuffix("-v3") for name in ENV_POLICY_MAP), "push-around-wall")
"""All tasks that a split may list: Meta-World's 50, and the paper's new one."""

ML10_TRAIN = (
    "reach", "push", "pick-place", "door-open", "drawer-close", "button-press-topdown", "peg-insert-side",
    "window-open", "sweep", "basketball",
)  # fmt: skip
SPLITS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "ml10": (ML10_TRAIN, ("drawer-open", "door-close", "shelf-place", "sweep-into", "lever-pull")),
    "ml10-reference": (
        ("basketball", "button-press", "dial-turn", "drawer-close", "peg-insert-side", "reach", "push", "pick-place",
         "sweep-into", "window-open"),
        ("door-close", "drawer-open", "lever-pull", "shelf-place", "sweep"),
    ),
    "ml45": (
        ("assembly", "basketball", "button-press-topdown", "button-press-topdown-wall", "button-press",
         "button-press-wall", "coffee-button", "coffee-pull", "coffee-push", "dial-turn", "disassemble", "door-close",
         "door-open", "drawer-close", "drawer-open", "faucet-open", "faucet-close", "hammer", "handle-press-side",
         "handle-press", "handle-pull-side", "handle-pull", "lever-pull", "pick-place-wall", "pick-out-of-hole",
         "push-back", "pick-place", "plate-slide", "plate-slide-side", "plate-slide-back", "plate-slide-back-side",
         "peg-insert-side", "peg-unplug-side", "soccer", "stick-push", "stick-pull", "push-wall", "push", "reach-wall",
         "reach", "shelf-place", "sweep-into", "sweep", "window-open", "window-close"),
        ("bin-picking", "box-close", "hand-insert", "door-lock", "door-unlock"),
    ),
    "push-around-wall": (ML10_TRAIN, ("push-around-wall",)),
    **{f"ML1-{task}": ((task,), (task,)) for task in TASKS if task != "push-around-wall"},
}  # fmt: skip
"""Meta-training and meta-testing tasks.

ml10 and ml45 are the benchmark's own splits, ml10-reference is that of the authors' released code, whose ML45 is the
benchmark's. An ML1 has one task in both; as each episode and demonstration has a goal of its own, those of meta-testing
are unseen in meta-training.
"""

WITHOUT_DISTANCE = {"assembly", "box-close", "disassemble", "door-open", "hammer", "lever-pull"}
"""Tasks whose info has a zero for the distance to the goal, or, in lever-pull, the distance from hand to lever."""


class SeededEpisodes(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Makes ``reset(seed=...)`` mean what gymnasium says, and reports what it drew; Meta-World ignores the seed."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the episode of `seed`; ``info["goal"]`` holds its object and goal positions, in metres."""
        env: Any = self.env
        if seed is not None:
            env.seed(seed)
        observation, info = env.reset(options=options)
        return observation, {**info, "goal": env._last_rand_vec.tolist()}


class HiddenGoal(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Zeroes the goal in observations, as Meta-World's partially observable environments do.

    The infos' ``full_observation`` is for experts, which cannot do without.
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the episode of `seed`."""
        full, info = self.env.reset(seed=seed, options=options)
        return _without_goal(full), {**info, "full_observation": full}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute an action."""
        full, reward, terminated, truncated, info = self.env.step(action)
        return _without_goal(full), reward, terminated, truncated, {**info, "full_observation": full}


def _without_goal(observation: Float64[np.ndarray, " obs_dim"]) -> Float64[np.ndarray, " obs_dim"]:
    return np.concatenate((observation[:-GOAL_DIM], np.zeros(GOAL_DIM)))


class MetaWorldSuite:
    """Meta-World tasks in a split; an episode is a success if the task is solved at any step within the horizon.

    So it is in the paper and in ``metaworld.evaluation`` alike: the latter ends an episode at its first success, or
    after 500 steps.
    """

    family = "metaworld"
    camera = View((0.0, 0.62, 0.1), distance=1.25, azimuth=145, elevation=-30)
    obs_dim = 39
    action_dim = 4
    action_space = Box(-1, 1, (4,))
    best_score = 1
    points = Points(
        size=39, hand=(0, 1, 2), gripper=3, object=(4, 5, 6), orientation=(7, 8, 9, 10), second_object=(11, 12, 13),
        second_orientation=(14, 15, 16, 17), previous=18, goal=(36, 37, 38), reach=0.01,
    )  # fmt: skip

    def __init__(self, config: SuiteConfig) -> None:
        """Check the names of suite and tasks.

        Raises:
            UserError: for a suite or a task that there is not, or a setting that it does not have.
        """
        if config.start_noise != 1:
            raise UserError(
                f"suite.start_noise: got {config.start_noise:g}; that is the kitchen's; leave it out for {config.name}"
            )
        name = {name.lower(): name for name in SPLITS}.get(config.name.lower())
        if name is None:
            known = ", ".join(name for name in SPLITS if not name.startswith("ML1-"))
            tasks = ", ".join(task for task in TASKS if f"ML1-{task}" in SPLITS)
            raise UserError(
                f"suite.name: got {config.name}; wanted {known}, kitchen-topburner, -microwave, -kettle or -slide, or "
                f"ML1- and one of {tasks}{nearest(config.name, SPLITS)}"
            )
        train, test = SPLITS[name]
        self.name = name if config.train_tasks is config.test_tasks is None else f"{name}-part"
        self.train_tasks = train if config.train_tasks is None else config.train_tasks
        self.test_tasks = test if config.test_tasks is None else config.test_tasks
        for field, tasks in (("train_tasks", self.train_tasks), ("test_tasks", self.test_tasks)):
            if unknown := [task for task in tasks if task not in TASKS]:
                raise UserError(
                    f"suite.{field}: got {', '.join(unknown)}; wanted some of {', '.join(TASKS)}"
                    f"{nearest(unknown[0], TASKS)}"
                )
        self.horizon = config.horizon or HORIZONS[config.protocol]
        self._goal_visible = config.goal_visible
        rule = f"goal {'visible' if config.goal_visible else 'hidden'}; success at any step within {self.horizon}"
        self.protocol = rule if config.protocol == "paper" else f"Meta-World's evaluation; {rule}"

    def make_measured_env(self, task: str) -> Environment:
        """Build the same with rewards, whose terms are in the infos."""
        return self.make_env(task, rewards=True)

    def measure_of(self, task: str) -> Measure:
        """Return the distance to the goal, or Meta-World's reward for the tasks that compute no such distance."""
        if task in WITHOUT_DISTANCE:
            return Measure("unscaled_reward", "Meta-World's reward, 0 to 10")
        return Measure("obj_to_target", "distance to the goal (m)")

    def make_env(self, task: str, *, rewards: bool = False) -> Environment:
        """Build a task's environment, made fast; unless asked for, its rewards are NaN and its info is ``success``."""
        stock = PushAroundWallEnv if task == "push-around-wall" else ALL_V3_ENVIRONMENTS[f"{task}-v3"]
        env = SeededEpisodes(fast_environment(stock, rewards=rewards))
        return env if self._goal_visible else HiddenGoal(env)

    def expert(self, task: str) -> Expert:
        """Return Meta-World's own scripted policy, or ours for the task that it does not have.

        Its warning of actions beyond [-1, 1] is ignored from here on: whoever acts clips them.
        """
        warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")
        return PushAroundWallExpert() if task == "push-around-wall" else ENV_POLICY_MAP[f"{task}-v3"]()
