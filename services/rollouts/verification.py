"""How often a suite's scripted expert does a task, by the seeds of its attempts."""

from collections.abc import Sequence
from typing import NamedTuple

from dmil_core.configs import DemonstrationConfig
from dmil_core.errors import UserError
from dmil_core.trajectories import Episode
from services.rollouts.episodes import demonstrate
from services.suites.base import TaskSuite, build_env


class VerificationRow(NamedTuple):
    """The outcome of one attempt."""

    task: str
    seed: int
    noise: float
    success: bool
    score: int
    """Sub-tasks done, in suites that count them; otherwise 1 for a success."""
    steps: int
    """Until the task was solved, or until the attempt ended without."""


def verify(suite: TaskSuite, task: str, seeds: Sequence[int], noise: float) -> list[VerificationRow]:
    """Let the expert try once for each seed, with N(0, noise²) added to the actions that are executed.

    The first seed is tried once more after all others, and must give the same attempt.

    Raises:
        ValueError: if the task has no expert.
        UserError: if an attempt does not follow from its seed, or an environment is not as the suite says.
    """
    expert = suite.expert(task)
    if expert is None:
        raise ValueError(f"task: got {task} of {suite.name}; wanted one that has a scripted expert")
    env, config = build_env(suite, task), DemonstrationConfig(noise=noise, trailing_steps=0)
    rows, first = [], None
    for seed in seeds:
        try:
            attempt = demonstrate(expert, env, seed, suite.horizon, config)
        except UserError as error:
            raise UserError(f"{suite.name}: {error}") from error
        first = first or attempt
        rows.append(VerificationRow(task, seed, noise, attempt.success, attempt.score, len(attempt)))
    if first is not None:
        _check_same(first, demonstrate(expert, env, first.seed, suite.horizon, config), f"{suite.name}: task {task}")
    env.close()
    return rows


def _check_same(first: Episode, again: Episode, where: str) -> None:
    """Compare two attempts of one seed; refuse them by the first step after which they differ."""
    steps = min(len(first.observations), len(again.observations))
    differs = (first.observations[:steps] != again.observations[:steps]).any(axis=1)
    if differs.any() or first.goal != again.goal or len(first) != len(again):
        when = "at the reset" if not differs.any() or differs[0] else f"after step {differs.argmax()}"
        raise UserError(
            f"{where}: reset(seed={first.seed}): got another episode than the first time, {when}; wanted the same; "
            "draw all that is random from self.np_random, after super().reset(seed=seed), and keep nothing of earlier "
            "episodes in the environment or the expert"
        )
