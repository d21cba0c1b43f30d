"""The way of the hand in a demonstration, and how it moves where object and goal are elsewhere."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.points import Axes, Points, position, present
from dmil_core.seeding import named_rng

MOVED = 1.0
"""An object has moved when it is so far from its first place, in units of the hand's reach in a step."""
ARRIVED = 0.7
"""Part of the way after contact on which the goal takes over from the object."""


def contact(demonstration: Demonstration, points: Points) -> int:
    """Return the first step at which the object has moved, or the number of steps if it never does."""
    places = position(demonstration.observations, points.object, points)
    moved = np.linalg.norm(places - places[0], axis=1) > MOVED * points.reach
    return int(moved.argmax()) if moved.any() else len(demonstration)


def way(demonstration: Demonstration, points: Points) -> Float32[np.ndarray, " steps"]:
    """Return how far the hand has gone at each step."""
    hand = position(demonstration.observations, points.hand, points)
    return np.r_[0, np.linalg.norm(np.diff(hand, axis=0), axis=1)].cumsum().astype(np.float32)


def goal_weight(demonstration: Demonstration, points: Points) -> Float32[np.ndarray, " steps"]:
    """Return how much the goal's displacement, in place of the object's, moves the path at each step, from 0 to 1.

    Where the object never moves the goal is all there is to go to, from the first step on; where no goal is seen, the
    path stays with the object.
    """
    if not present(demonstration.observations, points.goal, points).all():
        return np.zeros(len(demonstration), np.float32)
    begun, gone = contact(demonstration, points), way(demonstration, points)
    begun = 0 if begun == len(demonstration) else begun
    at_contact = gone[min(begun, len(gone) - 1)]
    share = (gone - at_contact) / max(ARRIVED * (gone[-1] - at_contact), 0.1 * points.reach)
    return np.where(np.arange(len(gone)) < begun, 0, np.clip(share, 0, 1)).astype(np.float32)


RADIUS = 10.0
"""How far object and goal are displaced at most in each horizontal direction, in units of the hand's reach in a step:
10 cm where that is 1 cm."""
LEAD = 1.4
"""The hand has all of the displacement after 1/1.4 of its way to the contact: it begins where it did."""
TIMES = 4
"""How often each demonstration itself stands beside its displaced copies."""


def displaced(demonstration: Demonstration, points: Points, rng: np.random.Generator) -> Demonstration:
    """Return what the demonstration could have been with object and goal elsewhere.

    The path of the hand, and the actions with it, follow the object until contact and the goal after it; half of the
    time both are displaced alike. The last number of a position, its height, stays.
    """
    steps, begun, gone = len(demonstration), contact(demonstration, points), way(demonstration, points)
    until = np.clip(LEAD * gone / max(gone[min(begun, steps - 1)], 0.1 * points.reach), 0, 1)[:, None]
    weight = goal_weight(demonstration, points)[:, None]

    def draw() -> np.ndarray:
        return np.r_[rng.uniform(-RADIUS, RADIUS, len(points.hand) - 1), 0] * points.reach

    of_object = draw()
    of_goal = of_object if rng.random() < 0.5 else draw()
    together = (1 - weight) * of_object + weight * of_goal
    of_path = until * together
    held = np.where(np.arange(steps)[:, None] < begun, of_object, together)
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
    """Return the support set and about `copies` displaced copies, shared between its demonstrations.

    The demonstrations themselves come `TIMES` over, so that copies do not drown them.

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
