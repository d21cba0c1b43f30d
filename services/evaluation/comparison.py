"""Rows side by side: means with intervals over seeds and episodes, and paired differences.

A sweep's rows and a few runs become the same `Comparison`. A mean over several seeds has the interval of a stratified
bootstrap over seeds, then episodes; over one seed Wilson's, or Student's for scores. The paper's figure is *outside*
where it lies outside our interval and our mean outside its spread. Rows are compared on the same seeds and the same
episodes, and not at all where these are others.
"""

import itertools
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from dmil_core.configs import ExperimentConfig
from dmil_core.errors import UserError
from dmil_core.seeding import named_rng
from dmil_core.statistics import interquartile_mean, mean_score, stratified_bootstrap, success_rate
from services.evaluation.paper_results import Published
from services.evaluation.results import EpisodeResult, EvaluationFolder, Metric, grouped
from services.evaluation.summary import sub_skill_shares
from services.suites.base import Split
from services.tracking.history import read_metrics

Answer = Literal["yes, higher", "yes, lower", "not decided"]
DIGITS: Mapping[Metric, int] = {"success_rate": 3, "score": 2}
"""That a mean is shown to."""


class CellKey(NamedTuple):
    """What identifies a cell."""

    row: str
    suite: str
    split: Split
    shots: int


class SeedOutcomes(NamedTuple):
    """The episodes of one seed in a cell, and their outcomes."""

    protocol: str
    tasks: tuple[str, ...]
    """By name."""
    episodes: tuple[tuple[tuple[int, int, tuple[float, ...]], ...], ...]
    """By task: number, seed and goal of each."""
    outcomes: Float[np.ndarray, "tasks episodes"]
    """The success or the score of each."""


Outcomes = Mapping[int, SeedOutcomes]
"""Of each seed."""


@dataclass(frozen=True)
class SeedEvaluation:
    """One seed of a row on a suite: a configuration that was trained, and an evaluation of it."""

    measured: EvaluationFolder
    """What was evaluated."""
    row: str
    suite: str
    seed: int
    name: str
    """Of the run or trial."""
    config: ExperimentConfig
    environment_steps: int
    """That meta-training took."""
    home: Path
    """Folder of what was measured on the way, ``tracking.jsonl``."""

    @cached_property
    def metrics(self) -> list[dict[str, float]]:
        """Those of each iteration."""
        return read_metrics(self.home)


class Cell(BaseModel):
    """One mean of the table."""

    row: str
    suite: str
    split: Split
    shots: int
    seeds: list[int]
    tasks: int
    episodes: int
    """Of all seeds and tasks."""
    mean: float
    low: float | None
    high: float | None
    interquartile_mean: float
    """Over the rates of each task and seed."""
    interval: Literal["bootstrap over seeds and episodes", "Wilson", "Student"]
    sub_skills_in_use: float | None
    """Those with over a tenth of a task's states after adaptation, on average over adaptations; none of a method
    without sub-skills."""
    environment_steps: int
    """That meta-training took, of all seeds together."""
    paper: Published | None
    difference: float | None
    """From the paper's figure."""
    outside: bool | None
    """Whether the two differ by more than either's spread; unknown where there is no interval."""


class _Pair(BaseModel):
    row: str
    baseline: str
    suite: str
    split: Split
    shots: int


class Difference(_Pair):
    """One row against another, episode by episode."""

    seeds: list[int]
    pairs: int
    """Of episodes."""
    mean: float
    low: float
    high: float
    differs: Answer
    """Whether the interval leaves out zero."""


class Unpaired(_Pair):
    """Two rows that cannot be compared episode by episode."""

    why: str


@dataclass(frozen=True)
class Comparison:
    """What is put side by side."""

    rows: Sequence[str]
    suites: Sequence[str]
    splits: Sequence[Split]
    shots: Sequence[int]
    metric: Metric
    by: Literal["variants", "suites"]
    """What the table has in its rows; suites are then those of one benchmark."""
    baseline: str | None
    """The row that the others are compared with, if any is."""
    evaluations: Sequence[SeedEvaluation]
    published: Mapping[CellKey, Published]
    """The paper's figures."""

    @cached_property
    def keys(self) -> list[CellKey]:
        """Those of all cells, also of cells without episodes."""
        return [CellKey(*of) for of in itertools.product(self.rows, self.suites, self.splits, self.shots)]

    @cached_property
    def outcomes(self) -> dict[CellKey, Outcomes]:
        """The outcome of each episode.

        Raises:
            UserError: if a row has not as many episodes of each task and seed.
        """
        outcomes: dict[CellKey, dict[int, SeedOutcomes]] = defaultdict(dict)
        for evaluation in self.evaluations:
            groups = grouped(evaluation.measured.episodes, lambda episode: (episode.split, episode.shots))
            for (split, shots), group in groups.items():
                seeds = outcomes[CellKey(evaluation.row, evaluation.suite, split, shots)]
                seeds[evaluation.seed] = outcome = _seed_outcomes(group, self.metric, evaluation)
                if len({of_seed.outcomes.shape for of_seed in seeds.values()}) > 1:
                    raise _other_episodes(evaluation, outcome.outcomes.shape)
        return dict(outcomes)

    @cached_property
    def cells(self) -> list[Cell]:
        """The mean of each cell that has episodes."""
        return [self._cell(key) for key in self.keys if key in self.outcomes]

    def _cell(self, key: CellKey) -> Cell:
        """Return the mean of a cell's outcomes with its interval, beside the paper's figure."""
        outcomes, paper = self.outcomes[key], self.published.get(key)
        evaluations = [of for of in self.evaluations if (of.row, of.suite) == (key.row, key.suite)]
        use = sub_skill_shares([row for of in evaluations for row in of.measured.adaptations if row.shots == key.shots])
        seeds = sorted(outcomes)
        values = np.stack([outcomes[seed].outcomes for seed in seeds])
        if len(seeds) > 1:
            estimate = stratified_bootstrap(values, named_rng(0, "table", *map(str, key)))
            kind = "bootstrap over seeds and episodes"
        elif self.metric == "success_rate":
            estimate, kind = success_rate((values > 0).ravel().tolist()), "Wilson"
        else:
            estimate, kind = mean_score(values.ravel().tolist()), "Student"
        mean, low, high = estimate.mean, *((None, None) if np.isnan(estimate.low) else (estimate.low, estimate.high))
        outside = None
        if paper is not None and low is not None and high is not None:
            outside = not low <= paper.value <= high and abs(mean - paper.value) > (paper.spread or 0.0)
        return Cell(
            **key._asdict(),
            seeds=seeds,
            tasks=values.shape[1],
            episodes=values.size,
            mean=mean,
            low=low,
            high=high,
            interquartile_mean=interquartile_mean(values.mean(2).ravel().tolist()),
            interval=kind,
            sub_skills_in_use=use[key.split].in_use_per_task if key.split in use else None,
            environment_steps=sum(of.environment_steps for of in evaluations),
            paper=paper,
            difference=None if paper is None else mean - paper.value,
            outside=outside,
        )

    @cached_property
    def pairs(self) -> list[Difference | Unpaired]:
        """Each row against the baseline, wherever there are both."""
        return [
            difference(key, self.baseline, self.outcomes[key], self.outcomes[key._replace(row=self.baseline)])
            for key in self.keys
            if self.baseline is not None
            and key.row != self.baseline
            and {key, key._replace(row=self.baseline)} <= self.outcomes.keys()
        ]


def _seed_outcomes(rows: Sequence[EpisodeResult], metric: Metric, evaluation: SeedEvaluation) -> SeedOutcomes:
    by_task = grouped(sorted(rows, key=lambda row: (row.task, row.episode)), lambda row: row.task)
    counts = tuple(len(of_task) for of_task in by_task.values())
    if len(set(counts)) > 1:
        raise _other_episodes(evaluation, counts)
    tasks = by_task.values()
    values = [[float(row.success if metric == "success_rate" else row.score) for row in task] for task in tasks]
    episodes = tuple(tuple((row.episode, row.seed, row.goal) for row in task) for task in tasks)
    return SeedOutcomes(rows[0].protocol, tuple(by_task), episodes, np.array(values))


def _other_episodes(evaluation: SeedEvaluation, got: tuple[int, ...]) -> UserError:
    return UserError(
        f"{evaluation.measured.folder}: got rows of {evaluation.row} with not as many episodes of each task and seed: "
        f"{', '.join(map(str, got))}; remove the folder, in a sweep also trials/{evaluation.name}/result.json, and "
        "evaluate again"
    )


def difference(key: CellKey, baseline: str, outcomes: Outcomes, others: Outcomes) -> Difference | Unpaired:
    """Return how one row differs from another on the seeds and episodes that both have, or why it is not known."""
    seeds = sorted(outcomes.keys() & others.keys())
    pair = {**key._asdict(), "baseline": baseline}
    if not seeds:
        left, right = (" ".join(map(str, sorted(of))) for of in (outcomes, others))
        return Unpaired(**pair, why=f"they have no seed in common: {left} against {right}")
    for seed in seeds:
        if why := _what_differs(outcomes[seed], others[seed]):
            return Unpaired(**pair, why=why)
    values = np.stack([outcomes[seed].outcomes - others[seed].outcomes for seed in seeds])
    mean, low, high, *_ = stratified_bootstrap(values, named_rng(0, "difference", *map(str, key)))
    differs: Answer = "yes, higher" if low > 0 else "yes, lower" if high < 0 else "not decided"
    return Difference(**pair, seeds=seeds, pairs=values.size, mean=mean, low=low, high=high, differs=differs)


def _what_differs(one: SeedOutcomes, other: SeedOutcomes) -> str | None:
    """Return in words what keeps the episodes of one seed from being the same ones."""
    if one.protocol != other.protocol:
        return f"their protocols differ: {one.protocol}, against {other.protocol}"
    if one.tasks != other.tasks:
        left, right = (
            ", ".join(sorted(tasks)) for tasks in ({*one.tasks} - {*other.tasks}, {*other.tasks} - {*one.tasks})
        )
        return f"their tasks differ: {left or 'none'} in the one alone, {right or 'none'} in the other"
    if one.outcomes.shape != other.outcomes.shape:
        return f"they have {one.outcomes.shape[1]} against {other.outcomes.shape[1]} episodes of each task"
    if one.episodes != other.episodes:
        return "their episodes are others: they begin from other seeds, or with other goals"
    return None
