"""Deliver to MLflow what it did not take while a run was on, tell how much that is, or deliver the report once more.

MLflow is where MLFLOW_TRACKING_URI says, and else the file mlflow.db in this folder: its pages are served by ui.
"""

import os
import secrets
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn

import tyro
from tyro.conf import Positional

from dmil_core.errors import RunError, UserError
from dmil_core.files import inside
from services.cli.arguments import exit_code, parse
from services.cli.progress import console
from services.storage.redaction import error_line, redacted
from services.storage.run_folders import SPOOL, find_folder
from services.tracking.delivery import REFUSED, Delivery
from services.tracking.links import PORT, artifacts_beside, tracking_uri
from services.tracking.spool import Artifact, Spool

REPORT = "report"
"""In a run's folder, and among its artifacts."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``tracking``."""

    action: Positional[Literal["flush", "status", "report", "ui"]]
    """Deliver what waits, tell what does, deliver the folder report again, as it is after services.report, or serve
    MLflow's pages to you alone."""
    run: Positional[str] = ""
    """Name or folder of a run."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""
    port: int = PORT
    """That ui listens on."""


def run(arguments: Sequence[str]) -> None:
    """Run the program.

    Raises:
        UserError: if there is no such run, or another process is delivering its records.
        RunError: if MLflow does not take the records.
    """
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    uri = tracking_uri()
    if args.action == "ui":
        _serve(uri, args.port)
    folder = find_folder(args.run, args.runs, SPOOL, "RUN")
    if args.action == "report":
        _report(folder, uri)
        return
    trials = sorted(spool.parent.relative_to(folder) for spool in folder.glob(f"trials/*/{SPOOL}"))  # of a sweep
    for own in (folder, *(inside(folder, trial) for trial in trials)):
        delivery = Delivery(own, uri)
        try:
            _flush(delivery, own, uri) if args.action == "flush" else _status(delivery)
        finally:
            delivery.close()


def _serve(uri: str, port: int) -> NoReturn:
    """Become MLflow's server, with a token of its own."""
    if uri.startswith("http"):
        raise UserError(f"MLFLOW_TRACKING_URI: got {redacted(uri)}, which has pages itself; wanted a database")
    from services.tracking.server import server_command, server_environment

    token = secrets.token_urlsafe()
    console.print(f"MLflow: http://127.0.0.1:{port}\nuser:   any\npassword: {token}", soft_wrap=True)
    console.print("MLflow's own messages follow; Ctrl-C ends it")
    command = server_command(artifacts_beside(uri) or Path("mlartifacts"), port)
    os.execve(sys.executable, command, {**os.environ, **server_environment(uri, token)})


def _flush(delivery: Delivery, folder: Path, uri: str) -> None:
    delivery.take_over()  # another may have been at it until now
    before, waiting = delivery.identity.delivered, len(delivery.waiting())
    try:
        delivery.deliver()
    except (RunError, UserError):
        raise
    except Exception as error:  # noqa: BLE001  MLflow and what is below it raise many kinds
        raise RunError(
            f"MLflow at {redacted(uri)} does not take records: {error_line(error)}; "
            f"{delivery.identity.delivered - before} of {waiting} were delivered, the others wait in "
            f"{folder / SPOOL}; set MLFLOW_TRACKING_URI to the MLflow that the run began with, and "
            "flush again"
        ) from None  # its text may hold secrets
    console.print(
        f"delivered: {delivery.identity.delivered - before} of {waiting} records, MLflow run {delivery.identity.run_id}"
    )
    if (folder / REFUSED).exists():
        console.print(f"of all, those that MLflow refuses for good are in {folder / REFUSED}, each with the reason")


def _report(folder: Path, uri: str) -> None:
    """Record the folder with the report of a run that is over once more, and deliver it."""
    if not (folder / REPORT).is_dir():
        raise UserError(f"RUN: got {folder}, which has no folder {REPORT}; wanted a finished run: dmil report run")
    delivery = Delivery(folder, uri)
    try:
        _flush(delivery, folder, uri)  # nobody else delivers, and so records, from here on
        spool = Spool(folder / SPOOL)
        spool.append("artifact", Artifact(path=REPORT, folder=REPORT))
        spool.close()
        _flush(delivery, folder, uri)
    finally:
        delivery.close()


def _status(delivery: Delivery) -> None:
    waiting = len(delivery.waiting())
    console.print(f"MLflow run: {delivery.identity.run_id or 'not there yet'}")
    console.print(
        f"records: {delivery.identity.delivered + waiting}, delivered {delivery.identity.delivered}, waiting {waiting}"
    )
    if delivery.busy():
        console.print("a process, the run itself or a flush, is delivering them")


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
