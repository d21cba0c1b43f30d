"""Errors told in words: those that are the user's to mend, and those that stop a run all the same."""

import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

__all__ = ["RunError", "UserError", "WorkError", "piece_of_work"]


class UserError(ValueError):
    """Something the user gave cannot be used.

    Its message names the field or file, what it got, what was wanted and what to do. Programs print it without a
    traceback and end with exit code 2.
    """


class RunError(RuntimeError):
    """Something that is not the user's mistake stops a run: a fault in a worker, a full disk, numbers gone wrong.

    Its message names where it happened and how to go on. Programs print it without a traceback and end with exit
    code 1.
    """


class WorkError(RuntimeError):
    """A Python error in a piece of pure work, with all that is needed to do that piece again, alone."""

    def __init__(self, where: str, problem: str, trace: str, piece: Mapping[str, str | int]) -> None:
        """Tell of an error.

        Args:
            where: which piece of work it was, in words.
            problem: the last line of the traceback.
            trace: all of it.
            piece: what names the piece among all.
        """
        super().__init__(where, problem, trace, piece)  # all, for it travels between processes
        self.where, self.problem, self.trace, self.piece = where, problem, trace, piece

    def __str__(self) -> str:
        """Say what is told in one line."""
        return f"{self.where}: {self.problem}"


@contextmanager
def piece_of_work(where: str, **piece: str | int) -> Iterator[None]:
    """Do a piece of pure work inside.

    Args:
        where: which one it is, in words.
        piece: what names it among all.

    Raises:
        WorkError: for any error that is not the user's.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        problem = traceback.format_exception_only(error)[-1].strip()
        raise WorkError(where, problem, traceback.format_exc(), piece) from error
