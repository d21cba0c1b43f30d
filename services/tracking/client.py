"""MLflow's client as a run uses it: never waited for long, asked directly on this machine, answers of limited size."""

import os
import time
from io import BytesIO
from typing import TYPE_CHECKING, Any

from requests import PreparedRequest, Response
from requests.adapters import HTTPAdapter

from dmil_core.errors import RunError
from services.storage.private import bypass_proxies
from services.tracking.links import database

if TYPE_CHECKING:
    from mlflow import MlflowClient

MLFLOW_DEFAULTS = {
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",  # a call that MLflow's client made again by itself could make a second run
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "60",  # a slow answer is no trouble for a thread
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",  # it would print a traceback of what it raises, into the live screen
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
}
MOST_BYTES = 2**26
SECONDS_FOR_AN_ANSWER = 300.0
PART_BYTES = 2**16


def set_mlflow_defaults() -> None:
    """Set the environment variables that MLflow's client has for settings, where they are not set.

    It takes them from nowhere else, and some when it is first imported: call this before.
    """
    os.environ.update({name: value for name, value in MLFLOW_DEFAULTS.items() if name not in os.environ})
    bypass_proxies(os.environ)


def connect(uri: str) -> "MlflowClient":
    """Return a client of the MLflow at `uri`, whose answers are read up to `MOST_BYTES` and no longer than minutes.

    Raises:
        RunError: if it is a file that cannot be there.
    """
    set_mlflow_defaults()
    _check_place(uri)
    from mlflow import MlflowClient  # takes seconds to import: not before it is needed
    from mlflow.utils import request_utils

    adapter = request_utils.TCPKeepAliveHTTPAdapter  # MLflow makes its sessions with what has this name
    if not issubclass(adapter, BoundedAnswers):
        request_utils.TCPKeepAliveHTTPAdapter = type("BoundedAdapter", (BoundedAnswers, adapter), {})
    return MlflowClient(uri)


def _check_place(uri: str) -> None:
    """Refuse a file that SQLite cannot open: MLflow would try again and again for minutes."""
    file = database(uri)
    if file is None:
        return
    there = next(place for place in (file, *file.absolute().parents) if os.path.exists(place))  # noqa: PTH110
    if (there == file) == there.is_dir():
        raise RunError(f"{there} is {'a' if there == file else 'no'} folder")
    if not os.access(there, os.R_OK if there == file else os.W_OK):
        raise RunError(f"{there} cannot be {'read' if there == file else 'written to'}")


class BoundedAnswers(HTTPAdapter):
    """Reads an answer at once, unless it is a file, and refuses one without end."""

    def send(self, request: PreparedRequest, stream: bool = False, *args: Any, **options: Any) -> Response:
        """Send a request.

        Raises:
            RunError: if the answer is too long, or comes too slowly.
        """
        response = super().send(request, stream, *args, **options)
        if not stream:
            response.raw = BytesIO(_whole(response))
        return response


def _whole(response: Response) -> bytes:
    body, deadline = bytearray(), time.monotonic() + SECONDS_FOR_AN_ANSWER
    while part := response.raw.read1(PART_BYTES, decode_content=True):
        body += part
        if len(body) > MOST_BYTES or time.monotonic() > deadline:
            response.raw.close()
            raise RunError(
                f"got an answer of over {len(body) >> 20} MiB or {SECONDS_FOR_AN_ANSWER:.0f} s; wanted MLflow's"
            )
    return bytes(body)
