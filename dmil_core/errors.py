"""The one base of every error that is the user's to mend."""

__all__ = ["UserError"]


class UserError(ValueError):
    """Something the user gave cannot be used.

    Its message names the field or file, what it got, what was wanted and what to do. Programs print it without a
    traceback and end with exit code 2.
    """
