"""The actor that runs experts and adapted policies in the simulator."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from dmil_core.configs import DemonstrationConfig, EvaluationConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.errors import as_work_error
from dmil_core.methods.base import Method, Policy, Rollout
from dmil_core.networks import unflatten
from dmil_core.seeding import named_seed
from services.rollouts.adaptations import Adaptation, AdaptationOutcome, Imitation, imitate, try_out
from services.rollouts.episodes import collect_rollouts, demonstrate, episodes_beside
from services.rollouts.verification import VerificationRow, verify
from services.suites.base import Attempt, Environment, TaskSuite, build_env

ENVIRONMENTS_KEPT = 40
"""At most so many environments stay built in a worker, 24 MB each in Meta-World."""


class SimulationWorker:
    """Builds environments once and uses them again; an episode depends on its seed alone."""

    def __init__(self, suite: TaskSuite) -> None:
        """Simulate the tasks of `suite`."""
        torch.set_num_threads(1)
        self._suite = suite
        self._envs: dict[str, list[Environment]] = {}

    def _environments(self, task: str, count: int) -> list[Environment]:
        """Return at least `count` environments of a task; those of the tasks longest unused make room."""
        envs = self._envs.pop(task, [])
        while self._envs and max(count, len(envs)) + sum(map(len, self._envs.values())) > ENVIRONMENTS_KEPT:
            for env in self._envs.pop(next(iter(self._envs))):
                env.close()
        envs += [build_env(self._suite, task) for _ in range(count - len(envs))]
        self._envs[task] = envs
        return envs

    def attempts(self, task: str, numbers: Sequence[int], config: DemonstrationConfig) -> list[Attempt]:
        """Let the expert try, once for each of `numbers`, which name the attempts.

        Raises:
            WorkError: for a Python error in one of them.
        """
        (env, *_), expert = self._environments(task, 1), self._suite.expert(task)
        assert expert is not None
        steps, attempts = config.steps(task, self._suite.horizon), []
        for number in numbers:
            seed = named_seed(config.seed, "demonstration", task, number)
            with as_work_error(f"task {task}, attempt {number}, seed {seed}", task=task, attempt=number):
                attempts.append(demonstrate(expert, env, seed, steps, config))
        return attempts

    def verify(self, task: str, seeds: Sequence[int], noise: float) -> list[VerificationRow]:
        """Let the expert try once for each seed, see `services.rollouts.verification`.

        Raises:
            WorkError: for a Python error in one of them.
        """
        with as_work_error(f"task {task}, seeds {seeds[0]} to {seeds[-1]}", task=task, seed=seeds[0]):
            return verify(self._suite, task, seeds, noise)

    def collect_rollouts(self, policy: Policy, task: str, seed: int, steps: int) -> list[Rollout]:
        """Let a policy act in a task for so many steps, see `services.rollouts.episodes.collect_rollouts`."""
        envs = self._environments(task, episodes_beside(steps, self._suite.horizon))
        return collect_rollouts(policy, envs, seed, steps, self._suite.horizon)

    def try_out(
        self,
        method: Method,
        parameters: Float32[np.ndarray, " size"],
        shapes: Mapping[str, torch.Size],
        adaptation: Adaptation,
        held_out: Sequence[Demonstration],
        evaluation: EvaluationConfig,
        seed: int,
    ) -> AdaptationOutcome:
        """Adapt and roll out one adaptation.

        Raises:
            WorkError: for a Python error in it.
        """
        with as_work_error(f"{adaptation.in_words}, seed {seed}", **adaptation.piece):
            envs = self._environments(adaptation.task, len(adaptation.episodes))
            own = unflatten(torch.tensor(parameters), shapes)
            return try_out(method, own, adaptation, held_out, envs, self._suite.horizon, evaluation, seed)

    def imitate(
        self,
        method: Method,
        parameters: Float32[np.ndarray, " size"],
        shapes: Mapping[str, torch.Size],
        adaptation: Adaptation,
        held_out: Sequence[Demonstration],
        evaluation: EvaluationConfig,
        seed: int,
    ) -> Imitation:
        """Adapt as in one adaptation, and compare the policy with demonstrations; the arguments are those of `try_out`.

        Raises:
            WorkError: for a Python error in it.
        """
        with as_work_error(f"{adaptation.in_words}, seed {seed}", **adaptation.piece):
            return imitate(method, unflatten(torch.tensor(parameters), shapes), adaptation, held_out, evaluation)


def piece_of_call(method: str, arguments: Sequence[Any]) -> tuple[str, dict[str, str | int]]:
    """Return what names a call of a worker's method: in words, and as the piece of work that `WorkError` tells of."""
    if method == "attempts":
        task, numbers, _ = arguments
        return f"task {task}, attempts {numbers[0]} to {numbers[-1]}", {"task": task, "attempt": numbers[0]}
    if method == "verify":
        task, seeds, _ = arguments
        return f"task {task}, seeds {seeds[0]} to {seeds[-1]}", {"task": task, "seed": seeds[0]}
    adaptation: Adaptation = arguments[3]
    return adaptation.in_words, adaptation.piece
