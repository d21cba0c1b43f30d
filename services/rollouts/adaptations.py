"""Adaptations to support sets, and what is kept of the episodes that judge them: pure, no Ray."""

from collections.abc import Mapping, Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np

from dmil_core.configs import EvaluationConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import Policy, SubSkillUse
from dmil_core.trajectories import Rollout
from services.suites.base import Split


class Adaptation(NamedTuple):
    """One adaptation to one support set, and the episodes that judge it."""

    split: Split
    task: str
    shots: int
    draw: int
    episodes: tuple[int, ...]

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"{self.split} task {self.task}, {self.shots}-shot, support set {self.draw}"

    @property
    def key(self) -> dict[str, str | int]:
        """What identifies it among all adaptations."""
        return {"split": self.split, "task": self.task, "shots": self.shots, "draw": self.draw}

    def support(self, held_out: Sequence[Demonstration]) -> Sequence[Demonstration]:
        """Return this draw's support set: draws of one size are disjoint."""
        return held_out[self.draw * self.shots : (self.draw + 1) * self.shots]


def imitation_error(policy: Policy, demonstrations: Sequence[Demonstration]) -> float:
    """Return ‖π(s) − a‖² averaged over all steps: how far a policy is from what was demonstrated, in its states.

    What the policy remembers between steps is its own; the states are the demonstrations', whatever it does.
    """
    total, memory = 0.0, policy.start(len(demonstrations))
    alive = list(demonstrations)
    for step in range(max(map(len, demonstrations))):
        going_on = [step < len(demonstration) for demonstration in alive]
        alive, memory = list(compress(alive, going_on)), memory[going_on]
        decision = policy.act(np.stack([demonstration.observations[step] for demonstration in alive]), memory)
        wanted = np.stack([demonstration.actions[step] for demonstration in alive])
        total, memory = total + float(np.square(decision.actions - wanted).sum()), decision.memory
    return total / sum(map(len, demonstrations))


def plan_adaptations(
    tasks: Sequence[tuple[Split, str]], evaluation: EvaluationConfig, held_out: Mapping[str, int] | None = None
) -> list[Adaptation]:
    """Return all adaptations of an evaluation, a task's episodes spread over its support sets.

    `held_out` has the number of demonstrations that a task's support sets are drawn from. Where they are too few for
    `EvaluationConfig.support_draws` disjoint ones, there are as many as they make.
    """

    def draws(task: str, shots: int) -> int:
        enough = evaluation.support_draws if held_out is None else held_out[task] // shots
        return min(evaluation.support_draws, evaluation.episodes, enough)

    return [
        Adaptation(split, task, shots, draw, tuple(range(draw, evaluation.episodes, draws(task, shots))))
        for split, task in tasks
        for shots in evaluation.shots
        for draw in range(draws(task, shots))
    ]


class EpisodeOutcome(NamedTuple):
    """What a result row holds of a rollout."""

    seed: int
    goal: list[float]
    success: bool
    score: int
    steps: int
    sub_skill_steps: list[int]
    """Steps in which each sub-skill acted, up to the highest one that did."""
    sub_skill_switches: int
    """Steps in which another sub-skill acted than in the step before."""
    diverged: bool = False
    """Whether it ended because an action was not finite."""
    fault: int | None = None
    """The first observation that the simulator gave and that is not finite, the reset's being 0."""

    @classmethod
    def of(cls, rollout: Rollout) -> "EpisodeOutcome":
        """Leave out the trajectory."""
        chosen = rollout.sub_skills
        use = np.bincount(chosen).tolist(), int(np.count_nonzero(np.diff(chosen)))
        ended = rollout.diverged, rollout.fault
        return cls(rollout.seed, rollout.goal, rollout.success, rollout.score, len(rollout), *use, *ended)


class AdaptationOutcome(NamedTuple):
    """The episodes of an adaptation, and the sub-skills along the held-out demonstrations it did not adapt to."""

    episodes: list[EpisodeOutcome]
    use: list[SubSkillUse]
    device: str = "cpu"
    """What adapted, as rows name it."""


class ImitationErrors(NamedTuple):
    """The `imitation_error` of an adapted policy."""

    support: float
    """On what it was adapted to."""
    held_out: float | None
    """On the held-out demonstrations of the task that it was not adapted to, where there are any."""
    device: str = "cpu"
    """What adapted, as rows name it."""
