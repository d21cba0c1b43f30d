"""The one interface of a method of few-shot imitation.

A method is an immutable value: its settings and what it learned once from the data, such as the standardisation.
What it learns iteration by iteration are named tensors, which it is handed and never keeps. So every call is a pure
function of its arguments and can be made again anywhere.

How the compared methods fit: MIL keeps the support set in its `Policy`, for its encoder; MLSH makes its high level
inside `task_gradient` and `adapt`, local to the task, and its policy remembers the macro-step; PEMIRL and nearest
neighbour have an `adapt` without gradient; nearest neighbour learns nothing and is a `Method` only; OptionGAIL's
policy remembers the option, and its training material is rollouts beside demonstrations: `MetaLearner` is generic
in the material of one slot for that.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration
from dmil_core.meta_gradient import TaskGradient
from dmil_core.networks import Parameters

__all__ = ["Decision", "Drawn", "FineTuning", "MetaLearner", "Method", "Policy", "SubSkillUse"]


@runtime_checkable
class Drawn(Protocol):
    """What one slot of an iteration learns from."""

    @property
    def ids(self) -> Sequence[str]:
        """The ids of the demonstrations in it."""
        ...


Material = TypeVar("Material", bound=Drawn)


class Decision(NamedTuple):
    """What a policy does in several episodes at once."""

    actions: Float32[np.ndarray, "episodes action_dim"]
    sub_skills: Int64[np.ndarray, " episodes"]
    memory: Int64[np.ndarray, "episodes memory_dim"]


class SubSkillUse(NamedTuple):
    """Which sub-skill a policy takes at each step of a demonstration, and which one fits the action best."""

    chosen: Int64[np.ndarray, " steps"]
    best: Int64[np.ndarray, " steps"]


@runtime_checkable
class Policy(Protocol):
    """A policy adapted to one task, acting in several episodes in lockstep.

    What it must remember between steps it returns as `memory`, one row an episode, and is handed back: rows of
    finished episodes are dropped by the caller.
    """

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes memory_dim"]:
        """Return the memory of so many episodes that begin."""
        ...

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes memory_dim"]
    ) -> Decision:
        """Choose one action for each episode; a method without sub-skills reports sub-skill 0."""
        ...

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return the sub-skills along a demonstration; a method without sub-skills reports sub-skill 0."""
        ...


class FineTuning(NamedTuple):
    """How to adapt at test; a method without gradient at test ignores it."""

    steps: int
    learning_rate: float


@runtime_checkable
class Method(Protocol):
    """Anything that turns a support set into a policy."""

    @property
    def sub_skills(self) -> int:
        """The number of sub-skills K, 1 for a method without."""
        ...

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> Policy:
        """Return the policy adapted to the support demonstrations of one task; `parameters` stay as they are."""
        ...


@runtime_checkable
class MetaLearner(Method, Protocol[Material]):
    """A method that learns across tasks, by gradients that add up over the slots of a batch."""

    def constants(self) -> Mapping[str, np.ndarray]:
        """Return what the method learned once from the data, to be stored with its parameters."""
        ...

    def initial_parameters(self, stream: np.random.Generator) -> Parameters:
        """Draw the parameters that meta-training starts from."""
        ...

    def sample(self, demonstrations: Sequence[Demonstration], stream: np.random.Generator) -> Material:
        """Draw from one task's demonstrations what one slot of an iteration learns from."""
        ...

    def task_gradient(self, parameters: Parameters, material: Material) -> TaskGradient:
        """Return one slot's outer gradient."""
        ...
