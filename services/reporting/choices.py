"""What the high level chooses at each step, along demonstrations and in rollouts, before and after adaptation."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from dmil_core.methods.base import Policy
from dmil_core.seeding import named_seed
from dmil_core.settings import sub_skills_of
from services.experiments.finished_run import FinishedRun
from services.reporting.run_group import RunGroup, has_sub_skills, policies
from services.rollouts.episodes import rollout
from services.suites.base import Environment, build_env

DEMONSTRATIONS, ROLLOUTS = "held-out demonstrations", "rollouts"


class Segment(NamedTuple):
    """Steps one after the other for which a sub-skill is kept."""

    start: int
    steps: int
    sub_skill: int


class TimelineStatistics(NamedTuple):
    """How sub-skills are used in some episodes, or along some demonstrations."""

    episodes: int
    steps: int
    """In all of them."""
    shares: Float64[np.ndarray, " sub_skills"]
    """Of all steps."""
    dwell: Float64[np.ndarray, " sub_skills"]
    """For how many steps a sub-skill is kept once it is taken, on average; NaN where it never is. The end of an
    episode ends it too."""
    switches: float
    """In an episode, on average."""
    transitions: Int64[np.ndarray, "sub_skills sub_skills"]
    """How often the sub-skill of a row is followed, at the next step, by that of a column."""

    @property
    def followed(self) -> Float64[np.ndarray, "sub_skills sub_skills"]:
        """The transitions as fractions of their row; NaN where nothing follows."""
        total = self.transitions.sum(1, keepdims=True)
        return np.divide(self.transitions, total, out=np.full(self.transitions.shape, np.nan), where=total > 0)


def segments(timeline: Int64[np.ndarray, " steps"]) -> list[Segment]:
    """Return the stretches of equal sub-skills of a timeline, in their order."""
    starts = np.flatnonzero(np.diff(timeline, prepend=-1))
    ends = np.append(starts[1:], len(timeline))
    return [
        Segment(start, end - start, int(timeline[start]))
        for start, end in zip(starts.tolist(), ends.tolist(), strict=False)
    ]


def statistics(timelines: Sequence[Int64[np.ndarray, " _"]], sub_skills: int) -> TimelineStatistics:
    """Return how sub-skills are used in episodes, none of which goes over into another.

    Each number of a timeline is at least 0 and below K, the number of `sub_skills`.
    """
    steps, kept = np.zeros(sub_skills, np.int64), np.zeros(sub_skills, np.int64)
    transitions = np.zeros((sub_skills, sub_skills), np.int64)
    for timeline in timelines:
        for segment in segments(timeline):
            steps[segment.sub_skill] += segment.steps
            kept[segment.sub_skill] += 1
        np.add.at(transitions, (timeline[:-1], timeline[1:]), 1)
    return TimelineStatistics(
        episodes=len(timelines),
        steps=int(steps.sum()),
        shares=steps / max(1, steps.sum()),
        dwell=np.divide(steps, kept, out=np.full(sub_skills, np.nan), where=kept > 0),
        switches=float(transitions.sum() - transitions.trace()) / max(1, len(timelines)),
        transitions=transitions,
    )


def describe_shares(shares: Float64[np.ndarray, " sub_skills"]) -> str:
    """Return the share of each sub-skill that is used at all."""
    return ", ".join(f"sub-skill {k} {share:.0%}" for k, share in enumerate(shares) if share)


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

    def statistics(self, on: str) -> TimelineStatistics:
        """Return the statistics of one kind of timelines."""
        return statistics([timeline.sub_skills for timeline in self.timelines[on]], self.sub_skills)


def choices_on(group: RunGroup, task: str, shots: int, rollouts: int) -> list[Choices]:
    """Return what each run that has sub-skills chooses on a task, before and after adaptation.

    Its rollouts are those of the run's own evaluation with the same support set.

    Raises:
        UserError: if no demonstration is left besides the support set.
    """
    support, others = group.shots(task, shots)
    suite, choices = group.experiment.suite, []
    with ExitStack() as open_envs:
        envs = [build_env(suite, task) for _ in range(rollouts)]
        for env in envs:
            open_envs.callback(env.close)
        for label, run in group.runs.items():
            if not has_sub_skills(run):
                continue
            for adaptation, policy in policies(run, support).items():
                along = [Timeline(other.id, policy.sub_skill_use(other).chosen) for other in others]
                acted = _acted(policy, run, task, envs, suite.horizon)
                timelines = {DEMONSTRATIONS: along, ROLLOUTS: acted}
                choices.append(Choices(label, adaptation, sub_skills_of(run.config.method), timelines))
    return choices


def _acted(policy: Policy, run: FinishedRun, task: str, envs: Sequence[Environment], horizon: int) -> list[Timeline]:
    """Let a policy act in the episodes of the evaluation's first support set."""
    if not envs:
        return []
    numbers = [run.config.evaluation.support_draws * index for index in range(len(envs))]
    seeds = [named_seed(run.config.seed, "evaluation", task, number) for number in numbers]
    rollouts = rollout(policy, envs, seeds, horizon)
    if any(episode.diverged for episode in rollouts):
        return []
    return [
        Timeline(f"{number}{' solved' if episode.success else ''}", episode.sub_skills)
        for number, episode in zip(numbers, rollouts, strict=True)
    ]
