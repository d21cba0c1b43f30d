"""MLflow tracking that never stops a run: records go to a file in the run's folder first, a thread delivers them."""

import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dmil_core.configs import ExperimentConfig
from services.provenance import git_commit, library_versions

os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "3")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")

if TYPE_CHECKING:
    from mlflow import MlflowClient

T = TypeVar("T")

__all__ = ["DEFAULT_URI", "Tracker", "introduce", "tracking_uri"]

DEFAULT_URI = "sqlite:///mlflow.db"
METRICS_PER_CALL = 1000
"""What MLflow takes in one batch."""
PARAMETERS_PER_CALL = 100
RETRY_SECONDS = 10.0
LINGER_SECONDS = 1.0
"""How long records are gathered before they are sent together."""


def tracking_uri() -> str:
    """Return ``MLFLOW_TRACKING_URI``, or an SQLite file in the working directory."""
    return os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_URI


class Tracker:
    """One MLflow run, fed from ``tracking.jsonl`` in the run's folder."""

    def __init__(self, folder: Path, experiment: str, say: Callable[[str], None]) -> None:
        """Open the MLflow run that belongs to a run's folder, or make one as soon as MLflow answers.

        Args:
            folder: of the run; a folder that was tracked before continues the same MLflow run.
            experiment: the MLflow experiment's name.
            say: where the one message goes when MLflow does not answer.
        """
        self.uri = tracking_uri()
        self._folder, self._experiment, self._say = folder, experiment, say
        _drop_half_line(folder / "tracking.jsonl")
        self._spool = (folder / "tracking.jsonl").open("a", buffering=1)
        self._identity = folder / "mlflow_run.json"
        self._offset = json.loads(self._identity.read_text())["delivered"] if self._identity.exists() else 0
        self.run_id: str | None = json.loads(self._identity.read_text())["run_id"] if self._identity.exists() else None
        self._client: MlflowClient | None = None
        self._closing = threading.Event()
        self._complained = False
        self._answered = threading.Event()
        self._thread = threading.Thread(target=self._work, name="mlflow", daemon=True)
        self._thread.start()

    def parameters(self, values: Mapping[str, Any]) -> None:
        """Record settings; MLflow keeps the first value of each, a resumed run's other value becomes a tag."""
        self._record("parameters", {name: str(value) for name, value in values.items()})

    def metrics(self, step: int, values: Mapping[str, float]) -> None:
        """Record metrics of one iteration."""
        self._record("metrics", {"step": step, "time": int(time.time() * 1000), "values": dict(values)})

    def tags(self, values: Mapping[str, str]) -> None:
        """Record tags; a later value replaces an earlier one."""
        self._record("tags", dict(values))

    def inputs(self, digests: Mapping[str, str]) -> None:
        """Record data sets by name and digest as the run's inputs."""
        self._record("inputs", dict(digests))

    def artifact(self, path: Path, folder: str | None = None) -> None:
        """Record a file or folder as an artifact."""
        self._record("artifact", {"path": str(path.resolve()), "folder": folder})

    def identify(self, patience: float = 20.0) -> str | None:
        """Return the MLflow run's id; when MLflow was only just asked for it, wait so many seconds for the answer."""
        self._answered.wait(patience)
        return self.run_id

    def close(self, status: str, patience: float = 60.0) -> bool:
        """End the MLflow run as FINISHED, FAILED or KILLED; return whether all records have been delivered.

        Args:
            status: how the run ended.
            patience: seconds to wait for the delivery.
        """
        self._record("end", status)
        self._closing.set()
        self._thread.join(patience)
        self._spool.close()
        return not self._thread.is_alive() and not self._pending()

    def _record(self, kind: str, value: Any) -> None:
        self._spool.write(json.dumps([kind, value]) + "\n")

    def _pending(self) -> bool:
        return self._offset < (self._folder / "tracking.jsonl").stat().st_size

    def _work(self) -> None:
        while True:
            closing = self._closing.wait(LINGER_SECONDS)
            try:
                self._deliver()
            except Exception as error:  # noqa: BLE001  whatever MLflow raises, training goes on
                self._answered.set()
                if not self._complained:
                    self._complained = True
                    self._say(
                        f"MLflow at {self.uri} does not take records ({type(error).__name__}); training goes on, "
                        f"records wait in {self._folder / 'tracking.jsonl'}"
                    )
                if closing:
                    return
                self._closing.wait(RETRY_SECONDS)
            else:
                if closing and not self._pending():
                    return

    def _deliver(self) -> None:
        """Send every whole line behind the offset, and remember how far delivery got."""
        with (self._folder / "tracking.jsonl").open("rb") as file:
            file.seek(self._offset)
            lines = [line for line in file if line.endswith(b"\n")]
        if not lines:
            return
        client, run_id = self._open()
        while lines:
            kind = json.loads(lines[0])[0]
            taken = 1
            while kind == "metrics" and taken < len(lines) and lines[taken].startswith(b'["metrics"'):
                taken += 1
            values = [json.loads(line)[1] for line in lines[:taken]]
            getattr(self, f"_send_{kind}")(client, run_id, values)
            self._offset += sum(map(len, lines[:taken]))
            self._remember()
            lines = lines[taken:]

    def _remember(self) -> None:
        beside = self._identity.with_suffix(".tmp")
        beside.write_text(json.dumps({"run_id": self.run_id, "delivered": self._offset}))
        beside.replace(self._identity)

    def _open(self) -> "tuple[MlflowClient, str]":
        if self._client is None:
            from mlflow import MlflowClient  # takes seconds to import: not before it is needed

            client = MlflowClient(self.uri)
            if self.run_id is None:
                found = client.get_experiment_by_name(self._experiment)
                experiment_id = (
                    found.experiment_id
                    if found
                    else client.create_experiment(self._experiment, artifact_location=_beside(self.uri))
                )
                self.run_id = client.create_run(experiment_id, run_name=self._folder.name).info.run_id
                self._remember()
            else:
                client.update_run(self.run_id, status="RUNNING")
            self._client = client
            self._answered.set()
        assert self.run_id is not None
        return self._client, self.run_id

    @staticmethod
    def _send_metrics(client: "MlflowClient", run_id: str, values: list[dict[str, Any]]) -> None:
        from mlflow.entities import Metric

        metrics = [
            Metric(name, value, record["time"], record["step"])
            for record in values
            for name, value in record["values"].items()
        ]
        for part in _parts(metrics, METRICS_PER_CALL):
            client.log_batch(run_id, metrics=part)

    @staticmethod
    def _send_parameters(client: "MlflowClient", run_id: str, values: list[dict[str, str]]) -> None:
        from mlflow.entities import Param

        there = client.get_run(run_id).data.params
        for part in _parts([Param(name, values[0][name]) for name in values[0].keys() - there], PARAMETERS_PER_CALL):
            client.log_batch(run_id, params=part)
        changed = {f"resumed.{name}": value for name, value in values[0].items() if there.get(name, value) != value}
        Tracker._send_tags(client, run_id, [changed])

    @staticmethod
    def _send_tags(client: "MlflowClient", run_id: str, values: list[dict[str, str]]) -> None:
        for name, value in values[0].items():
            client.set_tag(run_id, name, value)

    @staticmethod
    def _send_inputs(client: "MlflowClient", run_id: str, values: list[dict[str, str]]) -> None:
        from mlflow.entities import Dataset, DatasetInput

        inputs = [DatasetInput(Dataset(name, sha[:32], "local", name), []) for name, sha in values[0].items()]
        client.log_inputs(run_id, datasets=inputs)

    @staticmethod
    def _send_artifact(client: "MlflowClient", run_id: str, values: list[dict[str, str | None]]) -> None:
        path = Path(str(values[0]["path"]))
        send = client.log_artifacts if path.is_dir() else client.log_artifact
        send(run_id, str(path), values[0]["folder"])

    @staticmethod
    def _send_end(client: "MlflowClient", run_id: str, values: list[str]) -> None:
        client.set_terminated(run_id, values[0])


def introduce(tracker: Tracker, config: ExperimentConfig) -> None:
    """Record what a run is: every setting, the commit of the code and the versions of the libraries."""
    tracker.parameters(dict(_flat(config.model_dump(mode="json"), "")))
    tracker.tags({"suite": config.suite.name, "method": config.method.name, "seed": str(config.seed)})
    tracker.tags({"git_commit": git_commit(), **{f"version.{name}": v for name, v in library_versions().items()}})


def _drop_half_line(path: Path) -> None:
    """Cut off a last line that a killed process did not finish."""
    if path.exists():
        whole = path.read_bytes().rpartition(b"\n")
        os.truncate(path, len(whole[0] + whole[1]))


def _beside(uri: str) -> str | None:
    """Return where artifacts go: beside an SQLite file, and else where the server says."""
    if not uri.startswith("sqlite:///"):
        return None
    return (Path(uri.removeprefix("sqlite:///")).resolve().parent / "mlartifacts").as_uri()


def _flat(settings: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _parts(items: list[T], size: int) -> Iterable[list[T]]:
    return (items[first : first + size] for first in range(0, len(items), size))
