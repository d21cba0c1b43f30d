"""Write the page of a finished run: its figures, curves, settings and episodes, as one file.

It opens from disk in any browser, asks the network for nothing, and may be sent to others as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from dmil_core.errors import UserError
from dmil_core.files import inside
from services.cli.arguments import parse
from services.cli.places import announce
from services.cli.progress import Bar, console
from services.distributed.cluster import RunnerKind


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report run``."""

    run: tyro.conf.Positional[str]
    """Name or folder of a finished run."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""
    output: Path | None = None
    """The file to write; report/report.html in the run's folder if not given."""
    videos: bool = False
    """Also film an episode that failed in each of the worst tasks; the films become part of the page."""
    adaptation: bool = False
    """Also measure success and loss over fine-tuning steps, for 1, 3, 5 and 10 shots, in at most four meta-testing
    tasks: some minutes, once; the page shows it from then on."""
    runner: RunnerKind = "ray"
    """Where to measure: in Ray actors, or in this process; the result is the same."""
    workers: int | None = None
    """Ray workers, one for each CPU of the cluster if not given."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    from services.distributed.ray_runner import open_runner
    from services.experiments.finished_run import PAGE, REPORT, FinishedRun
    from services.reporting.adaptation_curves import measure
    from services.reporting.run_report import all_sections, write_run_page

    finished = FinishedRun.find(args.run, args.runs)
    path = args.output or inside(finished.folder, REPORT) / PAGE
    if path.is_dir():
        raise UserError(f"--output: got {path}, a folder; wanted a file, as {path / PAGE}")
    announce(report=(path, "--output FILE"))
    if args.adaptation:
        with open_runner(args.runner, finished.experiment.suite, args.workers) as runner:
            measure(finished, runner)
    sections = all_sections(videos=args.videos)
    with Bar("report", len(sections)) as bar:
        write_run_page(finished, path, sections, lambda: bar.advance(1))
    console.print(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    console.print(f"open it in a browser: {path.absolute().as_uri()}")
