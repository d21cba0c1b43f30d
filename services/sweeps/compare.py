"""Put runs side by side on one page: methods, or seeds of one; or the rows of a sweep."""

import re
import shlex
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import tyro

from dmil_core.errors import UserError
from services.cli.arguments import parse
from services.cli.progress import console
from services.evaluation.comparison import Comparison, Contender, Place
from services.experiments.finished_run import FinishedRun
from services.reporting.page import Commands
from services.reporting.side_by_side import write_comparison
from services.storage.run_folders import find_folder
from services.sweeps.folders import MARK, SweepFolder
from services.sweeps.tables import Tables, comparison_of, tables_of


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report compare``."""

    names: tyro.conf.Positional[tuple[str, ...]]
    """Names or folders of two finished runs or more, or of one sweep, which may be still under way."""
    runs: Path = Path("runs")
    """The folder that runs' and sweeps' own folders are in."""
    output: Path | None = None
    """File of the page; comparison.html, or a sweep's tables/report.html, if not given."""
    baseline: str | None = None
    """The row that the others are compared with; the first, or the sweep's own, if not given."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    given = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    sweeps = [
        name for name in given.names if any((place / MARK).is_file() for place in (Path(name), given.runs / name))
    ]
    if sweeps and len(given.names) > 1:
        raise UserError(f"RUN: got the sweep {sweeps[0]} with others; wanted it alone, or finished runs only")
    path = _of_sweep(sweeps[0], given) if sweeps else _of_runs(given)
    console.print(f"page: {path}", markup=False)


def _of_sweep(name: str, given: Arguments) -> Path:
    sweep = SweepFolder(find_folder(name, given.runs, MARK, "SWEEP"))
    rows = sweep.record.sweep.row_names
    if given.baseline is not None and given.baseline not in rows:
        raise UserError(f"--baseline: got {given.baseline!r}; wanted one of {', '.join(rows)}")
    comparison = comparison_of(sweep, given.baseline)
    path = given.output or sweep.path / "tables" / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_sweep_page(tables_of(sweep, comparison), comparison, path)
    return path


def _of_runs(given: Arguments) -> Path:
    if len(given.names) < 2:
        raise UserError(f"RUN: got {' '.join(given.names) or 'none'}; wanted two finished runs or more, or one sweep")
    runs = [FinishedRun.found(name, given.runs) for name in given.names]
    comparison = runs_compared(runs, given.baseline)
    path = given.output or Path("comparison.html")
    path.parent.mkdir(parents=True, exist_ok=True)
    again = ["python", "-m", "services.report", "compare", *given.names, "--runs", str(given.runs)]
    again += [] if given.baseline is None else ["--baseline", given.baseline]
    lead = [
        f"{len(runs)} runs on {comparison.suites[0]}; the others are compared with {comparison.baseline}. Runs that "
        "differ only in the seed are one row."
    ]
    title = f"{', '.join(comparison.rows)} side by side"
    write_comparison(path, title, lead, comparison, [Commands("To make this page again", [shlex.join(again)])])
    return path


def write_sweep_page(tables: Tables, comparison: Comparison, path: Path) -> None:
    """Write the page of a sweep.

    Raises:
        DiskFullError: for want of space.
    """
    trials = ", ".join(f"{count} {status}" for status, count in tables.trials.items())
    paper = f" Beside it stands {tables.paper.replace('table', 'Table ')} of the paper." if tables.paper else ""
    lead = [
        f"{tables.metric.replace('_', ' ').capitalize()} at preset {tables.preset}; trials: {trials}.{paper} Begun "
        f"{tables.began}, commit {tables.commit[:12]}."
    ]
    lead += [f"Failed: {name}: {error}" for name, error in tables.failed.items()]
    write_comparison(path, tables.what, lead, comparison, [Commands("The sweep", [tables.command])])


def runs_compared(runs: Sequence[FinishedRun], baseline: str | None = None) -> Comparison:
    """Return finished runs as they are put side by side.

    The baseline is a row or a run: that of the first run if none is named.

    Raises:
        UserError: for runs of different suites, the same run twice, or a baseline that is none of them.
    """
    names = _names(runs)
    suites = {name: run.config.suite.name for name, run in names.items()}
    if len(set(suites.values())) > 1:
        told = ", ".join(f"{name} of {suite}" for name, suite in suites.items())
        raise UserError(f"RUN: got {told}; wanted runs of one suite: rates on different tasks are no contest")
    rows = _rows(names)
    contenders = [_contender(row, name, names[name]) for row, own in rows.items() for name in own]
    named = baseline or next(iter(names))
    found = next((row for row, own in rows.items() if named == row or named in own), None)
    if found is None:
        raise UserError(f"--baseline: got {named!r}; wanted one of {', '.join([*rows, *names])}")
    cells = [cell for run in runs for cell in run.summary.rows]
    suite = contenders[0].suite
    return Comparison(
        rows=list(rows),
        suites=[suite],
        splits=list(dict.fromkeys(cell.split for cell in cells)),
        shots=sorted({cell.shots for cell in cells}),
        metric="score" if any(cell.score for cell in cells) else "success_rate",
        by="variants",
        baseline=found,
        contenders=contenders,
        published={
            Place(row, suite, cell.split, cell.shots): cell.paper
            for row, own in rows.items()
            for cell in names[own[0]].summary.rows
            if cell.paper is not None
        },
    )


def _names(runs: Sequence[FinishedRun]) -> dict[str, FinishedRun]:
    """Return runs by the name of their folder, or where two have the same, by its path."""
    count = Counter(run.name for run in runs)
    names = {run.name if count[run.name] == 1 else str(run.folder): run for run in runs}
    folders = Counter(run.folder.resolve() for run in runs)
    if twice := [folder for folder, times in folders.items() if times > 1]:
        raise UserError(f"RUN: got {twice[0]} twice; wanted each run once")
    return names


def _rows(runs: dict[str, FinishedRun]) -> dict[str, list[str]]:
    """Return the names of the runs of each row: those that differ only in the seed."""
    groups: dict[tuple[str, int], list[str]] = defaultdict(list)
    times: Counter[tuple[str, int]] = Counter()
    for name, run in runs.items():
        settings = run.config.model_dump_json(exclude={"seed"})
        # The same seed again, as of other code, is another row.
        groups[settings, times[settings, run.config.seed]].append(name)
        times[settings, run.config.seed] += 1
    rows = {_row_name(own): own for own in groups.values()}
    return rows if len(rows) == len(groups) else {", ".join(own): own for own in groups.values()}


def _row_name(names: Sequence[str]) -> str:
    """Return what the names of one row's runs have in common, as dmil of dmil-seed-0 and dmil-seed-1."""
    if len(names) == 1:
        return names[0]
    shared = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    common = "".join(letters[0] for letters in shared)
    return re.sub(r"[-_. ]*(seed)?[-_. ]*\d*$", "", common) or ", ".join(names)


def _contender(row: str, name: str, run: FinishedRun) -> Contender:
    return Contender(
        row=row,
        suite=run.config.suite.name,
        seed=run.config.seed,
        name=name,
        config=run.config,
        environment_steps=run.summary.environment_steps,
        home=run.folder,
        folder=run.folder,
    )
