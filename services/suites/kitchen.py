"""The Franka kitchen (Gupta et al. 2019; gymnasium-robotics' ``FrankaKitchen-v1``): tasks are chains of sub-tasks."""

import contextlib
import io
from collections.abc import Sequence
from itertools import combinations
from threading import Lock
from typing import Any

import gymnasium
import mujoco as compiled_mujoco
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float32, Float64

from dmil_core.configs import SuiteConfig
from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.errors import UserError, nearest
from dmil_core.points import Points
from services.suites.base import Environment, Expert
from services.suites.kitchen_expert import KitchenExpert, kitchen_model
from services.suites.rendering import View

with contextlib.redirect_stderr(io.StringIO()):  # it prints a notice about environments that are not the kitchen
    from gymnasium_robotics.envs.franka_kitchen import kitchen_env

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it

NAMES = {
    "microwave": "microwave",
    "kettle": "kettle",
    "bottomburner": "bottom burner",
    "topburner": "top burner",
    "light": "light switch",
    "hinge": "hinge cabinet",
    "slide": "slide cabinet",
}
"""The sub-tasks, in the order in which chains name them, and what gymnasium-robotics calls them."""


def chains(without: str, length: int = 4) -> tuple[str, ...]:
    """Return all chains of `length` distinct sub-tasks, in the order of `NAMES`, that lack the one `without`."""
    return tuple("-".join(chain) for chain in combinations([name for name in NAMES if name != without], length))


SPLITS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    f"kitchen-{held_out}": (chains(held_out), (test,))
    for held_out, test in (
        ("topburner", "microwave-kettle-topburner-light"),
        ("microwave", "microwave-bottomburner-light-slide"),
        ("kettle", "microwave-kettle-hinge-slide"),
        ("slide", "microwave-kettle-hinge-slide"),
    )
}
"""Meta-training and meta-testing tasks of Table 5's four rows.

The paper names the sub-task that meta-training lacks and the chain that is tested, not the chains that are trained:
here they are all 15 chains of four of the other six sub-tasks.
"""

DEFAULT_SPLIT = "kitchen-topburner"
HORIZON = 280
"""Steps in an episode, as in the paper."""
START_ANGLE = 0.05
"""Radians by which each arm joint's first angle may differ from the environment's: the first states of the real
demonstrations have standard deviations of 0.01 to 0.08."""
START_KETTLE = 0.01
"""Metres by which the kettle's first place may differ, in either direction of the stove."""


class SharedModelRobot(kitchen_env.FrankaRobot):
    """Takes the model that is read once in a process: that takes 0.6 s, and nobody changes it."""

    def _initialize_simulation(self) -> tuple[Any, Any]:
        return kitchen_model(), mujoco.MjData(kitchen_model())


_building = Lock()


def _kitchen_env(chain: Sequence[str]) -> kitchen_env.KitchenEnv:
    """Build gymnasium-robotics' environment with the shared model.

    Its constructor takes no robot, so the module's own class stands back for ours while it runs.
    """
    with _building:
        stock, kitchen_env.FrankaRobot = kitchen_env.FrankaRobot, SharedModelRobot
        try:
            return kitchen_env.KitchenEnv([NAMES[sub_task] for sub_task in chain])
        finally:
            kitchen_env.FrankaRobot = stock


class KitchenTask(gymnasium.Env[np.ndarray, np.ndarray]):
    """One chain of sub-tasks, from starts drawn at random.

    An observation is the paper's 30-dimensional state: 9 angles and openings of the robot and 21 coordinates of the
    objects, with the environment's sensor noise on them. An action holds 9 joint velocities in units of 2 rad/s (or
    m/s, for the fingers); a step lasts 0.08 s.

    A sub-task counts by gymnasium-robotics' rule: once its coordinates were nearer than 0.3 to its goal at the end of
    a step, whatever becomes of it afterwards, and in any order. The reward is the number that a step adds to the
    score.
    """

    def __init__(self, chain: Sequence[str], start_noise: float = 1.0) -> None:
        """Build the simulation; `start_noise` is in units of `START_ANGLE` and `START_KETTLE`."""
        self._env = _kitchen_env(chain)
        self.model, self.data = self._env.model, self._env.data
        self._rest = self._env.robot_env.init_qpos
        self._spread = start_noise * np.array([START_ANGLE] * 7 + [START_KETTLE] * 2)
        self.observation_space = Box(-np.inf, np.inf, (30,), np.float64)
        self.action_space = Box(-1, 1, (9,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the episode of `seed`, or begin with ``options["state"]``, 30 positions of robot and objects.

        ``info["goal"]`` holds how the start differs from the environment's: 7 angles in radians, 2 places of the
        kettle in metres.
        """
        super().reset(seed=seed)
        shift = self.np_random.uniform(-self._spread, self._spread)
        start = self._rest.copy()
        start[[*range(7), 23, 24]] += shift
        if options is not None and "state" in options:
            start = np.array(options["state"], np.float64)
            shift = (start - self._rest)[[*range(7), 23, 24]]
        self._env.robot_env.init_qpos = start
        observation, _ = self._env.reset(seed=int(self.np_random.integers(2**31)))
        return state(observation["observation"]), {"goal": shift.tolist(), "score": 0, "completed": []}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Advance by 0.08 s; info holds ``success``, the ``score`` and the names of the sub-tasks ``completed``."""
        before = len(self._env.episode_task_completions)
        observation, _, _, _, _ = self._env.step(action)
        completed = [name for name in NAMES if NAMES[name] in self._env.episode_task_completions]
        score = len(completed)
        info = {"success": score == len(self._env.goal), "score": score, "completed": completed}
        return state(observation["observation"]), float(score - before), False, False, info

    def close(self) -> None:
        """Free the simulation."""
        self._env.close()


def state(observation: Float64[np.ndarray, "*steps 59"]) -> Float64[np.ndarray, "*steps 30"]:
    """Return the paper's state: the robot's 9 positions and the objects' 21, without velocities."""
    return np.concatenate([observation[..., :9], observation[..., 18:39]], axis=-1)


class KitchenSuite:
    """Chains in a split; an episode is a success if every sub-task was done at some step within the horizon."""

    family = "kitchen"
    camera = View((-0.2, 0.5, 2.0), distance=2.2, azimuth=70, elevation=-35)
    obs_dim = 30
    action_dim = 9
    points = Points(size=30, hand=tuple(range(9)), reach=0.16)
    action_space = Box(-1, 1, (9,))

    def __init__(self, config: SuiteConfig) -> None:
        """Take a split of `SPLITS`, or some other chains in place of its own.

        Raises:
            UserError: for a split or a sub-task that is not there, or a sub-task named twice, or a
                setting that the kitchen does not have.
        """
        name = DEFAULT_SPLIT if config.name.lower() == "kitchen" else config.name.lower()
        if name not in SPLITS:
            raise UserError(
                f"suite.name: got {config.name}; wanted kitchen or {', '.join(SPLITS)}{nearest(config.name, SPLITS)}"
            )
        if config.protocol != "paper" or not config.goal_visible:
            field = "goal_visible: got False" if config.protocol == "paper" else f"protocol: got {config.protocol}"
            raise UserError(f"suite.{field}; that is Meta-World's; leave it out for {name}")
        train, test = SPLITS[name]
        self.name = name if config.train_tasks is config.test_tasks is None else f"{name}-part"
        self.train_tasks = train if config.train_tasks is None else config.train_tasks
        self.test_tasks = test if config.test_tasks is None else config.test_tasks
        for field, tasks in (("train_tasks", self.train_tasks), ("test_tasks", self.test_tasks)):
            for task in tasks:
                sub_tasks_of(task, f"suite.{field}")
        self.best_score = max(len(sub_tasks_of(task)) for task in (*self.train_tasks, *self.test_tasks))
        self.horizon = config.horizon or HORIZON
        self.expert_tasks = (*NAMES, *dict.fromkeys(task for _, tested in SPLITS.values() for task in tested))
        self.start_noise = config.start_noise
        self.protocol = f"each sub-task at any step within {self.horizon}; start noise {self.start_noise:g}"

    def make_env(self, task: str) -> Environment:
        """Build the environment of a chain, such as ``microwave-kettle-topburner-light``."""
        return KitchenTask(sub_tasks_of(task), self.start_noise)

    def expert(self, task: str) -> Expert:
        """Return the scripted expert of a chain."""
        return KitchenExpert(sub_tasks_of(task))

    def replay(self, demonstration: Demonstration) -> str:
        """Return the sub-tasks that a demonstration's actions complete, see `replay`."""
        return ", ".join(replay(demonstration)) or "none"

    def state_of(self, recorded: Float32[np.ndarray, "steps dims"]) -> Float32[np.ndarray, "steps 30"]:
        """Return the states in recorded observations.

        Those are: the 30-dimensional states; D4RL's, where goals follow them; or gymnasium-robotics', flattened, where
        the 59 numbers of ``observation`` follow what is achieved and desired.

        Raises:
            DemonstrationError: for observations of any other kind.
        """
        dims = recorded.shape[1]
        if dims in (30, 60):
            return recorded[:, :30]
        if dims >= 59:
            return state(recorded[:, -59:])
        raise DemonstrationError(
            f"observations: got {dims} numbers; wanted the 30 of a state, D4RL's 60, or 59 and more of FrankaKitchen-v1"
        )


def sub_tasks_of(task: str, field: str = "task") -> tuple[str, ...]:
    """Return the sub-tasks that a chain's name lists.

    Raises:
        UserError: for an unknown one, or one that is named twice.
    """
    chain = tuple(task.split("-"))
    if not set(chain) <= set(NAMES) or len(set(chain)) < len(chain):
        raise UserError(
            f"{field}: got {task}; wanted some of {', '.join(NAMES)}, each at most once, joined by hyphens"
            f"{nearest(task, NAMES)}"
        )
    return chain


def replay(demonstration: Demonstration, *, seed: int = 0) -> tuple[str, ...]:
    """Replay a demonstration's actions open loop from its first state; return the sub-tasks completed on the way.

    The seed is of the environment's sensor noise, which acts on the robot too.
    """
    env = KitchenTask(tuple(NAMES))
    _, info = env.reset(seed=seed, options={"state": resting(demonstration.observations[0])})
    for action in demonstration.actions:
        info = env.step(action)[4]
    env.close()
    return tuple(info["completed"])


def resting(observed: Float32[np.ndarray, "30"]) -> Float64[np.ndarray, "30"]:
    """Return positions that the simulation can begin with: an observed state without what noise makes impossible."""
    start = observed.astype(np.float64)
    start[7:9] = np.clip(start[7:9], 0, 0.04)
    start[26:30] /= np.linalg.norm(start[26:30])
    return start
