"""The two bases of every error that is told in words: the user's to mend, and what stops a run all the same."""

__all__ = ["RunError", "UserError"]


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
