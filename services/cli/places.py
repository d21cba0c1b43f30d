"""Where results will lie: reported before the work begins, and refused where somebody else will delete them."""

import os
import re
from pathlib import Path

from dmil_core.errors import UserError
from services.cli.progress import console

RAY_FOLDER = re.compile(r"/(runtime_resources/\w+|session_\d{4}-\d\d-\d\d_[\d_-]+)(/|$)")
"""What lies in it goes with its Ray cluster, or sooner: the packages of jobs, and a session's own files."""


MLFLOW = "MLflow"
"""What stops no run, wherever it is."""


def announce(**places: tuple[Path | None, str]) -> None:
    """Print where results will lie, as absolute paths.

    Args:
        places: by what lies there: a file or folder, or None for what is on no disk of this machine, and how to give
            another, as ``--runs FOLDER`` or ``DMIL_DATA=FOLDER``.

    Raises:
        UserError: if one is in Ray's own folder, as in a job with ``--working-dir``, or where nothing can be, as below
            a file; nothing is printed then.
    """
    resolved = {what: path.resolve() for what, (path, _) in places.items() if path is not None}
    if passing := [what for what, path in resolved.items() if RAY_FOLDER.search(str(path))]:
        got = "; ".join(f"{what}: got {resolved[what]}" for what in passing)
        remedies = [places[what][1] for what in passing]
        raise UserError(
            f"{got}; Ray deletes that with its cluster; wanted what stays: give, with absolute paths, "
            f"{' '.join(remedies)}; a job is given variables by ray job submit --runtime-env-json "
            """'{"env_vars": {"NAME": "VALUE"}}'"""
        )
    for what, path in resolved.items():
        if what != MLFLOW and (why := _misplaced(path, how := places[what][1])):
            raise UserError(f"{what}: got {path}, where {why}; wanted a place for it: {how}")
    for what, path in resolved.items():
        console.print(f"{what}: {path}", soft_wrap=True)


def _misplaced(path: Path, how: str) -> str | None:
    """Return why nothing can be written to `path`, which is given by `how`, or None; who only reads there may read."""
    there = next(place for place in (path, *path.parents) if os.path.exists(place))  # noqa: PTH110  Path's may raise
    if path.is_dir() and how.endswith("FILE"):
        return "a folder is"
    if not there.is_dir() and (there != path or how.endswith("FOLDER")):
        return f"{there} is no folder"
    return f"{there} cannot be written to" if how.startswith("--") and not os.access(there, os.W_OK) else None
