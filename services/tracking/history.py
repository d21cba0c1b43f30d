"""What a run noted of itself while it went, in its ``tracking.jsonl``."""

from pathlib import Path
from typing import NamedTuple

from services.storage.run_folders import SPOOL
from services.tracking.spool import read_spool


class Origin(NamedTuple):
    """What a run was made of."""

    commits: tuple[str, ...]
    """Of the code, those that it was begun and resumed with."""
    data_sets: dict[str, str]
    """The SHA-256 of each, by its id."""


def read_metrics(folder: Path) -> list[dict[str, float]]:
    """Return the metrics of each iteration of a run; an iteration done again counts once.

    Raises:
        UserError: names the line that is damaged.
    """
    by_step: dict[int, dict[str, float]] = {}
    for line in read_spool(folder / SPOOL):
        if line.kind == "metrics":
            by_step.setdefault(line.value.step, {"iteration": line.value.step}).update(line.value.values)
    return [by_step[step] for step in sorted(by_step)]


def read_origin(folder: Path) -> Origin:
    """Return what a run was made of; one that was not tracked says nothing of it.

    Raises:
        UserError: names the line that is damaged.
    """
    commits, data_sets = [], {}
    for line in read_spool(folder / SPOOL):
        if line.kind == "tags" and "git_commit" in line.value:
            commits.append(line.value["git_commit"])
        elif line.kind == "inputs":
            data_sets |= line.value
    return Origin(tuple(dict.fromkeys(commits)), data_sets)
