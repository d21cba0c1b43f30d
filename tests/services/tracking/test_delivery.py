"""Delivery of what waits: all of it and once, by one process at a time."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mlflow import MlflowClient

from dmil_core.errors import UserError
from services.tracking.delivery import Delivery, Identity
from services.tracking.ownership import RUN_TAG
from services.tracking.tracker import Tracker
from tests.services.tracking.conftest import steps

PROJECT = Path(__file__).parents[3]

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


@pytest.mark.thorough
@pytest.mark.usefixtures("no_mlflow")
def test_what_mlflow_took_before_a_kill_kept_us_from_noting_it_is_there_once(tmp_path: Path, mlflow_file: str):
    (tmp_path / "table.md").write_text("a table")
    tracker = Tracker(tmp_path, "killed")
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
    assert identity.experiment_id is not None
    return {"run_id": identity.run_id, "experiment_id": identity.experiment_id, "delivered": 2}


@pytest.mark.usefixtures("no_mlflow")
def test_who_takes_over_begins_where_the_other_ended(tmp_path: Path, mlflow_file: str):
    Tracker(tmp_path, "an experiment").close("FINISHED")
    one, other = Delivery(tmp_path, mlflow_file), Delivery(tmp_path, mlflow_file)
    one.deliver()
    one.close()
    other.deliver()
    other.close()
    assert (other.identity.run_id, other.identity.delivered) == (one.identity.run_id, 2)


@pytest.mark.usefixtures("no_mlflow")
def test_what_is_delivered_together_is_noted_together(tmp_path: Path, mlflow_file: str):
    tracker = Tracker(tmp_path, "an experiment")
    for step in range(1, 4):
        tracker.metrics(step, {"loss": 1 / step})
    tracker.close("FINISHED")
    records = (tmp_path / "tracking.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "tracking.jsonl").write_text("".join(records[:-1]))  # without the end: the metrics come last
    delivery = Delivery(tmp_path, mlflow_file)
    delivery.deliver()
    delivery.close()
    assert (delivery.identity.delivered, delivery.waiting()) == (len(records) - 1, [])


@pytest.mark.parametrize("content", ["", "no JSON", "{}", '{"run_id": "x", "delivered": 1}'])
def test_a_damaged_identity_is_named(tmp_path: Path, content: str):
    (tmp_path / "mlflow_run.json").write_text(content)
    with pytest.raises(UserError, match=r"mlflow_run\.json: got .*delete it") as caught:
        Tracker(tmp_path, "an experiment")
    assert isinstance(caught.value, UserError)


def test_more_delivered_than_there_is_is_refused(tmp_path: Path):
    identity = Identity.find_or_make(tmp_path, "an experiment").model_copy(update={"delivered": 2})
    (tmp_path / "mlflow_run.json").write_text(identity.model_dump_json())
    (tmp_path / "tracking.jsonl").write_text('["tags", {}]\n')
    with pytest.raises(UserError, match="got 2 records delivered; wanted at most the 1 of"):
        Delivery(tmp_path, "sqlite://")


@pytest.mark.usefixtures("no_mlflow")
def test_a_data_set_s_name_is_cut_to_what_mlflow_takes(tmp_path: Path, mlflow_file: str):
    tracker = Tracker(tmp_path, "an experiment")
    names = [f"hdf5:/{'deep/' * 120}{task}.hdf5" for task in ("reach", "push")]
    tracker.inputs(dict.fromkeys(names, "0" * 64))
    tracker.close("FINISHED")
    delivery = Delivery(tmp_path, mlflow_file)
    delivery.deliver()
    delivery.close()
    run = MlflowClient(mlflow_file).get_run(str(delivery.identity.run_id))
    assert run.inputs is not None
    found = {given.dataset.name for given in run.inputs.dataset_inputs}
    assert {(name[:6], name[-10:], len(name)) for name in found} == {("hdf5:/", name[-10:], 500) for name in names}


@pytest.mark.usefixtures("no_mlflow")
def test_an_artifact_that_is_gone_does_not_hold_up_the_others(tmp_path: Path, mlflow_file: str):
    (tmp_path / "gone.md").write_text("gone")
    tracker = Tracker(tmp_path, "an experiment")
    tracker.artifact(tmp_path / "gone.md")
    tracker.close("FINISHED")
    (tmp_path / "gone.md").unlink()
    delivery = Delivery(tmp_path, mlflow_file)
    delivery.deliver()
    delivery.close()
    run = MlflowClient(mlflow_file).get_run(str(delivery.identity.run_id))
    assert run.info.status == "FINISHED"
    assert run.data.tags["missing.gone.md"] == "was gone before MLflow could be given it"


def test_only_files_of_the_run_s_folder_are_sent(tmp_path: Path, mlflow_file: str, monkeypatch, logged):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    monkeypatch.chdir(tmp_path)
    private, run = tmp_path / "private", tmp_path / "run"
    (private / "deep").mkdir(parents=True)
    for path in (private / "key", private / "deep" / "key"):
        path.write_text("PRIVATE KEY")
    (run / "report" / "own").mkdir(parents=True)
    (run / "report" / "own" / "table.md").write_text("a table")
    (run / "report" / "figure").symlink_to(private / "key")
    (run / "report" / "own" / "more").symlink_to(private)
    os.mkfifo(run / "report" / "pipe")
    (run / "notes").symlink_to("report/figure")
    (run / "folder").symlink_to("../private")
    tracker = Tracker(run, "a gift")
    for name in ("notes", "folder", "folder/key", "report/own/more/deep", "report/pipe", "report"):
        tracker.artifact(run / name)
    assert tracker.close("FINISHED")
    client = MlflowClient(mlflow_file)
    (tmp_path / "sent").mkdir()
    sent = Path(client.download_artifacts(str(tracker.run_id), "", str(tmp_path / "sent")))
    assert [
        path.relative_to(sent) for path in sent.rglob("*") if path.name in ("table.md", "key", "figure", "pipe")
    ] == [Path("own/table.md")]
    tags = client.get_run(str(tracker.run_id)).data.tags
    assert {name for name in tags if name.startswith("missing.")} == {
        "missing.notes", "missing.folder", "missing.folder/key", "missing.report/own/more/deep", "missing.report/pipe",
    }  # fmt: skip
    said = "\n".join(logged())
    assert f"notes: not sent to MLflow: {run / 'notes'}: got a link" in said
    assert "report: not sent to MLflow, as they are no plain files: ['figure', 'more', 'pipe']" in said
