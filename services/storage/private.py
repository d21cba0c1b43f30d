"""What the processes of one user share on a machine with others: a folder and a token of their own, and no proxy."""

import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path

from dmil_core.errors import UserError

PREFIX = "dmil-"
LONGEST_BASE = 18
"""Bytes: a socket's path has 107 at most, and Ray's sockets lie up to 89 deeper."""
LOOPBACK = "localhost,127.0.0.1,::1"


def make_private_folder() -> Path:
    """Return a new folder that only this user can enter, with a path short enough for Ray's sockets.

    It lies in ``RAY_TMPDIR`` or ``TMPDIR`` if their paths are short, and else in ``/tmp``. What lies in it may have any
    permissions, as Ray gives everybody all of them: nobody else gets there.

    Raises:
        UserError: if none of these can be written.
    """
    bases = dict.fromkeys((os.environ.get("RAY_TMPDIR", ""), tempfile.gettempdir(), "/tmp"))
    short = [base for base in bases if base and len(os.fsencode(os.path.abspath(base))) <= LONGEST_BASE]  # noqa: PTH100
    for base in short:
        try:
            return Path(tempfile.mkdtemp(prefix=PREFIX, dir=base)).absolute()
        except OSError:
            continue
    raise UserError(
        f"TMPDIR: got no folder among {', '.join(short)} that can be written; wanted one for the sockets of Ray, whose "
        f"path has at most {LONGEST_BASE} bytes; set TMPDIR to it"
    )


@contextmanager
def private_folder() -> Iterator[Path]:
    """Have a folder that only this user can enter, and remove it in the end.

    Raises:
        UserError: if there is no place for it.
    """
    folder = make_private_folder()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def private_token(folder: Path, warn: Callable[[str], object]) -> Path:
    """Return the file ``token`` in a folder, which is made if there is none yet, or others could read or replace it.

    `warn` receives what was open to others.

    Raises:
        UserError: if the folder or the token is somebody else's.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    path = folder / "token"
    if exposed := _exposure(folder, 0o022) or _exposure(path, 0o077):
        warn(f"{exposed}, open to other users; it is closed, and a new token made")
        folder.chmod(0o700)
        path.unlink(missing_ok=True)
    if not path.exists() or path.stat().st_size == 0:  # empty: a start was killed
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(secrets.token_hex(32))
    return path


def _exposure(path: Path, closed: int) -> str | None:
    """Return how others can get at a path of one's own by its mode bits `closed`, or None."""
    if not os.path.lexists(path):
        return None
    found = path.lstat()
    if stat.S_ISLNK(found.st_mode) or found.st_uid != os.geteuid():
        raise UserError(f"{path}: got a link, or another user's; wanted your own; remove it, or give another --folder")
    return f"{path}: got mode {stat.S_IMODE(found.st_mode):04o}" if found.st_mode & closed else None


def bypass_proxies(environment: MutableMapping[str, str]) -> None:
    """Have programs with this environment ask servers on this machine directly: a proxy would receive their tokens."""
    given = environment.get("no_proxy") or environment.get("NO_PROXY") or ""
    if given != "*" and LOOPBACK not in given:
        given = f"{given},{LOOPBACK}".removeprefix(",")
    environment.update(no_proxy=given, NO_PROXY=given)
