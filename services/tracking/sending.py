"""Records as calls of MLflow."""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, TypeVar

from dmil_core.checksums import sha256
from dmil_core.errors import shorten
from dmil_core.files import ForeignFileError, copy_plain, inside
from services.tracking.spool import Artifact, Line, Measured, Trained

if TYPE_CHECKING:
    from mlflow import MlflowClient

logger = logging.getLogger(__name__)
T = TypeVar("T")
LONGEST_KEY = 250
"""Of a metric's, a parameter's and a tag's name, in MLflow."""
DIGITS = 12
"""Of a digest, in a name that was cut."""
METRICS_PER_CALL = 1000
"""What MLflow takes in one batch."""
TEXTS_PER_CALL = 100
LONGEST_NAME = 500
"""Of a data set, in MLflow."""


def acceptable(name: str) -> str:
    """Return a name as MLflow takes one of a metric, a parameter or a tag: other characters become underscores."""
    plain = re.sub(r"[^\w\-./: ]", "_", name)
    if len(plain) > LONGEST_KEY:
        plain = f"{plain[: LONGEST_KEY - DIGITS - 1]}-{sha256(name.encode())[:DIGITS]}"
    return "/".join(part for part in plain.split("/") if part.strip(".")) or "_"


def next_batch(waiting: Sequence[Line]) -> Sequence[Line]:
    """Return the first records, as many as go into one call."""
    if not isinstance(waiting[0].value, Measured):
        return waiting[:1]
    metrics = list(takewhile(lambda line: isinstance(line.value, Measured), waiting))
    room = METRICS_PER_CALL - len(metrics[0].value.values)
    taken = 1
    while taken < len(metrics) and (room := room - len(metrics[taken].value.values)) >= 0:
        taken += 1
    return metrics[:taken]


def send(client: "MlflowClient", run_id: str, folder: Path, batch: Sequence[Line]) -> None:
    """Have MLflow take records that go into one call."""
    from mlflow.entities import Dataset, DatasetInput, Metric

    value = batch[0].value
    match batch[0].kind:
        case "begin":
            client.update_run(run_id, status="RUNNING")
        case "metrics" | "system":
            measured = [line.value for line in batch]
            names = {name: acceptable(name) for one in measured for name in one.values}
            metrics = [
                Metric(names[name], value, one.time, one.step) for one in measured for name, value in one.values.items()
            ]
            _tell_renamed(client, run_id, names)
            for part in _parts(metrics, METRICS_PER_CALL):
                client.log_batch(run_id, metrics=part, synchronous=True)
        case "parameters":
            _send_parameters(client, run_id, value)
        case "tags":
            _send_tags(client, run_id, value)
        case "inputs":
            inputs = [DatasetInput(Dataset(_cut(name), sha[:32], "local", name), []) for name, sha in value.items()]
            client.log_inputs(run_id, datasets=inputs)
        case "artifact":
            _send_artifact(client, run_id, folder, value)
        case "model":
            _send_model(client, run_id, folder, value)
        case "end":
            client.set_terminated(run_id, value.status, value.time)


def _send_parameters(client: "MlflowClient", run_id: str, values: dict[str, str]) -> None:
    from mlflow.entities import Param

    _tell_renamed(client, run_id, names := {name: acceptable(name) for name in values})
    values = {names[name]: value for name, value in values.items()}
    there = client.get_run(run_id).data.params
    for part in _parts([Param(name, values[name]) for name in values.keys() - there], TEXTS_PER_CALL):
        client.log_batch(run_id, params=part, synchronous=True)
    changed = {f"resumed.{name}": value for name, value in values.items() if there.get(name, value) != value}
    _send_tags(client, run_id, changed)


def _tell_renamed(client: "MlflowClient", run_id: str, names: Mapping[str, str]) -> None:
    """Note as tags which names were changed."""
    renamed = {f"renamed.{new}": old for old, new in names.items() if old != new}
    if renamed:
        logger.info(
            f"MLflow has no such names; changed: {', '.join(f'{old} to {names[old]}' for old in renamed.values())}"
        )
    _send_tags(client, run_id, renamed)


def _send_tags(client: "MlflowClient", run_id: str, values: dict[str, str]) -> None:
    from mlflow.entities import RunTag

    for part in _parts([RunTag(acceptable(name), value) for name, value in values.items()], TEXTS_PER_CALL):
        client.log_batch(run_id, tags=part, synchronous=True)


def _send_artifact(client: "MlflowClient", run_id: str, folder: Path, value: Artifact) -> None:
    """Send a file, or the regular files of a folder; what links in it lead to is not the run's, and stays here."""
    with TemporaryDirectory() as made:
        try:
            left_out = copy_plain(folder, value.path, Path(made))
        except FileNotFoundError:
            missing = "was gone before MLflow could be given it"
        except ForeignFileError as error:
            missing = str(error)
        else:
            if left_out:
                names = shorten([path.name for path in left_out])
                logger.warning(f"{value.path}: not sent to MLflow, as they are no plain files: {names}")
            client.log_artifacts(run_id, made, value.folder)
            return
    logger.warning(f"{value.path}: not sent to MLflow: {missing}")
    _send_tags(client, run_id, {f"missing.{value.path}": missing})


def _send_model(client: "MlflowClient", run_id: str, folder: Path, value: Trained) -> None:
    from dmil_core.checkpoint import Checkpoint, CheckpointError
    from services.tracking.models import log_model

    try:
        checkpoint = Checkpoint(inside(folder, value.checkpoint))
    except (CheckpointError, ForeignFileError) as error:
        _send_tags(client, run_id, {f"missing.{value.checkpoint}": str(error)[:5000]})
    else:
        log_model(client, run_id, checkpoint, value.example.model_dump())


def _cut(name: str) -> str:
    """Return a name of a data set, which may be a path, as long as MLflow has it."""
    return name if len(name) <= LONGEST_NAME else f"{name[:20]}...{name[23 - LONGEST_NAME :]}"


def _parts(items: list[T], size: int) -> Iterator[list[T]]:
    return (items[first : first + size] for first in range(0, len(items), size))
