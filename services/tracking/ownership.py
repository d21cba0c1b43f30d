"""Whose an MLflow run is, and where MLflow keeps its artifacts: compared before anything is sent.

Whoever shares an MLflow can make an experiment under our name with a place of her choice, and a folder that somebody
else hands over can say that it belongs to any run.
"""

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from dmil_core.errors import RunError, UserError
from dmil_core.files import read_file
from services.storage.redaction import redacted
from services.storage.run_folders import IDENTITY
from services.tracking.links import artifacts_beside

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Experiment, LoggedModel, Run

RUN_TAG = "dmil.run"
"""The tag by which a run is found again whose id was never noted."""
FOLDER_TAG = "dmil.folder"
"""Where the run's folder is."""
IDENTITY_BYTES = 10_000


def check_place(client: "MlflowClient", uri: str, experiment: "Experiment") -> None:
    """Refuse an experiment that keeps artifacts elsewhere than where MLflow at `uri` keeps those of any other.

    That is beside an SQLite file; behind the server, which hands artifacts over itself; or where its default
    experiment has them too, as in one bucket. A server does not choose a folder of this machine.

    Raises:
        UserError: names the place.
    """
    place, beside = experiment.artifact_location, artifacts_beside(uri)
    if beside is not None:
        own = beside.as_uri()
    else:
        kind = urlsplit(place)
        if kind.scheme == "mlflow-artifacts" and not kind.netloc:
            return
        root = client.get_experiment("0").artifact_location.removesuffix("/0")
        served = uri.startswith("http") and kind.scheme in ("", "file")
        own = "mlflow-artifacts:/" if served else f"{root}/{experiment.experiment_id}"
    if place != own:
        raise UserError(
            f"MLflow's experiment {experiment.name!r} keeps artifacts in {redacted(place) or 'no place'}; wanted "
            f"{redacted(own)}, as of any experiment there: somebody made it for another place; "
            f"{_mlflow('experiments', 'rename', '--experiment-id', experiment.experiment_id)} --new-name NAME, and a "
            "new one is made"
        )


def _mlflow(*words: str) -> str:
    """Return a command as it can be pasted, whatever ids a server gives."""
    return shlex.join(["mlflow", *words])


def check_active(experiment: "Experiment") -> None:
    """Refuse an experiment that was deleted in MLflow, which keeps it in its trash.

    Raises:
        RunError: names the command that restores it.
    """
    if experiment.lifecycle_stage == "deleted":
        raise RunError(
            f"MLflow's experiment {experiment.name!r} was deleted there; records wait until it is restored: "
            f"{_mlflow('experiments', 'restore', '--experiment-id', experiment.experiment_id)}"
        )


def check_there(client: "MlflowClient", run_id: str) -> "Run":
    """Return a run, unless it or its experiment was deleted in MLflow.

    Raises:
        RunError: names the command that restores it.
    """
    run = client.get_run(run_id)
    check_active(client.get_experiment(run.info.experiment_id))
    if run.info.lifecycle_stage == "deleted":
        raise RunError(
            f"MLflow's run {run_id} was deleted there; records wait until it is restored: "
            f"{_mlflow('runs', 'restore', '--run-id', run_id)}"
        )
    return run


def check_model(client: "MlflowClient", uri: str, model: "LoggedModel") -> None:
    """Refuse a model whose files are not among the artifacts of its experiment.

    Raises:
        UserError: names the place, or as `check_place`.
    """
    experiment = client.get_experiment(model.experiment_id)
    check_place(client, uri, experiment)
    if not model.artifact_location.startswith(f"{experiment.artifact_location}/"):
        raise UserError(
            f"MLflow's model {model.model_id} lies in {redacted(model.artifact_location)}; wanted it among the "
            f"artifacts of its experiment {experiment.name!r}; delete it in MLflow"
        )


def check_run(client: "MlflowClient", uri: str, folder: Path, run_id: str, tag: str) -> None:
    """Refuse a run that is not the one of a folder, by our own id `tag` of it, and note in it where the folder is.

    Raises:
        UserError: if the run has another tag, artifacts in a strange place, or a folder that is still there.
        RunError: if it was deleted.
    """
    run, here = check_there(client, run_id), folder.resolve()
    if run.data.tags.get(RUN_TAG) != tag:
        raise _stranger(folder, f"got the MLflow run {run_id}, which has another tag {RUN_TAG} than this folder's")
    check_place(client, uri, client.get_experiment(run.info.experiment_id))
    home = run.data.tags.get(FOLDER_TAG)
    if home is not None and Path(home) != here and _tag_in(Path(home)) == tag:
        raise _stranger(folder, f"got the MLflow run {run_id}, which is that of {home}")
    if home != str(here):
        client.set_tag(run_id, FOLDER_TAG, str(here))


def _tag_in(folder: Path) -> str | None:
    """Return the tag that a folder has, if it is one of a run."""
    try:
        return json.loads(read_file(folder, IDENTITY, IDENTITY_BYTES))["tag"]
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _stranger(folder: Path, got: str) -> UserError:
    return UserError(
        f"{folder / IDENTITY}: {got}; wanted its own; delete the file, and the next --resume gives the records of this "
        "folder to a new MLflow run"
    )
