"""A toy with declared points: a hand goes by way of a place beside an object, takes it and carries it to a goal.

On which side of the object the place lies is the task, which only a demonstration shows.
"""

import numpy as np

from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import Policy
from dmil_core.points import Points
from dmil_core.seeding import named_rng

REACH, STEPS = 0.01, 80
POINTS = Points(
    size=17, hand=(0, 1, 2), gripper=3, object=(4, 5, 6), previous=7, goal=(14, 15, 16), reach=REACH
)  # fmt: skip


class World:
    """One episode."""

    def __init__(self, seed: int) -> None:
        draw = named_rng(seed, "world")
        self.hand = np.zeros(3)
        self.object = np.r_[draw.uniform([0.1, -0.1], [0.2, 0.1]), 0.0]
        self.goal = np.r_[draw.uniform([0.0, 0.15], [0.2, 0.25]), 0.0]
        self.held, self.beside, self.seen = False, 0, self._now()

    def _now(self) -> np.ndarray:
        return np.r_[self.hand, 0.5, self.object]

    def observe(self) -> np.ndarray:
        """Return what is seen, with what was seen before."""
        return np.r_[self._now(), self.seen, self.goal].astype(np.float32)

    def step(self, action: np.ndarray) -> None:
        """Move the hand, and the object with it if it is held; it is taken where the hand stays beside it."""
        self.seen = self._now()
        self.hand = self.hand + REACH * np.clip(action[:3], -1, 1)
        if self.held:
            self.object = self.object + REACH * np.clip(action[:3], -1, 1)
        beside = bool(np.linalg.norm(self.hand - self.object) < 0.03)
        self.beside = self.beside + 1 if beside else 0
        self.held = self.held or self.beside >= 5

    @property
    def done(self) -> bool:
        """Whether the object is at the goal."""
        return bool(np.linalg.norm(self.object - self.goal) < 0.03)


def demonstrate(task: int, seed: int) -> Demonstration:
    """Let the expert of a task act."""
    world, angle, passed = World(seed), 2 * np.pi * task / 8, False
    beside = 0.08 * np.array([np.cos(angle), np.sin(angle), 0.0])
    observations, actions = [], []
    for _ in range(STEPS):
        passed = passed or bool(np.linalg.norm(world.object + beside - world.hand) < 0.012)
        aim = world.goal - world.object if world.held else world.object + (0 if passed else beside) - world.hand
        action = np.r_[np.clip(25 * aim, -1, 1), 0.5].astype(np.float32)
        observations.append(world.observe())
        actions.append(action)
        world.step(action)
    assert world.done
    return Demonstration(f"d{seed}", f"task-{task}", np.array(observations), np.array(actions))


def success(policy: Policy, seed: int) -> bool:
    """Let a policy act in an episode and tell whether the object came to the goal."""
    world, memory = World(seed), policy.start(1)
    for _ in range(2 * STEPS):
        decision = policy.act(world.observe()[None], memory)
        memory = decision.memory
        world.step(decision.actions[0])
    return world.done
