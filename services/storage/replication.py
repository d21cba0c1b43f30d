"""A copy of a run, or of what a sweep trained, in a storage that all machines reach: another goes on from there."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from services.storage.checkpoints import FILES, MARKER
from services.storage.redaction import error_line
from services.storage.remote import Storage, given_storage

logger = logging.getLogger(__name__)

NAMED = r"iteration-\d{7,}"
IDENTITY = "mlflow_run.json"
RECORDS = (
    IDENTITY, "tracking.jsonl", "config.json", "metrics.json", "adaptations.jsonl", "episodes.jsonl", "summary.json",
)  # fmt: skip
"""What else a run needs to go on, and to be looked at. The first says how far MLflow has taken the second: it is read
before it and written after it, so that the copy never says that more was taken than it holds."""
MOST_RECORDS = 2**30
SECONDS = 10.0
"""Between looks at the folder."""
FAREWELL_SECONDS = 60.0


class Replica:
    """The copy of one run's folder."""

    def __init__(self, folder: Path, storage: Storage, place: str = "runs") -> None:
        """Name the copy as the folder, in the folder `place` of the storage; nothing is written yet."""
        self._folder, self._storage, self._name = folder, storage, f"{place}/{folder.name}"
        self._copied: dict[str, tuple[float, int]] = {}

    def copy(self) -> None:
        """Bring the copy up to date: checkpoints, then the records of what came after.

        What the storage raises, whatever it is, passes through; the next call goes on.
        """
        self._copy_checkpoints()
        changed = {}
        for name in RECORDS:
            path = self._folder / name
            if path.is_file() and self._copied.get(name) != (state := _state(path)):
                changed[name] = state, path.read_bytes()
        for name in sorted(changed, key=lambda name: name == IDENTITY):
            state, content = changed[name]
            self._storage.put(f"{self._name}/{name}", content)
            self._copied[name] = state

    def _copy_checkpoints(self) -> None:
        place = f"{self._name}/checkpoints"
        there = self._storage.committed(place, MARKER, NAMED)
        here = {path.parent.name: path for path in sorted(self._folder.glob(f"checkpoints/iteration-*/{MARKER}"))}
        for name, marker in here.items():
            try:
                if there.get(name) == marker.read_bytes():
                    continue
                contents = {file: (marker.parent / file).read_bytes() for file in (*FILES, MARKER)}
            except FileNotFoundError:  # the run has let go of it meanwhile
                continue
            self._storage.put_folder(f"{place}/{name}", contents, MARKER)
        if here:
            for name in there.keys() - here.keys():
                self._storage.remove(f"{place}/{name}", MARKER)

    def restore(self) -> bool:
        """Fetch what the folder lacks; return whether there was anything.

        Of checkpoints the newest is fetched, if it is newer than all in the folder; then the records too.

        Raises:
            RunError: if the copy cannot be used.
        """
        place = f"{self._name}/checkpoints"
        here = [path.name for path in self._folder.glob("checkpoints/iteration-*")]
        newest = max(self._storage.committed(place, MARKER, NAMED), default="")
        if (self._folder / "config.json").exists() and newest <= max(here, default=""):
            return False
        records = {name: self._storage.get(f"{self._name}/{name}", MOST_RECORDS) for name in RECORDS}
        if records["config.json"] is None:
            return False
        self._folder.mkdir(parents=True, exist_ok=True)
        if newest:
            (self._folder / "checkpoints").mkdir(exist_ok=True)
            target = self._folder / "checkpoints" / newest
            self._storage.get_folder(f"{place}/{newest}", target, FILES, MARKER)
        for name, content in records.items():
            if content is not None:
                (self._folder / name).write_bytes(content)
        return True


def _state(path: Path) -> tuple[float, int]:
    status = path.stat()
    return status.st_mtime, status.st_size


def restored(folder: Path) -> bool:
    """Fetch a run that the storage has further than its folder; return whether it did.

    Raises:
        UserError: if ``DMIL_STORAGE`` names none.
        RunError: if the copy cannot be used.
    """
    storage = given_storage()
    return storage is not None and Replica(folder, storage).restore()


@contextmanager
def replicated(folder: Path, place: str = "runs", *, restore: bool = False) -> Iterator[None]:
    """Keep a copy of a run's folder while the run goes on, if ``DMIL_STORAGE`` names a storage.

    A storage that does not answer never stops a run; the copy is brought up to date when it answers again. One
    warning is logged when the storage fails, one if the copy is not whole at the end.

    Args:
        folder: of the run.
        place: the folder of the storage that the copy is in.
        restore: fetch beforehand what the storage has further.

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
