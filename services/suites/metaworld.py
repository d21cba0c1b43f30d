"""Meta-World ML10 (Yu et al. 2019), with goals visible and episodes that follow from their seed."""

import warnings
from typing import Any

import gymnasium
import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

from dmil_core.configs import SuiteConfig
from dmil_core.errors import UserError
from services.suites.base import Environment, Expert
from services.suites.metaworld_speed import fast_environment

__all__ = ["SPLITS", "MetaWorldSuite", "UnknownTaskError"]

SPLITS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "ml10": (
        ("reach", "push", "pick-place", "door-open", "drawer-close", "button-press-topdown", "peg-insert-side",
         "window-open", "sweep", "basketball"),
        ("drawer-open", "door-close", "shelf-place", "sweep-into", "lever-pull"),
    ),
    "ml10-reference": (
        ("basketball", "button-press", "dial-turn", "drawer-close", "peg-insert-side", "reach", "push", "pick-place",
         "sweep-into", "window-open"),
        ("door-close", "drawer-open", "lever-pull", "shelf-place", "sweep"),
    ),
}  # fmt: skip
"""Meta-training and meta-testing tasks: the benchmark's own split, and the one of the authors' released code."""


warnings.filterwarnings("ignore", message=r"Constant\(s\) may be too high")  # whoever acts clips the actions


class UnknownTaskError(UserError):
    """A task that Meta-World does not have."""


class SeededEpisodes(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Makes ``reset(seed=...)`` mean what gymnasium says, and reports what it drew; Meta-World ignores the seed."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin the episode of `seed`; ``info["goal"]`` holds its object and goal positions, in metres."""
        env: Any = self.env
        if seed is not None:
            env.seed(seed)
        observation, info = env.reset(options=options)
        return observation, {**info, "goal": env._last_rand_vec.tolist()}


class MetaWorldSuite:
    """Meta-World tasks in a split; an episode is a success if the task is solved at any step within the horizon."""

    obs_dim = 39
    action_dim = 4

    def __init__(self, config: SuiteConfig) -> None:
        """Check the tasks' names.

        Raises:
            UnknownTaskError: for a name that Meta-World does not have.
        """
        self.name = config.name if config.train_tasks is config.test_tasks is None else f"{config.name}-part"
        train, test = SPLITS[config.name]
        self.train_tasks = train if config.train_tasks is None else config.train_tasks
        self.test_tasks = test if config.test_tasks is None else config.test_tasks
        self.horizon = config.horizon
        self.protocol = f"goal visible; success at any step within {config.horizon}"
        known = sorted(name.removesuffix("-v3") for name in ENV_POLICY_MAP)
        for field, tasks in (("train_tasks", self.train_tasks), ("test_tasks", self.test_tasks)):
            if unknown := [task for task in tasks if task not in known]:
                raise UnknownTaskError(f"suite.{field}: got {', '.join(unknown)}; wanted some of {', '.join(known)}")

    def make_env(self, task: str, *, rewards: bool = False) -> Environment:
        """Build a task's environment, made fast; unless asked for, its rewards are NaN and its info is ``success``."""
        return SeededEpisodes(fast_environment(ALL_V3_ENVIRONMENTS[f"{task}-v3"], rewards=rewards))

    def expert(self, task: str) -> Expert:
        """Return Meta-World's own scripted policy."""
        return ENV_POLICY_MAP[f"{task}-v3"]()
