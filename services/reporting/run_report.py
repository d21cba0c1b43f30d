"""Write the page of a finished run: its figures, curves, settings and episodes, as one file.

It opens from disk in any browser, asks the network for nothing, and may be sent to others as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from dmil_core.errors import UserError
from dmil_core.files import inside
from services.cli.arguments import parse
from services.cli.places import announce
from services.cli.progress import Bar, console
from services.distributed.ray_runner import RunnerKind, open_runner
from services.experiments.finished_run import PAGE, REPORT, FinishedRun
from services.reporting.adaptation_curves import adaptation_section, measure
from services.reporting.curves import training_curves
from services.reporting.embedding import embedding_section
from services.reporting.failures import failures_of_run
from services.reporting.film_strip import strip_of_run
from services.reporting.page import Section, write_page
from services.reporting.provenance import episodes_of_run, origin_of_run
from services.reporting.rates import rates_of_tasks, table_of_all
from services.reporting.run_group import group_runs, has_sub_skills
from services.reporting.settings import settings_of_run
from services.reporting.sub_skills import sub_skill_sections

Writing = Callable[[FinishedRun], Sequence[Section]]


def _rates(finished: FinishedRun) -> list[Section]:
    return [rates_of_tasks(finished)]


def _strip(finished: FinishedRun) -> list[Section]:
    return [strip_of_run(finished)]


def _sub_skills(finished: FinishedRun) -> list[Section]:
    """Return what the high level chooses in tasks of meta-testing, and where, if there is a choice."""
    if not has_sub_skills(finished):
        return []
    group = group_runs({finished.name: finished})
    return [*sub_skill_sections(group), embedding_section(group)]


def _curves(finished: FinishedRun) -> list[Section]:
    return [training_curves(finished), adaptation_section(finished)]


def _origin(finished: FinishedRun) -> list[Section]:
    return [settings_of_run(finished), origin_of_run(finished), episodes_of_run(finished)]


AT_THE_END: Sequence[Writing] = (_strip, _rates, _curves, _origin)
"""The sections that a run writes when it ends: they take seconds."""


def _all_sections(*, videos: bool) -> Sequence[Writing]:
    """Return all sections of the page, in their order."""

    def failures(finished: FinishedRun) -> list[Section]:
        return [failures_of_run(finished, videos=videos)]

    return _strip, _rates, failures, _sub_skills, _curves, _origin


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


def write_run_page(
    finished: FinishedRun,
    path: Path,
    sections: Sequence[Writing] = AT_THE_END,
    advance: Callable[[], None] = lambda: None,
) -> None:
    """Write the page of a run; `advance` is called after each of its sections.

    Raises:
        UserError: for a file of the run that is missing or damaged.
        DiskFullError: for want of space.
    """
    written: list[Section] = []
    for write in sections:
        written += write(finished)
        advance()
    config = finished.config
    title = f"{finished.name}: {config.method.name} on {config.suite.name}"
    write_page(path, title, table_of_all(finished), written)


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    finished = FinishedRun.find(args.run, args.runs)
    path = args.output or inside(finished.folder, REPORT) / PAGE
    if path.is_dir():
        raise UserError(f"--output: got {path}, a folder; wanted a file, as {path / PAGE}")
    announce(report=(path, "--output FILE"))
    if args.adaptation:
        with open_runner(args.runner, finished.experiment.suite, args.workers) as runner:
            measure(finished, runner)
    sections = _all_sections(videos=args.videos)
    with Bar("report", len(sections)) as bar:
        write_run_page(finished, path, sections, lambda: bar.advance(1))
    console.print(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    console.print(f"open it in a browser: {path.absolute().as_uri()}")
