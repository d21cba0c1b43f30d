"""A program's output, which never ends the program: what it does not take is lost, and that is told once elsewhere."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


class SteadyStream:
    """A stream that raises nothing when it is closed, full or gone, or lacks a character."""

    def __init__(self, stream: TextIO, name: str, other: TextIO) -> None:
        """Write to `stream`; the first failure is told in `other`."""
        self._stream, self._name, self._other = stream, name, other
        self._is_lost = False

    def __getattr__(self, attribute: str) -> Any:
        return getattr(self._stream, attribute)

    def write(self, text: str) -> int:
        """Write a text, with escapes in place of characters that the stream's encoding lacks."""
        try:
            try:
                self._stream.write(text)
            except UnicodeEncodeError as error:
                self._stream.write(text.encode(error.encoding, "backslashreplace").decode(error.encoding))
        except (OSError, ValueError) as error:
            self._lose(error)
        return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        try:
            self._stream.flush()
        except (OSError, ValueError) as error:
            self._lose(error)

    def _lose(self, error: Exception) -> None:
        """Send what comes, and what is buffered still, nowhere."""
        with suppress(OSError, ValueError):  # it may have no descriptor, or be closed
            _to_nowhere(self._stream.fileno())
        if not self._is_lost:
            self._is_lost = True
            with suppress(OSError, ValueError):
                self._other.write(f"warning: {self._name} takes no more text ({error}); going on without\n")
                self._other.flush()


def _to_nowhere(descriptor: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != descriptor:
        os.dup2(nowhere, descriptor)
        os.close(nowhere)


@contextmanager
def steady_streams() -> Iterator[None]:
    """Have what goes wrong with the standard streams inside end nothing, also where they were closed from the start."""
    for descriptor in range(3):  # a file that was opened later would get its number, and what is printed
        try:
            os.fstat(descriptor)
        except OSError:
            _to_nowhere(descriptor)
    before = sys.stdout, sys.stderr
    out, err = (stream or open(os.devnull, "w") for stream in before)  # noqa: PTH123, SIM115  for the process's life
    sys.stdout = cast("TextIO", SteadyStream(out, "standard output", err))
    sys.stderr = cast("TextIO", SteadyStream(err, "standard error", out))
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before
