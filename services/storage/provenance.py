"""What made a result: the versions of the libraries, and the commit of the code."""

import subprocess
from functools import cache
from importlib.metadata import version
from pathlib import Path

LIBRARIES = ("dmil", "torch", "numpy", "mujoco", "metaworld", "gymnasium", "ray", "mlflow")


@cache
def library_versions() -> dict[str, str]:
    """Return the versions that a result depends on."""
    return {library: version(library) for library in LIBRARIES}


def git_commit() -> str:
    """Return the commit of the code, with ``-dirty`` if it was changed since, or ``unknown`` outside a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
