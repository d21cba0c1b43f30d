"""A run's model in MLflow: its last checkpoint, with the code that turns a support set into actions."""

import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmil_core.checkpoint import FILES, MARKER, Checkpoint
from dmil_core.configs import EvaluationConfig
from dmil_core.errors import UserError
from dmil_core.files import copy_plain, inside
from services.storage.redaction import error_line, redacted
from services.tracking.client import connect, set_mlflow_defaults
from services.tracking.links import tracking_uri
from services.tracking.ownership import check_model

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import LoggedModel, Run
    from mlflow.models import ModelSignature

NAME = "model"
CODE = Path(__file__).with_name("imitator.py")
CHECKPOINT_TAG = "checkpoint"
"""The digest of what the model was made of."""
LIBRARIES = ("mlflow", "numpy", "torch")
"""That a model asks for by their version. Not the project itself: an index may hold somebody else's under its name."""


def models_of(client: "MlflowClient", run: "Run") -> "list[LoggedModel]":
    """Return the models of a run that are there as a whole, the newest first."""
    models = client.search_logged_models([run.info.experiment_id], f"source_run_id = '{run.info.run_id}'")
    return [model for model in models if model.status == "READY"]


def checkpoint_in(model: Path) -> Path:
    """Return the folder of the checkpoint in a model that was downloaded.

    Raises:
        OSError: if the model says that it lies elsewhere.
    """
    from mlflow.models import Model

    return inside(model, Model.load(str(model)).flavors["python_function"]["artifacts"]["checkpoint"]["path"])


def download(client: "MlflowClient", uri: str, model: "LoggedModel", folder: Path) -> Path:
    """Download a model into `folder`, and return the folder of its checkpoint: none of a model's code is run.

    Raises:
        UserError: if it lies elsewhere than among the artifacts of its experiment.
    """
    from mlflow.artifacts import download_artifacts

    check_model(client, uri, model)
    # Not by its address: that is looked up at the process's MLflow, which may be another.
    files = download_artifacts(artifact_uri=model.artifact_location, dst_path=str(folder), tracking_uri=uri)
    return checkpoint_in(Path(files))


def checkpoint_at(address: str) -> Checkpoint:
    """Read the checkpoint of a model in the MLflow of ``MLFLOW_TRACKING_URI``; `dmil_core.load` asks for it.

    Args:
        address: ``models:/NAME@ALIAS``, ``models:/NAME/VERSION``, ``models:/ID`` or ``runs:/RUN_ID/model``.

    Raises:
        UserError: if there is none, or MLflow does not answer.
    """
    set_mlflow_defaults()
    from mlflow.exceptions import MlflowException

    uri = tracking_uri()
    with tempfile.TemporaryDirectory() as made:
        try:
            client = connect(uri)
            return Checkpoint(download(client, uri, _model_at(client, address), Path(made)))
        except (MlflowException, OSError, LookupError) as error:
            raise UserError(
                f"{address}: got no model at {redacted(uri)}: {error_line(error)}; wanted models:/NAME@ALIAS, "
                "models:/NAME/VERSION, models:/ID or runs:/RUN_ID/model; set MLFLOW_TRACKING_URI to the run's"
            ) from None  # its text may hold secrets


def _model_at(client: "MlflowClient", address: str) -> "LoggedModel":
    scheme, _, place = address.partition(":/")
    if scheme == "runs":
        return models_of(client, client.get_run(place.partition("/")[0]))[0]
    name, alias, label = place.partition("@") if "@" in place else place.partition("/")
    if not alias:
        return client.get_logged_model(name)
    found = client.get_model_version_by_alias if alias == "@" else client.get_model_version
    return client.get_logged_model((found(name, label).source or "").removeprefix("models:/"))


def log_model(client: "MlflowClient", run_id: str, checkpoint: Checkpoint, example: dict[str, Any]) -> None:
    """Have MLflow keep a checkpoint as the model of a run; one that it has already stays as it is."""
    run = client.get_run(run_id)
    if any(model.tags.get(CHECKPOINT_TAG) == checkpoint.digest for model in models_of(client, run)):
        return
    config = checkpoint.manifest.config
    tags = {"suite": config.suite.name, "method": config.method.name, "seed": str(config.seed)}
    model = client.create_logged_model(
        run.info.experiment_id, NAME, run_id, {**tags, CHECKPOINT_TAG: checkpoint.digest}, model_type=config.method.name
    )
    with tempfile.TemporaryDirectory() as made:
        copy = Path(made) / checkpoint.path.name  # of what is the checkpoint's: whatever else lies there stays here
        for name in (*FILES, MARKER):
            copy_plain(checkpoint.path, name, copy)
        _save(Path(made) / NAME, checkpoint, copy, example, model)
        client.log_model_artifacts(model.model_id, str(Path(made) / NAME))
    from mlflow.entities import LoggedModelOutput

    client.log_outputs(run_id, [LoggedModelOutput(model.model_id, checkpoint.manifest.iteration)])
    client.finalize_logged_model(model.model_id, "READY")


def _save(folder: Path, checkpoint: Checkpoint, copy: Path, example: dict[str, Any], model: "LoggedModel") -> None:
    """Write a model as MLflow has it, without a pickle."""
    from mlflow.models import Model
    from mlflow.pyfunc import save_model

    save_model(
        folder,
        python_model=CODE,
        artifacts={"checkpoint": str(copy)},
        signature=_signature(checkpoint.manifest.config.evaluation),
        input_example=example,
        pip_requirements=[f"{library}=={version(library)}" for library in LIBRARIES],
        model_config={"action_dim": len(example["support"][0]["actions"][0])},
        mlflow_model=Model(
            artifact_path=model.artifact_location,
            model_uuid=model.model_id,
            model_id=model.model_id,
            run_id=model.source_run_id,
            metadata={"needs": "this project, installed where the model is loaded", **checkpoint.manifest.versions},
        ),
    )


def _signature(evaluation: EvaluationConfig) -> "ModelSignature":
    from mlflow.models import ModelSignature
    from mlflow.types import ParamSchema, ParamSpec
    from mlflow.types.schema import Array, ColSpec, DataType, Object, Property, Schema

    rows = Array(Array(DataType.double))
    demonstration = Object([Property("observations", rows), Property("actions", rows)])
    return ModelSignature(
        inputs=Schema(
            [
                ColSpec(Array(demonstration), "support", required=False),
                ColSpec(DataType.string, "support_id", required=False),
                ColSpec(Array(DataType.double), "observation"),
                ColSpec(Array(DataType.long), "memory", required=False),
            ]
        ),
        outputs=Schema(
            [
                ColSpec(Array(DataType.double), "action"),
                ColSpec(DataType.long, "sub_skill"),
                ColSpec(Array(DataType.long), "memory"),
                ColSpec(DataType.string, "support_id"),
            ]
        ),
        params=ParamSchema(
            [
                ParamSpec("fine_tuning_steps", DataType.long, evaluation.fine_tuning_steps),
                ParamSpec("learning_rate", DataType.double, evaluation.learning_rate),
            ]
        ),
    )
