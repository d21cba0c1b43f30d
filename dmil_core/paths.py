"""The path of the hand in a demonstration, and how it shifts when object and goal are displaced."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.points import Axes, Points, position, present
from dmil_core.seeding import named_rng

MOVED = 1.0
"""Distance from its first position at which an object counts as moved, in units of the hand's reach in a step."""
ARRIVED = 0.7
"""Fraction of the path after contact over which the goal takes over from the object."""
RADIUS = 10.0
"""Largest displacement of object and goal in each horizontal direction, in units of the hand's reach in a step: 10 cm
where that is 1 cm."""
LEAD = 1.4
"""The hand has the whole displacement after 1/1.4 of its path to the contact; it starts from where it did."""
TIMES = 4
"""How many times each undisplaced demonstration is repeated beside its displaced copies."""


def contact(demonstration: Demonstration, points: Points) -> int:
    """Return the first step at which the object has moved, or the number of steps if it never does."""
    places = position(demonstration.observations, points.object, points)
    moved = np.linalg.norm(places - places[0], axis=1) > MOVED * points.reach
    return int(moved.argmax()) if moved.any() else len(demonstration)


def travelled(demonstration: Demonstration, points: Points) -> Float32[np.ndarray, " steps"]:
    """Return the length of the hand's path up to each step, in the unit of its position."""
    hand = position(demonstration.observations, points.hand, points)
    return np.r_[0, np.linalg.norm(np.diff(hand, axis=0), axis=1)].cumsum().astype(np.float32)


def goal_weight(demonstration: Demonstration, points: Points) -> Float32[np.ndarray, " steps"]:
    """Return the weight of the goal's displacement, against the object's, in that of the path at each step.

    It is 0 until contact, and then rises to 1 with the path travelled. If the object never moves, it rises from the
    first step on; if no goal is seen, it stays 0.
    """
    if not present(demonstration.observations, points.goal, points).all():
        return np.zeros(len(demonstration), np.float32)
    steps, distance = len(demonstration), travelled(demonstration, points)
    touched = contact(demonstration, points) % steps  # 0 if never
    share = (distance - distance[touched]) / max(ARRIVED * (distance[-1] - distance[touched]), 0.1 * points.reach)
    return np.where(np.arange(steps) < touched, 0, np.clip(share, 0, 1)).astype(np.float32)


def displaced(demonstration: Demonstration, points: Points, rng: np.random.Generator) -> Demonstration:
    """Return the demonstration as it could have been with object and goal at other positions, drawn from `rng`.

    The path of the hand, and the actions with it, follow the object until contact and the goal after it. With
    probability 1/2 object and goal have the same displacement. Heights, the last number of a position, are unchanged.
    """
    steps, touched = len(demonstration), contact(demonstration, points)
    distance = travelled(demonstration, points)
    until = np.clip(LEAD * distance / max(distance[min(touched, steps - 1)], 0.1 * points.reach), 0, 1)[:, None]
    weight = goal_weight(demonstration, points)[:, None]

    def draw() -> np.ndarray:
        return np.r_[rng.uniform(-RADIUS, RADIUS, len(points.hand) - 1), 0] * points.reach

    of_object = draw()
    of_goal = of_object if rng.random() < 0.5 else draw()
    together = (1 - weight) * of_object + weight * of_goal
    of_path = until * together
    held = np.where(np.arange(steps)[:, None] < touched, of_object, together)
    observations, actions = demonstration.observations.copy(), demonstration.actions.copy()

    def move(axes: Axes | None, shift: np.ndarray, *, also_before: bool = True) -> None:
        if axes is None:
            return
        there = present(demonstration.observations, axes, points)
        observations[:, list(axes)] += there * shift
        if also_before and points.previous is not None:
            shift = np.broadcast_to(shift, (steps, len(axes)))
            observations[:, [axis + points.previous for axis in axes]] += there * np.r_[shift[:1], shift[:-1]]

    move(points.hand, of_path)
    move(points.object, held)
    move(points.second_object, of_goal)
    move(points.goal, of_goal, also_before=False)
    moves = np.diff(of_path, axis=0, append=of_path[-1:]) / points.reach
    actions[:, : len(points.hand)] = np.clip(actions[:, : len(points.hand)] + moves, -1, 1)
    return dataclasses.replace(demonstration, observations=observations, actions=actions)


def with_copies(support: Sequence[Demonstration], points: Points | None, copies: int) -> Sequence[Demonstration]:
    """Return the support set with `copies` displaced copies, rounded up to as many of each demonstration.

    The demonstrations themselves are repeated `TIMES` times, so that the copies do not outweigh them.

    Raises:
        UserError: for copies where no object is declared.
    """
    if not copies:
        return support
    if points is None or points.object is None:
        raise UserError(
            f"evaluation.displaced: got {copies} for a suite that declares no object; wanted suite.points with hand "
            "and object, see docs/your-own-task.md; or 0"
        )
    rng, each = named_rng(0, "displaced"), -(-copies // len(support))
    return [*support] * TIMES + [displaced(one, points, rng) for one in support for _ in range(each)]
