"""One process works in a folder at a time, and a second one is told which."""

import errno
import fcntl
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from pydantic import BaseModel, ValidationError

from dmil_core.errors import UserError
from dmil_core.files import at_work_in, open_descriptor, room_for

logger = logging.getLogger(__name__)

LOCK = ".lock"
MAX_BYTES = 2**12
WITHOUT_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}
"""How a file system says that it has none."""


class FolderHeldError(UserError):
    """A folder that another process works in."""


class Holder(BaseModel):
    """The process that works in a folder."""

    host: str
    process: int
    since: str


@contextmanager
def held(folder: Path, name: str = LOCK, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder while this process works in it; the end of the process, however it comes, frees it.

    It is made if it is not there; if it is moved away meanwhile, it is not made anew. On a file system without locks a
    warning takes the lock's place. With `wait`, the end of another process that holds it is waited for.

    Raises:
        DiskFullError: for want of space.
        FolderHeldError: names the process that holds the folder.
    """
    descriptor = open_descriptor(folder, name, os.O_RDWR | os.O_CREAT)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderHeldError(
                f"{folder}: got {_holder(descriptor)} at work in it; wanted a folder that no other process works in; "
                "wait until that one ends, or stop it"
            ) from error
        except OSError as error:
            if error.errno not in WITHOUT_LOCKS:
                raise
            logger.warning(f"{folder}: its file system has no locks; see to it that only one process works in it")
        holder = Holder(
            host=socket.gethostname(), process=os.getpid(), since=f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
        )
        content = holder.model_dump_json().encode()
        with room_for(folder / name, len(content)):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, content, 0)
        with at_work_in(folder):
            yield
    finally:
        os.close(descriptor)


def _holder(descriptor: int) -> str:
    try:
        holder = Holder.model_validate_json(os.pread(descriptor, MAX_BYTES, 0))
    except ValidationError:
        return "another process"
    return f"process {holder.process} of {holder.host}, since {holder.since},"
