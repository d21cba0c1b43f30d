"""The figures that come with a model, and whether an evaluation of one's own agrees with them."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from dmil_core.checkpoint import Checkpoint
from dmil_core.errors import UserError
from dmil_core.files import read_json
from dmil_core.statistics import interval_text
from services.evaluation.summary import Summary, SummaryRow
from services.storage.run_folders import SUMMARY

MOST_BYTES = 2**24
"""Of the summary beside a model's manifest, which is that of its run."""


class Verdict(NamedTuple):
    """One rate beside the model's own."""

    words: str
    met: bool
    """Whether it lies in the interval of the model's own."""


def expected_rows(checkpoint: Checkpoint, tasks: Collection[str]) -> list[SummaryRow]:
    """Return the rows of a model's own figures that are of these meta-testing tasks.

    Raises:
        UserError: if it comes without figures, or with none of these tasks.
    """
    if not (checkpoint.path / SUMMARY).is_file():
        raise UserError(
            f"--expect: got {checkpoint.path}, without a {SUMMARY}; wanted a model that comes with the project, as "
            "ml10; or leave the flag out"
        )
    summary = read_json(checkpoint.path, SUMMARY, Summary, MOST_BYTES, "wanted a run's; export the model again")
    rows = [row for row in summary.rows if row.split == "meta-testing"]
    of_tasks = [row for row in rows if set(row.per_task) == set(tasks)]
    if not of_tasks:
        known = ", ".join(dict.fromkeys(task for row in rows for task in row.per_task))
        raise UserError(f"--expect: got the tasks {', '.join(tasks)}; wanted those of the model's figures: {known}")
    return of_tasks


def verdicts(summary: Summary, expected: Sequence[SummaryRow]) -> list[Verdict]:
    """Return, for each size of support set that both have, how an evaluation compares with the expected rows."""
    by_shots = {row.shots: row for row in summary.rows if row.split == "meta-testing"}
    return [_verdict(by_shots[row.shots], row) for row in expected if row.shots in by_shots]


def _verdict(found: SummaryRow, expected: SummaryRow) -> Verdict:
    met = expected.low <= found.success_rate <= expected.high
    interval = interval_text(expected.low, expected.high, 3)
    words = f"{found.split}, {found.shots}-shot: {_counted(found)}; the model's own {_counted(expected)}, 95% interval"
    return Verdict(f"{words} {interval}: {'within' if met else 'outside'}", met)


def _counted(row: SummaryRow) -> str:
    return f"{round(row.success_rate * row.episodes)}/{row.episodes}, {row.success_rate:.3f}"
