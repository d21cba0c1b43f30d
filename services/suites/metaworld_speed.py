"""Meta-World's environments made fast, with results that stay equal.

A step of Meta-World costs several times its physics: every contact is read in Python, rotations go through SciPy,
rewards are shaped that a rollout never reads; a reset lets the hand settle twice. `fast_environment` builds an
environment of a class derived from Meta-World's own, in which these parts are exchanged. Meta-World's classes and
modules stay as they are, and so do all environments that anybody else builds in the process.

Observations and success flags are those of Meta-World, bit for bit, and so are rewards where they are asked for;
``tests/services/suites/test_metaworld_speed.py`` holds all tasks to that.
"""

import ast
import copy
import inspect
import math
import textwrap
from collections.abc import Callable, Sequence
from functools import cache, cached_property, lru_cache
from types import CellType, FunctionType, SimpleNamespace
from typing import Any, NamedTuple, cast

import mujoco as compiled_mujoco
import numpy as np
from jaxtyping import Float64
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from metaworld.utils import reward_utils
from scipy.spatial.transform import Rotation

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it

FRAME = 18
"""Numbers in the observation of one moment: hand, gripper, and two objects' positions and quaternions."""
STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
"""All that the next step of physics depends on, the solver's start included."""


def fast_environment(stock: type[SawyerXYZEnv], *, rewards: bool = False) -> SawyerXYZEnv:
    """Build a goal-visible environment whose episodes are drawn from its own stream, which its ``seed()`` sets.

    Args:
        stock: Meta-World's class of the task, of those whose goal is hidden unless one asks.
        rewards: whether to compute them. Without, a step's reward is NaN and its info holds ``success`` only, and of
            Meta-World's code for rewards no more is run than the statements that success depends on.
    """
    env: Any = _fast_class(stock)()
    env._rewards = rewards
    # As Meta-World's own goal-visible classes do; the observation space would go on to clip the goal to zero.
    env._partially_observable = False
    del env.sawyer_observation_space
    env._set_task_called = True
    env._freeze_rand_vec = False
    env.seeded_rand_vec = True
    return env


class Ids(NamedTuple):
    """Where the parts of the hand stand in MuJoCo's arrays."""

    hand: int
    right_claw: int
    left_claw: int
    right_finger: int
    left_finger: int
    left_pad: int
    right_pad: int


class FastSteps(SawyerXYZEnv):
    """What a fast environment does in place of `SawyerXYZEnv`."""

    _rewards: bool
    _success: Callable[[np.ndarray, np.ndarray], Any]
    _resetting: str | None = None
    _settled_with: bytes | None = None

    def _initialize_simulation(self) -> tuple[Any, Any]:
        model = copy.copy(_compiled(self.fullpath, getattr(self, "compile_scene", mujoco.MjModel.from_xml_path)))
        model.vis.global_.offwidth, model.vis.global_.offheight = self.width, self.height
        return model, mujoco.MjData(model)

    @cached_property
    def _ids(self) -> Ids:
        return Ids(
            *(self.model.body(name).id for name in ("hand", "rightclaw", "leftclaw")),
            *(self.model.site(name).id for name in ("rightEndEffector", "leftEndEffector")),
            *(self.model.geom(name).id for name in ("leftpad_geom", "rightpad_geom")),
        )

    @cached_property
    def _settled(self) -> np.ndarray:
        return np.empty(mujoco.mj_stateSize(self.model, STATE))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Execute an action (x, y, z, gripper), each in [-1, 1], for `frame_skip` steps of physics."""
        if self.curr_path_length >= self.max_path_length:
            raise ValueError("You must reset the env manually once truncate==True")
        data = self.data
        hand = data.mocap_pos[0]
        hand += np.clip(action[:3], -1, 1) * self.action_scale
        np.clip(hand, self.mocap_low, self.mocap_high, out=hand)
        data.ctrl[:] = action[3], -action[3]
        mujoco.mj_step(self.model, data, nstep=self.frame_skip)
        # All of it, though the observation needs the kinematics alone: the solver starts the next step from here.
        mujoco.mj_forward(self.model, data)
        self.curr_path_length += 1
        observation, space = self._get_obs(), self.sawyer_observation_space
        np.clip(observation, space.low, space.high, out=observation)
        self._last_stable_obs = observation
        truncated = self.curr_path_length == self.max_path_length
        if not self._rewards:
            return observation, math.nan, False, truncated, {"success": self._success(observation, action)}
        reward, info = self.evaluate_state(observation, action)
        return observation, reward, False, truncated, info

    def _get_obs(self) -> np.ndarray:
        goal = np.zeros(3) if self._partially_observable else self._get_pos_goal()
        frame = self._get_curr_obs_combined_no_goal()
        observation = np.concatenate((frame, self._prev_obs, goal))
        self._prev_obs = frame
        return observation

    def _get_curr_obs_combined_no_goal(self) -> np.ndarray:
        frame = np.zeros(FRAME)
        bodies = self.data.xpos
        frame[:3] = bodies[self._ids.hand]
        apart = bodies[self._ids.right_claw] - bodies[self._ids.left_claw]
        frame[3] = min(math.sqrt(apart.dot(apart)) / 0.1, 1.0)
        positions, quaternions = self._get_pos_objects(), self._get_quat_objects()
        for number in range(len(positions) // 3):
            start = 4 + 7 * number
            frame[start : start + 3] = positions[3 * number : 3 * number + 3]
            frame[start + 3 : start + 7] = quaternions[4 * number : 4 * number + 4]
        return frame

    @property
    def tcp_center(self) -> np.ndarray:
        """The middle between the fingers, in metres."""
        sites = self.data.site_xpos
        return (sites[self._ids.right_finger] + sites[self._ids.left_finger]) / 2.0

    def touching_object(self, object_geom_id: int) -> bool:
        """Return whether both pads of the gripper press on the object."""
        contact = self.data.contact
        pairs = contact.geom.tolist()
        for pad in (self._ids.left_pad, self._ids.right_pad):
            touching = [row for row, pair in enumerate(pairs) if pad in pair and object_geom_id in pair]
            if not sum(self.data.efc_force[contact.efc_address[row]] for row in touching) > 0:
                return False
        return True

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the environment's own stream draws it, whatever `seed` is.

        Meta-World resets the model twice, and MuJoCo's data in between: of the first time nothing remains but what it
        drew and moved in the model, so the hand need not settle for it.
        """
        self._resetting = "drawing"
        try:
            return super().reset(seed, options)
        finally:
            self._resetting = None

    def _reset_hand(self, steps: int = 50) -> None:
        if self._resetting == "drawing":
            self._resetting = "settling"
        elif self._resetting == "settling":
            # From MuJoCo's initial state the hand settles alike each time unless a body has been moved in the model.
            # Sites, the one other thing that tasks move there, take no part in the physics.
            bodies = self.model.body_pos.tobytes()
            if bodies != self._settled_with:
                self._settle(steps * self.frame_skip - 1)
                mujoco.mj_getState(self.model, self.data, self._settled, STATE)
                self._settled_with = bodies
            mujoco.mj_setState(self.model, self.data, self._settled, STATE)
            mujoco.mj_step(self.model, self.data)  # the last one again, for all that it leaves besides the state
        else:
            self._settle(steps * self.frame_skip)
        super()._reset_hand(steps=0)  # what a task does besides

    def _settle(self, steps: int) -> None:
        self.data.mocap_pos[0] = self.hand_init_pos
        self.data.mocap_quat[0] = 1, 0, 1, 0
        self.data.ctrl[:] = -1, 1
        mujoco.mj_step(self.model, self.data, nstep=steps)


@lru_cache(maxsize=1)  # 20 MB; environments of one task are built one after the other
def _compiled(path: str, compile_scene: Callable[[str], Any]) -> Any:
    return compile_scene(path)


@cache
def _fast_class(stock: type[SawyerXYZEnv]) -> type[SawyerXYZEnv]:
    """Derive from a class of Meta-World's one that does the same and calls the fast parts."""
    rebound: Any = type(stock.__name__, (stock,), {})
    fast_utils = SimpleNamespace(**{**vars(reward_utils), "tolerance": _tolerance})
    exchange = Exchange(
        [
            (stock, rebound),  # some methods call static ones by the name of their class
            (Rotation, SimpleNamespace(from_matrix=FastRotation)),
            (reward_utils, fast_utils),
            (reward_utils.tolerance, _tolerance),
        ]
    )
    for parent in reversed(stock.__mro__[: stock.__mro__.index(SawyerXYZEnv) + 1]):
        for name, member in vars(parent).items():
            if isinstance(member, FunctionType) and name != "__init__":
                setattr(rebound, name, exchange.rebind(member))
            elif isinstance(member, staticmethod):
                setattr(rebound, name, staticmethod(exchange.rebind(member.__func__)))
    rebound._success, rebound._success_terms = success_functions(rebound)
    return type(stock.__name__, (FastSteps, rebound), {})


class Exchange:
    """Copies functions so that some of their global names mean something else; the originals stay as they are."""

    def __init__(self, exchanged: Sequence[tuple[Any, Any]]) -> None:
        """Mean by the first of each pair the second."""
        self._exchanged = exchanged
        self._globals: dict[str, dict[str, Any]] = {}

    def rebind(self, function: FunctionType) -> FunctionType:
        """Return a copy of `function`, and of one that it decorates, with the other globals."""
        if function.__module__ not in self._globals:
            names = function.__globals__.items()
            self._globals[function.__module__] = {name: self._meant(value) for name, value in names}
        closure = tuple(
            CellType(self.rebind(cell.cell_contents)) if isinstance(cell.cell_contents, FunctionType) else cell
            for cell in function.__closure__ or ()
        )
        return FunctionType(
            function.__code__, self._globals[function.__module__], function.__name__, function.__defaults__, closure
        )

    def _meant(self, value: Any) -> Any:
        return next((new for old, new in self._exchanged if value is old), value)


def _tolerance(
    x: Any,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    sigmoid: Any = "gaussian",
    value_at_margin: float = 0.1,
) -> Any:
    """Return what ``reward_utils.tolerance`` does, without arrays in the case that nearly all rewards use."""
    lower, upper = bounds
    if sigmoid != "long_tail" or not isinstance(x, float) or not lower <= upper or not margin > 0:
        return reward_utils.tolerance(x, bounds, margin, sigmoid, value_at_margin)
    if lower <= x <= upper:
        return 1.0
    distance = float((lower - x if x < lower else x - upper) / margin)
    return 1 / ((distance * math.sqrt(1 / value_at_margin - 1)) ** 2 + 1)


class FastRotation(NamedTuple):
    """Of SciPy's `Rotation`, the one use that Meta-World makes of it."""

    matrix: Float64[np.ndarray, "3 3"]

    def as_quat(self) -> Float64[np.ndarray, " 4"]:
        """Return the quaternion (x, y, z, w)."""
        return quaternion(self.matrix)


def success_functions(task: type[SawyerXYZEnv]) -> tuple[FunctionType, FunctionType]:
    """Cut what success depends on out of a task's ``evaluate_state`` and the ``compute_reward`` that it calls.

    Meta-World computes both in one, and success needs one distance of it. Statements are kept whole or not at all.

    Returns:
        The methods ``_success`` and ``_success_terms``, which take what the two take. The latter is called by the
        former, and returns None in place of the terms that success does not need.
    """
    evaluate = cast(Any, task.evaluate_state).__closure__[0].cell_contents  # the decorator asks for `set_task`
    compute = cast(Any, task).compute_reward
    evaluation, computation = _definition(evaluate), _definition(compute)
    info: Any = next(node for node in ast.walk(evaluation) if isinstance(node, ast.Dict))
    success = next(value for key, value in zip(info.keys, info.values, strict=True) if ast.unparse(key) == "'success'")
    at = next(index for index, line in enumerate(evaluation.body) if "self.compute_reward(" in ast.unparse(line))
    call: Any = evaluation.body[at]
    after, needed = _needed_for([*evaluation.body[at + 1 : -1], ast.Return(success)], set())
    wanted = [not needed.isdisjoint(_names(term)) for term in call.targets[0].elts]
    call.value.func.attr = "_success_terms"
    before, _ = _needed_for(evaluation.body[:at], needed)
    evaluation.body = [*before, call, *after] if any(wanted) else [*before, *after]
    versions = (line for line in computation.body if "self.reward_function_version == 'v2'" in ast.unparse(line))
    current: Any = next(versions, computation)
    terms = current.body[-1].value
    if len(terms.elts) == len(wanted):  # two tasks return in another form: of these all terms stay
        terms.elts = [term if want else ast.Constant(None) for term, want in zip(terms.elts, wanted, strict=True)]
    computation.body, _ = _needed_for(current.body, set())
    return _compiled_as(evaluation, evaluate), _compiled_as(computation, compute)


def _definition(function: FunctionType) -> ast.FunctionDef:
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(definition, ast.FunctionDef)
    return definition


def _compiled_as(definition: ast.FunctionDef, function: FunctionType) -> FunctionType:
    """Compile a definition where `function` stands, without decorators and annotations."""
    definition.decorator_list, definition.returns = [], None
    for argument in definition.args.args:
        argument.annotation = None
    module = ast.fix_missing_locations(ast.Module([definition], []))
    made: dict[str, FunctionType] = {}
    exec(compile(module, function.__code__.co_filename, "exec"), function.__globals__, made)
    return made[definition.name]


def _needed_for(lines: Sequence[ast.stmt], needed: set[str]) -> tuple[list[ast.stmt], set[str]]:
    """Return the statements that `needed`, or what is returned, depends on, and all names in them."""
    kept: list[ast.stmt] = []
    for line in reversed(lines):
        if isinstance(line, ast.If):
            then, for_then = _needed_for(line.body, needed)
            otherwise, for_otherwise = _needed_for(line.orelse, needed)
            if then or otherwise:
                kept = [ast.If(line.test, then or [ast.Pass()], otherwise), *kept]
                needed = needed | for_then | for_otherwise | _names(line.test)
        elif isinstance(line, ast.Return) or not needed.isdisjoint(_assigned(line)):
            kept, needed = [line, *kept], needed | _names(line)
    return kept, needed


def _assigned(line: ast.stmt) -> set[str]:
    """Return the names that a statement may change; only the kinds that Meta-World's rewards are made of are known."""
    if isinstance(line, ast.Assign):
        return set().union(*map(_names, line.targets))
    if isinstance(line, ast.AnnAssign | ast.AugAssign):
        return _names(line.target)
    assert isinstance(line, ast.Assert | ast.Expr | ast.Delete), f"a statement of an unknown kind: {ast.unparse(line)}"
    return set()


def _names(node: ast.AST) -> set[str]:
    """Return all names in a piece of code, with their attributes, but ``self`` alone."""
    parts = (part for part in ast.walk(node) if isinstance(part, ast.Name | ast.Attribute))
    return {ast.unparse(part) for part in parts} - {"self"}


def quaternion(matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 4"]:
    """Return a rotation matrix as the quaternion (x, y, z, w) that SciPy gives, of the same sign and bits.

    MuJoCo's own ``mju_mat2Quat`` differs in sign. SciPy follows Markley (2008), "Unit Quaternion from Rotation
    Matrix", and so does this; it leaves out SciPy's check that the matrix is a rotation.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    trace = xx + yy + zz
    largest = max(xx, yy, zz, trace)
    if largest == xx:
        x, y, z, w = 1 - trace + 2 * xx, yx + xy, zx + xz, zy - yz
    elif largest == yy:
        x, y, z, w = yx + xy, 1 - trace + 2 * yy, zy + yz, xz - zx
    elif largest == zz:
        x, y, z, w = zx + xz, zy + yz, 1 - trace + 2 * zz, yx - xy
    else:
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1 + trace
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return np.array((x / norm, y / norm, z / norm, w / norm))
