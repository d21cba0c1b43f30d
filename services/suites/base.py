"""A suite of tasks behind one small protocol."""

from typing import Literal, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from jaxtyping import Float32, Float64

from dmil_core.configs import ExperimentConfig
from dmil_core.errors import UserError
from dmil_core.points import Points

Environment = gymnasium.Env[np.ndarray, np.ndarray]
"""A task's environment, with a flat observation and actions in a `Box`. ``reset(seed=n)`` twice gives the same episode
twice. ``info["success"]`` of a step, or ``info["is_success"]``, says whether the task is solved. The infos of resets
may hold under ``goal``, a list of numbers, what was drawn at random. Where there is a score, the infos of steps hold it
under ``score``. Where observations leave out something that the expert needs, the infos of resets and steps hold the
whole ones under ``full_observation``."""


class Expert(Protocol):
    """A scripted expert of one task.

    One expert acts in many episodes, one after the other, and receives no notice of where one begins: all it knows of
    an episode is in the observation.
    """

    def get_action(self, obs: Float64[np.ndarray, " obs_dim"], /) -> Float32[np.ndarray, " action_dim"]:
        """Return what the expert does, before clipping to the action space."""
        ...


class Measure(NamedTuple):
    """A number that measures at each step how far an episode has come."""

    name: str
    """Of it in the infos of steps."""
    words: str
    """What it is, with its unit."""


class TaskSuite(Protocol):
    """Meta-training and meta-testing tasks of one kind of robot.

    Besides what is listed, a suite may have:

    - ``points``: the `Points` of its observations, for features and methods that work with differences of positions;
    - ``state_of(recorded)``: the observations (steps, `obs_dim`) in recorded ones (steps, any dimensions), for data
      sets that hold more, or another form;
    - ``replay(demonstration)``: what its actions lead to, in words;
    - ``camera``: what `services.suites.rendering.picture` looks through, if its environments are MuJoCo's;
    - ``measure_of(task)``: a `Measure` of how far an episode has come, or None; of suites with scores it is the score;
    - ``make_measured_env(task)``: as ``make_env``, but its infos hold the measure, where those of ``make_env`` do not;
    - ``action_space``: the `Box` of its environments' actions, where making one takes long;
    - ``expert_tasks``: the tasks whose experts are verified, where those are not the tasks of both splits.
    """

    name: str
    """Of the split; results of different ones are never averaged."""
    family: str
    """Names the robot and its simulator: suites of one family and one protocol share the demonstrations of a task."""
    train_tasks: tuple[str, ...]
    test_tasks: tuple[str, ...]
    obs_dim: int
    action_dim: int
    horizon: int
    """Steps in an episode."""
    best_score: int
    """The score of an episode in which all is done: 1 where there is success or none, else the number of sub-tasks."""
    protocol: str
    """Names all that an episode depends on besides task and seed, and the rule by which it counts as a success; rows
    of different protocols are never compared."""

    def make_env(self, task: str) -> Environment:
        """Build a task's environment; it may be reset and reused for any number of episodes."""
        ...

    def expert(self, task: str) -> Expert | None:
        """Return a task's scripted expert, if there is one."""
        ...


def with_points(config: ExperimentConfig, suite: TaskSuite) -> ExperimentConfig:
    """Return the settings with the points that the suite declares, where any are used and none are given."""
    declared: Points | None = getattr(suite, "points", None)
    evaluation = config.evaluation
    used = config.method.uses_points or evaluation.displaced or "tracking" in evaluation.controls
    if declared is None or not used or config.suite.points is not None:
        return config
    return config.model_copy(update={"suite": config.suite.model_copy(update={"points": declared})})


def measure_of(suite: TaskSuite, task: str) -> Measure | None:
    """Return what measures how far an episode of a task has come, if the suite names anything."""
    if hasattr(suite, "measure_of"):
        return suite.measure_of(task)  # type: ignore[attr-defined]
    return Measure("score", "sub-tasks done") if suite.best_score > 1 else None


def build_env(suite: TaskSuite, task: str, *, measured: bool = False) -> Environment:
    """Build a task's environment, and check its spaces; if `measured`, its infos hold what `measure_of` names.

    Raises:
        UserError: if they are not those that the suite names.
    """
    env = getattr(suite, "make_measured_env", suite.make_env)(task) if measured else suite.make_env(task)
    for field, space, size in (
        ("observation_space", env.observation_space, suite.obs_dim),
        ("action_space", env.action_space, suite.action_dim),
    ):
        if not isinstance(space, Box) or space.shape != (size,):
            raise UserError(
                f"{suite.name}: task {task}: {field}: got {space}; wanted a Box of the shape ({size},), as the suite's "
                f"{'obs_dim' if field == 'observation_space' else 'action_dim'} says; mend either"
            )
    return env


def action_space_of(suite: TaskSuite) -> Box:
    """Return the space of actions in a suite's environments.

    Raises:
        UserError: as `build_env`.
    """
    space = getattr(suite, "action_space", None) or build_env(suite, suite.train_tasks[0]).action_space
    assert isinstance(space, Box)
    return space


Split = Literal["meta-training", "meta-testing"]
