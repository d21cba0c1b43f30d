"""A record that MLflow will never take does not block those behind it."""

import http.server
import json
import shlex
import sqlite3
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from contextlib import closing
from pathlib import Path

import pytest
from mlflow import MlflowClient

from services.tracking import __main__ as tracking
from services.tracking import sending
from services.tracking.delivery import REFUSED, Delivery, Identity
from services.tracking.sending import acceptable
from services.tracking.tracker import Tracker
from tests.services.programs import Server


@pytest.fixture
def folder(workplace: Path) -> Path:
    (workplace / "runs" / "run").mkdir(parents=True)
    return workplace / "runs" / "run"


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("success_rate/meta-testing/1-shot", "success_rate/meta-testing/1-shot"),
        ("lr=1e-2/x", "lr_1e-2/x"),
        ("../a//b\n", "a/b_"),
        (".", "_"),
        ("λ=0, ü", "λ_0_ ü"),
    ],
)
def test_names_are_made_acceptable(name: str, wanted: str):
    assert acceptable(name) == wanted
    long, other = acceptable("x" * 300), acceptable("x" * 301)
    assert len(long) == len(other) == 250
    assert long != other


def test_odd_records_are_delivered_and_what_was_changed_is_noted(folder: Path, mlflow_file: str):
    tracker = Tracker(folder, "odd")
    tracker.parameters({"a=b": "x" * 9000, "plain": "1"})
    tracker.metrics(1, {"lr=1e-2/rate": 0.5, "rate": 0.25})
    tracker.tags({"n" * 400: "long", "why?": "no"})
    tracker.artifact(folder / "gone.txt")
    tracker.inputs({"/a/path" * 100: "0" * 64})
    assert tracker.close("FINISHED")
    run = MlflowClient(mlflow_file).get_run(str(tracker.run_id))
    assert run.info.status == "FINISHED"
    assert run.data.metrics == {"lr_1e-2/rate": 0.5, "rate": 0.25}
    assert run.data.tags["renamed.lr_1e-2/rate"] == "lr=1e-2/rate"
    assert run.data.tags["renamed.a_b"] == "a=b"
    assert run.data.params["plain"] == "1"
    assert run.data.tags["why_"] == "no"
    assert "missing.gone.txt" in run.data.tags
    assert not (folder / REFUSED).exists()


def test_what_is_refused_for_good_is_put_aside_and_the_rest_is_delivered(
    folder: Path, mlflow_file: str, monkeypatch, logged, capsys
):
    monkeypatch.setattr(sending, "acceptable", lambda name: name)  # as of a server that takes less
    tracker = Tracker(folder, "refused")
    for step in range(1, 31):
        tracker.metrics(step, {"loss" if step != 17 else "lo=ss": 1.0 / step})
    tracker.parameters({"a=b": "1"})
    tracker.tags({"after": "all"})
    assert tracker.close("FINISHED")
    client = MlflowClient(mlflow_file)
    run = client.get_run(str(tracker.run_id))
    assert run.info.status == "FINISHED"
    assert run.data.tags["after"] == "all"
    measured = [point.step for point in client.get_metric_history(run.info.run_id, "loss")]
    assert sorted(measured) == [*range(1, 17), *range(18, 31)]
    refused = [json.loads(line) for line in (folder / REFUSED).read_text().splitlines()]
    assert [(number, kind) for number, _, kind, _ in refused] == [(18, "metrics"), (32, "parameters")]
    assert all("Invalid value" in reason for _, reason, _, _ in refused)
    assert len([line for line in logged() if "for good" in line]) == 2
    tracking.run(["flush", "run"])
    printed = capsys.readouterr().out
    assert "delivered: 0 of 0 records" in printed
    assert f"runs/run/{REFUSED}" in printed


def test_a_deleted_experiment_or_run_is_told_with_the_command_that_restores_it(folder: Path, mlflow_file: str, logged):
    client = MlflowClient(mlflow_file)
    first = Tracker(folder, "deleted")
    assert first.close("FINISHED")
    run_id, experiment_id = str(first.run_id), str(Identity.of(folder).experiment_id)
    client.delete_run(run_id)
    again = Tracker(folder, "deleted")
    again.tags({"kept": "yes"})
    assert not again.close("FINISHED")
    assert any(f"mlflow runs restore --run-id {run_id}" in line for line in logged())
    client.restore_run(run_id)
    client.delete_experiment(experiment_id)
    other = folder.with_name("other")
    other.mkdir()
    tracker = Tracker(other, "deleted")
    assert not tracker.close("FINISHED")
    assert any(f"mlflow experiments restore --experiment-id {experiment_id}" in line for line in logged())
    client.restore_experiment(experiment_id)
    for each in (folder, other):
        delivery = Delivery(each, mlflow_file)
        delivery.deliver()
        delivery.close()
        assert not (each / REFUSED).exists()
    assert client.get_run(run_id).data.tags["kept"] == "yes"


def test_counts_are_never_negative(folder: Path, mlflow_file: str, capsys):
    tracker = Tracker(folder, "counts")
    assert tracker.close("FINISHED")
    tracker._spool.count = 0
    assert tracker.waiting == 0
    tracking.run(["status", "run"])
    assert "waiting 0" in capsys.readouterr().out


LOCKED = """
import sqlite3, sys, threading
from pathlib import Path
from services.cli.arguments import exit_code
from services.tracking import delivery
from services.tracking.tracker import Tracker
def run(arguments):
    Path("run").mkdir()
    tracker = Tracker(Path("run"), "quiet")
    tracker.close("FINISHED")
sys.exit(exit_code(run, []))
"""


@pytest.mark.parametrize("kind", ["read-only", "newer"])
def test_a_database_that_takes_nothing_is_one_line(workplace: Path, mlflow_file: str, kind: str):
    source = Path(mlflow_file.removeprefix("sqlite:///"))
    (workplace / "own.db").write_bytes(source.read_bytes())
    uri = "sqlite:///own.db"
    if kind == "read-only":
        uri = "sqlite:///file:own.db?mode=ro&uri=true"
    else:
        with sqlite3.connect("own.db") as database:
            database.execute("update alembic_version set version_num = 'ffffffffffff'")
        database.close()
    line = f"MLFLOW_TRACKING_URI={shlex.quote(uri)} {shlex.quote(sys.executable)} -c {shlex.quote(LOCKED)} 2>&1"
    printed = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False).stdout
    lines = printed.splitlines()
    assert "Traceback" not in printed, printed
    assert len(lines) == 2, printed
    assert "does not take records" in lines[0]
    assert "records wait in run/tracking.jsonl" in lines[1]


@pytest.mark.thorough
def test_a_locked_database_is_one_line_too(folder: Path, mlflow_file: str, monkeypatch, capsys):
    Path("own.db").write_bytes(Path(mlflow_file.removeprefix("sqlite:///")).read_bytes())
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///own.db")
    with closing(sqlite3.connect("own.db", isolation_level=None)) as lock:
        lock.execute("begin exclusive")
        assert not Tracker(folder, "locked").close("FINISHED")
        lines = capsys.readouterr().out.splitlines()
    assert 1 <= len(lines) <= 2, lines
    assert "records wait in" in lines[-1]


@pytest.mark.thorough
def test_what_an_older_server_lacks_is_left_out(folder: Path, mlflow_server: Server, monkeypatch, logged):
    class Older(http.server.BaseHTTPRequestHandler):
        """Passes everything on but a call that came with a later version."""

        def do_POST(self) -> None:
            content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            request = urllib.request.Request(
                f"{mlflow_server.uri}{self.path}",
                content or None,
                {"Content-Type": "application/json"},
                method=self.command,
            )
            try:
                with urllib.request.urlopen(request) as answer:
                    status, body = answer.status, answer.read()
            except urllib.error.HTTPError as error:
                status, body = error.code, error.read()
            if self.path.endswith("log-inputs"):
                status, body = 404, b"<title>404 Not Found</title>"
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_POST  # noqa: N815

        def log_message(self, format: str, *args: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Older) as older:
        threading.Thread(target=older.serve_forever, daemon=True).start()
        monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{older.server_port}")
        tracker = Tracker(folder, "older")
        tracker.inputs({"toy": "0" * 64})
        tracker.metrics(1, {"loss": 0.5})
        assert tracker.close("FINISHED")
        older.shutdown()
    run = MlflowClient(mlflow_server.uri).get_run(str(tracker.run_id))
    assert (run.info.status, run.data.metrics) == ("FINISHED", {"loss": 0.5})
    (line,) = [line for line in logged() if "for good" in line]
    assert "inputs" in line
