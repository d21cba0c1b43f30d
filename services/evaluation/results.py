"""Rows of results: one an episode, one an adaptation, with all that is needed to run them again."""

from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dmil_core.errors import UserError, describe_errors
from dmil_core.files import read_file, write_file
from dmil_core.settings import Optimiser
from services.suites.base import Split

Row = TypeVar("Row", bound=BaseModel)
Key = TypeVar("Key", bound=Hashable)
MOST_BYTES = 2**30
"""In a file of rows."""
LONGEST_LINE = 2**20


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    suite: str
    protocol: str
    method: str
    checkpoint: str
    """The checkpoint's digest, which covers all but its loss and the id of the MLflow run."""
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
    optimiser: Optimiser = "sgd"
    displaced: int = 0
    """Displaced copies of the support set."""
    versions: dict[str, str]
    device: str = "cpu"
    """What adapted: cpu, or cuda and the card's name. The episodes are always the CPU's."""


class EpisodeResult(_Row):
    """One episode of an adapted policy."""

    episode: int
    seed: int
    """Of the environment."""
    goal: tuple[float, ...]
    """What the environment drew from the seed."""
    success: bool
    score: int
    """Sub-tasks done in suites that count them, else 1 for a success."""
    steps: int
    sub_skill_steps: tuple[int, ...]
    """How many steps each sub-skill acted."""
    sub_skill_switches: int | None = None
    """In how many steps another acted than in the step before; older rows have none."""
    diverged: bool = False
    """Whether it ended because the policy's action was not finite: a failure."""
    fault: int | None = Field(default=None, exclude_if=lambda fault: fault is None)
    """The first observation that is not finite: the simulator's fault, for which the episode does not count."""

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"{self.split} task {self.task}, {self.shots}-shot, episode {self.episode}, seed {self.seed}"


class AdaptationResult(_Row):
    """How an adapted policy uses its sub-skills on held-out demonstrations of the task."""

    steps: int
    """Demonstrated steps that were compared."""
    agreeing: int
    """Of these, where the high level takes the sub-skill that fits the demonstrated action best."""
    sub_skill_steps: tuple[int, ...]
    """Of these, how many each sub-skill takes."""


class ImitationResult(_Row):
    """How far an adapted policy's actions are from those demonstrated: mean ‖π(s) − a‖² over steps.

    A policy that has diverged has no error.
    """

    support_error: float | None
    """On the demonstrations that it was adapted to."""
    held_out_error: float | None
    """On held-out ones that it was not adapted to, where there are any."""


def grouped(rows: Iterable[Row], by: Callable[[Row], Key]) -> dict[Key, list[Row]]:
    """Return rows by what a function says of each, in their order."""
    groups: dict[Key, list[Row]] = {}
    for row in rows:
        groups.setdefault(by(row), []).append(row)
    return groups


def write_rows(path: Path, rows: Iterable[BaseModel]) -> None:
    """Write a file of JSON lines, whole, in place of the one there was.

    Raises:
        DiskFullError: for want of space; the file is then what it was.
    """
    write_file(path.parent, path.name, "".join(row.model_dump_json(exclude_defaults=True) + "\n" for row in rows))


def read_rows(path: Path, model: type[Row]) -> list[Row]:
    """Read the rows of a file of JSON lines.

    Raises:
        UserError: names the file and the line that is not a row as `write_rows` writes it.
    """
    rows = []
    for number, line in read_lines(path):
        try:
            rows.append(model.model_validate_json(line, strict=True))
        except ValidationError as error:
            got = describe_errors(error, "row", "; ")
            raise UserError(f"{path}:{number}: {got}; wanted a whole {model.__name__}; make the file again") from error
    return rows


def read_lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a file with their numbers from 1.

    Raises:
        UserError: if there is no such file, it is too large or a line too long, or its last line has no end: whoever
            wrote it was killed.
    """
    try:
        lines = read_file(path.parent, path.name, MOST_BYTES).split(b"\n")
    except OSError as error:
        raise UserError(f"{path}: got {error.strerror}; wanted a file of JSON lines; make it again") from error
    for number, line in enumerate(lines, start=1):
        if len(line) > LONGEST_LINE:
            raise UserError(f"{path}:{number}: got a line of {len(line)} bytes; wanted at most {LONGEST_LINE}")
        if number < len(lines):
            yield number, line
        elif line:
            raise UserError(f"{path}:{number}: got half a line; wanted a whole one; remove it or make the file again")


@dataclass(frozen=True)
class EvaluationFolder:
    """A folder with the rows of an evaluation; each file is read when it is asked for, once."""

    folder: Path

    @cached_property
    def episodes(self) -> list[EpisodeResult]:
        """A row an episode."""
        return read_rows(self.folder / "episodes.jsonl", EpisodeResult)

    @cached_property
    def adaptations(self) -> list[AdaptationResult]:
        """A row an adaptation."""
        return read_rows(self.folder / "adaptations.jsonl", AdaptationResult)


Metric = Literal["success_rate", "score"]
