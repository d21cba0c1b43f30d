"""A scripted expert of the kitchen: way points relative to the objects, tracked by inverse kinematics.

It is a function of one observation, without memory: each sub-task's stages are tried from the last to the first, and
the first whose preconditions hold is taken up (preimage backchaining, Lozano-Pérez et al. 1984). So it goes on from
wherever it is, and tries again when a handle slips away. Where the hand goes, how it is turned and how the arm is
folded follow the demonstrations of Gupta et al. (2019).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco as compiled_mujoco
import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import ArrayLike

from services.suites.inverse_kinematics import Arm, Pose, bounded_least_squares, pose_error

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it

STEP = 0.08
"""Seconds in a step of the environment."""
REACH = 2 * STEP
"""How far, in radians or metres, an action of 1 sets a joint's goal ahead of the joint."""
JOINTS = 7


@cache
def kitchen_model() -> Any:
    """Return the environment's model, read once in a process."""
    library = find_spec("gymnasium_robotics")  # without importing it: that prints a notice
    assert library is not None
    assert library.origin is not None
    assets = Path(library.origin).parent / "envs/assets/kitchen_franka"
    return mujoco.MjModel.from_xml_path(str(assets / "kitchen_assets/kitchen_env_model.xml"))


class Scene:
    """What one observation shows."""

    def __init__(self, arm: Arm, state: Float64[np.ndarray, "30"]) -> None:
        """Read the 30-dimensional state, which is the model's positions with a little noise on them."""
        self.qpos = state.copy()
        self.qpos[26:30] /= np.linalg.norm(self.qpos[26:30])
        self.opening: float = state[7:9].sum()
        """Between the fingers, in metres."""
        arm.place(self.qpos)
        self.hand = arm.hand()
        self.site = arm.site


@dataclass(frozen=True)
class Target:
    """Where the hand shall go."""

    pose: Pose
    posture: Float64[np.ndarray, "7"]
    """Joint angles in radians to stay near to as far as the pose leaves a choice."""
    closed: bool
    stage: str


@dataclass(frozen=True)
class SubTask:
    """One thing to do in the kitchen."""

    joint: int
    """The state's coordinate that says how far it is done."""
    rest: float
    """What that coordinate is before."""
    goal: float
    """What it shall become: well beyond the environment's threshold."""
    contact: Callable[[Scene], Float64[np.ndarray, "3"]]
    """Where the hand touches the object."""
    act: Callable[[Scene, Float64[np.ndarray, "3"]], Target]
    """Returns where the hand shall go, given where it touches the object."""
    clearance: float = 0.10
    """Metres between hand and object from which the hand is free to travel."""
    pushed: bool = False
    """Whether closed fingers push it; otherwise they take hold of it."""

    def progress(self, scene: Scene) -> float:
        """Return 0 for not begun, 1 for reached."""
        return (scene.qpos[self.joint] - self.rest) / (self.goal - self.rest)

    def done(self, scene: Scene) -> bool:
        """Return whether to leave it: once begun it is carried to the end, left again it may fall back a little."""
        near = np.linalg.norm(self.contact(scene) - scene.hand.position) < 0.06
        return self.progress(scene) > (1.0 if near and scene.opening < 0.06 else 0.9)


def orient(approach: Sequence[float], opening: Sequence[float]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation of a hand that looks along `approach` and opens its fingers about along `opening`."""
    z = np.array(approach) / np.linalg.norm(approach)
    x = np.cross(opening, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def turned(angle: float, vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Return `vector` turned about the vertical by `angle` radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])


def travel(scene: Scene, to: Pose, posture: Float64[np.ndarray, "7"], closed: bool, front: float = 0.40) -> Target:
    """Go to a way point through the free space in front of the furniture, whose handles begin 0.49 m from the wall."""
    hand = scene.hand.position
    away = to.position - hand
    sideways = np.linalg.norm(away[[0, 2]])
    position = to.position.copy()
    if sideways > 0.08:
        position[1] = min(position[1], front)
        if hand[1] > front + 0.08:
            position[[0, 2]] = hand[[0, 2]] + 0.015 * away[[0, 2]] / sideways
    return Target(Pose(position, to.rotation), posture, closed, "travel")


def take(
    scene: Scene, grip: Pose, moved: Pose, posture: Float64[np.ndarray, "7"], thickness: float, tall: float = 0.03
) -> Target:
    """Take hold of a thing at `grip`, then bring the hand to `moved`."""
    across, sideways, ahead = scene.hand.rotation.T @ (grip.position - scene.hand.position)
    around = abs(sideways) < 0.035 and abs(across) < tall
    if around and abs(ahead) < 0.05 and scene.opening < thickness:
        return Target(moved, posture, True, "move")
    if around and abs(ahead) < 0.02:
        return Target(grip, posture, True, "close")
    if abs(sideways) < 0.03 and abs(across) < tall + 0.02 and -0.02 < ahead < 0.15:
        return Target(grip, posture, False, "approach")
    return travel(scene, Pose(grip.position - 0.10 * grip.rotation[:, 2], grip.rotation), posture, False)


def push(
    scene: Scene,
    thing: Float64[np.ndarray, "3"],
    side: float,
    beside: float,
    rotation: Float64[np.ndarray, "3 3"],
    posture: Float64[np.ndarray, "7"],
) -> Target:
    """Push a thing to the left from its right (`side` 1) or to the right from its left (-1), with closed fingers."""
    away = scene.hand.position - thing
    along, ahead, height = side * away[0], away[1], abs(away[2])

    def at(along: float, ahead: float, stage: str) -> Target:
        return Target(Pose(thing + np.array([side * along, ahead, 0]), rotation), posture, True, stage)

    if height < 0.04 and -0.03 < along < beside + 0.04 and ahead > -0.025:
        return at(along - beside, 0, "move")
    if height < 0.06 and 0.6 * beside < along < beside + 0.06 and ahead > -0.14:
        return at(beside, 0, "approach")
    return travel(scene, at(beside, -0.10, "").pose, posture, True)


def beside(site: str, offset: ArrayLike = (0, 0, 0)) -> Callable[[Scene], Float64[np.ndarray, "3"]]:
    """Return what finds the point at an offset from a site, in metres."""
    return lambda scene: scene.site(site) + np.asarray(offset)


def microwave(scene: Scene, handle: Float64[np.ndarray, "3"]) -> Target:
    """Take the door's handle and draw it around its hinge."""
    angle = scene.qpos[22]
    hinge = np.array([-1.127, 0.454, handle[2]])
    rotation = orient((-0.2 + 0.5 * angle, 1, -0.03), (1, 0, 0))
    posture = np.array([-1.24, -1.76, 1.88, -1.4, -0.7, 1.25, 2.5])
    moved = hinge + turned(-0.2, handle - hinge)
    return take(scene, Pose(handle, rotation), Pose(moved, rotation), posture, 0.052)


def kettle_pillar(scene: Scene) -> Float64[np.ndarray, "3"]:
    """Return where the left of the two pillars under the kettle's handle is, in metres."""
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, scene.qpos[26:30])
    return scene.qpos[23:26] + axes.reshape(3, 3) @ np.array([-0.092, 0, 0.18])


def kettle(scene: Scene, pillar: Float64[np.ndarray, "3"]) -> Target:
    """Take the left pillar, and carry the kettle to the back with its weight half lifted."""
    way = (np.array([-0.29, 0.75, 0]) - pillar) * [3, 1, 0]  # first to the right, past the microwave's corner
    pushed = (scene.qpos[24] - 0.40) / 0.30
    rotation = orient((0.34 - 0.2 * pushed, 1, -0.05 + 0.1 * pushed), (1, 0, 0.15))
    near, far = (-0.82, -1.76, 2.11, -2.15, 0.1, 1.07, 1.93), (-1.64, -1.76, 1.83, -1.56, -1.04, 1.19, 2.64)
    posture = np.array(near) + np.clip(pushed, 0, 1) * np.subtract(far, near)
    moved = pillar + 0.08 * way / np.linalg.norm(way)
    moved[2] = 1.86  # on its foot it would turn around the hand
    return take(scene, Pose(pillar, rotation), Pose(moved, rotation), posture, 0.06, tall=0.08)


def burner(knob: str, joint: int) -> SubTask:
    """Return the sub-task of turning a knob: take it by its sides, then roll the hand."""
    ahead, posture = np.array([0.05, 1, 0.12]), np.array([-1.33, -1.4, 1.55, -2.3, 0.4, 1.95, 1.6])

    def act(scene: Scene, contact: Float64[np.ndarray, "3"]) -> Target:
        def rolled(angle: float, at: Float64[np.ndarray, "3"]) -> Pose:
            return Pose(at, orient(ahead.tolist(), (np.cos(angle), 0, np.sin(angle))))

        angle = scene.qpos[joint]
        moved = rolled(angle - 0.4, scene.site(knob))  # pressed against the knob, the fingers slip less
        return take(scene, rolled(angle, contact), moved, posture, 0.045)

    contact = beside(knob, -0.04 * ahead / np.linalg.norm(ahead))
    return SubTask(joint, 0, -0.9, contact, act, clearance=0.07)


def light(scene: Scene, lever: Float64[np.ndarray, "3"]) -> Target:
    """Push the lever to the left."""
    posture = np.array([-1.25, -1.55, 1.44, -2.0, 0.65, 1.65, 0.94])
    return push(scene, lever, 1, 0.06, orient((0.03, 1, 0.13), (1, 0, 0)), posture)


def slide(scene: Scene, handle: Float64[np.ndarray, "3"]) -> Target:
    """Push the sliding door to the right by its handle."""
    posture = np.array([-1.8, -1.4, 1.05, -1.98, 0.4, 1.78, 0.9])
    rotation = orient((0.45 + 0.8 * scene.qpos[19], 0.7, 0.5), (0.85, -0.5, 0))
    return push(scene, handle, -1, 0.07, rotation, posture)


def hinge(scene: Scene, handle: Float64[np.ndarray, "3"]) -> Target:
    """Take the door's handle and draw it around its hinge; the arm folds as the door opens."""
    angle = scene.qpos[21]
    axis = np.array([-0.224, 0.71, handle[2]])
    rotation = orient((0.03 + 0.3 * angle, 0.8, 0.58), (1, -0.05 - 0.3 * angle, 0))
    closed, half_open = (-1.73, -1.69, 0.81, -1.36, 0.74, 1.28, 0.88), (-1.29, -1.76, 0.88, -2.02, 0.74, 1.42, 0.51)
    posture = np.array(closed) + min(angle / 0.6, 1.5) * np.subtract(half_open, closed)
    moved = axis + turned(0.2, handle - axis)
    return take(scene, Pose(handle, rotation), Pose(moved, rotation), posture, 0.055, tall=0.05)


SUB_TASKS: Mapping[str, SubTask] = {
    "microwave": SubTask(22, 0, -0.8, beside("microhandle_site"), microwave),
    "kettle": SubTask(24, 0.35, 0.65, kettle_pillar, kettle, clearance=0.16),
    "bottomburner": burner("knob2_site", 11),
    "topburner": burner("knob4_site", 15),
    "light": SubTask(17, 0, -0.65, beside("light_site", (0, -0.02, 0)), light, pushed=True),
    "slide": SubTask(19, 0, 0.3, beside("slide_site", (0, 0, -0.05)), slide, pushed=True),
    "hinge": SubTask(21, 0, 1.35, beside("hinge_site2", (0, 0, -0.06)), hinge),
}
"""In the order in which the expert does them: the open hinge door would be in the way of the slide cabinet."""


class KitchenExpert:
    """Does a chain of sub-tasks."""

    def __init__(self, chain: Sequence[str]) -> None:
        model = kitchen_model()
        self._arm = Arm(model, "end_effector", JOINTS)
        self._chain = [sub_task for name, sub_task in SUB_TASKS.items() if name in chain]
        self._stiffness = model.actuator_gainprm[:JOINTS, 0]
        self._response = 1 - np.exp(-self._stiffness / model.dof_damping[:JOINTS] * STEP)

    def get_action(self, obs: Float64[np.ndarray, " obs_dim"], /) -> Float32[np.ndarray, "9"]:
        """Return what to do in the 30-dimensional state `obs`."""
        scene = Scene(self._arm, np.asarray(obs, np.float64))
        target = self.target(scene)
        change = self._towards(target, scene)
        arm = (change / self._response + self._arm.gravity() / self._stiffness) / REACH
        return np.concatenate([arm, np.full(2, -0.3 if target.closed else 0.3)]).astype(np.float32)

    def target(self, scene: Scene) -> Target:
        """Return where the hand shall go: away from what is done, then to what is not."""
        done = [sub_task.done(scene) for sub_task in self._chain]
        hand = scene.hand
        for sub_task, is_done in zip(self._chain, done, strict=True):
            distance = np.linalg.norm(sub_task.contact(scene) - hand.position)
            if is_done and distance < sub_task.clearance:
                if not sub_task.pushed and distance < 0.05 and scene.opening < 0.07:
                    return Target(hand, scene.qpos[:JOINTS], False, "release")
                back = np.array([0, -0.1, 0]) if sub_task.pushed else -0.1 * hand.rotation[:, 2]
                return Target(Pose(hand.position + back, hand.rotation), scene.qpos[:JOINTS], sub_task.pushed, "leave")
        for sub_task, is_done in zip(self._chain, done, strict=True):
            if not is_done:
                return sub_task.act(scene, sub_task.contact(scene))
        return Target(hand, scene.qpos[:JOINTS], False, "rest")

    def _towards(self, target: Target, scene: Scene) -> Float64[np.ndarray, "7"]:
        """Return the change of the joint angles in this step, in radians: damped least squares within the limits."""
        error = pose_error(target.pose, scene.hand)
        error[:3] *= min(1, 0.055 / max(float(np.linalg.norm(error[:3])), 1e-9))
        error[3:] *= min(1, 0.15 / max(float(np.linalg.norm(error[3:])), 1e-9))
        angles = scene.qpos[:JOINTS]
        weights = np.array([1, 1, 1, 0.2, 0.2, 0.2])
        matrix = np.vstack([weights[:, None] * self._arm.jacobian(), 0.02 * np.eye(JOINTS)])
        wanted = np.concatenate([weights * error, 0.02 * np.clip(target.posture - angles, -0.15, 0.15)])
        fastest = REACH * self._response
        lower = np.clip(self._arm.limits[0] - angles, -fastest, 0)
        upper = np.clip(self._arm.limits[1] - angles, 0, fastest)
        return bounded_least_squares(matrix, wanted, lower, upper)
