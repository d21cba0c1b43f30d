"""The table of a sweep beside the paper's: means with intervals over seeds and episodes, and paired differences.

A mean over several seeds has the interval of a stratified bootstrap over seeds, then episodes; over one seed Wilson's,
or Student's for scores. The paper's figure is *outside* where it lies outside our interval and our mean outside its
spread. Rows are compared on the same seeds and the same episodes.
"""

import csv
import io
import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import matplotlib
import numpy as np
import tyro
import yaml
from jaxtyping import Float
from pydantic import BaseModel

from dmil_core.seeding import stream
from dmil_core.statistics import Interval, interquartile_mean, mean_score, stratified_bootstrap, success_rate
from services.command_line import parse
from services.disk import write_file
from services.folders import find_folder
from services.progress import console
from services.published import Published, figure
from services.results import AdaptationResult, EpisodeResult, Split, read_rows
from services.summary import sub_skill_use
from services.sweeps.folders import MARK, SweepError, SweepFolder
from services.sweeps.settings import Metric
from services.tracking import Tracker

matplotlib.use("Agg")
from matplotlib import pyplot  # after the choice of the backend
from rich.table import Table

__all__ = ["Cell", "Difference", "Tables", "outcomes_of", "publish", "run", "show", "tables_of", "write_tables"]

DIGITS = {"success_rate": 3, "score": 2}
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
    sub_skills_in_use: float
    """Those with over a tenth of a task's states after adaptation, on average over adaptations."""
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


def _in_use(sweep: SweepFolder) -> dict[Place, float]:
    """Return how many sub-skills are in use per task in all finished trials."""
    found: dict[Place, list[AdaptationResult]] = defaultdict(list)
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        for row, folder in (result.evaluated if result else {}).items():
            for adaptation in read_rows(sweep.runs / folder / "adaptations.jsonl", AdaptationResult):
                found[Place(row, trial.suite, adaptation.split, adaptation.shots)].append(adaptation)
    return {place: sub_skill_use(rows)[place.split].in_use_per_task for place, rows in found.items()}


def _grouped(rows: Iterable[EpisodeResult]) -> dict[tuple[Split, int], list[EpisodeResult]]:
    groups: dict[tuple[Split, int], list[EpisodeResult]] = defaultdict(list)
    for row in rows:
        groups[row.split, row.shots].append(row)
    return groups


def cell(place: Place, outcomes: Outcomes, in_use: float, table: str | None, metric: Metric) -> Cell:
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
    in_use, results = _in_use(sweep), {name: sweep.result(name) for name in sweep.trials}
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
        columns=list(dict.fromkeys(_column(place, settings.rows) for place in places)),
        cells=[
            cell(place, outcomes[place], in_use[place], settings.paper, settings.metric)
            for place in places
            if place in outcomes
        ],
        differences=[found for found in differences if found is not None] if not settings.search else [],
        samples=_samples(sweep),
        trials={status: statuses.count(status) for status in dict.fromkeys(statuses)},
        failed={name: str(result.error) for name, result in results.items() if result and result.status == "failed"},
        seconds=sum(result.seconds.get("total", 0.0) for result in results.values() if result),
    )


def _column(place: Place | Cell, by: str) -> str:
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


# Showing them


def _grid(tables: Tables) -> dict[str, dict[str, Cell]]:
    grid: dict[str, dict[str, Cell]] = {row: {} for row in tables.rows}
    for found in tables.cells:
        grid[found.suite if tables.by == "suites" else found.row][_column(found, tables.by)] = found
    return grid


def _lines(found: Cell | None, digits: int) -> list[str]:
    """Return a cell's lines: none if it was not run."""
    if found is None:
        return []
    interval = "" if found.low is None else f" ({found.low:.{digits}f} to {found.high:.{digits}f})"
    lines = [f"{found.mean:.{digits}f}{interval}"]
    if found.paper is not None:
        mark = " outside" if found.outside else ""
        lines.append(f"paper {found.paper.in_words(digits)}: {found.difference:+.{digits}f}{mark}")
    lines.append(f"{found.sub_skills_in_use:.1f} sub-skills in use")
    plural = "seed" if len(found.seeds) == 1 else "seeds"
    return [*lines, f"{len(found.seeds)} {plural}, {found.episodes} episodes"]


def _head(tables: Tables) -> str:
    trials = ", ".join(f"{count} {status}" for status, count in tables.trials.items())
    against = f"; beside it {tables.paper.replace('table', 'Table ')} of the paper" if tables.paper else ""
    return f"{tables.what}: {tables.metric.replace('_', ' ')} at scale {tables.size}{against} (trials: {trials})"


def show(tables: Tables, sweep: SweepFolder) -> None:
    """Print the table, the differences, what failed, and where all of it is written."""
    digits = DIGITS[tables.metric]
    if tables.samples:
        console.print(_samples_view(tables))
    else:
        grid = _grid(tables)
        view = Table(
            "", *[column.replace(", ", "\n") for column in tables.columns], title=_head(tables), show_lines=True
        )
        for row in tables.rows:
            view.add_row(row, *["\n".join(_lines(grid[row].get(column), digits)) for column in tables.columns])
        console.print(view)
    if tables.differences:
        view = Table("row", "against", "where", "difference", "95% interval", "pairs", "seeds", "differs?")
        for found in tables.differences:
            view.add_row(*_difference_fields(found, digits))
        console.print(view)
    for name, error in tables.failed.items():
        console.print(f"failed: {name}: {error}", markup=False)
    console.print(f"tables: {sweep.path / 'tables'}")


def _samples_view(tables: Tables) -> Table:
    view = Table("sample", "suite", "seed", "status", "iterations", "held out", "settings", title=_head(tables))
    for sample in tables.samples:
        view.add_row(*_sample_fields(sample))
    return view


def _sample_fields(sample: Sample) -> list[str]:
    held_out = "" if sample.held_out is None else f"{sample.held_out:.3f}"
    settings = yaml.safe_dump(sample.settings, default_flow_style=True, width=1000).strip()
    return [sample.sample, sample.suite, str(sample.seed), sample.status, str(sample.iteration), held_out, settings]


def _difference_fields(found: Difference, digits: int) -> list[str]:
    where = f"{found.suite}, {found.split}, {found.shots}-shot"
    interval = f"{found.low:+.{digits}f} to {found.high:+.{digits}f}"
    fields = [found.row, found.baseline, where, f"{found.mean:+.{digits}f}", interval]
    return [*fields, str(found.pairs), str(len(found.seeds)), found.differs]


def write_tables(sweep: SweepFolder) -> Tables:
    """Write the folder ``tables``: JSON, Markdown, CSV, LaTeX, a plot; of a search also the best settings."""
    tables = tables_of(sweep)
    folder = sweep.path / "tables"
    folder.mkdir(exist_ok=True)
    write_file(folder / "tables.json", tables.model_dump_json(indent=1) + "\n")
    write_file(folder / "table.md", _markdown(tables))
    write_file(folder / "cells.csv", _csv([_flat(found) for found in tables.cells]))
    write_file(folder / "differences.csv", _csv([found.model_dump() for found in tables.differences]))
    write_file(folder / "table.tex", _latex(tables))
    if tables.samples:
        best = yaml.safe_dump(tables.samples[0].settings, sort_keys=False)
        write_file(folder / "best.yaml", f"# {_head(tables)}; {tables.command}\n{best}")
    if tables.cells:
        _draw(tables, folder / "table.png")
    return tables


def _flat(found: Cell) -> dict[str, object]:
    row = found.model_dump()
    paper = row.pop("paper")
    row["paper"], row["paper_spread"] = (paper["value"], paper["spread"]) if paper else (None, None)
    return row


def _csv(rows: Sequence[Mapping[str, object]]) -> str:
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: " ".join(map(str, v)) if isinstance(v, list) else v for key, v in row.items()})
    return text.getvalue()


def _markdown(tables: Tables) -> str:
    digits, grid = DIGITS[tables.metric], _grid(tables)
    lines = [_head(tables) + ".", "", f"Begun {tables.began}, commit {tables.commit[:12]}: `{tables.command}`", ""]
    if tables.samples:
        lines += _rows(["sample", "suite", "seed", "status", "iterations", "held out", "settings"])
        lines += [_row(_sample_fields(sample)) for sample in tables.samples]
    else:
        lines += _rows(["", *tables.columns])
        for row in tables.rows:
            lines.append(_row([row, *["<br>".join(_lines(grid[row].get(c), digits)) for c in tables.columns]]))
    if tables.cells:
        lines += ["", "Interquartile means over tasks and seeds; sub-skills with over a tenth of a task's states:", ""]
        lines += _rows(["row", "where", "interquartile mean", "sub-skills in use", "interval"])
        for found in tables.cells:
            where = f"{found.suite}, {found.split}, {found.shots}-shot"
            middle, in_use = f"{found.interquartile_mean:.{digits}f}", f"{found.sub_skills_in_use:.1f}"
            lines.append(_row([found.row, where, middle, in_use, found.interval]))
    if tables.differences:
        lines += ["", "On the same seeds and episodes:", ""]
        lines += _rows(["row", "against", "where", "difference", "95% interval", "pairs", "seeds", "differs?"])
        lines += [_row(_difference_fields(found, digits)) for found in tables.differences]
    lines += [f"\nFailed: {name}: {' '.join(error.split())}" for name, error in tables.failed.items()]
    return "\n".join(lines) + "\n"


def _rows(head: Sequence[str]) -> list[str]:
    return [_row(head), _row(["---"] * len(head))]


def _row(fields: Iterable[str]) -> str:
    return f"| {' | '.join(field.replace('|', '/') for field in fields)} |"


_TEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "λ": r"$\lambda$", "σ": r"$\sigma$"}
)


def _latex(tables: Tables) -> str:
    """Lay the table out for the package booktabs."""
    digits, grid = DIGITS[tables.metric], _grid(tables)

    def stacked(lines: list[str]) -> str:
        return r"\shortstack{" + r" \\ ".join(line.translate(_TEX) for line in lines) + "}" if lines else ""

    lines = [f"% {_head(tables)}; {tables.command}", rf"\begin{{tabular}}{{l{'c' * len(tables.columns)}}}", r"\toprule"]
    head = [stacked(column.split(", ")) for column in tables.columns]
    lines += [" & ".join(["", *head]) + r" \\", r"\midrule"]
    for row in tables.rows:
        own = [stacked(_lines(grid[row].get(column), digits)[:-2]) for column in tables.columns]
        lines.append(" & ".join([row.translate(_TEX), *own]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def _panels(tables: Tables) -> Iterator[tuple[str, list[Cell]]]:
    groups: dict[str, list[Cell]] = defaultdict(list)
    for found in tables.cells:
        groups[f"{found.suite}, {found.split}"].append(found)
    yield from groups.items()


def _draw(tables: Tables, path: Path) -> None:
    """Draw each suite's and split's means with their intervals, the paper's hollow beside them."""
    panels = list(_panels(tables))
    columns = min(len(panels), 2)
    lines = -(-len(panels) // columns)
    top = (0, 1.03 if tables.metric == "success_rate" else None)
    figure_, axes = pyplot.subplots(
        lines, columns, figsize=(6.5 * columns, 3.6 * lines), layout="constrained", squeeze=False
    )
    for axis, (title, cells) in zip(axes.flat, panels, strict=False):
        rows = list(dict.fromkeys(found.row for found in cells))
        shots = sorted({found.shots for found in cells})
        for index, count in enumerate(shots):
            own = [found for found in cells if found.shots == count]
            x = [rows.index(found.row) + 0.16 * (index - (len(shots) - 1) / 2) for found in own]
            mean = np.array([found.mean for found in own])
            below = [found.mean - (found.mean if found.low is None else found.low) for found in own]
            above = [(found.mean if found.high is None else found.high) - found.mean for found in own]
            axis.errorbar(x, mean, [below, above], fmt="o", capsize=3, color=f"C{index}", label=f"{count}-shot")
            papers = [(place, found.paper) for place, found in zip(x, own, strict=True) if found.paper]
            axis.errorbar(
                [place + 0.06 for place, _ in papers], [paper.value for _, paper in papers],
                [paper.spread or 0.0 for _, paper in papers], fmt="s", mfc="none", color=f"C{index}",
                label=f"{count}-shot, paper" if papers else None,
            )  # fmt: skip
        axis.set(title=title, ylabel=tables.metric.replace("_", " "), xticks=range(len(rows)), ylim=top)
        axis.set_xticklabels(rows, rotation=20 if len(rows) > 4 else 0)
        axis.grid(axis="y", alpha=0.3)
        axis.legend(fontsize="small")
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    figure_.suptitle(_head(tables), fontsize="medium")
    figure_.savefig(path, dpi=110)
    pyplot.close(figure_)


def publish(tracker: Tracker, tables: Tables, sweep: SweepFolder) -> None:
    """Record the table, its plot and its means on the sweep's MLflow run."""
    tracker.metrics(0, {_metric_name(found): found.mean for found in tables.cells}, anew=True)
    tracker.tags({"mlflow.note.content": _markdown(tables)})
    tracker.artifact(sweep.path / "tables", "tables")
    tracker.artifact(sweep.path / MARK)


def _metric_name(found: Cell) -> str:
    """Return a name of characters that MLflow takes."""
    name = f"{found.row}/{found.suite}/{found.split}/{found.shots}-shot"
    return "".join(c if c.isascii() and (c.isalnum() or c in "/_-. ") else "_" for c in name)


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report tables``."""

    sweep: tyro.conf.Positional[str]
    """Name or folder of a sweep, which may be still under way."""
    runs: Path = Path("runs")
    """The folder that sweeps' own folders are in."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    given = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    sweep = SweepFolder(find_folder(given.sweep, given.runs, MARK, "SWEEP"))
    show(write_tables(sweep), sweep)
