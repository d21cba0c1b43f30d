"""What the processes of one user share on a machine with others: a folder that nobody else enters, and no proxy."""

import os
import shutil
import tempfile
from collections.abc import Iterator, MutableMapping
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


def bypass_proxies(environment: MutableMapping[str, str]) -> None:
    """Have programs with this environment ask servers on this machine directly: a proxy would receive their tokens."""
    given = environment.get("no_proxy") or environment.get("NO_PROXY") or ""
    if given != "*" and LOOPBACK not in given:
        given = f"{given},{LOOPBACK}".removeprefix(",")
    environment.update(no_proxy=given, NO_PROXY=given)
