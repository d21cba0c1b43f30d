"""What the tests of sweeps share."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.entities import Run
from ray.util.placement_group import placement_group

from services.distributed import cluster
from tests.services.programs import Cluster


@pytest.fixture(scope="session")
def runs_of() -> Callable[[str, Path], tuple[Run, list[Run]]]:
    """Returns the MLflow run of a sweep's folder, and its children."""

    def find(uri: str, sweep: Path) -> tuple[Run, list[Run]]:
        client = MlflowClient(uri)
        parent_id = json.loads((sweep / "mlflow_run.json").read_text())["run_id"]
        parent = client.get_run(parent_id)
        found = client.search_runs([parent.info.experiment_id], f"tags.`mlflow.parentRunId` = '{parent_id}'")
        return parent, list(found)

    return find


@pytest.fixture
def one_at_a_time(joined: Cluster) -> Iterator[None]:
    """Leaves one CPU of the session's cluster, so that trials run in their order."""
    with cluster.joined():
        assert placement_group([{"CPU": cluster.cpus() - 1}]).wait()
        yield
