"""Errors for people: those that are the user's to mend, and those that stop a run all the same."""

import reprlib
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches

from pydantic import ValidationError

MOST_LINES = 10
ALIKE = 0.3
"""Of the letters of two names, as difflib counts them: what is less alike is not proposed."""


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
    """A Python error in a work item, with all that is needed to run the item again, alone."""

    def __init__(self, label: str, problem: str, trace: str, key: Mapping[str, str | int]) -> None:
        """Name the item by `label` in messages and by `key` among all; `problem` is the last line of `trace`."""
        super().__init__(label, problem, trace, key)  # all, for it travels between processes
        self.label, self.problem, self.trace, self.key = label, problem, trace, key

    def __str__(self) -> str:
        """Return the item and the problem in one line."""
        return f"{self.label}: {self.problem}"


@contextmanager
def as_work_error(label: str, **key: str | int) -> Iterator[None]:
    """Raise an error inside as a `WorkError` of this label and key, unless it is one already or the user's mistake.

    Raises:
        WorkError: names the item.
    """
    try:
        yield
    except (UserError, WorkError):
        raise
    except Exception as error:
        problem = traceback.format_exception_only(error)[-1].strip()
        raise WorkError(label, problem, traceback.format_exc(), key) from error


class _Shortened(reprlib.Repr):
    """Shortens also what has no decimal digits: Python refuses to write out integers of some thousand of them."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = 100

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() < 1000 else f"an integer of {x.bit_length()} bits"


_shortened = _Shortened()


def shorten(value: object) -> str:
    """Return a value as it stands in a message: `repr`, cut short however large the value is."""
    return _shortened.repr(value)


def nearest(name: object, known: Iterable[str]) -> str:
    """Return the three known names that are most like a name, as a message ends with them; nothing if none is."""
    spelled = {one.lower(): one for one in known}
    alike = get_close_matches(str(name)[:100].lower(), spelled, n=3, cutoff=ALIKE)
    return f"; the nearest are {', '.join(spelled[one] for one in alike)}" if alike else ""


def describe_errors(error: ValidationError, whole: str = "settings", separator: str = "\n") -> str:
    """Return each wrong value, of the first ones: the key, what it got, and what was wanted.

    `whole` is named where no key is to blame.
    """
    problems = error.errors(include_url=False)
    lines: list[str] = []
    for problem in problems[:MOST_LINES]:
        where = ".".join(map(str, problem["loc"])) or whole
        message = problem["msg"].removeprefix("Value error, ")
        short = where if len(where) <= 100 else f"{where[:50]}...{where[-50:]}"
        if problem["type"] == "value_error":  # a validator of ours names key, value and what was wanted by itself
            lines.append(message)
        else:
            lines.append(f"{short}: got {shorten(problem['input'])}; {message[0].lower()}{message[1:]}")
    if len(problems) > MOST_LINES:
        lines.append(f"and {len(problems) - MOST_LINES} more")
    return separator.join(lines)
