"""Whose a run in MLflow is, and where its artifacts go: compared before anything is sent."""

import json
import re
import shutil
from pathlib import Path
from typing import Any, cast

import pytest
from mlflow import MlflowClient
from mlflow.entities import Experiment

from dmil_core.errors import RunError, UserError
from services.tracking.delivery import Delivery, Identity
from services.tracking.ownership import FOLDER_TAG, IDENTITY, check_active, check_model, check_place
from services.tracking.tracker import Tracker


@pytest.fixture
def delivered(tmp_path: Path, mlflow_file: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a run that MLflow has."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    folder = tmp_path / "runs" / "mine"
    folder.mkdir(parents=True)
    tracker = Tracker(folder, "an experiment")
    tracker.tags({"seed": "0"})
    assert tracker.close("FINISHED")
    return folder


def deliver(folder: Path, uri: str) -> None:
    delivery = Delivery(folder, uri)
    try:
        delivery.deliver()
    finally:
        delivery.close()


FOREIGN: dict[str, tuple[dict[str, Any], str]] = {
    "a copy": ({}, "which is that of"),
    "by its tag alone": ({"run_id": None}, "which is that of"),
    "another run's id": ({"tag": "0" * 32}, "which has another tag dmil.run than this folder's"),
}


@pytest.mark.parametrize(("changes", "said"), FOREIGN.values(), ids=FOREIGN)
def test_a_folder_that_says_to_be_another_s_changes_nothing_there(
    delivered: Path, mlflow_file: str, tmp_path: Path, changes: dict[str, Any], said: str
):
    before = MlflowClient(mlflow_file).get_run(str(Identity.of(delivered).run_id))
    gift = Path(shutil.copytree(delivered, tmp_path / "gift"))
    identity = json.loads((gift / IDENTITY).read_text()) | {"name": "gift", "delivered": 0} | changes
    (gift / IDENTITY).write_text(json.dumps(identity))
    (gift / "tracking.jsonl").write_text('["tags", {"seed": "666"}]\n')
    with pytest.raises(UserError, match=said) as caught:
        deliver(gift, mlflow_file)
    assert f"{gift / IDENTITY}: got the MLflow run {before.info.run_id}" in str(caught.value)
    assert MlflowClient(mlflow_file).get_run(before.info.run_id).to_dictionary() == before.to_dictionary()
    (gift / IDENTITY).unlink()
    Identity.find_or_make(gift, "an experiment")  # as --resume does
    deliver(gift, mlflow_file)
    assert Identity.of(gift).run_id not in (None, before.info.run_id)


def test_a_folder_that_was_moved_keeps_its_run(delivered: Path, mlflow_file: str):
    run_id, moved = Identity.of(delivered).run_id, delivered.rename(delivered.with_name("renamed"))
    with (moved / "tracking.jsonl").open("a") as file:
        file.write('["tags", {"seed": "1"}]\n')
    deliver(moved, mlflow_file)
    tags = MlflowClient(mlflow_file).get_run(str(run_id)).data.tags
    assert (tags["seed"], tags[FOLDER_TAG]) == ("1", str(moved.resolve()))


@pytest.mark.parametrize("tag", ["x' OR '", "0" * 31, f"{'0' * 32}\n"])
def test_an_id_that_is_none_asks_mlflow_nothing(delivered: Path, mlflow_file: str, tag: str):
    (delivered / IDENTITY).write_text(json.dumps(json.loads((delivered / IDENTITY).read_text()) | {"tag": tag}))
    with pytest.raises(UserError, match=r"mlflow_run\.json: got tag: "):
        deliver(delivered, mlflow_file)


def test_an_experiment_made_for_another_place_gets_nothing(tmp_path: Path, mlflow_file: str, monkeypatch, logged):
    client = MlflowClient(mlflow_file)
    number = client.create_experiment("made before", artifact_location=(tmp_path / "theirs").as_uri())
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    (tmp_path / "table.md").write_text("a table")
    tracker = Tracker(tmp_path, "made before")
    tracker.artifact(tmp_path / "table.md")
    assert not tracker.close("FINISHED")
    said = f"MLflow's experiment 'made before' keeps artifacts in {(tmp_path / 'theirs').as_uri()}; wanted "
    assert said in logged()[0]
    assert client.search_runs([number]) == []
    assert not (tmp_path / "theirs").exists()
    client.rename_experiment(number, "made before, for another place")
    deliver(tmp_path, mlflow_file)
    model = client.create_logged_model(number, "theirs")
    with pytest.raises(UserError, match="keeps artifacts in"):
        check_model(client, mlflow_file, model)
    check_model(client, mlflow_file, client.create_logged_model(str(Identity.of(tmp_path).experiment_id), "ours"))


def test_a_server_s_experiments_keep_their_artifacts_behind_it(mlflow_server, tmp_path: Path):
    client, host = MlflowClient(mlflow_server.uri), "127.0.0.1:9"
    made = client.get_experiment(client.create_experiment("ordinary"))
    check_place(client, mlflow_server.uri, made)
    # Not all of them can be made on a server of today.
    places = (str(tmp_path), tmp_path.as_uri(), f"mlflow-artifacts://{host}/a", f"https://{host}/a", "s3://theirs/a")
    for place in places:
        elsewhere = Experiment(made.experiment_id, "elsewhere", place, "active")
        with pytest.raises(UserError, match=r"'elsewhere' keeps artifacts in .*; wanted mlflow-artifacts:/"):
            check_place(client, mlflow_server.uri, elsewhere)


@pytest.mark.parametrize("id_", ["1; touch made", "$(touch made)", "--new-name x"])
def test_a_command_to_paste_runs_nothing_that_a_server_says(tmp_path: Path, id_: str):
    made, unasked = Experiment(id_, "ours", "file:///elsewhere", "deleted"), cast("MlflowClient", None)
    with pytest.raises(RunError, match=re.escape(f"--experiment-id '{id_}'")):
        check_active(made)
    with pytest.raises(UserError, match=re.escape(f"--experiment-id '{id_}' --new-name NAME")):
        check_place(unasked, f"sqlite:///{tmp_path}/mlflow.db", made)
