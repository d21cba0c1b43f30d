"""The records of a run on disk, ``tracking.jsonl``: one JSON line each, in the order in which they were made."""

import errno
import json
import threading
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, TypeAdapter, ValidationError

from dmil_core.errors import UserError
from dmil_core.files import append_to, open_file, room_for

LONGEST_LINE = 2**22
NOTE = "mlflow.note.content"
"""The one tag of MLflow's own that a run sets in a record: what its page shows. Others name, nest and move runs."""


class _Content(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Measured(_Content):
    """Metrics of one iteration."""

    step: int
    time: int
    """In milliseconds since 1970; MLflow tells metrics apart by it, so it is noted here, once."""
    values: dict[str, float]


class Ended(_Content):
    """How and when a run ended."""

    status: Literal["FINISHED", "FAILED", "KILLED"]
    time: int


def _below(path: str) -> str:
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise ValueError("wanted a path below the run's folder")
    return path


class Artifact(_Content):
    """A file or folder of the run: only such are ever sent, whatever the file of records says."""

    path: Annotated[str, AfterValidator(_below)]
    folder: Annotated[str, AfterValidator(_below)] | None
    """Where it goes among the run's artifacts."""


class Example(_Content):
    """What a model may be asked, in the form of `services.tracking.packing`."""

    support: list[dict[Literal["observations", "actions"], list[list[float]]]]
    observation: list[float]


class Trained(_Content):
    """A checkpoint of the run that is its model."""

    checkpoint: Annotated[str, AfterValidator(_below)]
    example: Example


def _ours(tags: dict[str, str]) -> dict[str, str]:
    if strange := [name for name in tags if name.startswith(("mlflow.", "dmil.")) and name != NOTE]:
        raise ValueError(f"wanted none of MLflow's own tags: {strange[0]}")
    return tags


Texts = dict[str, str]
_RECORD: TypeAdapter[tuple[str, Any]] = TypeAdapter(
    tuple[Literal["begin"], None]
    | tuple[Literal["metrics", "system"], Measured]
    | tuple[Literal["parameters", "inputs"], Texts]
    | tuple[Literal["tags"], Annotated[Texts, AfterValidator(_ours)]]
    | tuple[Literal["artifact"], Artifact]
    | tuple[Literal["model"], Trained]
    | tuple[Literal["end"], Ended]
)


class Line(NamedTuple):
    """One record, and where it stands."""

    kind: str
    value: Any
    number: int
    """From 1, as editors count."""
    end: int
    """The bytes of the file up to and with it."""


def read_spool(path: Path, *, line: int = 0, offset: int = 0) -> Iterator[Line]:
    """Yield the records of a file that may still grow; a last line without its end is none yet.

    The first `line` lines, of `offset` bytes, are left out; a file that is not there holds no records.

    Raises:
        UserError: names the file and the line that is damaged.
    """
    try:
        file = open_file(path.parent, path.name)
    except FileNotFoundError:
        return
    with file:
        file.seek(offset)
        for number, text in enumerate(iter(lambda: file.readline(LONGEST_LINE), b""), line + 1):
            if not text.endswith(b"\n") and len(text) < LONGEST_LINE:
                return
            offset += len(text)
            try:
                kind, value = _RECORD.validate_json(text)
            except ValidationError as error:
                raise UserError(
                    f"{path}, line {number}: got {text[:60]!r}; wanted a record, as of tags or metrics, in JSON; put "
                    '["tags", {}] in its place to go on without it'
                ) from error
            yield Line(kind, value, number, offset)


class Spool:
    """The file of records, open for more."""

    def __init__(self, path: Path) -> None:
        """Open a file of records, and cut off a last line that a killed process did not finish.

        Raises:
            UserError: names the file and the line that is damaged.
        """
        self.path = path
        self.measured: defaultdict[str, dict[int, float]] = defaultdict(dict)
        """The last value that is recorded of each metric at each step."""
        self.count = self._size = 0
        for line in read_spool(path):
            self.count, self._size = line.number, line.end
            if isinstance(line.value, Measured):
                self._note(line.value)
        self._lock = threading.Lock()
        self._file = append_to(path.parent, path.name)
        self._file.truncate(self._size)

    def append(self, kind: str, value: Any) -> None:
        """Write one record, whole or not at all, from any thread: a killed process loses none of those written.

        Raises:
            DiskFullError: for want of space.
        """
        content = value.model_dump() if isinstance(value, BaseModel) else value
        line = json.dumps([kind, content]).encode() + b"\n"
        with self._lock, room_for(self.path, len(line)):
            if self._file.write(line) < len(line):
                self._file.truncate(self._size)
                raise OSError(errno.ENOSPC, "No space left on device")
            self.count, self._size = self.count + 1, self._size + len(line)
            if isinstance(value, Measured):
                self._note(value)

    def _note(self, measured: Measured) -> None:
        for name, value in measured.values.items():
            self.measured[name][measured.step] = value

    def close(self) -> None:
        """Close the file."""
        self._file.close()
