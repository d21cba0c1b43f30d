"""The one way into a folder: what lies below it is opened by its name there, through no link, and written whole.

A folder may come from a stranger. Its own path is the user's word, and may lead through links; below it nothing may.
"""

import errno
import os
import secrets
import shutil
import stat
import string
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from io import BufferedReader, FileIO
from pathlib import Path, PurePath
from tempfile import TemporaryFile
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from dmil_core.errors import RunError, UserError, describe_errors, shorten

Model = TypeVar("Model", bound=BaseModel)

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
FULL_IN_WORDS = (
    "No space left on device",
    "Disk quota exceeded",
    "os error 28",
    "errno = 28",
    "errno = 27",
    "errno = 122",
)
"""How libraries that write by themselves say it."""


WRITING = ".writing-"
"""Begins the name of a folder that is being made; the rest are hexadecimal digits."""
FOLDER = os.O_RDONLY | os.O_DIRECTORY
Name = str | PurePath
"""A path below a folder, without ``..``."""

_AT_WORK: list[Path] = []
"""The folders of `at_work_in`, one as often as it is held."""


class DiskFullError(RunError):
    """A disk without room for what is to be written."""


class ForeignFileError(OSError, UserError):
    """What a folder of this program's has no place for: a link, a pipe, a device, more bytes than are sane."""

    def __str__(self) -> str:
        """Return what was found where, and what to do."""
        return (
            f"{self.filename}: got {self.strerror}; wanted a plain file or folder; put what is meant in its place, or "
            "remove it"
        )


def at_home(path: str | Path) -> Path:
    """Return a path that somebody gave, with ``~`` or ``~user`` in the place where shells know it."""
    try:
        return Path(path).expanduser()
    except RuntimeError:  # there is no such user
        return Path(path)


def check_folder(folder: Path, mark: str = ".") -> None:
    """See whether a folder is there still, with the file `mark` in it: what is gone must not be begun anew beside.

    Raises:
        RunError: if not.
    """
    if not (folder / mark).exists():
        raise RunError(f"{folder}: got no such folder any more; wanted it where it was; put it back, then go on")


@contextmanager
def at_work_in(folder: Path) -> Iterator[None]:
    """Make nothing below a folder inside once that is gone: `check_folder` then raises in the place of a new one."""
    _AT_WORK.append(folder)
    try:
        yield
    finally:
        _AT_WORK.remove(folder)


@contextmanager
def room_for(path: Path, needed: int) -> Iterator[None]:
    """Write `needed` bytes to `path` inside; its folder need not exist yet.

    Raises:
        DiskFullError: if they are not there before, or run out meanwhile.
    """
    there = next(folder for folder in path.absolute().parents if folder.exists())
    total, _, free = shutil.disk_usage(there)
    try:
        if free < needed and total:  # some network disks do not tell their size
            raise OSError(errno.ENOSPC, "No space left on device")
        yield
    except Exception as error:
        if not _for_want_of_space(error):
            raise
        limit = ", but a quota or ulimit -f allows less" if free >= needed else ""
        raise DiskFullError(
            f"{path}: needs {needed} bytes, its disk had {free} free{limit}; nothing half-written is kept; make room, "
            "then start again: a run goes on with --resume"
        ) from error


def reserve(folder: Path, needed: int) -> None:
    """See whether `needed` bytes can be written in a folder, for a library that does not survive it if they cannot.

    Raises:
        OSError: if not.
    """
    with TemporaryFile(dir=folder) as file:
        os.posix_fallocate(file.fileno(), 0, needed)


def _for_want_of_space(error: Exception) -> bool:
    return (isinstance(error, OSError) and error.errno in FULL) or any(words in str(error) for words in FULL_IN_WORDS)


def open_descriptor(root: Path, name: Name, flags: int) -> int:
    """Return the descriptor of a regular file below a folder; with ``os.O_CREAT`` its folders are made too.

    Raises:
        ForeignFileError: for a link on the way or at its end, and for anything but a regular file.
        RunError: if the folder is gone that this process works in, see `at_work_in`.
        OSError: if it cannot be opened.
    """
    path = root / name
    with _parent(root, name, make=bool(flags & os.O_CREAT)) as folder:
        descriptor = _open(path, flags, folder)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ForeignFileError(errno.EINVAL, "no regular file", str(path))
    return descriptor


@contextmanager
def _parent(root: Path, name: Name, *, make: bool = False) -> Iterator[int]:
    """Give the descriptor of the folder that `name` lies in."""
    if make:
        for folder in tuple(_AT_WORK):  # threads come and go
            if root.is_relative_to(folder):
                check_folder(folder)
        root.mkdir(parents=True, exist_ok=True)
    with ExitStack() as opened:
        path, here = root, os.open(root, FOLDER)
        opened.callback(os.close, here)
        for part in _parts(name)[:-1]:
            path = path / part
            if make:
                with suppress(FileExistsError):
                    os.mkdir(part, dir_fd=here)
            here = _open(path, FOLDER, here)
            opened.callback(os.close, here)
        yield here


def _parts(name: Name) -> tuple[str, ...]:
    parts = PurePath(name).parts
    if not parts or PurePath(name).is_absolute() or ".." in parts or "\0" in str(name):
        raise ForeignFileError(errno.EPERM, "a path that lies outside its folder", shorten(str(name)))
    return parts


def _open(path: Path, flags: int, folder: int) -> int:
    """Open the last part of `path`, which lies in `folder`."""
    try:  # a pipe without a writer would wait for ever
        return os.open(path.name, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666, dir_fd=folder)
    except OSError as error:
        if error.errno in {errno.ELOOP, errno.ENOTDIR} and path.is_symlink():
            raise ForeignFileError(errno.ELOOP, "a link, which is not followed", str(path)) from None
        raise OSError(error.errno, error.strerror, str(path)) from None


def open_file(root: Path, name: Name, most: int | None = None) -> BufferedReader:
    """Open a regular file below a folder for reading.

    Raises:
        ForeignFileError: as `open_descriptor`, and for one of over `most` bytes.
        OSError: if there is none.
    """
    file = os.fdopen(open_descriptor(root, name, os.O_RDONLY), "rb")
    if most is not None and (size := os.fstat(file.fileno()).st_size) > most:
        file.close()
        raise ForeignFileError(errno.EFBIG, f"{size} bytes, of which at most {most} are read", str(root / name))
    return file


def read_file(root: Path, name: Name, most: int) -> bytes:
    """Return the content of a regular file of at most `most` bytes below a folder.

    Raises:
        ForeignFileError: as `open_file`.
        OSError: if there is none.
    """
    with open_file(root, name, most) as file:
        return file.read(os.fstat(file.fileno()).st_size)  # it makes room for as many bytes as it is asked for


def named(path: Path) -> tuple[Path, str]:
    """Return the folder and the name of a file that the user named, which may be a link: all links are followed."""
    found = Path(os.path.realpath(path))
    return found.parent, found.name


def append_to(root: Path, name: Name) -> FileIO:
    """Open a regular file below a folder at its end, unbuffered; it is made if it is not there.

    Raises:
        ForeignFileError: as `open_descriptor`.
    """
    return FileIO(open_descriptor(root, name, os.O_RDWR | os.O_APPEND | os.O_CREAT), "ab")


def create_file(root: Path, name: Name, content: bytes) -> None:
    """Write a new file below a folder, unsynced.

    Raises:
        FileExistsError: if there is something of that name.
        ForeignFileError: for a link on the way.
    """
    with os.fdopen(open_descriptor(root, name, os.O_WRONLY | os.O_CREAT | os.O_EXCL), "wb") as file:
        file.write(content)


def write_file(root: Path, name: Name, content: str | bytes) -> None:
    """Write a file below a folder beside, sync it and rename it; the folders on the way are made.

    Whoever reads it finds what it was, or all of the new content. A link of its name is replaced, not followed.

    Raises:
        ForeignFileError: for a link on the way.
        DiskFullError: for want of space; the file is then what it was.
    """
    data = content.encode() if isinstance(content, str) else content
    path = root / name
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.writing")
    with room_for(path, len(data)), _parent(root, name, make=True) as folder:
        try:
            with os.fdopen(_open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, folder), "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.rename(beside.name, path.name, src_dir_fd=folder, dst_dir_fd=folder)
        except BaseException:
            with suppress(FileNotFoundError):
                os.unlink(beside.name, dir_fd=folder)
            raise
        os.fsync(folder)


@contextmanager
def making_folder(root: Path, name: Name, *, instead: bool = False) -> Iterator[Path]:
    """Make a folder whole or not at all: what is written into the one given, beside it, is synced and renamed.

    With `instead` it takes the place of what has its name by then.

    Raises:
        FileExistsError: if there is one of that name by then.
        ForeignFileError: for a link on the way.
    """
    path = root / name
    beside = path.with_name(f"{WRITING}{secrets.token_hex(8)}")
    with _parent(root, name, make=True) as folder:
        try:
            os.mkdir(beside.name, dir_fd=folder)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None
        try:
            yield beside
            for made in (*beside.rglob("*"), beside):
                sync(made)
            if instead:
                _remove(path.name, folder)
            try:
                os.rename(beside.name, path.name, src_dir_fd=folder, dst_dir_fd=folder)
            except OSError as error:
                taken = error.errno in {errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR}
                raise OSError(errno.EEXIST if taken else error.errno, error.strerror, str(path)) from error
            os.fsync(folder)
        finally:
            shutil.rmtree(beside.name, ignore_errors=True, dir_fd=folder)


def _remove(name: str, folder: int) -> None:
    """Remove whatever has a name in a folder; of a link the link itself."""
    try:
        os.unlink(name, dir_fd=folder)
    except IsADirectoryError:
        shutil.rmtree(name, dir_fd=folder)
    except FileNotFoundError:
        pass


def remove_abandoned(root: Path, name: Name) -> None:
    """Remove what killed processes left of folders that they were making in a folder; nobody else may be making one."""
    for path in (root / name).glob(f"{WRITING}*"):
        if not path.is_symlink() and path.is_dir() and set(path.name.removeprefix(WRITING)) <= set(string.hexdigits):
            remove_folder(root, PurePath(name) / path.name)


def remove_folder(root: Path, name: Name) -> None:
    """Remove a folder below a folder, with all that is in it.

    Raises:
        OSError: if it is a link, or there is none.
    """
    with _parent(root, name) as folder:
        shutil.rmtree(PurePath(name).name, dir_fd=folder)


def remove_file(root: Path, name: Name) -> None:
    """Remove a file below a folder, if it is there; of a link the link itself."""
    with suppress(FileNotFoundError, NotADirectoryError), _parent(root, name) as folder:
        os.unlink(PurePath(name).name, dir_fd=folder)


def copy_plain(root: Path, name: Name, target: Path) -> list[Path]:
    """Copy a file, or the regular files of a folder, into the folder `target`.

    Returns:
        What of the folder was left out: links, pipes and the like.

    Raises:
        ForeignFileError: for a link on the way, and for what is neither file nor folder.
        FileNotFoundError: if there is nothing.
    """
    top = inside(root, name)
    base, found = (top, sorted(top.rglob("*"))) if top.is_dir() else (top.parent, [top])
    for path in found:
        if path == top or stat.S_ISREG(path.lstat().st_mode):
            made = open_descriptor(target, path.relative_to(base), os.O_WRONLY | os.O_CREAT | os.O_EXCL)
            with os.fdopen(made, "wb") as copy, open_file(root, path.relative_to(root)) as content:
                shutil.copyfileobj(content, copy)
    return [path for path in found if not (stat.S_ISREG(mode := path.lstat().st_mode) or stat.S_ISDIR(mode))]


def sync(path: Path) -> None:
    """Have a file's content, or a folder's list of files, reach the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def inside(root: Path, name: Name) -> Path:
    """Return the path `name` under `root`, which need not be there.

    Raises:
        ForeignFileError: if it may lie elsewhere: an absolute path, one with ``..``, a link on the way or at its end.
    """
    path = root
    for part in _parts(name):
        path = path / part
        if path.is_symlink():
            raise ForeignFileError(errno.ELOOP, "a link, which is not followed", str(path))
    return path


def read_json(root: Path, name: Name, model: type[Model], most: int, advice: str) -> Model:
    """Read a JSON file of at most `most` bytes below a folder into a model of pydantic's.

    Raises:
        UserError: names the file, and what is wrong with it or in it, with `advice`: what was wanted and what to do.
    """
    try:
        return model.model_validate_json(read_file(root, name, most))
    except (OSError, ValidationError) as error:
        wrong = isinstance(error, ValidationError)
        got = describe_errors(error, separator="; ") if wrong else error.strerror or str(error)
        raise UserError(f"{root / name}: got {got}; {advice}") from error
