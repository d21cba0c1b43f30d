"""Put runs side by side on one page: methods, or seeds of one; or the rows of a sweep."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from dmil_core.errors import UserError
from dmil_core.files import inside
from services.cli.arguments import parse
from services.cli.places import announce
from services.storage.run_folders import find_folder
from services.sweeps.folders import MARK, TABLES, SweepFolder


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
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    sweeps = [name for name in args.names if any((place / MARK).is_file() for place in (Path(name), args.runs / name))]
    if sweeps and len(args.names) > 1:
        raise UserError(f"RUN: got the sweep {sweeps[0]} with others; wanted it alone, or finished runs only")
    if sweeps:
        _of_sweep(sweeps[0], args)
    else:
        _of_runs(args)


def _of_sweep(name: str, args: Arguments) -> None:
    from services.sweeps.page import write_sweep_page
    from services.sweeps.tables import comparison_of, tables_of

    sweep = SweepFolder(find_folder(name, args.runs, MARK, "SWEEP"))
    rows = sweep.record.sweep.row_names
    if args.baseline is not None and args.baseline not in rows:
        raise UserError(f"--baseline: got {args.baseline!r}; wanted one of {', '.join(rows)}")
    comparison = comparison_of(sweep, args.baseline)
    path = args.output or inside(sweep.path, TABLES) / "report.html"
    announce(page=(path, "--output FILE"))
    write_sweep_page(tables_of(sweep, comparison), comparison, path)


def _of_runs(args: Arguments) -> None:
    from services.experiments.finished_run import FinishedRun
    from services.reporting.comparison import compare_runs
    from services.reporting.page import Commands
    from services.reporting.side_by_side import write_comparison

    if len(args.names) < 2:
        raise UserError(f"RUN: got {' '.join(args.names) or 'none'}; wanted two finished runs or more, or one sweep")
    runs = [FinishedRun.find(name, args.runs) for name in args.names]
    comparison = compare_runs(runs, args.baseline)
    path = args.output or Path("comparison.html")
    announce(page=(path, "--output FILE"))
    again = ["dmil", "report", "compare", *args.names, "--runs", str(args.runs)]
    again += [] if args.baseline is None else ["--baseline", args.baseline]
    lead = [
        f"{len(runs)} runs on {comparison.suites[0]}; the others are compared with {comparison.baseline}. Runs that "
        "differ only in the seed are one row."
    ]
    title = f"{', '.join(comparison.rows)} side by side"
    write_comparison(path, title, lead, comparison, [Commands("To make this page again", [shlex.join(again)])])
