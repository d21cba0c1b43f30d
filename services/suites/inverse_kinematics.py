"""Differential inverse kinematics of an arm: damped least squares on MuJoCo's Jacobian, within bounds."""

from typing import Any, NamedTuple

import mujoco as compiled_mujoco
import numpy as np
from jaxtyping import Float64

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it


class Pose(NamedTuple):
    """Where a hand is, in the world's axes."""

    position: Float64[np.ndarray, "3"]
    """In metres."""
    rotation: Float64[np.ndarray, "3 3"]
    """Its columns are the hand's axes."""


def pose_error(target: Pose, pose: Pose) -> Float64[np.ndarray, "6"]:
    """Return the way from `pose` to `target`: a translation in metres, and a rotation vector in radians."""
    quaternion, rotation = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (target.rotation @ pose.rotation.T).ravel())
    mujoco.mju_quat2Vel(rotation, quaternion, 1)
    return np.concatenate([target.position - pose.position, rotation])


def bounded_least_squares(
    matrix: Float64[np.ndarray, "rows joints"],
    target: Float64[np.ndarray, " rows"],
    lower: Float64[np.ndarray, " joints"],
    upper: Float64[np.ndarray, " joints"],
) -> Float64[np.ndarray, " joints"]:
    """Return the x within its bounds for which ``matrix @ x`` comes near `target`.

    Entries that leave their bounds are fixed there, and the others solved for again: exact where no bound is active,
    and an approximation elsewhere that lets the free joints take over the work of those at their limits.
    """
    solution, free = np.zeros(len(lower)), np.ones(len(lower), bool)
    while free.any():
        rest = target - matrix[:, ~free] @ solution[~free]
        solution[free] = np.linalg.lstsq(matrix[:, free], rest, rcond=None)[0]
        outside = free & ((solution < lower) | (solution > upper))
        if not outside.any():
            break
        solution = np.clip(solution, lower, upper)
        free &= ~outside
    return solution


class Arm:
    """Kinematics of an arm whose joints come first in its model, on simulator data of its own."""

    def __init__(self, model: Any, hand: str, joints: int) -> None:
        """Compute for the site named `hand` and the first `joints` joints, all of them hinges."""
        self._model, self._data, self._joints = model, mujoco.MjData(model), joints
        self._hand = model.site(hand).id
        self.limits = model.jnt_range[:joints].T.copy()
        """The lowest and the highest angle of each joint, in radians."""

    def place(self, qpos: Float64[np.ndarray, " nq"]) -> None:
        """Set the model's positions, at rest: what is asked next is answered for them."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)

    def hand(self) -> Pose:
        """Return where the hand is."""
        return Pose(self._data.site_xpos[self._hand].copy(), self._data.site_xmat[self._hand].reshape(3, 3).copy())

    def site(self, name: str) -> Float64[np.ndarray, "3"]:
        """Return where a site is, in metres."""
        return self._data.site_xpos[self._model.site(name).id].copy()

    def jacobian(self) -> Float64[np.ndarray, "6 joints"]:
        """Return the hand's velocity, translation over rotation, for each joint's unit velocity."""
        jacobian = np.zeros((6, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._hand)
        return jacobian[:, : self._joints]

    def gravity(self) -> Float64[np.ndarray, " joints"]:
        """Return the torques that hold the arm still, in Nm."""
        torques = np.zeros(self._model.nv)
        mujoco.mj_rne(self._model, self._data, 0, torques)
        return torques[: self._joints]
