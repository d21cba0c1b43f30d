"""How often a suite's scripted expert does a task, by the seeds of its attempts."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from dmil_core.configs import DemonstrationConfig
from services.rollouts.episodes import demonstrate
from services.suites.base import Attempt, Environment, SuiteError, TaskSuite, build_env


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

    def __init__(self, env: Environment, suite: str) -> None:
        super().__init__(env)
        self._suite = suite

    def reset(self, **arguments: Any) -> tuple[np.ndarray, dict]:
        self.best = 0
        return self.env.reset(**arguments)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict]:
        result = self.env.step(action)
        if "success" not in result[4]:
            raise SuiteError(
                f"{self._suite}: info of a step: got no success; wanted whether the task is solved; have step() say so"
            )
        self.best = max(self.best, int(result[4].get("score", result[4]["success"])))
        return result


def verify(suite: TaskSuite, task: str, seeds: Sequence[int], noise: float) -> list[VerificationRow]:
    """Let the expert try once for each seed, with N(0, noise²) added to the actions that are executed.

    The first seed is tried once more after all others, and must give the same attempt.

    Raises:
        ValueError: if the task has no expert.
        SuiteError: if an attempt does not follow from its seed, or an environment is not as the suite says.
    """
    expert = suite.expert(task)
    if expert is None:
        raise ValueError(f"task: got {task} of {suite.name}; wanted one that has a scripted expert")
    env, config = _BestScore(build_env(suite, task), suite.name), DemonstrationConfig(noise=noise, trailing_steps=0)
    rows, first = [], None
    for seed in seeds:
        attempt = demonstrate(expert, env, seed, suite.horizon, config)
        first = first or attempt
        rows.append(VerificationRow(task, seed, noise, attempt.solved_at is not None, env.best, len(attempt.actions)))
    if first is not None:
        _check_same(first, demonstrate(expert, env, first.seed, suite.horizon, config), f"{suite.name}: task {task}")
    env.close()
    return rows


def _check_same(first: Attempt, again: Attempt, where: str) -> None:
    """Compare two attempts of one seed.

    Raises:
        SuiteError: names the first step after which they differ.
    """
    steps = min(len(first.observations), len(again.observations))
    differs = (first.observations[:steps] != again.observations[:steps]).any(axis=1)
    if differs.any() or first.goal != again.goal or len(first.actions) != len(again.actions):
        when = "at the reset" if not differs.any() or differs[0] else f"after step {differs.argmax()}"
        raise SuiteError(
            f"{where}: reset(seed={first.seed}): got another episode than the first time, {when}; wanted the same; "
            "draw all that is random from self.np_random, after super().reset(seed=seed), and keep nothing of earlier "
            "episodes in the environment or the expert"
        )
