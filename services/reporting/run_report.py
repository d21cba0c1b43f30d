"""The page of a finished run: its figures, curves, settings and episodes, as one file."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from services.experiments.finished_run import FinishedRun
from services.reporting.adaptation_curves import adaptation_section
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

Writing = Callable[[FinishedRun], Section | Sequence[Section]]


def _sub_skills(finished: FinishedRun) -> Sequence[Section]:
    """Return what the high level chooses in tasks of meta-testing, and where, if there is a choice."""
    if not has_sub_skills(finished):
        return []
    group = group_runs({finished.name: finished})
    return [*sub_skill_sections(group), embedding_section(group)]


AT_THE_END: Sequence[Writing] = (
    strip_of_run,
    rates_of_tasks,
    training_curves,
    adaptation_section,
    settings_of_run,
    origin_of_run,
    episodes_of_run,
)
"""The sections that a run writes when it ends: they take seconds."""


def all_sections(*, videos: bool) -> Sequence[Writing]:
    """Return all sections of the page, in their order."""
    return *AT_THE_END[:2], partial(failures_of_run, videos=videos), _sub_skills, *AT_THE_END[2:]


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
        made = write(finished)
        written += [made] if isinstance(made, Section) else made
        advance()
    config = finished.config
    title = f"{finished.name}: {config.method.name} on {config.suite.name}"
    write_page(path, title, table_of_all(finished), written)
