"""What networks see of an observation in place of its raw numbers: differences of declared points at three scales.

Scripted experts and people alike move by where things are to each other, and change what they do within a centimetre
or two, which is a tenth of a standard deviation of the raw observation. So each difference d of two points is given as
d/0.2 m, tanh(d/0.1 m) and tanh(d/0.02 m).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from dmil_core.points import Points, moved, position, present

SCALES = (10.0, 2.0)
"""Of tanh, in units of `Points.reach`: 10 cm and 2 cm where that is 1 cm."""
LINEAR = 20.0


@dataclass(frozen=True)
class RelativeFeatures:
    """Turns observations into differences of the declared points, last moves, heights, orientations and gripper."""

    points: Points
    absolute: bool = False
    """Whether the hand's own position is among them."""

    def __call__(self, observations: Float32[np.ndarray, "steps obs_dim"]) -> Float32[np.ndarray, "steps features"]:
        """Return the features, a new array."""
        points, reach = self.points, self.points.reach
        hand, object_, goal, second = (
            position(observations, axes, points)
            for axes in (points.hand, points.object, points.goal, points.second_object)
        )
        second_there, goal_there = (present(observations, axes, points) for axes in (points.second_object, points.goal))
        differences = [object_ - hand]
        if points.goal is not None:
            differences += [(goal - hand) * goal_there, (goal - object_) * goal_there]
        if points.second_object is not None:
            differences += [(second - hand) * second_there, (second - object_) * second_there]
        away = np.concatenate(differences, 1) / reach
        parts = [away / LINEAR, *(np.tanh(away / scale) for scale in SCALES)]
        parts += [hand[:, -1:] / (10 * reach), object_[:, -1:] / (10 * reach)]
        if points.goal is not None:
            parts += [goal[:, -1:] / (10 * reach)]
        if points.gripper is not None:
            parts += [2 * observations[:, [points.gripper]] - 1, 10 * moved(observations, (points.gripper,), points)]
        parts += [observations[:, list(points.orientation)]]
        if points.second_object is not None:
            parts += [observations[:, list(points.second_orientation)] * second_there, second_there]
        parts += [moved(observations, points.hand, points) / reach]
        if points.object is not None:
            parts += [(moved(observations, points.object, points) / reach).clip(-3, 3)]
        if self.absolute:
            parts += [hand / (LINEAR * reach)]
        return np.concatenate(parts, 1, dtype=np.float32)
