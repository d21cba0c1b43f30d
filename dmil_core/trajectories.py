"""The one type of trajectories, and what an episode adds to it: collection, storage and methods share them."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Int64


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What was observed and done, step by step, in the environment's units.

    Args:
        observations: one before each action and, where it is known, the one after the last action.
        actions: one for each step.
    """

    observations: Float32[np.ndarray, "observations obs_dim"]
    actions: Float32[np.ndarray, "steps action_dim"]

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.actions)


@dataclass(frozen=True, eq=False)
class Episode(Trajectory):
    """A trajectory from the reset of an environment on, with the observation after the last action."""

    seed: int = 0
    goal: list[float] = field(default_factory=list)
    """What the environment drew at random, as it reports it."""
    solved_at: int | None = None
    """The first step after which the task was solved."""
    score: int = 0
    """The best of the episode: sub-tasks done in suites that count them, else 1 for a success."""

    @property
    def success(self) -> bool:
        """Whether the task was solved."""
        return self.solved_at is not None

    @property
    def fault(self) -> int | None:
        """The first observation that is not finite, the reset's being 0: a fault of the simulator, not of who acts."""
        finite = np.isfinite(self.observations).all(axis=1)
        return None if finite.all() else int(finite.argmin())


@dataclass(frozen=True, eq=False, kw_only=True)
class Rollout(Episode):
    """An episode of a policy, which ends with its first success; its actions are not clipped yet."""

    sub_skills: Int64[np.ndarray, " steps"]
    """The sub-skill that chose each action."""
    ended: bool = True
    """Whether it came to its end, by success or its last step, and was not cut off."""
    diverged: bool = False
    """Whether it ended because an action was not finite; that action is left out."""
