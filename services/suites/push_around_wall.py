"""Push-around-wall, the new task of the paper (Figure 8): take a cube and carry it around a wall to the goal.

A skill that no task of Meta-World asks for: ``push-wall`` and ``pick-place-wall`` count a cube at the goal however it
came there. Here the way counts. The scene is that of ``push-wall``, with a cube in place of its puck, and with cube and
goal so far behind the wall's two faces that the straight way between them always meets the wall.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import mujoco as compiled_mujoco
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float32, Float64
from metaworld.envs.sawyer_push_wall_v3 import SawyerPushWallEnvV3
from metaworld.policies.policy import move
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from metaworld.utils import reward_utils

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it

ENDS = (-0.02, 0.22)
"""Where the wall ends on the left and on the right, x in metres."""
FRONT, MIDDLE, BACK = 0.74, 0.75, 0.76
"""Its face before the robot, its middle plane and its other face, y in metres."""
TOP = 0.12
"""Its height, z in metres."""
CUBE = 0.04
"""The cube's edges, in metres."""
GOAL_RADIUS = 0.07
"""So near to the goal the cube has to rest, in metres; Meta-World's own for its tasks with this wall."""
STILL_MOVE, STILL_STEPS = 0.0005, 5
"""The cube rests if it moves no farther than this, in metres, in each of so many steps; it is carried at 0.01."""
LONGEST_MOVE = 0.05
"""What moves farther in one step was not carried, in metres: five times what the hand can do."""


class CubePath(NamedTuple):
    """What of the cube's way so far its judgement depends on.

    Two way points lie beside each end of the wall: one before it and one behind. The cube has gone around the wall when
    it has been at the two of one end, first before and then behind, and crossed the wall's plane only there: beyond
    the wall's end and below its top. Crossing it elsewhere, or a jump, spoils the way for the rest of the episode;
    coming back around the wall only takes back what was won.
    """

    position: tuple[float, float, float]
    """The cube's, in metres."""
    before: int = 0
    """The end of the wall that it was last beside, on the near side: -1 left, 1 right, 0 for neither."""
    around: bool = False
    spoiled: bool = False
    still: int = 0
    """For how many steps it has hardly moved."""

    @property
    def done(self) -> bool:
        """Whether the cube has gone around the wall and rests."""
        return self.around and self.still >= STILL_STEPS

    def to(self, cube: Float64[np.ndarray, " 3"]) -> "CubePath":
        """Return the path that goes on to the cube's position one step later."""
        position: Any = tuple(cube.tolist())
        move = math.dist(self.position, position)
        on = self._replace(position=position, still=self.still + 1 if move <= STILL_MOVE else 0)
        # NaN is a jump as well.
        if self.spoiled or not move <= LONGEST_MOVE or _crosses_elsewhere(self.position, position):
            return on._replace(around=False, spoiled=True)
        end = _beside(position)
        if position[1] <= FRONT:
            return on._replace(before=end, around=False)
        if position[1] >= BACK and end and end == self.before:
            return on._replace(around=True)
        return on


def _beside(position: tuple[float, float, float]) -> int:
    """Return beyond which end of the wall, -1 for left and 1 for right, a place below its top is; 0 for neither."""
    x, _, z = position
    return 0 if z >= TOP else int(x > ENDS[1]) - int(x < ENDS[0])


def _crosses_elsewhere(start: tuple[float, float, float], end: tuple[float, float, float]) -> bool:
    """Return whether the straight way crosses the wall's plane through the wall or above its top."""
    if (start[1] < MIDDLE) == (end[1] < MIDDLE):
        return False
    part = (MIDDLE - start[1]) / (end[1] - start[1])
    x, y, z = (a + part * (b - a) for a, b in zip(start, end, strict=True))
    return not _beside((x, y, z))


class PushAroundWallEnv(SawyerPushWallEnvV3):
    """The task as an environment of Meta-World's kind: its observation, actions, reward's range and info are theirs."""

    def __init__(self, **settings: Any) -> None:
        """Set the scene; `settings` are those of ``SawyerPushWallEnvV3``, for rendering."""
        super().__init__(**settings)
        cube_low, cube_high = (0.02, 0.6, 0.015), (0.10, 0.65, 0.015)
        goal_low, goal_high = (0.02, 0.83, 0.01), (0.10, 0.88, 0.02)
        self._random_reset_space = Box(
            np.hstack((cube_low, goal_low)), np.hstack((cube_high, goal_high)), dtype=np.float64
        )
        self.goal_space = Box(np.array(goal_low), np.array(goal_high), dtype=np.float64)

    @staticmethod
    def compile_scene(path: str) -> Any:
        """Compile the model of ``push-wall``, its puck made a cube of the same size."""
        scene = mujoco.MjSpec.from_file(path)
        shape = scene.geom("objGeom")
        shape.type, shape.size = mujoco.mjtGeom.mjGEOM_BOX, (CUBE / 2, CUBE / 2, CUBE / 2)
        return scene.compile()

    def _initialize_simulation(self) -> tuple[Any, Any]:
        model = self.compile_scene(self.fullpath)
        model.vis.global_.offwidth, model.vis.global_.offheight = self.width, self.height
        return model, mujoco.MjData(model)

    def reset_model(self) -> Float64[np.ndarray, " obs_dim"]:
        """Draw cube and goal, and begin the cube's path."""
        observation = super().reset_model()
        cube, goal = np.asarray(self.obj_init_pos), np.asarray(self._target_pos)
        self._start, self._goal = cube, goal
        self._path = CubePath(tuple(cube.tolist()))
        beside = [np.array((end + side * 1.5 * CUBE, MIDDLE, cube[2])) for end, side in zip(ENDS, (-1, 1), strict=True)]
        self._way_point = min(beside, key=lambda at: np.linalg.norm(cube - at) + np.linalg.norm(goal - at))
        return observation

    @SawyerXYZEnv._Decorators.assert_task_is_set
    def evaluate_state(
        self, obs: Float64[np.ndarray, " obs_dim"], action: Float32[np.ndarray, " 4"]
    ) -> tuple[float, dict[str, Any]]:
        """Judge the step that led to `obs`: it prolongs the cube's path."""
        self._path = self._path.to(obs[4:7])
        reward, tcp_to_obj, tcp_open, obj_to_target, grasp_reward, in_place_reward = self.compute_reward(action, obs)
        info = {
            "success": float(self._path.done and obj_to_target <= GOAL_RADIUS),
            "near_object": float(tcp_to_obj <= 0.03),
            "grasp_success": float(self.touching_main_object and tcp_open > 0 and obs[6] - 0.02 > self._start[2]),
            "grasp_reward": grasp_reward,
            "in_place_reward": in_place_reward,
            "obj_to_target": obj_to_target,
            "unscaled_reward": reward,
        }
        return reward, info

    def compute_reward(
        self, action: Float32[np.ndarray, " 4"], obs: Float64[np.ndarray, " obs_dim"]
    ) -> tuple[float, float, float, float, float, float]:
        """Return the reward, from 0 to 10, and its terms, as ``push-wall`` does.

        It grows with the grasp, then towards a point beside the nearer end of the wall, then, when the cube has gone
        around, towards the goal. A spoiled path earns no more than its grasp.
        """
        cube, opened, target = obs[4:7], float(obs[3]), self._goal
        tcp_to_obj = float(np.linalg.norm(cube - self.tcp_center))
        obj_to_target = float(np.linalg.norm(cube - target))
        scaling = np.array([3.0, 1.0, 1.0])
        near = partial(reward_utils.tolerance, bounds=(0, 0.05), sigmoid="long_tail")
        beside_wall = near(
            float(np.linalg.norm((cube - self._way_point) * scaling)),
            margin=float(np.linalg.norm((self._start - self._way_point) * scaling)),
        )
        in_place = near(obj_to_target, margin=float(np.linalg.norm(self._start - target)))
        grasped = self._gripper_caging_reward(
            action,
            cube,
            object_reach_radius=0.01,
            obj_radius=0.015,
            pad_success_thresh=0.05,
            xz_thresh=0.005,
            high_density=True,
        )
        reward = 2.0 * grasped
        if tcp_to_obj < 0.02 and opened > 0 and not self._path.spoiled:
            reward += 5.0 + 3.0 * in_place if self._path.around else 1.0 + 4.0 * beside_wall
        if self._path.done and obj_to_target <= GOAL_RADIUS:
            reward = 10.0
        return reward, tcp_to_obj, opened, obj_to_target, grasped, in_place


class PushAroundWallExpert:
    """A scripted expert in the manner of Meta-World's: what it does follows from the observation alone.

    It goes around the left end, which is the nearer one, and lets go of the cube at the goal.
    """

    GRIP = np.array((0.0, 0.0, 0.045))
    """From the cube to the hand that holds it, in metres."""
    OPEN, CLOSE = -1.0, 1.0

    def get_action(self, obs: Float64[np.ndarray, " obs_dim"], /) -> Float32[np.ndarray, " 4"]:
        """Return the hand's next move (x, y, z) and the gripper's effort."""
        hand, opening, cube, goal = obs[:3], obs[3], obs[4:7], obs[-3:]
        to_cube = cube + self.GRIP - hand
        closed = opening < 0.65
        if np.linalg.norm(cube[:2] - goal[:2]) < 0.03 and cube[2] < CUBE:
            move_by, effort = np.array((0.0, 0.0, 0.1 if opening > 0.95 else 0.0)), self.OPEN  # it is there
        elif np.linalg.norm(to_cube[:2]) > (0.035 if closed else 0.015):
            move_by, effort = to_cube + np.array((0.0, 0.0, 0.12)), self.OPEN
        elif abs(to_cube[2]) > 0.02:
            move_by, effort = to_cube, self.OPEN
        elif not closed:
            move_by, effort = to_cube, self.CLOSE
        else:
            move_by, effort = self._next_stop(cube, goal) - cube, self.CLOSE
        return np.array((*move(np.zeros(3), move_by, p=10.0), effort), np.float32)

    @staticmethod
    def _next_stop(cube: Float64[np.ndarray, " 3"], goal: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
        """Return where to carry a cube that is held, first of all up by its own height."""
        x, y, z = cube
        beside, height = ENDS[0] - 2 * CUBE, 1.5 * CUBE
        if z < CUBE and np.linalg.norm(cube[:2] - goal[:2]) > 0.05:
            return np.array((x, y, height))
        if y < MIDDLE and x > beside + CUBE / 2:
            return np.array((beside, y, height))
        if y < BACK + 2 * CUBE and x < ENDS[0]:
            return np.array((beside, BACK + 4 * CUBE, height))
        if np.linalg.norm(cube[:2] - goal[:2]) > 0.02:
            return np.array((goal[0], goal[1], height))
        return goal - (0, 0, CUBE / 2)  # below the table's top, not to slow down above it
