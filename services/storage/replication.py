"""A copy of a run, or of what a sweep trained, in a storage that all machines reach: another goes on from there."""

import logging
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar
from uuid import uuid4

from dmil_core.checkpoint import FILES, MARKER, MOST_MARKER, NAMED, Checkpoint, CheckpointError, iteration_of
from dmil_core.errors import RunError, UserError
from dmil_core.files import read_file, remove_folder, write_file
from services.storage.checkpoints import Checkpoints
from services.storage.folder_lock import held
from services.storage.redaction import error_line
from services.storage.remote import Storage, given_storage
from services.storage.run_folders import CONFIG, IDENTITY, SPOOL, SUMMARY

logger = logging.getLogger(__name__)
T = TypeVar("T")

ROWS = ("adaptations.jsonl", "episodes.jsonl")
"""Of an evaluation; those of episodes say that it is whole."""
RECORDS = (IDENTITY, SPOOL, CONFIG, "metrics.json", *ROWS, SUMMARY)
"""What else a run needs to go on, and to be looked at. The first says how far MLflow has taken the second: it is read
before it and written after it, so that the copy never says that more was taken than it holds."""
EVALUATIONS, EVALUATED = "evaluations", r"\d{7,}"
"""Where the rows of evaluations on the way lie, by iteration."""
RUNS = "runs"
CLAIM = "claim"
"""Whose a name is: the random tag of the run that has it, in its folder and in the storage."""
MOST_CLAIM = 100
MOST_RECORDS = 2**30
SECONDS = 10.0
"""Between looks at the folder."""
CLAIM_SECONDS = 20.0
"""So long a storage may take to say whether a name is free."""
FAREWELL_SECONDS = 60.0


class Replica:
    """The copy of one run's folder."""

    def __init__(self, folder: Path, storage: Storage, place: str = RUNS) -> None:
        """Name the copy as the folder, in the folder `place` of the storage; nothing is written yet."""
        self._folder, self._storage, self._name = folder, storage, f"{place}/{folder.name}"
        self._copied: dict[str, tuple[float, int]] = {}
        self._claimed = place != RUNS  # whose names are digests of what makes them

    def claim(self) -> None:
        """Have the storage note, once, which run has the name there.

        What the storage raises, whatever it is, passes through.

        Raises:
            RunError: if the folder is gone.
            UserError: if the name is another's.
        """
        if self._claimed:
            return
        tag, place = self._tag(), f"{self._name}/{CLAIM}"
        taken = self._get(CLAIM, MOST_CLAIM) is None and self._get(CONFIG) is not None  # by a version without claims
        if tag is None:  # so is this one
            tag, taken = self.new_tag(), False
        if taken or self._storage.create(place, tag, MOST_CLAIM) != tag:
            raise UserError(
                f"--name: got {self._folder.name}, which another run has in {self._storage.url}; wanted a name that "
                f"none has: give another, or go on with that run: --resume {self._folder.name}"
            )
        self._claimed = True

    def new_tag(self) -> bytes:
        """Give the folder a tag, by which the storage knows its run."""
        write_file(self._folder, CLAIM, tag := uuid4().hex.encode())
        return tag

    def _tag(self) -> bytes | None:
        try:
            return read_file(self._folder, CLAIM, MOST_CLAIM)
        except FileNotFoundError:
            return None

    def _get(self, name: str, most: int = MOST_RECORDS) -> bytes | None:
        return self._storage.get(f"{self._name}/{name}", most)

    def copy(self) -> None:
        """Bring the copy up to date: what the checkpoints' iterations measured, these, then what came after.

        A copied checkpoint is gone on from: its iterations are not done again, nor are earlier ones evaluated.

        What the storage raises, whatever it is, passes through; the next call goes on.

        Raises:
            UserError: if another run has the name there.
        """
        self.claim()
        checkpoints = [path.name for path in self._checkpoints.all()]
        evaluated = (path.name for path in (self._folder / EVALUATIONS).glob("*"))
        self._copy_records([SPOOL, *_rows_of(name for name in evaluated if re.fullmatch(EVALUATED, name))])
        self._copy_checkpoints(checkpoints)
        self._copy_records(RECORDS)

    def _copy_records(self, names: Sequence[str]) -> None:
        changed = {}
        for name in names:
            path = self._folder / name
            if path.is_file() and self._copied.get(name) != (state := _state(path)):
                changed[name] = state, read_file(self._folder, name, MOST_RECORDS)
        for name in sorted(changed, key=lambda name: name == IDENTITY):
            state, content = changed[name]
            self._storage.put(f"{self._name}/{name}", content)
            self._copied[name] = state

    def _copy_checkpoints(self, here: Sequence[str]) -> None:
        place = f"{self._name}/checkpoints"
        there = self._storage.committed(place, MARKER, NAMED)
        for name in here:
            own = f"checkpoints/{name}"
            try:
                if there.get(name) == read_file(self._folder, f"{own}/{MARKER}", MOST_MARKER):
                    continue
                contents = {
                    file: read_file(self._folder, f"{own}/{file}", most)
                    for file, most in {**FILES, MARKER: MOST_MARKER}.items()
                }
            except FileNotFoundError:  # the run has let go of it meanwhile
                continue
            self._storage.put_folder(f"{place}/{name}", contents, MARKER)
        if here:
            for name in there.keys() - set(here):
                self._storage.remove(f"{place}/{name}", MARKER)

    def is_ahead(self) -> bool:
        """Tell whether the storage has this run, and further than the folder, or the folder has none of it."""
        tag = self._tag()
        if tag is not None and tag != self._get(CLAIM, MOST_CLAIM):
            return False
        return bool(self._newer()) if (self._folder / CONFIG).exists() else self._get(CONFIG) is not None

    def _newer(self) -> list[str]:
        """Return the stored checkpoints that are newer than all whole ones in the folder, the newest first."""
        whole = self._checkpoints.newest_whole()
        here = -1 if whole is None else whole.manifest.iteration
        there = self._storage.committed(f"{self._name}/checkpoints", MARKER, NAMED)
        return sorted(
            (name for name in there if iteration_of(Path(name)) > here), key=lambda name: -iteration_of(Path(name))
        )

    @property
    def _checkpoints(self) -> Checkpoints:
        return Checkpoints(self._folder / "checkpoints", kept=0)

    def restore(self) -> bool:
        """Fetch what the folder lacks; return whether there was anything.

        Checkpoints that the folder does not have are fetched as far as they are whole, the older ones too, which the
        next copy would else remove there; then the records.

        Raises:
            RunError: if the copy cannot be used.
        """
        if not self.is_ahead():
            return False
        evaluated = self._storage.names(f"{self._name}/{EVALUATIONS}", EVALUATED)
        records = {name: self._get(name) for name in (CLAIM, *RECORDS, *_rows_of(evaluated))}
        newer = self._newer()
        stored = self._storage.committed(f"{self._name}/checkpoints", MARKER, NAMED)
        lacking = stored.keys() - {path.name for path in self._checkpoints.all()} - set(newer)
        fetched = [name for name in (*newer, *sorted(lacking)) if self._fetched(name)]
        if newer and not set(newer) & set(fetched):
            if self._checkpoints.newest_whole() is not None:
                return False
            raise RunError(
                f"{self._storage.url}/{self._name}: got no whole checkpoint, see above; wanted one; try again"
            )
        for name, content in records.items():
            if content is not None:
                write_file(self._folder, name, content)
        return True

    def _fetched(self, name: str) -> bool:
        """Fetch a checkpoint in the place of a damaged one; return whether the storage had it whole."""
        place = f"checkpoints/{name}"
        try:
            return self._storage.get_folder(
                f"{self._name}/{place}", self._folder, place, FILES, MARKER, Checkpoint, instead=True
            )
        except (CheckpointError, RunError) as error:
            logger.warning(f"{self._storage.url}/{self._name}/{place}: not taken: {error_line(error)}")
            return False


def _rows_of(evaluated: Iterable[str]) -> list[str]:
    """Return the files with an evaluation's rows, those that say that it is whole last."""
    return [f"{EVALUATIONS}/{iteration}/{file}" for iteration in evaluated for file in ROWS]


def _state(path: Path) -> tuple[float, int]:
    status = path.stat()
    return status.st_mtime, status.st_size


def claim_name(folder: Path) -> None:
    """Have the storage that ``DMIL_STORAGE`` names note that a new run has its folder's name.

    A storage that does not answer stops no run: the name is claimed before anything is copied there.

    Raises:
        UserError: if another run has it there, whose copy stays as it is; the new folder is then removed. Or if the
            URL names no storage.
    """
    storage = given_storage()
    if storage is None:
        return
    replica = Replica(folder, storage)
    replica.new_tag()
    try:
        _answer(replica.claim)
    except UserError:
        remove_folder(folder.parent, folder.name)
        raise
    except Exception as error:  # noqa: BLE001  whatever a storage raises
        why = error_line(error)
        logger.warning(f"{storage.url} does not say whether the name {folder.name} is free there ({why}); going on")


def _answer(ask: Callable[[], T]) -> T:
    """Return what a storage answers, or raise what it raises; it has `CLAIM_SECONDS`."""
    answers, errors = list[T](), list[Exception]()

    def work() -> None:
        try:
            answers.append(ask())
        except Exception as error:  # noqa: BLE001  it is raised by the one who waits
            errors.append(error)

    thread = threading.Thread(target=work, name="storage", daemon=True)
    thread.start()
    thread.join(CLAIM_SECONDS)
    if errors:
        raise errors[0]
    if not answers:
        raise TimeoutError(f"no answer for {CLAIM_SECONDS:.0f} s")
    return answers[0]


def restored(folder: Path) -> bool:
    """Fetch a run that the storage has further than its folder; return whether it did.

    A storage that does not answer stops no run that was begun here, or lies here whole: a warning is logged.

    Raises:
        UserError: if ``DMIL_STORAGE`` names none, or another process works in the folder.
        RunError: if the copy cannot be used, and the folder has nothing to go on from.
    """
    storage = given_storage()
    if storage is None:
        return False
    replica = Replica(folder, storage)
    try:
        if not _answer(replica.is_ahead):
            return False
        with held(folder):
            return replica.restore()
    except UserError:
        raise
    except Exception as error:
        if (folder / CONFIG).is_file():
            logger.warning(f"{storage.url} does not give {folder} ({error_line(error)}); going on with what is here")
            return False
        if isinstance(error, RunError):
            raise
        raise RunError(
            f"{storage.url} does not give {folder}: {error_line(error)}; wanted the run; try again"
        ) from None


@contextmanager
def replicated(folder: Path, place: str = RUNS, *, restore: bool = False) -> Iterator[None]:
    """Keep a copy of a run's folder while the run goes on, if ``DMIL_STORAGE`` names a storage.

    A storage that does not answer never stops a run; the copy is brought up to date when it answers again. One warning
    is logged when the storage fails, one if the copy is not whole at the end. With `restore`, what the storage has
    further is fetched beforehand.

    Raises:
        UserError: if the URL names no storage.
    """
    storage = given_storage()
    if storage is None:
        yield
        return
    replica, closing, complained = Replica(folder, storage, place), threading.Event(), threading.Event()

    def copied() -> bool:
        try:
            replica.copy()
        except Exception as error:  # noqa: BLE001  whatever a storage raises, the run goes on
            if not complained.is_set():
                logger.warning(f"{storage.url} does not take the copy of {folder} ({error_line(error)}); going on")
            complained.set()
            return False
        return True

    def work() -> None:
        while not closing.wait(SECONDS):
            copied()

    if restore:
        try:
            if replica.restore():
                logger.info(f"{folder}: fetched from {storage.url}")
        except Exception as error:  # noqa: BLE001  as above
            logger.warning(f"{storage.url} does not give {folder} ({error_line(error)}); going on without")
    thread = threading.Thread(target=work, name="replica", daemon=True)
    thread.start()
    try:
        yield
    finally:
        closing.set()
        thread.join(FAREWELL_SECONDS)
        began = time.monotonic()
        if thread.is_alive() or not copied():
            logger.warning(f"{storage.url} has no whole copy of {folder} ({time.monotonic() - began:.0f} s tried)")
