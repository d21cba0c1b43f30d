"""How often a suite's scripted expert does a task, by the seeds of its attempts."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from dmil_core.configs import DemonstrationConfig
from services.rollouts import demonstrate
from services.suites.base import TaskSuite

__all__ = ["VerificationRow", "verify"]


class VerificationRow(NamedTuple):
    """What came of one attempt."""

    task: str
    seed: int
    noise: float
    success: bool
    score: int
    """Sub-tasks done, in suites that count them; otherwise 1 for a success."""
    steps: int
    """Until the task was solved, or until the attempt ended without."""


class _BestScore(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Remembers the best score of an episode."""

    best = 0

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict]:
        self.best = 0
        return self.env.reset(**arguments)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict]:
        result = self.env.step(action)
        self.best = max(self.best, int(result[4].get("score", result[4]["success"])))
        return result


def verify(suite: TaskSuite, task: str, seeds: Iterable[int], noise: float) -> list[VerificationRow]:
    """Let the expert try once for each seed, with N(0, noise²) added to the actions that are executed.

    Raises:
        ValueError: if the task has no expert.
    """
    expert = suite.expert(task)
    if expert is None:
        raise ValueError(f"task: got {task} of {suite.name}; wanted one that has a scripted expert")
    env, config = _BestScore(suite.make_env(task)), DemonstrationConfig(noise=noise, trailing_steps=0)
    rows = []
    for seed in seeds:
        attempt = demonstrate(expert, env, seed, suite.horizon, config)
        rows.append(VerificationRow(task, seed, noise, attempt.solved_at is not None, env.best, len(attempt.actions)))
    env.close()
    return rows
