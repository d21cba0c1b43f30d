"""Files on disk: written whole or not at all, and read only as far as is sane."""

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from dmil_core.errors import RunError, UserError, describe_errors

Model = TypeVar("Model", bound=BaseModel)

FULL = {errno.ENOSPC, errno.EDQUOT}
FULL_IN_WORDS = ("No space left on device", "Disk quota exceeded", "os error 28", "errno = 28")
"""How libraries that write by themselves say it."""


class DiskFullError(RunError):
    """A disk without room for what is to be written."""


@contextmanager
def room_for(path: Path, needed: int) -> Iterator[None]:
    """Write `needed` bytes to `path` inside; its folder need not exist yet.

    Raises:
        DiskFullError: if they are not there before, or run out meanwhile.
    """
    there = next(folder for folder in path.absolute().parents if folder.exists())
    free = shutil.disk_usage(there).free
    try:
        if free < needed:
            raise OSError(errno.ENOSPC, "No space left on device")
        yield
    except Exception as error:
        if not _for_want_of_space(error):
            raise
        raise DiskFullError(
            f"{path}: needs {needed} bytes, its disk had {free} free; nothing half-written is kept; make room, then "
            "start again: a run goes on with --resume"
        ) from error


def _for_want_of_space(error: Exception) -> bool:
    return (isinstance(error, OSError) and error.errno in FULL) or any(words in str(error) for words in FULL_IN_WORDS)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file beside, sync it and rename it: whoever reads `path` finds what it was, or all of the new content.

    Raises:
        DiskFullError: for want of space; `path` is then what it was.
    """
    data = content.encode() if isinstance(content, str) else content
    beside = path.with_name(f".{path.name}.writing")
    with room_for(path, len(data)):
        try:
            with beside.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(path)
        except OSError:
            beside.unlink(missing_ok=True)
            raise
        sync(path.parent)


def sync(path: Path) -> None:
    """Have a file's content, or a folder's list of files, reach the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_file(path: Path, most: int) -> bytes:
    """Return the content of a regular file of at most `most` bytes.

    Raises:
        OSError: for anything else: nothing there, a folder, a device that never ends, a larger file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # a pipe without a writer would wait for ever
    with os.fdopen(descriptor, "rb") as file:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "is no regular file", str(path))
        if found.st_size > most:
            raise OSError(errno.EFBIG, f"of {found.st_size} bytes, of which at most {most} are read", str(path))
        return file.read(found.st_size)  # it makes room for as many bytes as it is asked for


def inside(root: Path, name: str) -> Path:
    """Return the path `name` under `root`, with all links followed.

    Raises:
        OSError: if it lies elsewhere: an absolute path, one with ``..``, a link that leads out or to itself.
    """
    try:
        path = (root / name).resolve()
    except RuntimeError as error:  # so Python 3.11 and 3.12 say it
        raise OSError(errno.ELOOP, "is a link to itself", name) from error
    if not path.is_relative_to(root.resolve()):
        raise OSError(errno.EPERM, f"lies outside {root}", name)
    return path


def read_json(path: Path, model: type[Model], most: int, advice: str) -> Model:
    """Read a JSON file of at most `most` bytes into a model of pydantic's.

    Raises:
        UserError: names the file and what is wrong in it, with `advice`: what was wanted and what to do.
    """
    try:
        return model.model_validate_json(read_file(path, most))
    except ValidationError as error:
        raise UserError(f"{path}: got {describe_errors(error, separator='; ')}; {advice}") from error
