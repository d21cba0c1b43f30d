"""Tracking never stops training: what MLflow does not take waits, and is delivered later."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mlflow import MlflowClient

from services import tracking
from services.checkpoints import Checkpoint
from services.tracking import Tracker


class Server:
    """A real MLflow server on loopback that can go away and come back with its database."""

    def __init__(self, folder: Path, port: int, answers: Callable, wait_for: Callable) -> None:
        self.folder, self.port, self.uri = folder, port, f"http://127.0.0.1:{port}"
        self._answers, self._wait_for = answers, wait_for
        self._process: subprocess.Popen | None = None

    def start(self) -> None:
        command = [
            sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{self.folder}/server.db",
            "--artifacts-destination", str(self.folder / "artifacts"), "--host", "127.0.0.1", "--port", str(self.port),
            "--workers", "1",
        ]  # fmt: skip
        with (self.folder / "server.log").open("a") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        self._wait_for(lambda: self._answers(f"{self.uri}/health"), "mlflow server")

    def stop(self) -> None:
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(30)
            self._process = None
            self._wait_for(lambda: not self._answers(f"{self.uri}/health"), "the end of mlflow server")


@pytest.fixture
def server(tmp_path: Path, free_port, answers, wait_for, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setenv("MLFLOW_SERVER_ENABLE_JOB_EXECUTION", "false")
    server = Server(tmp_path, free_port(), answers, wait_for)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server.uri)
    monkeypatch.setattr(tracking, "RETRY_SECONDS", 0.5)
    yield server
    server.stop()


def test_with_no_server_training_ends_and_says_so_once(
    train, workplace: Path, free_port, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{free_port()}")
    checkpoint: Checkpoint = train("run", "--training.iterations", "3")
    printed = capsys.readouterr().out
    assert checkpoint.manifest.iteration == 3
    assert checkpoint.manifest.mlflow_run_id is None
    assert printed.count("does not take records") == 1
    assert printed.count("records that are not delivered wait in runs/run/tracking.jsonl") == 1
    records = [json.loads(line) for line in (workplace / "runs" / "run" / "tracking.jsonl").read_text().splitlines()]
    steps = [value["step"] for kind, value in records if kind == "metrics" and "gradient_norm" in value["values"]]
    assert steps == [1, 2, 3]
    assert {"parameters", "tags", "inputs", "artifact", "end"} <= {kind for kind, _ in records}
    assert (workplace / "runs" / "run" / "summary.json").exists()


@pytest.mark.slow
def test_a_server_takes_records_also_those_of_the_time_it_was_away(server: Server, tmp_path: Path, wait_for):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "table.md").write_text("a table")
    said: list[str] = []
    server.start()
    client = MlflowClient(server.uri)
    tracker = Tracker(folder, "an experiment", said.append)
    tracker.parameters({f"setting.{number}": number for number in range(150)})
    tracker.metrics(1, {"loss": 0.5})
    run_id = tracker.identify()
    assert run_id is not None
    wait_for(lambda: client.get_run(run_id).data.metrics == {"loss": 0.5}, "the first metric")

    server.stop()
    tracker.metrics(2, {"loss": 0.25})
    tracker.tags({"while": "away"})
    wait_for(lambda: bool(said), "a word about it")
    tracker.metrics(3, {"loss": 0.125})
    server.start()
    tracker.artifact(folder / "table.md", "report")
    assert tracker.close("FINISHED")

    assert len(said) == 1
    assert server.uri in said[0]
    run = client.get_run(run_id)
    assert (run.info.status, run.data.tags["while"], len(run.data.params)) == ("FINISHED", "away", 150)
    assert [(point.step, point.value) for point in client.get_metric_history(run_id, "loss")] == [
        (1, 0.5),
        (2, 0.25),
        (3, 0.125),
    ]
    assert [entry.path for entry in client.list_artifacts(run_id, "report")] == ["report/table.md"]


def test_what_was_not_delivered_is_delivered_by_the_next_tracker(
    tmp_path: Path, free_port, mlflow_file: str, monkeypatch: pytest.MonkeyPatch
):
    said: list[str] = []
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{free_port()}")
    tracker = Tracker(tmp_path, "waiting", said.append)
    tracker.parameters({"iterations": 5, "seed": 0})
    tracker.metrics(1, {"loss": 1.0})
    assert not tracker.close("KILLED")
    assert tracker.run_id is None

    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    again = Tracker(tmp_path, "waiting", said.append)
    again.parameters({"iterations": 9, "seed": 0})
    again.metrics(2, {"loss": 0.5})
    assert again.close("FINISHED")
    assert len(said) == 1

    run = MlflowClient(mlflow_file).get_run(str(again.run_id))
    assert run.data.params == {"iterations": "5", "seed": "0"}
    assert run.data.tags["resumed.iterations"] == "9"
    assert "resumed.seed" not in run.data.tags
    history = MlflowClient(mlflow_file).get_metric_history(run.info.run_id, "loss")
    assert [(point.step, point.value) for point in history] == [(1, 1.0), (2, 0.5)]
    assert run.info.status == "FINISHED"
