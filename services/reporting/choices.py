"""What the high level chooses at each step, along demonstrations and in rollouts, before and after adaptation."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from dmil_core.methods.base import Policy
from dmil_core.seeding import named_seed
from dmil_core.settings import sub_skills_of
from services.experiments.finished_run import FinishedRun
from services.reporting.lineup import Lineup, has_sub_skills, policies
from services.reporting.usage import Usage, usage
from services.rollouts.episodes import rollout
from services.suites.base import Environment, build_env

DEMONSTRATIONS, ROLLOUTS = "held-out demonstrations", "rollouts"


class Timeline(NamedTuple):
    """The sub-skill at each step of a demonstration or an episode."""

    name: str
    sub_skills: Int64[np.ndarray, " steps"]


class Choices(NamedTuple):
    """What the high level of a policy chooses on a task."""

    run: str
    adaptation: str
    sub_skills: int
    """K."""
    timelines: Mapping[str, Sequence[Timeline]]
    """Along held-out demonstrations, and in rollouts; a policy that has diverged has none of these."""

    def usage(self, on: str) -> Usage:
        """Return the statistics of one kind of timelines."""
        return usage([timeline.sub_skills for timeline in self.timelines[on]], self.sub_skills)


def choices_on(lineup: Lineup, task: str, shots: int, rollouts: int) -> list[Choices]:
    """Return what each run that has sub-skills chooses on a task, before and after adaptation.

    Args:
        lineup: the runs.
        task: one of those that are shown.
        shots: demonstrations to adapt to.
        rollouts: episodes to run, those of the run's own evaluation with the same support set.

    Raises:
        UserError: if no demonstration is left to look at.
    """
    support, others = lineup.shots(task, shots)
    suite, found = lineup.experiment.suite, []
    with ExitStack() as open_envs:
        envs = [build_env(suite, task) for _ in range(rollouts)]
        for env in envs:
            open_envs.callback(env.close)
        for label, run in lineup.runs.items():
            if not has_sub_skills(run):
                continue
            for adaptation, policy in policies(run, support).items():
                along = [Timeline(other.id, policy.sub_skill_use(other).chosen) for other in others]
                acted = _acted(policy, run, task, envs, suite.horizon)
                timelines = {DEMONSTRATIONS: along, ROLLOUTS: acted}
                found.append(Choices(label, adaptation, sub_skills_of(run.config.method), timelines))
    return found


def _acted(policy: Policy, run: FinishedRun, task: str, envs: Sequence[Environment], horizon: int) -> list[Timeline]:
    """Let a policy act in the episodes of the evaluation's first support set."""
    if not envs:
        return []
    numbers = [run.config.evaluation.support_draws * place for place in range(len(envs))]
    seeds = [named_seed(run.config.seed, "evaluation", task, number) for number in numbers]
    rollouts = rollout(policy, envs, seeds, horizon)
    if any(episode.diverged for episode in rollouts):
        return []
    return [
        Timeline(f"{number}{' solved' if episode.success else ''}", episode.sub_skills)
        for number, episode in zip(numbers, rollouts, strict=True)
    ]
