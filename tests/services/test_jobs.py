"""The programs as Ray jobs: submitted from the project's root to a cluster that was started there."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from services.storage.checkpoints import Checkpoints
from tests.services.programs import QUICK_EVALUATION

PROJECT = Path(__file__).parents[2]

JOB = [sys.executable, "-m", "ray.scripts.scripts", "job"]
ONE = ("--workers", "1")
SHORT = ("--training.iterations", "2", "--training.checkpoint-every", "2", *QUICK_EVALUATION)


@pytest.fixture
def job(cluster, workplace: Path, store, mlflow_file: str) -> Callable[..., str]:
    """Run `ray job`, from the project's root, and return what it prints."""

    def run(do: str, *arguments: str) -> str:
        command = [*JOB, do, "--address", cluster.dashboard, *arguments]
        done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.fixture
def submit(job: Callable[..., str], workplace: Path, store, mlflow_file: str) -> Callable[..., str]:
    """Submit one of the programs; it writes into the test's own folder."""
    environment = {"env_vars": {"DMIL_DATA": str(store.root), "MLFLOW_TRACKING_URI": mlflow_file}}

    def run(name: str, program: str, *arguments: str, wait: bool = True) -> str:
        settings = ["--runtime-env-json", json.dumps(environment), "--submission-id", name]
        command = [sys.executable, "-m", f"services.{program}", *arguments, "--runs", str(workplace / "runs")]
        return job("submit", *settings, *([] if wait else ["--no-wait"]), "--", *command)

    return run


def test_a_job_succeeds_and_leaves_nothing_in_the_checkout(submit, workplace: Path):
    before = {path.name for path in PROJECT.iterdir()}
    assert "succeeded" in submit("whole", "meta_train", "--preset", "ml10-smoke", "--name", "job", *ONE, *SHORT)
    summary = json.loads((workplace / "runs" / "job" / "summary.json").read_text())
    assert [row["episodes"] for row in summary["rows"]] == [3, 1]
    made = {path.name for path in PROJECT.iterdir()} - before
    assert not made & {"data", "runs", "mlflow.db", "mlartifacts"}


@pytest.mark.thorough
def test_a_stopped_job_has_its_checkpoint_and_goes_on_to_the_same_bits(submit, job, train, wait_for, workplace: Path):
    endless = ("--training.iterations", "100000", "--training.checkpoint-every", "50000")
    submit("stopped", "meta_train", "--preset", "ml10-smoke", *ONE, *endless, "--name", "job", wait=False)
    records = workplace / "runs" / "job" / "tracking.jsonl"
    wait_for(lambda: records.exists() and "gradient_norm" in records.read_text(), "an iteration")
    job("stop", "stopped")
    logs = job("logs", "stopped")
    assert "stopped; to go on: dmil meta-train --resume" in logs
    iteration = Checkpoints(workplace / "runs" / "job" / "checkpoints", kept=1).newest().manifest.iteration
    assert iteration >= max(map(int, re.findall(r"^meta-training (\d+)/100000, ", logs, re.MULTILINE)), default=1)

    fewer = ("--training.iterations", str(iteration + 2), "--training.checkpoint-every", "50000")
    resumed = train("job", *fewer, resume=True)
    assert resumed.manifest.iteration == iteration + 2
    whole = train("whole", *fewer)
    np.testing.assert_array_equal(resumed.state.parameters, whole.state.parameters)


@pytest.mark.thorough
def test_a_sweep_is_a_job_too(submit, workplace: Path):
    small = {"training": {"iterations": 1}, "evaluation": {"episodes": 1, "fine_tuning_steps": 1}}
    sweep = {"what": "a test", "suites": ["ml10"], "seeds": [0], "variants": {"one": small}, "shots": [1]}
    (workplace / "small.yaml").write_text(json.dumps(sweep))
    printed = submit("sweep", "tune_sweep", str(workplace / "small.yaml"), "--preset", "smoke", "--name", "small")
    assert "1 finished" in printed
    tables = json.loads((workplace / "runs" / "small" / "tables" / "tables.json").read_text())
    assert tables["trials"] == {"finished": 1}


@pytest.mark.thorough
def test_a_job_in_a_package_of_ray_s_leaves_no_results_there(cluster, tmp_path: Path):
    (tmp_path / "notes.txt").write_text("a package")
    command = [*JOB, "submit", "--address", cluster.dashboard, "--working-dir", str(tmp_path), "--"]
    command += [sys.executable, "-m", "services.collect_demos", "--preset", "ml10-smoke", "--runner", "local"]
    done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True)
    assert done.returncode == 1
    assert re.search(r"error: demonstrations: got /.*/data; Ray deletes that .* DMIL_DATA=FOLDER; a job", done.stdout)
