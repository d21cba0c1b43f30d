"""Tracking never stops training: what MLflow does not take waits, and is delivered later."""

import signal
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from mlflow import MlflowClient

from dmil_core import files
from dmil_core.files import DiskFullError
from services.storage.checkpoints import Checkpoints
from services.tracking import tracker as tracking
from services.tracking.__main__ import run as tracking_program
from services.tracking.delivery import Identity
from services.tracking.tracker import Tracker
from tests.services.programs import Server
from tests.services.tracking.conftest import records, steps


@pytest.mark.usefixtures("no_mlflow")
def test_a_metric_is_recorded_once_a_step_unless_it_is_measured_anew(tmp_path: Path):
    for _ in range(2):
        tracker = Tracker(tmp_path, "an experiment")
        tracker.metrics(1, {"loss": 0.5, "nan": float("nan")})
        tracker.metrics(2, {"loss": 0.25})
        tracker.metrics(1, {"loss": 0.75, "speed": 3.0})
        tracker.metrics(2, {"loss": 0.25, "success": 0.5}, anew=True)
        tracker.metrics(2, {"loss": 0.125}, anew=True)
        tracker.metrics(2, {"loss": 0.125}, anew=True)
        tracker.close("KILLED")
    found = [(measured.step, measured.values) for measured in records(tmp_path, "metrics")]
    assert str(found.pop(0)) == str((1, {"loss": 0.5, "nan": float("nan")}))
    first = [(2, {"loss": 0.25}), (1, {"speed": 3.0}), (2, {"success": 0.5}), (2, {"loss": 0.125})]
    assert found == [*first, (2, {"loss": 0.25}), (2, {"loss": 0.125})]


@pytest.mark.usefixtures("no_mlflow")
def test_closing_on_a_full_disk_does_not_hide_what_ended_the_run(tmp_path: Path, monkeypatch, logged):
    tracker = Tracker(tmp_path, "an experiment")
    usage = files.shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(DiskFullError, match=r"needs .* bytes"):
        tracker.tags({"a": "b"})
    assert not tracker.close("FAILED")
    assert any(text.startswith("the end of the run is not recorded: ") for text in logged())


@pytest.mark.usefixtures("no_mlflow")
def test_what_was_not_delivered_is_delivered_by_the_next_tracker(
    tmp_path: Path, mlflow_file: str, monkeypatch: pytest.MonkeyPatch, logged
):
    tracker = Tracker(tmp_path, "waiting")
    tracker.parameters({"iterations": 5, "seed": 0})
    tracker.metrics(1, {"loss": 1.0})
    assert not tracker.close("KILLED")
    assert tracker.run_id is None
    assert tracker.address_lines == [f"MLflow run: none yet at {tracker.uri}"]

    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    again = Tracker(tmp_path, "waiting")
    again.parameters({"iterations": 9, "seed": 0})
    again.metrics(2, {"loss": 0.5})
    assert again.close("FINISHED")
    assert len(logged()) == 2, "one that MLflow fails, one that records wait"
    assert again.address_lines[-1].startswith("its page: ")

    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"{mlflow_file}.other")
    elsewhere = Tracker(tmp_path, "waiting")
    assert not elsewhere.close("FINISHED")
    assert elsewhere.address_lines == [f"MLflow run: {again.run_id}, which took no records at {mlflow_file}.other"]

    run = MlflowClient(mlflow_file).get_run(str(again.run_id))
    assert run.data.params == {"iterations": "5", "seed": "0"}
    assert run.data.tags["resumed.iterations"] == "9"
    assert "resumed.seed" not in run.data.tags
    history = MlflowClient(mlflow_file).get_metric_history(run.info.run_id, "loss")
    assert [(point.step, point.value) for point in history] == [(1, 1.0), (2, 0.5)]
    assert run.info.status == "FINISHED"


@pytest.fixture
def slow_server() -> Iterator[tuple[str, threading.Event]]:
    """The address of a server that answers nobody before it is allowed to."""
    over = threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            over.wait()
            self.send_error(503)

        do_POST = do_GET  # noqa: N815

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Slow)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}", over
    over.set()
    server.shutdown()
    server.server_close()


@pytest.mark.thorough
def test_a_slow_server_is_not_waited_for(
    slow_server: tuple[str, threading.Event], tmp_path: Path, mlflow_file: str, monkeypatch
):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", slow_server[0])
    tracker = Tracker(tmp_path, "slow")
    for step in range(1, 101):
        tracker.metrics(step, {"loss": 1 / step})
        tracker.wait_for_run_id(timeout=0)
    assert tracker.wait_for_run_id() is None
    assert not tracker.close("FINISHED")
    slow_server[1].set()
    tracker._thread.join()

    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    tracking_program(["flush", str(tmp_path)])
    assert steps(mlflow_file, Identity.of(tmp_path).run_id, "loss") == list(range(1, 101))


@pytest.mark.thorough
def test_a_killed_run_that_goes_on_has_every_iteration_once(
    programs, train, wait_for, workplace: Path, mlflow_file: str
):
    arguments = ["--preset", "ml10-smoke", "--runner", "local", "--name", "run", "--training.checkpoint-every", "7"]
    program = programs.start("meta_train", *arguments, "--training.iterations", "100000")
    folder = workplace / "runs" / "run"
    checkpoints = Checkpoints(folder / "checkpoints", 3)

    def further() -> bool:
        """Tell whether iterations are recorded, and some delivered, that the last checkpoint does not know of."""
        assert program.poll() is None
        done = [measured.step for measured in records(folder, "metrics")]
        saved = checkpoints.newest().manifest.iteration if checkpoints.all() else 0
        return saved > 0 and Identity.of(folder).delivered > 10 and done[-1] % 7 > 2

    wait_for(further, "iterations beyond a checkpoint")
    program.send_signal(signal.SIGKILL)
    program.communicate()
    saved, recorded = checkpoints.newest().manifest.iteration, records(folder, "metrics")[-1].step
    assert recorded > saved
    until = recorded + 5
    train("run", "--training.iterations", str(until), resume=True)
    run_id = Identity.of(folder).run_id
    for name in ("gradient_norm", "iterations_per_second"):
        assert steps(mlflow_file, run_id, name) == list(range(1, until + 1)), name
    assert MlflowClient(mlflow_file).get_run(str(run_id)).info.status == "FINISHED"


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    server = Server(tmp_path)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", server.uri)
    monkeypatch.setattr(tracking, "RETRY_SECONDS", 0.5)
    yield server
    server.stop()


@pytest.mark.thorough
def test_a_server_takes_records_also_those_of_the_time_it_was_away(server: Server, tmp_path: Path, wait_for, logged):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "table.md").write_text("a table")
    server.start()
    client = MlflowClient(server.uri)
    tracker = Tracker(folder, "an experiment")
    tracker.parameters({f"setting.{number}": number for number in range(150)})
    tracker.metrics(1, {"loss": 0.5})
    run_id = tracker.wait_for_run_id()
    assert run_id is not None
    wait_for(lambda: client.get_run(run_id).data.metrics == {"loss": 0.5}, "the first metric")

    server.stop()
    tracker.metrics(2, {"loss": 0.25})
    tracker.tags({"while": "away"})
    wait_for(lambda: bool(logged()), "a word about it")
    tracker.metrics(3, {"loss": 0.125})
    server.start()
    tracker.artifact(folder / "table.md", "report")
    assert tracker.close("FINISHED")

    assert len(logged()) == 1
    assert server.uri in logged()[0]
    run = client.get_run(run_id)
    assert (run.info.status, run.data.tags["while"], len(run.data.params)) == ("FINISHED", "away", 150)
    assert [(point.step, point.value) for point in client.get_metric_history(run_id, "loss")] == [
        (1, 0.5),
        (2, 0.25),
        (3, 0.125),
    ]
    assert [entry.path for entry in client.list_artifacts(run_id, "report")] == ["report/table.md"]
