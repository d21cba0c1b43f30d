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
from services.evaluation.results import EpisodeResult, EvaluationFolder, Metric
from services.evaluation.summary import sub_skill_use
from services.suites.base import Split
from services.tracking.history import read_metrics

Answer = Literal["yes, higher", "yes, lower", "not decided"]
DIGITS: Mapping[Metric, int] = {"success_rate": 3, "score": 2}
"""That a mean is shown to."""


class Place(NamedTuple):
    """What one cell is of."""

    row: str
    suite: str
    split: Split
    shots: int


class Tried(NamedTuple):
    """What one seed was tried on at a place, and what came of it."""

    protocol: str
    tasks: tuple[str, ...]
    """By name."""
    episodes: tuple[tuple[tuple[int, int, tuple[float, ...]], ...], ...]
    """By task: number, seed and goal of each."""
    outcomes: Float[np.ndarray, "tasks episodes"]
    """The success or the score of each."""


Outcomes = Mapping[int, Tried]
"""Of each seed."""


@dataclass(frozen=True)
class Contender(EvaluationFolder):
    """One seed of a row on a suite: a configuration that was trained, and an evaluation of it."""

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
    contenders: Sequence[Contender]
    published: Mapping[Place, Published]
    """The paper's figures."""

    @cached_property
    def places(self) -> list[Place]:
        """All, also those that nothing is known of."""
        return [Place(*of) for of in itertools.product(self.rows, self.suites, self.splits, self.shots)]

    @cached_property
    def outcomes(self) -> dict[Place, Outcomes]:
        """The outcome of each episode.

        Raises:
            UserError: if a row has not as many episodes of each task and seed.
        """
        found: dict[Place, dict[int, Tried]] = defaultdict(dict)
        for contender in self.contenders:
            groups: dict[tuple[Split, int], list[EpisodeResult]] = defaultdict(list)
            for episode in contender.episodes:
                groups[episode.split, episode.shots].append(episode)
            for (split, shots), group in groups.items():
                seeds = found[Place(contender.row, contender.suite, split, shots)]
                seeds[contender.seed] = own = _tried(group, self.metric, contender)
                if len({tried.outcomes.shape for tried in seeds.values()}) > 1:
                    raise _other_episodes(contender, own.outcomes.shape)
        return dict(found)

    @cached_property
    def cells(self) -> list[Cell]:
        """A mean for each place that something is known of."""
        return [self._cell(place) for place in self.places if place in self.outcomes]

    def _cell(self, place: Place) -> Cell:
        own = [found for found in self.contenders if (found.row, found.suite) == (place.row, place.suite)]
        adaptations = [row for found in own for row in found.adaptations if row.shots == place.shots]
        use = sub_skill_use(adaptations).get(place.split)
        steps = sum(found.environment_steps for found in own)
        in_use = use and use.in_use_per_task
        return cell(place, self.outcomes[place], in_use, self.published.get(place), self.metric, steps)

    @cached_property
    def pairs(self) -> list[Difference | Unpaired]:
        """Each row against the baseline, wherever there are both."""
        return [
            difference(place, self.baseline, self.outcomes[place], self.outcomes[place._replace(row=self.baseline)])
            for place in self.places
            if self.baseline is not None
            and place.row != self.baseline
            and {place, place._replace(row=self.baseline)} <= self.outcomes.keys()
        ]


def _tried(rows: Sequence[EpisodeResult], metric: Metric, contender: Contender) -> Tried:
    by_task: dict[str, list[EpisodeResult]] = defaultdict(list)
    for row in sorted(rows, key=lambda row: (row.task, row.episode)):
        by_task[row.task].append(row)
    counts = tuple(len(own) for own in by_task.values())
    if len(set(counts)) > 1:
        raise _other_episodes(contender, counts)
    values = [
        [float(row.success if metric == "success_rate" else row.score) for row in own] for own in by_task.values()
    ]
    episodes = tuple(tuple((row.episode, row.seed, row.goal) for row in own) for own in by_task.values())
    return Tried(rows[0].protocol, tuple(by_task), episodes, np.array(values))


def _other_episodes(contender: Contender, got: tuple[int, ...]) -> UserError:
    return UserError(
        f"{contender.folder}: got rows of {contender.row} with not as many episodes of each task and seed: "
        f"{', '.join(map(str, got))}; remove the folder, in a sweep also trials/{contender.name}/result.json, and "
        "evaluate again"
    )


def cell(
    place: Place,
    outcomes: Outcomes,
    in_use: float | None,
    paper: Published | None,
    metric: Metric,
    environment_steps: int = 0,
) -> Cell:
    """Return the mean of some outcomes with its interval, beside the paper's figure."""
    seeds = sorted(outcomes)
    values = np.stack([outcomes[seed].outcomes for seed in seeds])
    if len(seeds) > 1:
        found = stratified_bootstrap(values, named_rng(0, "table", *map(str, place)))
        kind = "bootstrap over seeds and episodes"
    elif metric == "success_rate":
        found, kind = success_rate((values > 0).ravel().tolist()), "Wilson"
    else:
        found, kind = mean_score(values.ravel().tolist()), "Student"
    mean, low, high = found.mean, *((None, None) if np.isnan(found.low) else (found.low, found.high))
    outside = None
    if paper is not None and low is not None and high is not None:
        outside = not low <= paper.value <= high and abs(mean - paper.value) > (paper.spread or 0.0)
    return Cell(
        **place._asdict(),
        seeds=seeds,
        tasks=values.shape[1],
        episodes=values.size,
        mean=mean,
        low=low,
        high=high,
        interquartile_mean=interquartile_mean(values.mean(2).ravel().tolist()),
        interval=kind,
        sub_skills_in_use=in_use,
        environment_steps=environment_steps,
        paper=paper,
        difference=None if paper is None else mean - paper.value,
        outside=outside,
    )


def difference(place: Place, baseline: str, outcomes: Outcomes, others: Outcomes) -> Difference | Unpaired:
    """Return how one row differs from another on the seeds and episodes that both have, or why nobody can tell."""
    seeds = sorted(outcomes.keys() & others.keys())
    pair = {**place._asdict(), "baseline": baseline}
    if not seeds:
        own, other = (" ".join(map(str, sorted(found))) for found in (outcomes, others))
        return Unpaired(**pair, why=f"they have no seed in common: {own} against {other}")
    for seed in seeds:
        if why := _what_differs(outcomes[seed], others[seed]):
            return Unpaired(**pair, why=why)
    values = np.stack([outcomes[seed].outcomes - others[seed].outcomes for seed in seeds])
    found = stratified_bootstrap(values, named_rng(0, "difference", *map(str, place)))
    differs: Answer = "yes, higher" if found.low > 0 else "yes, lower" if found.high < 0 else "not decided"
    return Difference(
        **pair, seeds=seeds, pairs=values.size, mean=found.mean, low=found.low, high=found.high, differs=differs
    )


def _what_differs(one: Tried, other: Tried) -> str | None:
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
