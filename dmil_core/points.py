"""Which numbers of an observation are positions: what a suite declares, so that a method can work with differences."""

from functools import lru_cache
from typing import Annotated

import numpy as np
from jaxtyping import Float32
from pydantic import Field, model_validator

from dmil_core.errors import UserError
from dmil_core.settings import Positive, Settings

Index = Annotated[int, Field(ge=0, lt=10_000, strict=True)]
Axes = Annotated[tuple[Index, ...], Field(min_length=1, max_length=100)]


class Points(Settings):
    """Places of numbers in an observation, counted from 0; positions are in one frame and one unit."""

    size: Index
    """Numbers in an observation."""
    hand: Axes
    """Position of what acts, in metres: x, y and z of a gripper, height last. In a suite without an object it may be
    joint angles, in radians."""
    object: Axes | None = None
    """Position of the object."""
    goal: Axes | None = None
    """Position of the goal; absent where it is hidden, that is where its numbers are all zero."""
    second_object: Axes | None = None
    """Position of a second object, absent where its numbers are all zero."""
    gripper: Index | None = None
    """Opening of the gripper, from 0 to 1."""
    orientation: tuple[Index, ...] = ()
    """Orientation of the object, as a quaternion or the like."""
    second_orientation: tuple[Index, ...] = ()
    """Orientation of the second object."""
    previous: Annotated[int, Field(ge=1, lt=10_000, strict=True)] | None = None
    """How much further on an observation has the same number of the step before, for hand, object and gripper; none if
    it has not."""
    reach: Positive = 0.01
    """How far the hand moves in a step by an action of 1, in the unit of its position; the first numbers of an action
    move the hand, one for each number of `hand`."""

    @model_validator(mode="after")
    def _of_one_frame(self) -> "Points":
        for name in ("object", "goal", "second_object"):
            axes: Axes | None = getattr(self, name)
            if axes is not None and len(axes) != len(self.hand):
                raise ValueError(f"{name}: got {len(axes)} numbers; wanted {len(self.hand)}, as hand has")
        if self.object is None and (self.goal or self.second_object):
            raise ValueError("object: got none; wanted one, where there is a goal or a second object")
        own = (*self.hand, *(self.object or ()), *(() if self.gripper is None else (self.gripper,)))
        others = (*(self.goal or ()), *(self.second_object or ()), *self.orientation, *self.second_orientation)
        if (last := max((*others, *(index + (self.previous or 0) for index in own)))) >= self.size:
            raise ValueError(f"got the place {last}; wanted less than size, {self.size}")
        return self

    def check(self, obs_dim: int, action_dim: int) -> None:
        """Compare with the sizes of observations and actions.

        Raises:
            UserError: if a place or a motion is named that there is not.
        """
        if self.size != obs_dim:
            raise UserError(f"suite.points.size: got {self.size}; wanted {obs_dim}, the numbers of an observation")
        if len(self.hand) > action_dim:
            raise UserError(
                f"suite.points.hand: got {len(self.hand)} numbers; wanted at most {action_dim}, those of an action"
            )


@lru_cache(maxsize=1024)
def _columns(axes: Axes, further: int = 0) -> slice | list[int]:
    """Return what takes these numbers out of observations, or those so much further on: a view, if it can be one."""
    first, last = axes[0] + further, axes[-1] + further
    together = axes == tuple(range(axes[0], axes[-1] + 1))
    return slice(first, last + 1) if together else [axis + further for axis in axes]


def position(
    observations: Float32[np.ndarray, "steps obs_dim"], axes: Axes | None, points: Points
) -> Float32[np.ndarray, "steps axes"]:
    """Return the position of a point, which may be a view; that of one which is not declared is zero."""
    if axes is None:
        return np.zeros((len(observations), len(points.hand)), np.float32)
    return observations[:, _columns(axes)]


def present(
    observations: Float32[np.ndarray, "steps obs_dim"], axes: Axes | None, points: Points
) -> Float32[np.ndarray, "steps 1"]:
    """Return 1 where a point is there, 0 where its numbers are all zero."""
    return (position(observations, axes, points) != 0).any(1, keepdims=True).astype(np.float32)


def moved(
    observations: Float32[np.ndarray, "steps obs_dim"], axes: Axes, points: Points
) -> Float32[np.ndarray, "steps _"]:
    """Return how far some numbers moved since the step before; no numbers if an observation does not say."""
    if points.previous is None or not axes:
        return np.zeros((len(observations), 0), np.float32)
    return observations[:, _columns(axes)] - observations[:, _columns(axes, points.previous)]
