"""A suite in which a robot on a floor visits three stations in the order that its task names."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError

STATIONS = ("red", "green", "blue")
TRAIN_TASKS = ("red-green-blue", "red-blue-green", "green-red-blue", "green-blue-red", "blue-red-green")
TEST_TASKS = ("blue-green-red",)
HORIZON = 80
SPEED = 0.1
"""Metres per step along each axis, at an action of 1."""
RADIUS = 0.1
"""Distance within which a station counts as visited, in metres."""
PLACES = np.array([[-0.6, -0.4], [0.6, -0.4], [0.0, 0.7]])
SPREAD = 0.15
"""Maximal distance of stations from these places and of the robot from the middle, along each axis, in metres."""


class VisitTask(gymnasium.Env[np.ndarray, np.ndarray]):
    """One order of visits, on a floor of 2 by 2 metres.

    An observation has each station's position relative to the robot (6 numbers, in metres), and which stations are
    visited (3 numbers, 0 or 1). It does not contain the order, which only demonstrations show. An action is a velocity
    along both axes. A visit out of order does not count.
    """

    def __init__(self, order: list[int]) -> None:
        self.observation_space = Box(-np.inf, np.inf, (9,), np.float64)
        self.action_space = Box(-1, 1, (2,), np.float64)
        self._order = order

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the episode of `seed`; ``info["goal"]`` has the positions of robot and stations."""
        super().reset(seed=seed)  # seeds self.np_random, the only source of randomness
        self._robot = self.np_random.uniform(-SPREAD, SPREAD, 2)
        self._stations = PLACES + self.np_random.uniform(-SPREAD, SPREAD, (3, 2))
        self._visits = 0
        return self._observation(), {"goal": np.append(self._robot, self._stations).tolist()}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Move, and visit the next station of the order if it is near."""
        self._robot = np.clip(self._robot + SPEED * np.clip(action, -1, 1), -1, 1)
        before = self._visits
        if before < 3 and np.linalg.norm(self._stations[self._order[before]] - self._robot) < RADIUS:
            self._visits += 1
        info = {"success": self._visits == 3}
        return self._observation(), float(self._visits - before), False, False, info

    def _observation(self) -> np.ndarray:
        visited = np.zeros(3)
        visited[self._order[: self._visits]] = 1
        return np.concatenate([(self._stations - self._robot).ravel(), visited])


class VisitExpert:
    """Goes straight to the next unvisited station of its order, from the observation alone."""

    def __init__(self, order: list[int]) -> None:
        self._order = order

    def get_action(self, obs: np.ndarray, /) -> np.ndarray:
        """Return the velocity that reaches the station in one step; the environment clips it to the action space."""
        to_stations, visited = obs[:6].reshape(3, 2), obs[6:]
        station = next((station for station in self._order if not visited[station]), self._order[-1])
        return (to_stations[station] / SPEED).astype(np.float32)


class PlanarVisits:
    """All six orders of three stations: five for meta-training, one for meta-testing."""

    family = "planar-visits"
    obs_dim = 9
    action_dim = 2
    best_score = 1

    def __init__(self, config: SuiteConfig) -> None:
        """Take the tasks and the horizon from the settings if they are set."""
        self.train_tasks = config.train_tasks or TRAIN_TASKS
        self.test_tasks = config.test_tasks or TEST_TASKS
        for field, tasks in (("train_tasks", self.train_tasks), ("test_tasks", self.test_tasks)):
            if unknown := [task for task in tasks if task not in TRAIN_TASKS + TEST_TASKS]:
                known = ", ".join(TRAIN_TASKS + TEST_TASKS)
                raise UserError(f"suite.{field}: got {', '.join(unknown)}; wanted some of {known}")
        whole = (self.train_tasks, self.test_tasks) == (TRAIN_TASKS, TEST_TASKS)
        self.name = "planar-visits" if whole else "planar-visits-part"
        self.horizon = config.horizon or HORIZON
        self.protocol = f"all visits in turn within {self.horizon} steps, each from {RADIUS} m"

    def make_env(self, task: str) -> VisitTask:
        """Build a task's environment."""
        return VisitTask(_order(task))

    def expert(self, task: str) -> VisitExpert:
        """Return a task's scripted expert."""
        return VisitExpert(_order(task))


def _order(task: str) -> list[int]:
    return [STATIONS.index(station) for station in task.split("-")]
