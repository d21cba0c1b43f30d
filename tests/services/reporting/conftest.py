import shutil
import sys
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from dmil_core.configs import preset_of
from services.cli.composition import checked
from services.cli.yaml_files import merged
from services.demonstrations.store import DemoStore, data_root
from services.distributed.runner import LocalRunner
from services.experiments.experiment import Experiment
from services.experiments.finished_run import FinishedRun
from services.storage.checkpoints import Checkpoints
from services.tracking.tracker import Tracker

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "planar_visits" / "planar_visits.py"


@pytest.fixture(scope="session")
def planar_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the demonstrations of planar visits are kept, so that each is made once."""
    return tmp_path_factory.mktemp("planar-data")


@pytest.fixture
def planar_visits(tmp_path: Path, planar_data: Path, mlflow_file: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A suite whose episodes take no time, the example of the guide, as an installed package; an empty workplace."""
    package = tmp_path / "packages"
    information = package / "planar_visits-0.1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: planar-visits\nVersion: 0.1.0\n")
    (information / "entry_points.txt").write_text("[dmil.suites]\nplanar-visits = planar_visits:PlanarVisits\n")
    shutil.copy(EXAMPLE, package)
    monkeypatch.syspath_prepend(package)
    monkeypatch.delitem(sys.modules, "planar_visits", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DMIL_DATA", str(planar_data))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", mlflow_file)
    return tmp_path


@pytest.fixture(scope="session")
def planar_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a copy of each run on planar visits is kept, so that each is trained once."""
    return tmp_path_factory.mktemp("planar-runs")


@pytest.fixture
def trained(planar_visits: Path, planar_runs: Path) -> Callable[..., FinishedRun]:
    """Meta-trains a little on planar visits, and returns what is left: a checkpoint, without an evaluation."""

    def train(name: str, of: str = "dmil", **settings: Any) -> FinishedRun:
        config = preset_of("planar-visits", "smoke", of)
        given: dict[str, Any] = {"demonstrations": {"per_task": 14, "held_out": 8}}
        if config.training.iterations:
            given["training"] = {"iterations": 4, "checkpoint_every": 4}
        config = checked(merged(config.model_dump(), given | settings, "test"))
        folder = planar_visits / "runs" / name
        copy = planar_runs / sha256(config.model_dump_json().encode()).hexdigest()
        if copy.exists():
            return FinishedRun(shutil.copytree(copy, folder))
        experiment = Experiment(config, DemoStore(data_root()))
        runner = LocalRunner(experiment.suite)
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(config.model_dump_json())
        data = experiment.collect(runner)
        tracker = Tracker(folder, "test")
        experiment.train(runner, data, Checkpoints(folder / "checkpoints", 1), tracker)
        tracker.close("FINISHED")
        shutil.copytree(folder, copy)
        return FinishedRun(folder)

    return train
