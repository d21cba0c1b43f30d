"""The table of a sweep beside the paper's: means with intervals over seeds and episodes, and paired differences.

A mean over several seeds has the interval of a stratified bootstrap over seeds, then episodes; over one seed Wilson's,
or Student's for scores. The paper's figure is *outside* where it lies outside our interval and our mean outside its
spread. Rows are compared on the same seeds and the same episodes.
"""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from dmil_core.seeding import stream
from dmil_core.statistics import Interval, interquartile_mean, mean_score, stratified_bootstrap, success_rate
from services.published import Published, figure
from services.results import AdaptationResult, EpisodeResult, Split, read_rows
from services.summary import sub_skill_use
from services.sweeps.folders import SweepError, SweepFolder
from services.sweeps.settings import Metric

__all__ = ["Cell", "Difference", "Place", "Sample", "Tables", "column_of", "outcomes_of", "tables_of"]

Answer = Literal["yes, higher", "yes, lower", "not decided"]


class Place(NamedTuple):
    """What one cell is of."""

    row: str
    suite: str
    split: Split
    shots: int


Outcomes = Mapping[int, Float[np.ndarray, "tasks episodes"]]
"""Of each seed: the success or the score of each episode."""


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


class Difference(BaseModel):
    """One row against another, episode by episode."""

    row: str
    baseline: str
    suite: str
    split: Split
    shots: int
    seeds: list[int]
    pairs: int
    """Of episodes."""
    mean: float
    low: float
    high: float
    differs: Answer
    """Whether the interval leaves out zero."""


class Sample(BaseModel):
    """One sample of a search."""

    sample: str
    suite: str
    seed: int
    status: str
    iteration: int
    held_out: float | None
    settings: dict[str, dict[str, object]]


class Tables(BaseModel):
    """``tables.json``: all that is shown of a sweep."""

    name: str
    what: str
    paper: str | None
    metric: Metric
    size: str
    began: str
    commit: str
    command: str
    by: Literal["variants", "suites"]
    rows: list[str]
    columns: list[str]
    cells: list[Cell]
    differences: list[Difference]
    samples: list[Sample]
    """Of a search, the best first."""
    trials: dict[str, int]
    """How many there are, by what came of them."""
    failed: dict[str, str]
    """The error of each failed trial."""
    seconds: float
    """Of all finished trials, one after the other."""


def outcomes_of(sweep: SweepFolder) -> dict[Place, Outcomes]:
    """Return the outcome of each episode of all finished trials.

    Raises:
        SweepError: if a trial has not as many episodes of each task as the others.
    """
    metric = sweep.record.sweep.metric
    found: dict[Place, dict[int, np.ndarray]] = defaultdict(dict)
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        for row, folder in (result.evaluated if result else {}).items():
            rows = read_rows(sweep.runs / folder / "episodes.jsonl", EpisodeResult)
            for (split, shots), group in _grouped(rows).items():
                by_task: dict[str, dict[int, float]] = defaultdict(dict)
                for episode in group:
                    by_task[episode.task][episode.episode] = float(
                        episode.success if metric == "success_rate" else episode.score
                    )
                table = [[own[number] for number in sorted(own)] for _, own in sorted(by_task.items())]
                if len({len(own) for own in table}) > 1:
                    raise _other_episodes(sweep, row)
                found[Place(row, trial.suite, split, shots)][trial.seed] = np.array(table)
    for place, seeds in found.items():
        if len({outcomes.shape for outcomes in seeds.values()}) > 1:
            raise _other_episodes(sweep, place.row)
    return dict(found)


def _other_episodes(sweep: SweepFolder, row: str) -> SweepError:
    return SweepError(
        f"{sweep.path}: got rows of {row} with not as many episodes of each task and seed; remove its folders named in "
        "trials/*/result.json, and start the sweep again"
    )


def _in_use(sweep: SweepFolder) -> dict[Place, float | None]:
    """Return how many sub-skills are in use per task in all finished trials."""
    found: dict[Place, list[AdaptationResult]] = defaultdict(list)
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        for row, folder in (result.evaluated if result else {}).items():
            for adaptation in read_rows(sweep.runs / folder / "adaptations.jsonl", AdaptationResult):
                found[Place(row, trial.suite, adaptation.split, adaptation.shots)].append(adaptation)
    use = {place: sub_skill_use(rows).get(place.split) for place, rows in found.items()}
    return {place: own and own.in_use_per_task for place, own in use.items()}


def _environment_steps(sweep: SweepFolder) -> Counter[tuple[str, str]]:
    """Return the environment steps of all finished trials, by row and suite."""
    found: Counter[tuple[str, str]] = Counter()
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        for row in result.evaluated if result else ():
            found[row, trial.suite] += result.environment_steps if result else 0
    return found


def _grouped(rows: Iterable[EpisodeResult]) -> dict[tuple[Split, int], list[EpisodeResult]]:
    groups: dict[tuple[Split, int], list[EpisodeResult]] = defaultdict(list)
    for row in rows:
        groups[row.split, row.shots].append(row)
    return groups


def cell(
    place: Place,
    outcomes: Outcomes,
    in_use: float | None,
    table: str | None,
    metric: Metric,
    environment_steps: int = 0,
) -> Cell:
    """Return the mean of some outcomes with its interval, and the paper's figure."""
    seeds = sorted(outcomes)
    values = np.stack([outcomes[seed] for seed in seeds])
    low: float | None
    high: float | None
    if len(seeds) > 1:
        mean, low, high = stratified_bootstrap(values, stream(0, "table", *map(str, place)))
        kind = "bootstrap over seeds and episodes"
    elif metric == "success_rate":
        rate, kind = success_rate((values > 0).ravel().tolist()), "Wilson"
        mean, low, high = rate.rate, rate.low, rate.high
    else:
        score, kind = mean_score(values.ravel().tolist()), "Student"
        mean, low, high = score.mean, score.low, score.high
    paper = None if table is None else figure(table, place.row, place.suite, place.split, place.shots)
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


def difference(place: Place, baseline: str, outcomes: Outcomes, others: Outcomes) -> Difference | None:
    """Return how one row differs from another on the seeds that both have, if there are any."""
    seeds = sorted(outcomes.keys() & others.keys())
    if not seeds or outcomes[seeds[0]].shape != others[seeds[0]].shape:
        return None
    values = np.stack([outcomes[seed] - others[seed] for seed in seeds])
    found: Interval = stratified_bootstrap(values, stream(0, "difference", *map(str, place)))
    differs: Answer = "yes, higher" if found.low > 0 else "yes, lower" if found.high < 0 else "not decided"
    return Difference(
        **place._asdict(), baseline=baseline, seeds=seeds, pairs=values.size, **found._asdict(), differs=differs
    )


def tables_of(sweep: SweepFolder) -> Tables:
    """Work out what is shown of a sweep, of those of its trials that are finished by now."""
    record = sweep.record
    settings, outcomes = record.sweep, outcomes_of(sweep)
    rows, baseline = settings.row_names, settings.baseline or settings.row_names[0]
    places = [
        Place(row, suite, split, shots)
        for row in rows
        for suite, split, shots in itertools.product(settings.suites, settings.splits, settings.shots)
    ]
    differences = [
        difference(place, baseline, outcomes[place], outcomes[place._replace(row=baseline)])
        for place in places
        if place.row != baseline and place in outcomes and place._replace(row=baseline) in outcomes
    ]
    in_use, practised, results = (
        _in_use(sweep),
        _environment_steps(sweep),
        {name: sweep.result(name) for name in sweep.trials},
    )
    statuses = [result.status if result else "not run" for result in results.values()]
    return Tables(
        name=record.name,
        what=settings.what,
        paper=settings.paper,
        metric=settings.metric,
        size=record.size,
        began=f"{record.began:%Y-%m-%d %H:%M} UTC",
        commit=record.commit,
        command=record.command,
        by=settings.rows,
        rows=list(settings.suites) if settings.rows == "suites" else rows,
        columns=list(dict.fromkeys(column_of(place, settings.rows) for place in places)),
        cells=[
            cell(
                place,
                outcomes[place],
                in_use[place],
                settings.paper,
                settings.metric,
                practised[place.row, place.suite],
            )
            for place in places
            if place in outcomes
        ],
        differences=[found for found in differences if found is not None] if not settings.search else [],
        samples=_samples(sweep),
        trials={status: statuses.count(status) for status in dict.fromkeys(statuses)},
        failed={name: str(result.error) for name, result in results.items() if result and result.status == "failed"},
        seconds=sum(result.seconds.get("total", 0.0) for result in results.values() if result),
    )


def column_of(place: Place | Cell, by: str) -> str:
    """Return the column of the table that a cell stands in."""
    first = place.row if by == "suites" else place.suite
    return f"{first}, {place.split}, {place.shots}-shot"


def _samples(sweep: SweepFolder) -> list[Sample]:
    search = sweep.record.sweep.search
    if search is None:
        return []
    settings, samples = search.variants(), []
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        samples.append(
            Sample(
                sample=trial.variant,
                suite=trial.suite,
                seed=trial.seed,
                status=result.status if result else "not run",
                iteration=result.iteration if result else 0,
                held_out=result.held_out if result else None,
                settings=settings[trial.variant],
            )
        )
    # One that was stopped early is behind all that went on, whatever it had by then.
    return sorted(samples, key=lambda sample: (-sample.iteration, -(sample.held_out or 0.0)))
