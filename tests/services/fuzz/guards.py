"""Guards around the reading of an input that nobody vouches for: time, memory, and that reading is all it does."""

import os
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
DEEDS = (
    "os.chmod", "os.exec", "os.fork", "os.link", "os.mkdir", "os.posix_spawn", "os.remove", "os.rename", "os.rmdir",
    "os.symlink", "os.system", "os.truncate", "pickle.find_class", "shutil.", "socket.connect", "subprocess.Popen",
)  # fmt: skip
"""Events of the interpreter that no reader causes."""


class GuardError(BaseException):
    """A reader took too long, or did more than read; no `except Exception` stops it."""


_seen: list[str] | None = None
"""What the reader under watch did; None while none is."""


def _notice(event: str, arguments: tuple[object, ...]) -> None:
    if _seen is None:
        return
    if event == "open":
        path, _, flags = arguments
        if isinstance(flags, int) and flags & WRITING:
            _seen.append(f"opened {path} to write")
    elif event.startswith(DEEDS):
        _seen.append(f"{event}{arguments}")


def _too_long(number: int, frame: object) -> None:
    raise GuardError("took too long")


def set_up(spare_bytes: int) -> None:
    """Watch this process from now on, and leave it only so much more memory than it has.

    Where it asks for more, Python raises MemoryError and a library ends the process.
    """
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + spare_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    sys.addaudithook(_notice)
    signal.signal(signal.SIGPROF, _too_long)
    sys.dont_write_bytecode = True  # of what a reader imports late


@contextmanager
def guarded(seconds: float) -> Iterator[None]:
    """Raise GuardError if what is done inside takes more processor time, or writes, deletes, starts or connects."""
    global _seen
    _seen = seen = []
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        _seen = None
        if seen:
            raise GuardError("; ".join(seen))
