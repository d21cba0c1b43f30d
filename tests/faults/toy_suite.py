"""A quick suite: a point goes to a place that it sees. The variable TOY_ODDITY gives it an oddity of simulators."""

import os
import threading
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

from dmil_core.configs import SuiteConfig

BACKWARDS = ("b", "d")
"""Tasks whose actions move the point the other way."""


class PointEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A point on a floor; an observation has where it is and where it is to go."""

    def __init__(self, sign: int, oddity: str) -> None:
        self.observation_space = Box(-np.inf, np.inf, (4,), np.float64)
        self.action_space = Box(-1, 1, (2,), np.float64)
        self._sign, self._oddity, self._buffer = sign, oddity, np.zeros(4)

    def _observation(self) -> np.ndarray:
        self._buffer[:2], self._buffer[2:] = self._at, self._goal
        if self._oddity == "nan" and self._steps > 21:  # later than the expert takes
            return self._buffer * np.nan
        return self._buffer if self._oddity == "in place" else self._buffer.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._at, self._goal, self._steps = np.zeros(2), self.np_random.uniform(-1, 1, 2), 0
        return self._observation(), {"goal": self._goal.copy() if self._oddity == "arrays" else self._goal.tolist()}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._steps += 1
        self._at = self._at + 0.1 * self._sign * action
        done = bool(np.linalg.norm(self._at - self._goal) < 0.08)
        infos = {"arrays": {"success": np.float32(done), "score": np.array([done])}, "no success": {"solved": done}}
        reward = np.inf if self._oddity == "reward" and self._steps > 21 else 0.0
        return self._observation(), reward, done, False, infos.get(self._oddity, {"success": done})


class Expert:
    """Goes straight there."""

    def __init__(self, sign: int) -> None:
        self._sign = sign

    def get_action(self, obs: np.ndarray, /) -> np.ndarray:
        return (self._sign * (obs[2:] - obs[:2]) / 0.1).astype(np.float32)


class ToySuite:
    """Three tasks to train on and one to test on."""

    family, name, obs_dim, action_dim, best_score = "toy", "toy", 4, 2, 1

    def __init__(self, config: SuiteConfig) -> None:
        self._oddity = os.environ.get("TOY_ODDITY", "")
        self.train_tasks = config.train_tasks or ("a", "b", "c")
        self.test_tasks = config.test_tasks or ("d",)
        self.horizon = config.horizon or 30
        self.protocol = f"toy, {self.horizon} steps, {self._oddity}"
        if self._oddity == "lock":
            self.simulator = threading.Lock()  # as a client, a viewer or a socket has

    def make_env(self, task: str) -> PointEnv:
        return PointEnv(-1 if task in BACKWARDS else 1, self._oddity)

    def expert(self, task: str) -> Expert:
        return Expert(-1 if task in BACKWARDS else 1)
