"""What the tests of tracking share: an MLflow that is not there, and what was recorded and delivered."""

from collections.abc import Callable
from pathlib import Path

import pytest
from mlflow import MlflowClient

from services.tracking.spool import read_spool


@pytest.fixture
def no_mlflow(free_port: Callable[[], int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing listens at MLflow's address."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{free_port()}")


def records(folder: Path, kind: str) -> list:
    return [line.value for line in read_spool(folder / "tracking.jsonl") if line.kind == kind]


def steps(store: str, run_id: str | None, name: str) -> list[int]:
    """Return the steps of a metric's history in the order of the store's rows."""
    return [point.step for point in MlflowClient(store).get_metric_history(str(run_id), name)]
