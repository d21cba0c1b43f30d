"""Addresses of MLflow and of its pages: of a run, and of runs side by side."""

import json
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit, urlunsplit

SQLITE = "sqlite:///"
DEFAULT_URI = f"{SQLITE}mlflow.db"
PORT = 5000
LOCAL = f"http://127.0.0.1:{PORT}"
"""Where ``services.tracking ui`` serves what is no server itself."""

TRAINING = "workflowType=machine_learning"
"""What has MLflow show its pages for training beside, not those for applications of language models."""


def tracking_uri() -> str:
    """Return ``MLFLOW_TRACKING_URI``, or an SQLite file in the working directory."""
    return os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_URI


def database(uri: str) -> Path | None:
    """Return the file that holds the records of an MLflow that is a file."""
    return Path(unquote(uri.removeprefix(SQLITE).partition("?")[0])) if uri.startswith(SQLITE) else None


def run_link(uri: str, experiment_id: str, run_id: str) -> str:
    """Return the address of a run's page, for an MLflow at `uri`."""
    return f"{_site(uri)}/#/experiments/{experiment_id}/runs/{run_id}?{TRAINING}"


def comparison_link(uri: str, experiment_id: str, run_ids: Sequence[str]) -> str:
    """Return the address of the page that has runs of one experiment side by side."""
    runs, experiments = (quote(json.dumps(ids, separators=(",", ":"))) for ids in (list(run_ids), [experiment_id]))
    return f"{_site(uri)}/#/compare-runs?runs={runs}&experiments={experiments}&{TRAINING}"


def ui_command(uri: str) -> str | None:
    """Return the command that serves the pages of an MLflow that is a file, or None of one that serves them itself."""
    if not uri.startswith("sqlite"):
        return None
    return f"{'' if uri == DEFAULT_URI else f'MLFLOW_TRACKING_URI={shlex.quote(uri)} '}dmil tracking ui"


def artifacts_beside(uri: str) -> Path | None:
    """Return where artifacts go: beside an SQLite file, and else where the server says."""
    file = database(uri)
    return None if file is None else file.resolve().parent / "mlartifacts"


def _site(uri: str) -> str:
    """Return where the pages are, without a user and a password."""
    if not uri.startswith("http"):
        return LOCAL
    parts = urlsplit(uri)
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2], path=parts.path.rstrip("/"), query=""))
