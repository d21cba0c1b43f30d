"""Tracking never stops training: what MLflow does not take waits, and is delivered later, all of it and once."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from mlflow import MlflowClient

from dmil_core.errors import RunError, UserError
from services import disk, tracking
from services.checkpoints import Checkpoint, Checkpoints
from services.disk import DiskFullError
from services.tracking import Tracker, redacted
from services.tracking.__main__ import run as tracking_program
from services.tracking.delivery import RUN_TAG, BusyError, Delivery, Identity, IdentityError
from services.tracking.spool import Spool, SpoolError, read_spool

PROJECT = Path(__file__).parents[2]


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


def records(folder: Path, kind: str) -> list:
    return [line.value for line in read_spool(folder / "tracking.jsonl") if line.kind == kind]


def steps(store: str, run_id: str | None, name: str) -> list[int]:
    """Return the steps of a metric's history in the order of the store's rows."""
    return [point.step for point in MlflowClient(store).get_metric_history(str(run_id), name)]


def test_with_no_server_training_ends_and_a_flush_delivers(
    train, programs, workplace: Path, free_port, mlflow_file: str, monkeypatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{free_port()}")
    checkpoint: Checkpoint = train("run", "--training.iterations", "3")
    printed = capsys.readouterr().out
    folder = workplace / "runs" / "run"
    count = len((folder / "tracking.jsonl").read_text().splitlines())
    assert checkpoint.manifest.iteration == 3
    assert checkpoint.manifest.mlflow_run_id is None
    assert printed.count("does not take records") == 1
    assert printed.count(f"{count} of {count} MLflow records wait in runs/run/tracking.jsonl") == 1
    assert printed.count("python -m services.tracking flush runs/run") == 1
    done = [measured.step for measured in records(folder, "metrics") if "gradient_norm" in measured.values]
    assert done == [1, 2, 3]
    assert {line.kind for line in read_spool(folder / "tracking.jsonl")} == {
        "begin", "parameters", "tags", "inputs", "metrics", "artifact", "end",
    }  # fmt: skip
    assert (folder / "summary.json").exists()

    with pytest.raises(RunError, match=f"MLflow at http://127.0.0.1.* 0 of {count} were delivered"):
        tracking_program(["flush", "run"])
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    code, printed = programs("tracking", "flush", "runs/run")
    assert (code, printed.count(f"delivered: {count} of {count} records")) == (0, 1), printed
    tracking_program(["flush", "run"])
    tracking_program(["status", "run"])
    run_id = Identity.of(folder).run_id
    assert capsys.readouterr().out.splitlines() == [
        f"delivered: 0 of 0 records, MLflow run {run_id}",
        f"MLflow run: {run_id}",
        f"records: {count}, delivered {count}, waiting 0",
    ]
    assert steps(mlflow_file, run_id, "gradient_norm") == [1, 2, 3]
    run = MlflowClient(mlflow_file).get_run(str(run_id))
    (began, ended) = (records(folder, "metrics")[0].time, records(folder, "end")[0].time)
    assert (run.info.status, run.info.end_time) == ("FINISHED", ended)
    assert began - 60_000 < run.info.start_time < ended


@pytest.fixture
def slow_server() -> Iterator[tuple[str, threading.Event]]:
    """The address of a server that waits ten seconds before each answer, and what ends the waiting."""
    over = threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            over.wait(10)
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


@pytest.mark.slow
@pytest.mark.alone
def test_a_slow_server_is_not_waited_for(
    slow_server: tuple[str, threading.Event], tmp_path: Path, mlflow_file: str, monkeypatch
):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", slow_server[0])
    tracker = Tracker(tmp_path, "slow", print)
    began = time.monotonic()
    for step in range(1, 101):
        tracker.metrics(step, {"loss": 1 / step})
        tracker.identify(patience=0)
    assert time.monotonic() - began < 1
    assert tracker.identify() is None
    assert time.monotonic() - began < 9, "one call of over five seconds tells"
    began = time.monotonic()
    assert not tracker.close("FINISHED")
    assert time.monotonic() - began < 5
    slow_server[1].set()
    tracker._thread.join(15)

    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    tracking_program(["flush", str(tmp_path)])
    assert steps(mlflow_file, Identity.of(tmp_path).run_id, "loss") == list(range(1, 101))


DIES = """
import os, signal, sys
from pathlib import Path
from services.tracking.delivery import Delivery
field = sys.argv[3]
note = Delivery._note
def die(delivery, **changed):
    if field in changed and changed.get("delivered", 3) >= 3:
        os.kill(os.getpid(), signal.SIGKILL)
    note(delivery, **changed)
Delivery._note = die
Delivery(Path(sys.argv[1]), sys.argv[2]).deliver()
"""


@pytest.mark.slow
@pytest.mark.alone
def test_what_mlflow_took_before_a_kill_kept_us_from_noting_it_is_there_once(
    tmp_path: Path, free_port, mlflow_file: str, monkeypatch
):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{free_port()}")
    (tmp_path / "table.md").write_text("a table")
    tracker = Tracker(tmp_path, "killed", print)
    tracker.parameters({"seed": 0})
    for step in range(1, 2501):
        tracker.metrics(step, {"loss": 1 / step, "constant": 1.0})
    tracker.inputs({"push": "0" * 64})
    tracker.artifact(tmp_path / "table.md")
    assert not tracker.close("FINISHED")
    before = Identity.of(tmp_path)
    for field in ("run_id", "delivered"):
        died = subprocess.run([sys.executable, "-c", DIES, str(tmp_path), mlflow_file, field], cwd=PROJECT)
        assert died.returncode == -signal.SIGKILL
        delivered = Identity.of(tmp_path)
        assert delivered == (before if field == "run_id" else before.model_copy(update=delivered_two(delivered)))

    delivery = Delivery(tmp_path, mlflow_file)
    delivery.deliver()
    delivery.close()
    client = MlflowClient(mlflow_file)
    experiment = client.get_experiment_by_name("killed")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.data.tags[RUN_TAG] == before.tag
    assert run.data.params == {"seed": "0"}
    assert run.inputs is not None
    assert len(run.inputs.dataset_inputs) == 1
    for name in ("loss", "constant"):
        assert steps(mlflow_file, run.info.run_id, name) == list(range(1, 2501)), name


def delivered_two(identity: Identity) -> dict[str, object]:
    """Return what the begin and the parameters change in an identity."""
    assert identity.run_id is not None
    return {"run_id": identity.run_id, "delivered": 2}


@pytest.mark.slow
@pytest.mark.alone
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

    wait_for(further, "iterations beyond a checkpoint", 60)
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


def offline(folder: Path, free_port, monkeypatch, say: Callable[[str], None] = print) -> Tracker:
    """Return a tracker whose MLflow is not there."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{free_port()}")
    return Tracker(folder, "an experiment", say)


def test_a_metric_is_recorded_once_a_step_unless_it_is_measured_anew(tmp_path: Path, free_port, monkeypatch):
    for _ in range(2):
        tracker = offline(tmp_path, free_port, monkeypatch)
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


def test_one_process_delivers_at_a_time(tmp_path: Path, mlflow_file: str, free_port, monkeypatch, capsys):
    offline(tmp_path, free_port, monkeypatch).close("FINISHED")
    one = Delivery(tmp_path, mlflow_file)
    one.deliver()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    with pytest.raises(BusyError, match="another process, the run itself or a flush, delivers its records"):
        tracking_program(["flush", str(tmp_path)])
    capsys.readouterr()
    tracking_program(["status", str(tmp_path)])
    assert "is delivering them" in capsys.readouterr().out
    one.close()
    tracking_program(["flush", str(tmp_path)])


def test_who_takes_over_begins_where_the_other_ended(tmp_path: Path, mlflow_file: str, free_port, monkeypatch):
    offline(tmp_path, free_port, monkeypatch).close("FINISHED")
    one, other = Delivery(tmp_path, mlflow_file), Delivery(tmp_path, mlflow_file)
    one.deliver()
    one.close()
    other.deliver()
    other.close()
    assert (other.run_id, other.delivered) == (one.run_id, 2)


def test_what_holds_no_run_is_refused(tmp_path: Path, complaint):
    assert f"RUN: got '{tmp_path}'; wanted a folder with a tracking.jsonl in it" in complaint(
        tracking_program, "flush", str(tmp_path)
    )


@pytest.mark.parametrize("line", ["no JSON", "[]", '["metrics", {"step": 1}]', '["artifact", {"path": "/etc/passwd"}]'])
def test_a_damaged_record_is_named_by_file_and_line(tmp_path: Path, line: str, complaint):
    Identity.found_or_made(tmp_path, "an experiment")
    (tmp_path / "tracking.jsonl").write_text(f'["tags", {{}}]\n{line}\n["tags", {{}}]\n')
    printed = complaint(tracking_program, "flush", str(tmp_path))
    assert f"{tmp_path / 'tracking.jsonl'}, line 2: got " in printed
    with pytest.raises(SpoolError, match=r"tracking\.jsonl, line 2"):
        Tracker(tmp_path, "an experiment", print)


@pytest.mark.parametrize("path", ["/etc/passwd", "../other", "report/../../other"])
def test_only_what_is_the_run_s_is_ever_sent(tmp_path: Path, path: str):
    (tmp_path / "tracking.jsonl").write_text(json.dumps(["artifact", {"path": path, "folder": None}]) + "\n")
    with pytest.raises(SpoolError, match="line 1"):
        list(read_spool(tmp_path / "tracking.jsonl"))


@pytest.mark.parametrize("content", ["", "no JSON", "{}", '{"run_id": "x", "delivered": 1}'])
def test_a_damaged_identity_is_named(tmp_path: Path, content: str):
    (tmp_path / "mlflow_run.json").write_text(content)
    with pytest.raises(IdentityError, match=r"mlflow_run\.json: got .*delete it") as caught:
        Tracker(tmp_path, "an experiment", print)
    assert isinstance(caught.value, UserError)


def test_more_delivered_than_there_is_is_refused(tmp_path: Path):
    identity = Identity.found_or_made(tmp_path, "an experiment").model_copy(update={"delivered": 2})
    (tmp_path / "mlflow_run.json").write_text(identity.model_dump_json())
    (tmp_path / "tracking.jsonl").write_text('["tags", {}]\n')
    with pytest.raises(IdentityError, match="got 2 records delivered; wanted at most the 1 of"):
        Delivery(tmp_path, "sqlite://")


def test_a_line_that_a_killed_process_did_not_finish_is_cut_off(tmp_path: Path):
    (tmp_path / "tracking.jsonl").write_text('["tags", {}]\n["tags", {"a')
    spool = Spool(tmp_path / "tracking.jsonl")
    spool.append("tags", {"b": "c"})
    spool.close()
    assert records(tmp_path, "tags") == [{}, {"b": "c"}]


class HalfFull:
    """A file on a disk that becomes full in the middle of a write."""

    def __init__(self, file) -> None:
        self._file = file
        self.close, self.truncate = file.close, file.truncate

    def write(self, line: bytes) -> int:
        return self._file.write(line[:5])


def test_a_full_disk_ends_the_run_in_words_and_leaves_whole_records(tmp_path: Path):
    spool = Spool(tmp_path / "tracking.jsonl")
    spool.append("tags", {"a": "b"})
    file = spool._file
    spool._file = HalfFull(file)  # type: ignore[assignment]
    with pytest.raises(DiskFullError, match=r"tracking\.jsonl"):
        spool.append("tags", {"c": "d"})
    spool._file = file
    spool.append("tags", {"e": "f"})
    spool.close()
    assert records(tmp_path, "tags") == [{"a": "b"}, {"e": "f"}]


def test_closing_on_a_full_disk_does_not_hide_what_ended_the_run(tmp_path: Path, free_port, monkeypatch):
    said: list[str] = []
    tracker = offline(tmp_path, free_port, monkeypatch, said.append)
    usage = disk.shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr(disk.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(DiskFullError, match=r"needs .* bytes"):
        tracker.tags({"a": "b"})
    assert not tracker.close("FAILED")
    assert any(text.startswith("the end of the run is not recorded: ") for text in said)


def test_an_artifact_that_is_gone_does_not_hold_up_the_others(tmp_path: Path, free_port, mlflow_file, monkeypatch):
    (tmp_path / "gone.md").write_text("gone")
    tracker = offline(tmp_path, free_port, monkeypatch)
    tracker.artifact(tmp_path / "gone.md")
    tracker.close("FINISHED")
    (tmp_path / "gone.md").unlink()
    delivery = Delivery(tmp_path, mlflow_file)
    delivery.deliver()
    delivery.close()
    run = MlflowClient(mlflow_file).get_run(str(delivery.run_id))
    assert run.info.status == "FINISHED"
    assert run.data.tags["missing.gone.md"] == "was gone before MLflow could be given it"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("sqlite:///mlflow.db", "sqlite:///mlflow.db"),
        ("http://127.0.0.1:5000", "http://127.0.0.1:5000"),
        ("postgresql://user:SECRET@host/db", "postgresql://...@host/db"),
        ("http://user:SEC@RE/T@host:5000/x failed", "http://...@host:5000/x failed"),
        ("got 'https://SECRET@host'; wanted", "got 'https://...@host'; wanted"),
        ("postgresql://host/db?user=me&password=SECRET&x=1", "postgresql://host/db?user=me&password=...&x=1"),
    ],
)
def test_an_address_is_shown_without_its_secrets(text: str, shown: str):
    assert redacted(text) == shown


@pytest.mark.slow
@pytest.mark.alone
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
    assert len(said) == 2, "one that MLflow fails, one that records wait"

    run = MlflowClient(mlflow_file).get_run(str(again.run_id))
    assert run.data.params == {"iterations": "5", "seed": "0"}
    assert run.data.tags["resumed.iterations"] == "9"
    assert "resumed.seed" not in run.data.tags
    history = MlflowClient(mlflow_file).get_metric_history(run.info.run_id, "loss")
    assert [(point.step, point.value) for point in history] == [(1, 1.0), (2, 0.5)]
    assert run.info.status == "FINISHED"
