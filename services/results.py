"""Rows of results: one an episode, one an adaptation, with all that is needed to run them again."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

__all__ = ["AdaptationResult", "EpisodeResult", "Split", "write_rows"]

Split = Literal["meta-training", "meta-testing"]


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    suite: str
    protocol: str
    method: str
    checkpoint: str
    """SHA-256 of the checkpoint's manifest."""
    split: Split
    task: str
    shots: int
    draw: int
    """Which of the disjoint support sets was adapted to."""
    support: tuple[str, ...]
    """Ids of the support demonstrations."""
    data: str
    """SHA-256 of the task's demonstrations."""
    fine_tuning_steps: int
    learning_rate: float
    versions: dict[str, str]


class EpisodeResult(_Row):
    """One episode of an adapted policy."""

    episode: int
    seed: int
    """Of the environment."""
    goal: tuple[float, ...]
    """What the environment drew from the seed."""
    success: bool
    steps: int
    sub_skill_steps: tuple[int, ...]
    """How many steps each sub-skill acted."""


class AdaptationResult(_Row):
    """How an adapted policy uses its sub-skills on held-out demonstrations of the task."""

    steps: int
    """Demonstrated steps looked at."""
    agreeing: int
    """Of these, where the high level takes the sub-skill that fits the demonstrated action best."""
    sub_skill_steps: tuple[int, ...]
    """Of these, how many each sub-skill takes."""


def write_rows(path: Path, rows: Iterable[BaseModel]) -> None:
    """Append rows to a file of JSON lines."""
    with path.open("a") as file:
        file.writelines(row.model_dump_json() + "\n" for row in rows)
