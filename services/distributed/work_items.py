"""The kinds of simulation: attempts of experts, and adaptations of checkpoints."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32

from dmil_core.configs import DemonstrationConfig, EvaluationConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.devices import adapted_on, describe
from dmil_core.errors import as_work_error
from dmil_core.methods.base import Method, Policy
from dmil_core.networks import unflatten
from dmil_core.seeding import named_seed
from dmil_core.trajectories import Episode
from services.distributed.simulation_worker import SimulationWorker
from services.rollouts.adaptations import (
    Adaptation,
    AdaptationOutcome,
    EpisodeOutcome,
    ImitationErrors,
    imitation_error,
)
from services.rollouts.episodes import demonstrate, rollout
from services.rollouts.verification import VerificationRow, verify


@dataclass(frozen=True)
class ExpertAttempts:
    """Attempts of a task's expert, one for each of `numbers`."""

    task: str
    numbers: Sequence[int]
    config: DemonstrationConfig

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"task {self.task}, attempts {self.numbers[0]} to {self.numbers[-1]}"

    @property
    def key(self) -> dict[str, str | int]:
        """The first of its attempts, which identifies it in ``failure.json``."""
        return {"task": self.task, "attempt": self.numbers[0]}

    def run(self, worker: SimulationWorker) -> list[Episode]:
        """Return the attempts.

        Raises:
            WorkError: names the attempt in which there was a Python error.
        """
        (env, *_), expert = worker.environments(self.task, 1), worker.suite.expert(self.task)
        assert expert is not None
        steps, attempts = self.config.steps(self.task, worker.suite.horizon), []
        for number in self.numbers:
            seed = named_seed(self.config.seed, "demonstration", self.task, number)
            with as_work_error(f"task {self.task}, attempt {number}, seed {seed}", task=self.task, attempt=number):
                attempts.append(demonstrate(expert, env, seed, steps, self.config))
        return attempts


@dataclass(frozen=True)
class Verification:
    """One attempt of a task's expert for each seed, see `services.rollouts.verification`."""

    task: str
    seeds: Sequence[int]
    noise: float

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"task {self.task}, seeds {self.seeds[0]} to {self.seeds[-1]}"

    @property
    def key(self) -> dict[str, str | int]:
        """The first of its seeds, which identifies it in ``failure.json``."""
        return {"task": self.task, "seed": self.seeds[0]}

    def run(self, worker: SimulationWorker) -> list[VerificationRow]:
        """Return a row for each attempt."""
        return verify(worker.suite, self.task, self.seeds, self.noise)


@dataclass(frozen=True)
class AdaptationItem:
    """An adaptation, with what it starts from; the subclasses judge the adapted policy."""

    method: Method
    shapes: Mapping[str, torch.Size]
    """Names and shapes of the parameters, in the order in which they are laid out flat."""
    flat_parameters: Callable[[], Float32[np.ndarray, " size"]]
    """As `Runner.share` returns them."""
    adaptation: Adaptation
    held_out: Callable[[], Sequence[Demonstration]]
    """Demonstrations of the task that support sets are drawn from, as `Runner.share` returns them."""
    evaluation: EvaluationConfig
    seed: int
    """Of the experiment."""

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"{self.adaptation.label}, seed {self.seed}"

    @property
    def key(self) -> dict[str, str | int]:
        """What identifies it in ``failure.json``."""
        return self.adaptation.key

    def adapted(self, worker: SimulationWorker) -> "Adapted":
        """Adapt a copy of the parameters on the worker's device; the policy acts on the CPU."""
        device, held_out = worker.device_for(self.method), self.held_out()
        support = self.adaptation.support(held_out)
        parameters = unflatten(torch.tensor(self.flat_parameters()), self.shapes)
        policy = adapted_on(device, self.method, parameters, support, self.evaluation.fine_tuning)
        others = [demonstration for demonstration in held_out if demonstration not in support]
        return Adapted(policy, support, others, describe(device))


class Adapted(NamedTuple):
    """What came of an adaptation."""

    policy: Policy
    support: Sequence[Demonstration]
    others: Sequence[Demonstration]
    """The held-out demonstrations of the task that it was not adapted to."""
    device: str
    """What adapted, as rows name it."""


class AdaptationRollouts(AdaptationItem):
    """Judges an adapted policy by episodes."""

    def run(self, worker: SimulationWorker) -> AdaptationOutcome:
        """Adapt, and run the episodes.

        An episode is named by the experiment's seed, the task and its own number, so that all shots and methods meet
        the same episodes.
        """
        task, numbers = self.adaptation.task, self.adaptation.episodes
        envs, adapted = worker.environments(task, len(numbers)), self.adapted(worker)
        seeds = [named_seed(self.seed, "evaluation", task, number) for number in numbers]
        episodes = [EpisodeOutcome.of(one) for one in rollout(adapted.policy, envs, seeds, worker.suite.horizon)]
        return AdaptationOutcome(episodes, list(map(adapted.policy.sub_skill_use, adapted.others)), adapted.device)


class AdaptationImitation(AdaptationItem):
    """Judges an adapted policy by its distance from demonstrations."""

    def run(self, worker: SimulationWorker) -> ImitationErrors:
        """Adapt, and compare the policy with demonstrations; nothing is simulated."""
        policy, support, others, device = self.adapted(worker)
        of_others = imitation_error(policy, others) if others else None
        return ImitationErrors(imitation_error(policy, support), of_others, device)
