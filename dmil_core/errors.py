"""Errors told in words: those that are the user's to mend, and those that stop a run all the same."""

import reprlib
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from pydantic import ValidationError

MOST_LINES = 10


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


class _Shortened(reprlib.Repr):
    """Shortens also what has no decimal digits: Python refuses to write out integers of some thousand of them."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = 100

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() < 1000 else f"an integer of {x.bit_length()} bits"


_shortened = _Shortened()


def shown(value: object) -> str:
    """Return a value as it stands in a message: `repr`, cut short however large the value is."""
    return _shortened.repr(value)


def explain(error: ValidationError, whole: str = "settings") -> str:
    """Return one line for each wrong value, of the first ones: the key, what it got, and what was wanted.

    Args:
        error: of a model of pydantic's.
        whole: what to name where no key is to blame.
    """
    problems = error.errors(include_url=False)
    lines: list[str] = []
    for problem in problems[:MOST_LINES]:
        where = ".".join(map(str, problem["loc"])) or whole
        message = problem["msg"].removeprefix("Value error, ")
        # A validator of our own names the key, the value and what was wanted by itself.
        own = problem["type"] == "value_error"
        short = where if len(where) <= 100 else f"{where[:50]}...{where[-50:]}"
        lines.append(message if own else f"{short}: got {shown(problem['input'])}; {message[0].lower()}{message[1:]}")
    if len(problems) > MOST_LINES:
        lines.append(f"and {len(problems) - MOST_LINES} more")
    return "\n".join(lines)
