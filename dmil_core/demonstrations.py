"""Demonstrations, and the four disjoint sets of them that Algorithm 1 draws for a task."""

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float32

from dmil_core.errors import UserError
from dmil_core.trajectories import Trajectory


class DemonstrationError(UserError):
    """A demonstration, or a set of them, that cannot be learned from."""


@dataclass(frozen=True, eq=False)
class _Named:
    id: str
    task: str


@dataclass(frozen=True, eq=False)
class Demonstration(Trajectory, _Named):  # bases in this order: a constructor takes the fields of the last one first
    """One demonstrated trajectory of one task.

    Args:
        id: names the demonstration within its task; a result row refers to it.
        task: the task's name.
        observations: what the expert saw at each step, in the environment's units.
        actions: what the expert did at each step, in the environment's units.

    Raises:
        DemonstrationError: for no step at all, unequal lengths, a wrong rank, numbers that are not float32 or not
            finite. A single step can be learned from: it has no continuity, and counts in every other loss.
    """

    cut_from: "tuple[Demonstration, int] | None" = field(default=None, init=False, repr=False)
    """What it is a window of, and from which step on."""

    def __post_init__(self) -> None:
        for name in ("observations", "actions"):
            values = getattr(self, name)
            if values.ndim != 2 or values.shape[0] == 0 or values.shape[1] == 0:
                raise DemonstrationError(
                    f"demonstration {self.id} of {self.task}: {name} has the shape {values.shape}; "
                    "wanted (steps, dimensions) with at least one of each; drop the demonstration"
                )
            if values.dtype != np.float32:
                raise DemonstrationError(
                    f"demonstration {self.id} of {self.task}: {name} has numbers of the type {values.dtype}; wanted "
                    "float32; convert them"
                )
            if not np.isfinite(values).all():
                step = int(np.argwhere(~np.isfinite(values).all(axis=1))[0, 0])
                raise DemonstrationError(
                    f"demonstration {self.id} of {self.task}: {name} at step {step} is not finite; "
                    "wanted real numbers that float32 holds; drop the demonstration or mend the step"
                )
        if len(self.observations) != len(self.actions):
            raise DemonstrationError(
                f"demonstration {self.id} of {self.task}: {len(self.observations)} observations for "
                f"{len(self.actions)} actions; wanted one action for each observation"
            )

    def window(self, start: int, steps: int) -> "Demonstration":
        """Return the part of `steps` steps from `start` on, without a copy; its id says where it was cut.

        Raises:
            IndexError: if it does not lie inside the demonstration.
        """
        if not 0 <= start <= start + steps <= len(self):
            raise IndexError(f"window: got {steps} steps from {start} of {len(self)}; wanted a part of them")
        cut = slice(start, start + steps)
        window = dataclasses.replace(
            self,
            id=f"{self.id}[{start}:{start + steps}]",
            observations=self.observations[cut],
            actions=self.actions[cut],
        )
        object.__setattr__(window, "cut_from", (self, start))
        return window


class PathBatch(NamedTuple):
    """Some demonstrations of a task to see, and others to imitate."""

    context: tuple[Demonstration, ...]
    query: tuple[Demonstration, ...]
    seed: int
    """Names what is drawn in learning from them."""


@dataclass(frozen=True)
class TaskBatch:
    """What one task contributes to one outer step: τ1 and τ2 to adapt to, τ3 and τ4 to judge by (Algorithm 1)."""

    task: str
    support_high: tuple[Demonstration, ...]
    support_low: tuple[Demonstration, ...]
    query_high: tuple[Demonstration, ...]
    query_low: tuple[Demonstration, ...]
    path: "PathBatch | None" = None
    """What a path network learns from, if there is one."""
    on_labels: bool = False
    """Whether DMIL's sub-skills learn on the labels."""

    @property
    def sets(self) -> tuple[tuple[Demonstration, ...], ...]:
        """The four sets in the order of Algorithm 1: τ1, τ2, τ3, τ4."""
        return self.support_high, self.support_low, self.query_high, self.query_low

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of all demonstrations, set by set."""
        return tuple(demonstration.id for demonstrations in self.sets for demonstration in demonstrations)


def sample_task_batch(
    demonstrations: Sequence[Demonstration], trajectories: int, window: int | None, rng: np.random.Generator
) -> TaskBatch:
    """Draw {τ1}..{τ4} of Algorithm 1 for one task, `trajectories` in each.

    The four sets are disjoint when the task has 4 x `trajectories` demonstrations; with fewer, each set is drawn
    without replacement, and where even that is not possible, with it. Each trajectory is cut to `window` consecutive
    steps at a random place, or taken whole.

    Raises:
        DemonstrationError: if there is no demonstration.
    """
    total = len(demonstrations)
    if total == 0:
        raise DemonstrationError("demonstrations: got none for this task; wanted at least one; collect some first")
    if total >= 4 * trajectories:
        chosen = rng.permutation(total)[: 4 * trajectories].reshape(4, trajectories)
    else:
        chosen = np.stack([rng.choice(total, trajectories, replace=total < trajectories) for _ in range(4)])

    def cut(demonstration: Demonstration) -> Demonstration:
        if window is None or len(demonstration) <= window:
            return demonstration
        return demonstration.window(int(rng.integers(len(demonstration) - window + 1)), window)

    first, second, third, fourth = (tuple(cut(demonstrations[index]) for index in row) for row in chosen)
    return TaskBatch(demonstrations[0].task, first, second, third, fourth)


Features: TypeAlias = Callable[[Float32[np.ndarray, "steps obs_dim"]], Float32[np.ndarray, "steps features"]]
"""What networks see of observations, in other numbers than theirs."""


@dataclass(frozen=True, eq=False)
class Normalisation:
    """How observations, or features of them, are brought to zero mean and unit scale before a network sees them."""

    mean: Float32[np.ndarray, " features"]
    scale: Float32[np.ndarray, " features"]
    features: Features | None = None
    """What mean and scale are of; none: the observations themselves."""

    @classmethod
    def identity(cls, obs_dim: int, features: Features | None = None) -> "Normalisation":
        """Leave observations, or features of so many numbers, as they are."""
        return cls(np.zeros(obs_dim, np.float32), np.ones(obs_dim, np.float32), features)

    @classmethod
    def of(
        cls, demonstrations: Sequence[Demonstration], floor: float = 0.02, features: Features | None = None
    ) -> "Normalisation":
        """Take mean and standard deviation over all steps of the demonstrations of all meta-training tasks.

        `floor` is the least scale, in the observation's units: a coordinate that hardly moves in meta-training may move
        in a new task, and must not then drown all others. `features` are what networks see of observations, if not
        those.
        """
        observations = np.concatenate([demonstration.observations for demonstration in demonstrations])
        steps = (observations if features is None else features(observations)).astype(np.float64)
        return cls(steps.mean(0).astype(np.float32), np.maximum(steps.std(0), floor).astype(np.float32), features)

    def __call__(self, observations: Float32[np.ndarray, "steps obs_dim"]) -> Float32[np.ndarray, "steps features"]:
        """Return the standardised observations, or features, a new array."""
        return ((observations if self.features is None else self.features(observations)) - self.mean) / self.scale


def digest(demonstrations: Sequence[Demonstration]) -> str:
    """Return the SHA-256 of ids, shapes and values: equal digests mean equal data."""
    sha = hashlib.sha256()
    for demonstration in demonstrations:
        shapes = demonstration.observations.shape, demonstration.actions.shape
        sha.update(repr((demonstration.task, demonstration.id, *shapes)).encode())
        sha.update(np.ascontiguousarray(demonstration.observations).data)
        sha.update(np.ascontiguousarray(demonstration.actions).data)
    return sha.hexdigest()
