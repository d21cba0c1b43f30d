"""The one interface of a method of few-shot imitation.

A method is an immutable value: its settings and what it learned once from the data, such as the standardisation.
What it learns iteration by iteration are named tensors, which it is handed and never keeps. So every call is a pure
function of its arguments and can be made again anywhere. What a method needs is said by its type:

- `Method`: turns a support set into a policy, by gradients or without; nearest neighbour is no more than that.
- `MetaLearner`: also learns across tasks. What is local to a task lives inside `task_gradient` and `adapt`, such as the
  high level of MLSH; a policy keeps what acting needs, such as the support set in MIL's encoder, and what it must
  remember from step to step, such as OptionGAIL's option, is its `memory`.
- `PractisingLearner`: also acts in the environments of meta-training tasks, as OptionGAIL does.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from dmil_core.demonstrations import Demonstration, Standardisation
from dmil_core.networks import Parameters
from dmil_core.settings import MethodConfig


@runtime_checkable
class Drawn(Protocol):
    """What one slot of an iteration learns from."""

    @property
    def ids(self) -> Sequence[str]:
        """The ids of the demonstrations in it."""
        ...


Material = TypeVar("Material", bound=Drawn)
Config = TypeVar("Config", bound=MethodConfig)
Own = TypeVar("Own", bound="Standardised[Any]")


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


class Memoryless:
    """Base of policies whose choice depends on the state alone."""

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes 0"]:
        """Return an empty memory."""
        return np.zeros((episodes, 0), np.int64)


class Flat(Memoryless):
    """Base of such policies without sub-skills."""

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return sub-skill 0 throughout: there are no others."""
        none = np.zeros(len(demonstration), np.int64)
        return SubSkillUse(none, none)


class FineTuning(NamedTuple):
    """How to adapt at test; a method without gradient at test ignores it."""

    steps: int
    learning_rate: float


@runtime_checkable
class Method(Protocol):
    """Anything that turns a support set into a policy."""

    def constants(self) -> Mapping[str, np.ndarray]:
        """Return what the method learned once from the data, to be stored with its parameters."""
        ...

    def initial_parameters(self, stream: np.random.Generator) -> Parameters:
        """Draw the parameters to start from, which may be none."""
        ...

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> Policy:
        """Return the policy adapted to the support demonstrations of one task; `parameters` stay as they are."""
        ...


class TaskGradient(NamedTuple):
    """One task's contribution to the outer step, flat in the parameters' order, and what to show of it."""

    gradient: Float[Tensor, " size"]
    metrics: Mapping[str, float]


@runtime_checkable
class MetaLearner(Method, Protocol[Material]):
    """A method that learns across tasks, by gradients that add up over the slots of a batch."""

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, stream: np.random.Generator) -> Material:
        """Draw from one task's demonstrations what one slot of an iteration learns from.

        Args:
            demonstrations: of the task.
            iteration: counts from 0; decides of phases, if there are any.
            stream: where all is drawn from; what `task_gradient` draws later is named by a seed in the material.
        """
        ...

    def task_gradient(self, parameters: Parameters, material: Material) -> TaskGradient:
        """Return one slot's outer gradient.

        With ``outer_step == "average"`` it is how far the slot's own steps went, the other way round: parameters before
        minus parameters after. The metrics have the ``loss``, and ``sub_skill_share/K`` where there are sub-skills.
        """
        ...


class Rollout(NamedTuple):
    """An episode of a policy in meta-training, or its first part."""

    observations: Float32[np.ndarray, "steps+1 obs_dim"]
    actions: Float32[np.ndarray, "steps action_dim"]
    """As the policy chose them; the environment clips them."""
    sub_skills: Int64[np.ndarray, " steps"]
    success: bool
    """An episode ends with its first success."""
    ended: bool
    """Whether it came to its end, by success or its last step, and was not cut off."""


@runtime_checkable
class PractisingLearner(MetaLearner[Material], Protocol[Material]):
    """A method that also learns from acting in the environments of meta-training tasks."""

    def practice_steps(self, iteration: int) -> int:
        """Return how many steps each slot of an iteration acts, which may be none."""
        ...

    def explorer(self, parameters: Parameters, material: Material) -> Policy:
        """Return the policy that acts; what is random in it is named by a seed in the material and by its memory."""
        ...

    def with_practice(self, material: Material, rollouts: Sequence[Rollout]) -> Material:
        """Return the material with what came of acting."""
        ...


@dataclass(frozen=True)
class Standardised(ABC, Generic[Config]):
    """Base of the methods: its settings, and the standardisation as all that is learned once."""

    config: Config
    action_dim: int
    standardise: Standardisation

    config_type: ClassVar[type[MethodConfig]]
    """Of the settings, whose default name is the method's."""

    @classmethod
    def prepared(cls: type[Own], config: Config, action_dim: int, demonstrations: Sequence[Demonstration]) -> Own:
        """Return the method with what it learns once from the demonstrations of all meta-training tasks."""
        if config.standardise:
            return cls(config, action_dim, Standardisation.of(demonstrations))
        return cls(config, action_dim, Standardisation.identity(demonstrations[0].observations.shape[1]))

    @classmethod
    def restored(cls: type[Own], config: Config, action_dim: int, constants: Mapping[str, np.ndarray]) -> Own:
        """Return the method whose `constants` were stored."""
        standardise = Standardisation(constants["observation_mean"], constants["observation_scale"])
        return cls(config, action_dim, standardise)

    def constants(self) -> Mapping[str, np.ndarray]:
        """Return the observation statistics."""
        return {"observation_mean": self.standardise.mean, "observation_scale": self.standardise.scale}

    @property
    def obs_dim(self) -> int:
        """Numbers in an observation."""
        return len(self.standardise.mean)

    @abstractmethod
    def initial_parameters(self, stream: np.random.Generator) -> Parameters:
        """Draw the parameters to start from, which may be none."""

    @abstractmethod
    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> Policy:
        """Return the policy adapted to the support demonstrations of one task."""
