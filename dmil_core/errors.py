"""The two bases of every error that is told in words: the user's to mend, and what stops a run all the same."""

import reprlib

from pydantic import ValidationError

__all__ = ["RunError", "UserError", "explain", "shown"]

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
