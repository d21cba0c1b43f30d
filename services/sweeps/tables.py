"""The table of a sweep beside the paper's, of those of its trials that are finished by now."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

from pydantic import BaseModel

from services.cli.composition import with_evaluation
from services.evaluation.comparison import Cell, CellKey, Comparison, Difference, SeedEvaluation, Unpaired
from services.evaluation.paper_results import figure
from services.evaluation.results import EvaluationFolder, Metric
from services.sweeps.folders import SweepFolder
from services.sweeps.settings import PlannedTrial


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
    preset: str
    began: str
    commit: str
    command: str
    by: Literal["variants", "suites"]
    rows: list[str]
    columns: list[str]
    cells: list[Cell]
    differences: list[Difference]
    unpaired: list[Unpaired]
    """Rows that are not compared with the baseline though both were run."""
    samples: list[Sample]
    """Of a search, the best first."""
    trials: dict[str, int]
    """How many there are, by what came of them."""
    failed: dict[str, str]
    """The error of each failed trial."""
    seconds: float
    """Of all finished trials, one after the other."""


def comparison_of(sweep: SweepFolder, baseline: str | None = None) -> Comparison:
    """Return a sweep's rows as they are put side by side, with `baseline` in place of the sweep's own."""
    settings = sweep.record.sweep
    named = baseline or settings.baseline or settings.row_names[0]
    comparison = Comparison(
        rows=settings.row_names,
        suites=suites_of(sweep),
        splits=settings.splits,
        shots=settings.shots,
        metric=settings.metric,
        by=settings.rows,
        baseline=None if settings.search else named,
        evaluations=list(_evaluations(sweep)),
        published={},
    )
    if settings.paper is None:
        return comparison
    figures = {key: found for key in comparison.keys if (found := figure(settings.paper, *key)) is not None}
    return replace(comparison, published=figures)


def suite_of(trial: PlannedTrial) -> str:
    """Return what a trial's suite is called: a part, which no figure of the paper's is of, where tasks are left out."""
    tasks = trial.config.suite
    return trial.suite if tasks.train_tasks is tasks.test_tasks is None else f"{trial.suite}-part"


def suites_of(sweep: SweepFolder) -> list[str]:
    """Return what the suites of a sweep are called, in its order."""
    return list(dict.fromkeys(suite_of(trial) for trial in sweep.trials.values()))


def _evaluations(sweep: SweepFolder) -> Iterator[SeedEvaluation]:
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        if result is None:
            continue
        for row, folder in result.evaluated.items():
            yield SeedEvaluation(
                measured=EvaluationFolder(sweep.runs / folder),
                row=row,
                suite=suite_of(trial),
                seed=trial.seed,
                name=name,
                config=with_evaluation(trial.config, trial.evaluations[row]),
                environment_steps=result.environment_steps,
                home=sweep.of_trial(name),
            )


def tables_of(sweep: SweepFolder, comparison: Comparison | None = None) -> Tables:
    """Work out what is shown of a sweep; `comparison` is what its rows are known to come to, if they are."""
    record, comparison = sweep.record, comparison or comparison_of(sweep)
    settings = record.sweep
    results = {name: sweep.result(name) for name in sweep.trials}
    statuses = [result.status if result else "not run" for result in results.values()]
    return Tables(
        name=record.name,
        what=settings.what,
        paper=settings.paper if any(cell.paper for cell in comparison.cells) else None,
        metric=settings.metric,
        preset=record.preset,
        began=f"{record.began:%Y-%m-%d %H:%M} UTC",
        commit=record.commit,
        command=record.command,
        by=settings.rows,
        rows=suites_of(sweep) if settings.rows == "suites" else settings.row_names,
        columns=list(dict.fromkeys(column_of(key, settings.rows) for key in comparison.keys)),
        cells=comparison.cells,
        differences=[pair for pair in comparison.pairs if isinstance(pair, Difference)],
        unpaired=[pair for pair in comparison.pairs if isinstance(pair, Unpaired)],
        samples=_samples(sweep),
        trials={status: statuses.count(status) for status in dict.fromkeys(statuses)},
        failed={name: str(result.error) for name, result in results.items() if result and result.status == "failed"},
        seconds=sum(result.seconds.get("total", 0.0) for result in results.values() if result),
    )


def column_of(key: CellKey | Cell, by: str) -> str:
    """Return the column of the table that a cell stands in."""
    first = key.row if by == "suites" else key.suite
    return f"{first}, {key.split}, {key.shots}-shot"


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
                suite=suite_of(trial),
                seed=trial.seed,
                status=result.status if result else "not run",
                iteration=result.iteration if result else 0,
                held_out=result.held_out if result else None,
                settings=settings[trial.variant],
            )
        )
    # One that was stopped early is behind all that went on, whatever it had by then.
    return sorted(samples, key=lambda sample: (-sample.iteration, -(sample.held_out or 0.0)))
