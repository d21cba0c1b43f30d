"""The interface of a method of few-shot imitation.

A method is an immutable value: its settings, and what it computed once from the data, such as the normalisation of
observations. What it learns iteration by iteration are named tensors, which are passed to it and which it never keeps.
So every call is a pure function of its arguments, which any process can repeat. There are three kinds:

- `Method` turns a support set into a policy, by gradients or without.
- `MetaLearner` also learns across tasks. What belongs to one task lives inside `task_gradient` and `adapt`, such as the
  high level of MLSH; a policy keeps what acting needs, such as the support set in MIL's encoder.
- `OnlineMetaLearner` also acts in the environments of meta-training tasks, as OptionGAIL does.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.errors import UserError
from dmil_core.features import RelativeFeatures
from dmil_core.losses import Steps
from dmil_core.networks import Parameters
from dmil_core.paths import with_copies
from dmil_core.points import Points
from dmil_core.settings import FineTuning as FineTuning
from dmil_core.settings import MethodConfig
from dmil_core.trajectories import Rollout


class Decision(NamedTuple):
    """Actions of a policy in several episodes at once."""

    actions: Float32[np.ndarray, "episodes action_dim"]
    sub_skills: Int64[np.ndarray, " episodes"]
    memory: Int64[np.ndarray, "episodes memory_dim"]


class SubSkillUse(NamedTuple):
    """Sub-skill that a policy takes at each step of a demonstration, and the one that fits the action best."""

    chosen: Int64[np.ndarray, " steps"]
    best: Int64[np.ndarray, " steps"]


class Policy(ABC):
    """A policy adapted to one task, acting in several episodes in lockstep.

    What it must remember between steps it returns as `memory`, one row an episode, and receives again at the next
    step: the caller drops the rows of finished episodes. By default it remembers nothing and has one sub-skill.
    """

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes memory_dim"]:
        """Return the memory of episodes at their first step."""
        return np.zeros((episodes, 0), np.int64)

    @abstractmethod
    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes memory_dim"]
    ) -> Decision:
        """Choose one action for each episode; a method without sub-skills reports sub-skill 0."""

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return the sub-skills along a demonstration; a method without sub-skills reports sub-skill 0."""
        zeros = np.zeros(len(demonstration), np.int64)
        return SubSkillUse(zeros, zeros)


class NormalisedPolicy(Policy):
    """Base of policies without sub-skills, whose action depends on the normalised observation alone."""

    normalise: Normalisation

    @abstractmethod
    def actions(self, states: Float32[Tensor, "episodes obs_dim"]) -> Float32[Tensor, "episodes action_dim"]:
        """Return the action in each normalised state."""

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action for each episode."""
        actions = self.actions(torch.from_numpy(self.normalise(observations)))
        return Decision(actions.numpy(), np.zeros(len(observations), np.int64), memory)


OBSERVATION_FLOOR, FEATURE_FLOOR = 0.02, 0.05
"""The least scale of a number in an observation, and of a feature."""


def features_of(config: MethodConfig, points: Points | None) -> RelativeFeatures | None:
    """Return the map from observations to features, or None if networks see the observations themselves.

    Raises:
        UserError: for relative features without an object among the points.
    """
    if config.features == "raw":
        return None
    if points is None or points.object is None:
        raise UserError(
            "method.features: got relative for a suite that declares no object; wanted suite.points with hand and "
            "object, see docs/your-own-task.md; or --method.features raw"
        )
    return RelativeFeatures(points, config.absolute_position)


Config = TypeVar("Config", bound=MethodConfig)
M = TypeVar("M", bound="Method[Any]")


@dataclass(frozen=True)
class Method(ABC, Generic[Config]):
    """Turns a support set into a policy, for observations and actions of given sizes."""

    config: Config
    action_dim: int
    normalise: Normalisation
    points: Points | None = None
    """What the suite declares of observations; none where the method does not use it."""

    config_type: ClassVar[type[MethodConfig]]
    """Class of the settings, whose default name is the method's."""
    on_gpu: ClassVar[bool] = False
    """Whether it also computes inside `dmil_core.devices.computing_on` a GPU."""

    @classmethod
    def prepared(
        cls: type[M],
        config: Config,
        action_dim: int,
        demonstrations: Sequence[Demonstration],
        points: Points | None = None,
    ) -> M:
        """Return the method with the statistics of observations, or features, in all meta-training demonstrations.

        Raises:
            UserError: for relative features without declared points, or points that there are not.
        """
        features = features_of(config, points)
        observations = demonstrations[0].observations
        if points is not None:
            points.check(observations.shape[1], action_dim)
        seen = observations if features is None else features(observations)
        if config.standardise:
            floor = OBSERVATION_FLOOR if features is None else FEATURE_FLOOR
            return cls(config, action_dim, Normalisation.of(demonstrations, floor, features), points)
        return cls(config, action_dim, Normalisation.identity(seen.shape[1], features), points)

    @classmethod
    def restored(
        cls: type[M],
        config: Config,
        action_dim: int,
        constants: Mapping[str, np.ndarray],
        points: Points | None = None,
    ) -> M:
        """Return the method whose `constants` were stored."""
        mean, scale = constants["observation_mean"], constants["observation_scale"]
        return cls(config, action_dim, Normalisation(mean, scale, features_of(config, points)), points)

    def constants(self) -> Mapping[str, np.ndarray]:
        """Return the observation statistics, to be stored beside the parameters."""
        return {"observation_mean": self.normalise.mean, "observation_scale": self.normalise.scale}

    @property
    def input_dim(self) -> int:
        """Numbers that a network sees of an observation."""
        return len(self.normalise.mean)

    @property
    def obs_dim(self) -> int:
        """Numbers in an observation."""
        return self.input_dim if self.normalise.features is None or self.points is None else self.points.size

    @abstractmethod
    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the initial parameters, which may be none."""

    def support_steps(self, support: Sequence[Demonstration], fine_tuning: FineTuning) -> Steps:
        """Return the steps to fine-tune on: those of the support set and, if asked for, of its displaced copies."""
        return Steps.of(with_copies(support, self.points, fine_tuning.displaced), self.normalise)

    @abstractmethod
    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> Policy:
        """Return the policy adapted to the support demonstrations of one task; `parameters` stay unchanged."""


@runtime_checkable
class Batch(Protocol):
    """Data that one slot of an iteration learns from."""

    @property
    def ids(self) -> Sequence[str]:
        """Ids of its demonstrations."""
        ...


@dataclass(frozen=True)
class DemonstrationBatch:
    """Whole demonstrations of a task, as a `Batch`."""

    demonstrations: tuple[Demonstration, ...]
    seed: int
    """Names all that is drawn in learning from them."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of the demonstrations."""
        return tuple(demonstration.id for demonstration in self.demonstrations)


BatchT = TypeVar("BatchT", bound=Batch)


class TaskGradient(NamedTuple):
    """Contribution of one task to the outer step, flat in the parameters' order, and metrics of it."""

    gradient: Float[Tensor, " size"]
    metrics: Mapping[str, float]


class MetaLearner(Method[Config], Generic[Config, BatchT]):
    """A method that learns across tasks, by gradients that add up over the slots of an iteration."""

    batched: ClassVar[bool] = False
    """Whether `task_gradients` is one computation."""

    @abstractmethod
    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> BatchT:
        """Draw the batch of one slot from the demonstrations of its task.

        Args:
            demonstrations: of the task.
            iteration: counts from 0; decides the phase, where a method has phases.
            rng: source of all randomness; what `task_gradient` draws comes from a seed in the batch.
        """

    @abstractmethod
    def task_gradient(self, parameters: Parameters, batch: BatchT) -> TaskGradient:
        """Return the outer gradient of one slot.

        With ``outer_step == "average"`` it is the parameters before the slot's own steps minus those after. The
        metrics contain ``loss``, and ``sub_skill_share/K`` for each sub-skill.
        """

    def task_gradients(self, parameters: Parameters, batches: Sequence[BatchT]) -> list[TaskGradient]:
        """Return `task_gradient` of several slots of an iteration, but for rounding."""
        return [self.task_gradient(parameters, batch) for batch in batches]


class OnlineMetaLearner(MetaLearner[Config, BatchT]):
    """A method that also acts in the environments of meta-training tasks."""

    @abstractmethod
    def environment_steps(self, iteration: int) -> int:
        """Return the environment steps of each slot of an iteration, which may be 0."""

    @abstractmethod
    def exploration_policy(self, parameters: Parameters, batch: BatchT) -> Policy:
        """Return the policy that acts; its randomness comes from a seed in the batch and from its memory alone."""

    @abstractmethod
    def with_rollouts(self, batch: BatchT, rollouts: Sequence[Rollout]) -> BatchT:
        """Return the batch with rollouts of the exploration policy."""
