"""The program that delivers what a run left behind, and counts it."""

import os
from pathlib import Path

import pytest
from mlflow import MlflowClient

from dmil_core.checkpoint import Checkpoint
from dmil_core.errors import RunError, UserError
from dmil_core.files import ForeignFileError
from services.tracking.__main__ import run as tracking_program
from services.tracking.delivery import Delivery, Identity
from services.tracking.models import models_of
from services.tracking.spool import read_spool
from services.tracking.tracker import Tracker
from tests.services.tracking.conftest import records, steps


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
    assert printed.count("dmil tracking flush runs/run") == 1
    done = [measured.step for measured in records(folder, "metrics") if "gradient_norm" in measured.values]
    assert done == [1, 2, 3]
    assert {line.kind for line in read_spool(folder / "tracking.jsonl")} == {
        "begin", "parameters", "tags", "inputs", "metrics", "system", "artifact", "model", "end",
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
    (model,) = models_of(MlflowClient(mlflow_file), run)
    assert model.tags["checkpoint"] == checkpoint.digest
    assert began - 60_000 < run.info.start_time < ended


@pytest.mark.usefixtures("no_mlflow")
def test_one_process_delivers_at_a_time(tmp_path: Path, mlflow_file: str, monkeypatch, capsys):
    Tracker(tmp_path, "an experiment").close("FINISHED")
    one = Delivery(tmp_path, mlflow_file)
    one.deliver()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    with pytest.raises(UserError, match=f"got process {os.getpid()} of .* at work in it"):
        tracking_program(["flush", str(tmp_path)])
    capsys.readouterr()
    tracking_program(["status", str(tmp_path)])
    assert "is delivering them" in capsys.readouterr().out
    one.close()
    tracking_program(["flush", str(tmp_path)])
    (tmp_path / "tracking.lock").unlink()
    (tmp_path / "tracking.lock").symlink_to("victim")
    for action in ("flush", "status"):
        with pytest.raises(ForeignFileError, match=r"tracking\.lock: got a link"):
            tracking_program([action, str(tmp_path)])
    assert not (tmp_path / "victim").exists()


def test_what_holds_no_run_is_refused(tmp_path: Path, complaint):
    assert f"RUN: got '{tmp_path}'; wanted a folder with a tracking.jsonl in it" in complaint(
        tracking_program, "flush", str(tmp_path)
    )


def test_a_report_is_delivered_again_where_there_is_one_only(complaint, tmp_path: Path):
    (tmp_path / "tracking.jsonl").write_text("")
    message = complaint(tracking_program, "report", str(tmp_path))
    assert f"RUN: got {tmp_path}, which has no folder report; wanted a finished run" in message
