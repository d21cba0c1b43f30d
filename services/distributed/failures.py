"""What is stored of an error in a work item: all that is needed to run the item again, alone."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from dmil_core.configs import ExperimentConfig
from dmil_core.errors import RunError, WorkError
from dmil_core.files import named, read_json, write_file
from services.storage.provenance import library_versions

MOST_BYTES = 10_000_000


class Failure(BaseModel):
    """``failure.json``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    where: str
    problem: str
    """The last line of the traceback."""
    trace: str
    piece: dict[str, str | int]
    """What identifies the work item: iteration and slot; task, split, shots and draw; or task and attempt."""
    checkpoint: str | None
    """The state that the item starts from; none where nothing is trained yet."""
    config: ExperimentConfig
    versions: dict[str, str]


@contextmanager
def keeping_failures(
    folder: Path, config: ExperimentConfig, checkpoint: Callable[[], Path | None] = lambda: None
) -> Iterator[None]:
    """Store an error of a work item inside in ``failure.json``, so that the item can be run again.

    `checkpoint` stores the state that the failed item starts from, and returns where.

    Raises:
        RunError: names the item, the problem, and the command that runs it again.
    """
    try:
        yield
    except WorkError as error:
        path = folder / "failure.json"
        stored = checkpoint()
        failure = Failure(
            where=error.label,
            problem=error.problem,
            trace=error.trace,
            piece=dict(error.key),
            checkpoint=None if stored is None else str(stored.resolve()),
            config=config,
            versions=library_versions(),
        )
        write_file(folder, path.name, failure.model_dump_json(indent=1) + "\n")
        raise RunError(f"{error}\nto do it again, alone: dmil reproduce {path}") from error


def read_failure(path: Path) -> Failure:
    """Read ``failure.json``, or that of a folder.

    Raises:
        UserError: if there is none, or it is damaged.
    """
    if path.is_dir():
        path = path / "failure.json"
    return read_json(*named(path), Failure, MOST_BYTES, "wanted a failure.json that a program left behind")
