"""A suite of tasks behind one small protocol."""

from typing import NamedTuple, Protocol

import gymnasium
import numpy as np
from jaxtyping import Float32, Float64

__all__ = ["Attempt", "Environment", "Expert", "TaskSuite"]

Environment = gymnasium.Env[np.ndarray, np.ndarray]
"""A task's environment. ``reset(seed=n)`` twice gives the same episode twice, and its info holds under ``goal`` what
it drew at random; ``info["success"]`` of a step says whether the task is solved. Where observations leave out something
that the expert needs, the infos of resets and steps hold the whole ones under ``full_observation``."""


class Expert(Protocol):
    """A scripted expert of one task."""

    def get_action(self, obs: Float64[np.ndarray, " obs_dim"], /) -> Float32[np.ndarray, " action_dim"]:
        """Return what the expert does, before clipping to the action space."""
        ...


class Attempt(NamedTuple):
    """One attempt of an expert, a demonstration if it is a success."""

    seed: int
    goal: list[float]
    solved_at: int | None
    """The first step after which the task was solved."""
    observations: Float32[np.ndarray, "steps+1 obs_dim"]
    actions: Float32[np.ndarray, "steps action_dim"]


class TaskSuite(Protocol):
    """Meta-training and meta-testing tasks of one kind of robot."""

    name: str
    train_tasks: tuple[str, ...]
    test_tasks: tuple[str, ...]
    obs_dim: int
    action_dim: int
    horizon: int
    """Steps in an episode."""
    protocol: str
    """Names the rule by which an episode counts as a success; rows of different protocols are never compared."""

    def make_env(self, task: str) -> Environment:
        """Build a task's environment; it may be reset and reused for any number of episodes."""
        ...

    def expert(self, task: str) -> Expert | None:
        """Return a task's scripted expert, if there is one."""
        ...
