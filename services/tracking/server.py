"""MLflow's server behind a token: its pages and its REST interface, without its assistant and its jobs.

MLflow finds `create_app` by the entry point ``mlflow.app``; `server_command` starts it. MLflow's usual server, under
uvicorn, runs a shell for every client on this machine; under gunicorn that part is not there.
"""

import hmac
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flask import Flask, Response, request

APP = "dmil"
"""The name of the entry point."""
TOKEN = "MLFLOW_TRACKING_TOKEN"
"""The environment variable with the token, for the server and for MLflow's clients."""
LOGINS = (TOKEN, "MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD")
"""What MLflow's clients take from the environment to log in with."""
OPEN = "/health"
"""The one path that needs no token."""
REFUSAL = {"WWW-Authenticate": 'Basic realm="MLflow: any user, the token is the password"'}
PLACE = ("artifact_location", "artifactLocation")
"""The field of an experiment's place; protocol buffers know it by both."""
PROXIED = "mlflow-artifacts:"
"""How places below the server's own folder of artifacts begin."""


def server_command(artifacts: Path, port: int) -> list[str]:
    """Return the command that starts the server on a port of loopback, with the one folder of its artifacts."""
    return [
        sys.executable, "-m", "mlflow", "server", "--app-name", APP, "--artifacts-destination", str(artifacts),
        "--host", "127.0.0.1", "--port", str(port), "--workers", "1",
        "--gunicorn-opts", "--threads 8 --timeout 60 --no-control-socket",
    ]  # fmt: skip


def server_environment(store: str, token: str) -> dict[str, str]:
    """Return what the server needs in its environment: neither a store's password nor a token is on a command line."""
    return {
        "MLFLOW_BACKEND_STORE_URI": store,
        "MLFLOW_DISABLE_TELEMETRY": "true",
        "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",  # 2 processes in place of 10
        TOKEN: token,
    }


def create_app() -> Flask:
    """Return MLflow's application, which asks for the token.

    A program sends it as ``MLFLOW_TRACKING_TOKEN``, a browser as the password of any user.

    Raises:
        ValueError: if there is no token in the environment.
    """
    from mlflow.server import app

    token = os.environ.get(TOKEN)
    if not token:
        raise ValueError(f"{TOKEN}: got none; wanted the token that clients are to send")

    def refuse() -> Response | None:
        given = request.authorization
        secret = (given.token or given.password or "") if given else ""
        if request.path != OPEN and not hmac.compare_digest(secret.encode(), token.encode()):
            return Response("a token is wanted", 401, REFUSAL)
        if request.path.endswith("/experiments/create") and not _proxied(request.get_json(force=True, silent=True)):
            return Response("artifact_location: got a place; wanted none: artifacts have one folder here", 403)
        return None

    app.before_request_funcs.setdefault(None, []).insert(0, refuse)
    return app


def _proxied(body: Any) -> bool:
    """Tell whether an experiment's artifacts will lie in the server's own folder."""
    if isinstance(body, str):  # MLflow decodes it again
        try:
            body = json.loads(body)
        except ValueError:
            return True
    places = [body.get(name) for name in PLACE] if isinstance(body, Mapping) else []
    return all(not place or str(place).startswith(PROXIED) for place in places)
