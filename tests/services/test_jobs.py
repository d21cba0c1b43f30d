"""The program as a Ray job: submitted from the project's root to a cluster that was started there."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_job_succeeds_and_leaves_nothing_in_the_checkout(cluster, workplace: Path, store, mlflow_file: str):
    before = {path.name for path in PROJECT.iterdir()}
    environment = {"env_vars": {"DMIL_DATA": str(store.root), "MLFLOW_TRACKING_URI": mlflow_file}}
    command = [
        sys.executable, "-m", "ray.scripts.scripts", "job", "submit", "--address", cluster.dashboard,
        "--runtime-env-json", json.dumps(environment), "--",
        sys.executable, "-m", "services.meta_train", "--preset", "ml10-smoke",
        "--runs", str(workplace / "runs"), "--name", "job",
    ]  # fmt: skip
    submitted = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, timeout=240)
    assert submitted.returncode == 0, submitted.stdout + submitted.stderr
    assert "succeeded" in submitted.stdout
    summary = json.loads((workplace / "runs" / "job" / "summary.json").read_text())
    assert [row["episodes"] for row in summary["rows"]] == [6, 6, 2, 2]
    made = {path.name for path in PROJECT.iterdir()} - before
    assert not made & {"data", "runs", "mlflow.db", "mlartifacts"}
