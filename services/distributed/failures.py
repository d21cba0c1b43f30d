"""What is kept of an error in a piece of pure work: all that is needed to do the piece again, alone."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from dmil_core.configs import ExperimentConfig
from dmil_core.errors import RunError, UserError, WorkError
from services.storage.files import read_file, write_file
from services.storage.provenance import library_versions

MOST_BYTES = 10_000_000


class FailureError(UserError):
    """A file that holds no failure."""


class Failure(BaseModel):
    """``failure.json``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    where: str
    problem: str
    """The last line of the traceback."""
    trace: str
    piece: dict[str, str | int]
    """What names the piece: iteration and slot; task, split, shots and draw; or task and attempt."""
    checkpoint: str | None
    """The state that the piece begins from; none where that is not trained yet."""
    config: ExperimentConfig
    versions: dict[str, str]


@contextmanager
def keeping_failures(
    folder: Path, config: ExperimentConfig, checkpoint: Callable[[], Path | None] = lambda: None
) -> Iterator[None]:
    """Work inside; an error in a piece of it is kept in ``failure.json``, so that the piece can be done again.

    Args:
        folder: gets the file.
        config: of the experiment.
        checkpoint: makes sure that the state is kept which the failed piece begins from, and returns where.

    Raises:
        RunError: names the piece, what went wrong, and the command that does it again.
    """
    try:
        yield
    except WorkError as error:
        path = folder / "failure.json"
        folder.mkdir(parents=True, exist_ok=True)
        kept = checkpoint()
        failure = Failure(
            where=error.label,
            problem=error.problem,
            trace=error.trace,
            piece=dict(error.key),
            checkpoint=None if kept is None else str(kept.resolve()),
            config=config,
            versions=library_versions(),
        )
        write_file(path, failure.model_dump_json(indent=1) + "\n")
        raise RunError(f"{error}\nto do it again, alone: python -m services.reproduce {path}") from error


def read_failure(path: Path) -> Failure:
    """Read ``failure.json``, or that of a folder.

    Raises:
        FailureError: if there is none.
    """
    if path.is_dir():
        path = path / "failure.json"
    try:
        return Failure.model_validate_json(read_file(path, MOST_BYTES))
    except (OSError, ValidationError) as error:
        raise FailureError(f"{path}: got {error}; wanted a failure.json that a program left behind") from error
