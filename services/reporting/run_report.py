"""Write the page of a finished run: its figures, curves, settings and episodes, as one file.

It opens from disk in any browser, asks the network for nothing, and may be sent to others as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from services.command_line import ConfigError, parse
from services.progress import Bar, console
from services.report import PAGE
from services.reporting.curves import training_curves
from services.reporting.finished import FinishedRun
from services.reporting.page import Section, write_page
from services.reporting.provenance import episodes_of_run, origin_of_run
from services.reporting.rates import rates_of_tasks, table_of_all
from services.reporting.settings import settings_of_run

__all__ = ["Arguments", "run", "write_run_page"]

Writing = Callable[[FinishedRun], Section]
SECTIONS: Sequence[Writing] = (
    rates_of_tasks,
    # failures
    # sub-skills
    # t-SNE
    training_curves,
    # adaptation
    settings_of_run,
    origin_of_run,
    episodes_of_run,
)
"""Of the page, in their order."""
AT_THE_END: Sequence[Writing] = (rates_of_tasks, training_curves, settings_of_run, origin_of_run, episodes_of_run)
"""Those for which it is enough to read the run's folder: a run writes them when it ends."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``report run``."""

    run: tyro.conf.Positional[str]
    """Name or folder of a finished run."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""
    output: Path | None = None
    """The file to write; report/report.html in the run's folder if not given."""


def write_run_page(
    finished: FinishedRun,
    path: Path,
    sections: Sequence[Writing] = AT_THE_END,
    tell: Callable[[Section], None] = lambda written: None,
) -> None:
    """Write the page of a run.

    Args:
        finished: the run.
        path: of the file.
        sections: of the page.
        tell: is called with each section, as soon as it is there.

    Raises:
        UserError: for a file of the run that is missing or damaged.
        DiskFullError: for want of space.
    """
    written = []
    for write in sections:
        written.append(write(finished))
        tell(written[-1])
    config = finished.config
    title = f"{finished.name}: {config.method.name} on {config.suite.name}"
    write_page(path, title, table_of_all(finished), written)


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    given = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    finished = FinishedRun.found(given.run, given.runs)
    path = given.output or finished.folder / "report" / PAGE
    if path.is_dir():
        raise ConfigError(f"--output: got {path}, a folder; wanted a file, as {path / PAGE}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with Bar("report", len(SECTIONS)) as bar:
        write_run_page(finished, path, SECTIONS, lambda section: bar.advance(1, section.title))
    console.print(f"report: {path} ({path.stat().st_size / 1e6:.1f} MB)", markup=False)
    console.print(f"open it in a browser: {path.absolute().as_uri()}", markup=False)
