"""The policy of tracking."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import Decision, Policy
from dmil_core.paths import goal_weight
from dmil_core.points import Points, position, present

NEAR = 2.0
"""In units of the hand's reach in a step: so near, the path's next place is next."""
GAIN = 0.25
"""Action for each reach of the hand that it is away from the path's place: as Meta-World's experts have it, and on
twelve of its meta-training tasks better than 0.1 (240 episodes: 0.73 in place of 0.69 with one demonstration)."""
PATIENCE = 15
"""Steps after which the next place is next anyway."""
MICRO = 1e-6
"""The object's first place is remembered in millionths of its unit."""


@dataclass(frozen=True)
class _Path:
    """What of a demonstration is tracked."""

    hand: Float32[np.ndarray, "steps axes"]
    actions: Float32[np.ndarray, "steps action_dim"]
    weight: Float32[np.ndarray, " steps"]
    object: Float32[np.ndarray, " axes"]
    goal: Float32[np.ndarray, " axes"]


@dataclass(frozen=True)
class TrackingPolicy(Policy):
    """Tracks one of several paths; remembers which, where on it, how long, and where the object was at first."""

    paths: tuple[_Path, ...]
    points: Points

    @classmethod
    def of(cls, support: Sequence[Demonstration], points: Points) -> "TrackingPolicy":
        """Track the paths of a support set."""

        def path(demonstration: Demonstration) -> _Path:
            hand, object_, goal = (
                position(demonstration.observations, axes, points) for axes in (points.hand, points.object, points.goal)
            )
            weight = goal_weight(demonstration, points)
            return _Path(hand, demonstration.actions, weight, object_[0], goal[0])

        return cls(tuple(map(path, support)), points)

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes memory_dim"]:
        """Return the memory of episodes at their first step: path −1, index 0, waited 0, no place."""
        memory = np.zeros((episodes, 3 + len(self.points.hand)), np.int64)
        memory[:, 0] = -1
        return memory

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes memory_dim"]
    ) -> Decision:
        """Go towards the path's place, with the demonstrated action where it is near."""
        points, memory = self.points, memory.copy()
        hand, object_, goal = (
            position(observations, axes, points) for axes in (points.hand, points.object, points.goal)
        )
        seen = present(observations, points.goal, points)
        actions = np.zeros((len(observations), self.paths[0].actions.shape[1]), np.float32)
        for row, action in enumerate(actions):
            if memory[row, 0] < 0:
                away = [np.linalg.norm(path.object - object_[row]) + np.linalg.norm(path.goal - goal[row])
                        for path in self.paths]  # fmt: skip
                memory[row] = [int(np.argmin(away)), 0, 0, *np.round(object_[row] / MICRO).astype(np.int64)]
            number, index, waited = memory[row, :3]
            path = self.paths[number]
            by_object, by_goal = memory[row, 3:] * MICRO - path.object, (goal[row] - path.goal) * seen[row]
            shift = (1 - path.weight[index]) * by_object + path.weight[index] * by_goal
            error = (path.hand[index] + shift - hand[row]) / points.reach
            near = np.linalg.norm(error) < NEAR
            action[:] = path.actions[index]
            steered = slice(0, len(points.hand))
            action[steered] = np.clip(near * action[steered] + GAIN * error, -1, 1)
            if near or waited >= PATIENCE:
                memory[row, 1:3] = min(index + 1, len(path.actions) - 1), 0
            else:
                memory[row, 2] += 1
        return Decision(actions, np.zeros(len(observations), np.int64), memory)
