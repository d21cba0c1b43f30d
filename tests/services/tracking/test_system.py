"""Load of the machine, recorded beside a run."""

from pathlib import Path

import pytest
from mlflow import MlflowClient

from services.tracking import system
from services.tracking.delivery import Identity
from services.tracking.history import read_metrics
from services.tracking.system import recording_system
from services.tracking.tracker import Tracker
from tests.services.tracking.conftest import records


def test_samples_go_to_mlflow_as_its_system_metrics_and_a_resumed_run_goes_on_counting(
    tmp_path: Path, mlflow_file: str, wait_for, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    monkeypatch.setattr(system, "SECONDS", 0.05)
    for _ in range(2):
        tracker = Tracker(tmp_path, "load")
        before = len(records(tmp_path, "system"))
        with recording_system(tracker):
            tracker.metrics(1, {"loss": 0.5})
            wait_for(lambda before=before: len(records(tmp_path, "system")) > before, "a sample")
        assert tracker.close("FINISHED")
    samples = records(tmp_path, "system")
    assert [sample.step for sample in samples] == list(range(len(samples)))
    names = {"cpu_utilization_percentage", "system_memory_usage_megabytes", "disk_usage_percentage"}
    assert all(0 <= sample.values["system/cpu_utilization_percentage"] <= 100 for sample in samples)
    metrics = MlflowClient(mlflow_file).get_run(str(Identity.of(tmp_path).run_id)).data.metrics
    assert metrics.keys() >= {f"system/{name}" for name in (*names, "network_receive_megabytes")}
    assert read_metrics(tmp_path) == [{"iteration": 1, "loss": 0.5}], "they are no metrics of iterations"


@pytest.mark.usefixtures("no_mlflow")
def test_a_short_run_has_one_sample_at_its_end_and_waits_for_no_other(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(system, "SECONDS", 10**6)
    tracker = Tracker(tmp_path, "load")
    with recording_system(tracker):
        pass
    tracker.close("FINISHED")
    assert len(records(tmp_path, "system")) == 1
