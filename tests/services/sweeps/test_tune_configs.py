"""Sweeps of tune_configs, at preset smoke, as a user runs them: real Tune, real MLflow.

Those that are not run here vary one setting, as `em` does; `test_settings` plans the trials of all.
"""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from mlflow import MlflowClient
from mlflow.entities import Run

from services import tune_sweep
from services.sweeps.folders import SweepFolder
from tests.services.sweeps.test_settings import NAMES

ROWS = {
    "bilevel": ["DMIL", "DMIL-High", "DMIL-Low", "OptionGAIL"],
    "em": ["DMIL", "DMIL_soft"],
    "finetune_steps": ["10", "30", "50", "100", "300", "500"],
    "kitchen_k": ["K=2", "K=4", "K=8"],
    "methods": [
        "DMIL",
        "OptionGAIL",
        "OptionGAIL offline",
        "MIL",
        "MLSH",
        "PEMIRL",
        "behaviour cloning",
        "per task",
        "nearest neighbour",
    ],
}
FLAT = {"MIL", "PEMIRL", "behaviour cloning", "per task", "nearest neighbour"}
"""Rows of methods without sub-skills."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all sweeps here: what one has trained, the next ones need not."""
    return tmp_path_factory.mktemp("runs")


@pytest.fixture
def sweep(programs, runs: Path, runs_of, mlflow_file: str, joined) -> Callable[[str], tuple[dict, Run, list[Run]]]:
    """Run one of the project's sweeps at preset smoke; return its tables and its MLflow runs."""

    def run(name: str) -> tuple[dict, Run, list[Run]]:
        code, printed = programs("tune_sweep", name, "--preset", "smoke", "--name", name, "--runs", str(runs))
        assert code == 0, printed
        folder = runs / name
        tables = json.loads((folder / "tables" / "tables.json").read_text())
        assert set(tables["trials"]) <= {"finished", "stopped"}, printed
        assert tables["what"] in printed
        parent, children = runs_of(mlflow_file, folder)
        (link,) = [line for line in printed.splitlines() if line.startswith("its trials side by side: ")]
        assert link.startswith("its trials side by side: http://127.0.0.1:5000/#/compare-runs?runs=")
        assert all(child.info.run_id in link for child in children)
        return tables, parent, children

    return run


@pytest.mark.parametrize(
    "name", [name if name == "em" else pytest.param(name, marks=pytest.mark.thorough) for name in ROWS]
)
def test_each_sweep_ends_with_its_table(sweep, mlflow_file: str, name: str) -> None:
    tables, parent, children = sweep(name)
    artifacts = [found.path for found in MlflowClient(mlflow_file).list_artifacts(parent.info.run_id, "tables")]
    assert {"tables/report.html", "tables/table.png"} <= set(artifacts)
    assert list(dict.fromkeys(cell["row"] for cell in tables["cells"])) == ROWS[name]
    assert all(cell["episodes"] and cell["seeds"] == [0] for cell in tables["cells"])
    assert all(bool(cell["paper"]) == (name != "methods") for cell in tables["cells"])
    assert parent.info.status == "FINISHED"
    assert tables["what"] in parent.data.tags["mlflow.note.content"]
    assert len(children) == sum(tables["trials"].values())
    for child in children:
        assert child.info.status == "FINISHED"
        assert child.data.tags["sweep"] == name
        assert {"suite", "method", "seed", "variant"} <= child.data.tags.keys()
        assert any("success_rate/" in metric for metric in child.data.metrics)
        if child.data.tags["method"] not in ("per-task", "nearest-neighbour"):
            assert "loss" in child.data.metrics
    online = {cell["row"] for cell in tables["cells"] if cell["environment_steps"]}
    assert online == {"OptionGAIL"} & set(ROWS[name])
    flat = {cell["row"] for cell in tables["cells"] if cell["sub_skills_in_use"] is None}
    assert flat == FLAT & set(ROWS[name])


@pytest.mark.thorough
def test_a_search_stops_the_worse_and_names_the_best(sweep, runs: Path) -> None:
    tables, _, children = sweep("search")
    assert len(tables["samples"]) == len(children) == 4
    assert tables["samples"][0]["status"] == "finished"
    assert {child.info.status for child in children} == {"FINISHED"}
    assert all(sample["held_out"] is not None for sample in tables["samples"])
    assert set(yaml.safe_load((runs / "search/tables/best.yaml").read_text())) == {"method", "training"}
    assert {cell["split"] for cell in tables["cells"]} <= {"meta-training", "meta-testing"}
    folder = SweepFolder(runs / "search")
    results = [folder.result(name) for name in folder.trials]
    evaluated = [runs / path / "episodes.jsonl" for result in results if result for path in result.evaluated.values()]
    tasks = {json.loads(line)["task"] for path in evaluated for line in path.read_text().splitlines()}
    assert tasks == {"reach", "drawer-close", "push"}


def test_help_lists_the_sweeps(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tune_sweep.run(["--help"])
    printed = capsys.readouterr().out
    for name in NAMES:
        assert f"  {name} " in printed
    assert "(Table 4)" in printed
