"""An MLflow that lies: what it answers is limited, checked, and gets no token of another."""

import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from mlflow import MlflowException

from dmil_core.errors import RunError
from services.tracking import client
from services.tracking.client import connect
from services.tracking.delivery import Delivery, Identity
from services.tracking.ownership import RUN_TAG
from services.tracking.spool import Spool

Answer = Callable[[BaseHTTPRequestHandler], None]


class Server:
    """A server that answers everything in one way, and notes what it was sent."""

    def __init__(self, answer: Answer) -> None:
        self.logins: list[str | None] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                server.logins.append(self.headers["Authorization"])
                self.rfile.read(int(self.headers["Content-Length"] or 0))
                answer(self)

            do_POST = do_GET  # noqa: N815

            def log_message(self, format: str, *args: object) -> None:
                """Say nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Answer], Server]]:
    servers: list[Server] = []
    monkeypatch.setenv("MLFLOW_TRACKING_TOKEN", "SECRET")

    def serve(answer: Answer) -> Server:
        servers.append(Server(answer))
        return servers[-1]

    yield serve
    for server in servers:
        server.close()


def endless(request: BaseHTTPRequestHandler) -> None:
    """Send blanks, which may stand before JSON, until nobody reads them any more."""
    request.send_response(200)
    request.send_header("Transfer-Encoding", "chunked")
    request.end_headers()
    try:
        while True:
            request.wfile.write(b"10000\r\n" + b" " * 0x10000 + b"\r\n")
    except OSError:
        request.close_connection = True


def answering(body: Any) -> Answer:
    def answer(request: BaseHTTPRequestHandler) -> None:
        content = json.dumps(body).encode()
        request.send_response(200)
        request.send_header("Content-Length", str(len(content)))
        request.end_headers()
        request.wfile.write(content)

    return answer


def redirecting(site: str) -> Answer:
    def answer(request: BaseHTTPRequestHandler) -> None:
        request.send_response(307)
        request.send_header("Location", f"{site}{request.path}")
        request.send_header("Content-Length", "0")
        request.end_headers()

    return answer


def test_an_answer_without_end_is_not_read_to_its_end(serve, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(client, "MOST_BYTES", 10**6)
    with pytest.raises(Exception, match="wanted MLflow's"):
        connect(f"http://127.0.0.1:{serve(endless).port}").get_experiment_by_name("x")


def test_a_long_answer_is_read_whole(serve):
    name = "x" * 10**6
    server = serve(answering({"experiment": {"experiment_id": "1", "name": name}}))
    found = connect(f"http://127.0.0.1:{server.port}").get_experiment_by_name("x")
    assert found is not None
    assert found.name == name


@pytest.mark.parametrize(
    ("experiment", "run"), [("../../x", "0" * 32), ("1", "../../x"), ("1", "0" * 31), ("1", "0" * 32 + "\n")]
)
def test_what_is_no_id_is_not_believed(serve, tmp_path: Path, experiment: str, run: str):
    tag = Identity.find_or_make(tmp_path, "an experiment").tag
    info = {"run_id": run, "run_uuid": run, "experiment_id": experiment, "status": "RUNNING"}
    body = {
        "experiment": {"experiment_id": experiment, "name": "x", "artifact_location": "mlflow-artifacts:/1"},
        "run": {"info": info, "data": {"tags": [{"key": RUN_TAG, "value": tag}]}},
    }
    spool = Spool(tmp_path / "tracking.jsonl")
    spool.append("begin", None)
    delivery = Delivery(tmp_path, f"http://127.0.0.1:{serve(answering(body)).port}")
    try:
        with pytest.raises((RunError, MlflowException), match=r"no id of its own: |Invalid value .* 'run_id'"):
            delivery.deliver()
    finally:
        delivery.close()
        spool.close()
    assert ".." not in (tmp_path / "mlflow_run.json").read_text()


@pytest.mark.parametrize("name", ["http_proxy", "HTTP_PROXY"])
def test_neither_a_proxy_nor_another_server_receives_the_token(serve, name: str, monkeypatch: pytest.MonkeyPatch):
    proxy, other = serve(answering({})), serve(answering({"experiment": {"experiment_id": "1", "name": "x"}}))
    mlflow = serve(redirecting(f"http://localhost:{other.port}"))
    for variable in ("no_proxy", "NO_PROXY"):
        monkeypatch.setenv(variable, "")
    monkeypatch.setenv(name, f"http://127.0.0.1:{proxy.port}")
    assert connect(f"http://127.0.0.1:{mlflow.port}").get_experiment_by_name("x")
    assert (mlflow.logins, other.logins, proxy.logins) == (["Bearer SECRET"], [None], [])


@pytest.mark.parametrize(("name", "why"), [("folder", "folder is a folder"), ("file/mlflow.db", "file is no folder")])
def test_a_database_that_cannot_be_there_is_told_at_once(tmp_path: Path, name: str, why: str):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunError, match=why):
        connect(f"sqlite:///{tmp_path / name}")
    connect(f"sqlite:///{tmp_path / 'made' / 'mlflow.db'}")
