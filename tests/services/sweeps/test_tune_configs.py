"""Sweeps of tune_configs at preset smoke: the tables of all, and one as a user runs it: real Tune, real MLflow.

`test_settings` plans the trials of all; each method's own training is in `test_same_bits`.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from mlflow import MlflowClient
from mlflow.entities import Run

from services import tune_sweep
from services.storage.checkpoints import Checkpoints
from services.storage.remote import STORAGE
from services.sweeps.folders import SweepFolder
from services.sweeps.table_formats import write_tables
from services.tune_sweep import CONFIGS
from tests.services.sweeps.made_up import better, make_of
from tests.services.sweeps.test_settings import NAMES, sweep_of

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
        "tracking",
    ],
}
SHORT = {
    "training": {"iterations": 2, "checkpoint_every": 2}, "evaluation": {"episodes": 1, "fine_tuning_steps": 1},
}  # fmt: skip
FLAT = {"MIL", "PEMIRL", "behaviour cloning", "per task", "nearest neighbour", "tracking"}
"""Rows of methods without sub-skills."""


@pytest.mark.parametrize("name", ROWS)
def test_each_sweep_has_its_table(tmp_path: Path, name: str) -> None:
    sweep = make_of(tmp_path, sweep_of(name).at("smoke"), better)
    tables = write_tables(sweep)
    assert {path.name for path in (sweep.path / "tables").iterdir()} >= {"report.html", "table.png", "tables.json"}
    assert list(dict.fromkeys(cell.row for cell in tables.cells)) == ROWS[name]
    assert all(cell.episodes and cell.seeds == [0] for cell in tables.cells)
    assert all(bool(cell.paper) == (name != "methods") for cell in tables.cells)
    assert {cell.row for cell in tables.cells if cell.sub_skills_in_use is None} == FLAT & set(ROWS[name])


@pytest.fixture
def sweep(programs, workplace: Path, runs_of, mlflow_file: str, joined) -> Callable[[str], tuple[dict, Run, list[Run]]]:
    """Run a sweep at preset smoke; return its tables and its MLflow runs."""

    def run(file: str) -> tuple[dict, Run, list[Run]]:
        code, printed = programs("tune_sweep", file, "--preset", "smoke", "--name", "run")
        assert code == 0, printed
        folder = workplace / "runs" / "run"
        tables = json.loads((folder / "tables" / "tables.json").read_text())
        assert set(tables["trials"]) <= {"finished", "stopped"}, printed
        assert tables["what"] in printed
        parent, children = runs_of(mlflow_file, folder)
        (link,) = [line for line in printed.splitlines() if line.startswith("its trials side by side: ")]
        assert link.startswith("its trials side by side: http://127.0.0.1:5000/#/compare-runs?runs=")
        assert all(child.info.run_id in link for child in children)
        return tables, parent, children

    return run


def test_a_sweep_ends_with_its_table(sweep, mlflow_file: str) -> None:
    settings = yaml.safe_load((CONFIGS / "em.yaml").read_text())
    settings["presets"]["smoke"]["settings"] = SHORT
    Path("em.yaml").write_text(yaml.safe_dump(settings | {"shots": [1]}))
    tables, parent, children = sweep("em.yaml")
    artifacts = [found.path for found in MlflowClient(mlflow_file).list_artifacts(parent.info.run_id, "tables")]
    assert {"tables/report.html", "tables/table.png"} <= set(artifacts)
    assert list(dict.fromkeys(cell["row"] for cell in tables["cells"])) == ROWS["em"]
    assert all(cell["episodes"] and cell["seeds"] == [0] for cell in tables["cells"])
    assert {(cell["suite"], cell["paper"]) for cell in tables["cells"]} == {("ml10-part", None)}, (
        "nothing to compare with"
    )
    assert parent.info.status == "FINISHED"
    assert tables["what"] in parent.data.tags["mlflow.note.content"]
    assert len(children) == sum(tables["trials"].values())
    for child in children:
        assert child.info.status == "FINISHED"
        assert child.data.tags["sweep"] == "em"
        assert {"suite", "method", "seed", "variant"} <= child.data.tags.keys()
        assert any("success_rate/" in metric for metric in child.data.metrics)
        assert "loss" in child.data.metrics
    assert not any(cell["environment_steps"] for cell in tables["cells"])
    assert all(cell["sub_skills_in_use"] is not None for cell in tables["cells"])


@pytest.mark.thorough
def test_one_training_has_a_row_for_each_evaluation_and_is_fetched_elsewhere(
    sweep, workplace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its practice is counted, also where it was fetched."""
    monkeypatch.setenv(STORAGE, (tmp_path / "storage").as_uri())
    settings = {
        "what": "a test", "suites": ["ml10"], "seeds": [0], "variants": {"one": {"method": {"name": "option-gail"}}},
        "evaluations": {"1": {"fine_tuning_steps": 1}, "2": {"fine_tuning_steps": 2}}, "shots": [1],
        "settings": {"training": {"iterations": 3, "checkpoint_every": 3}, "evaluation": {"episodes": 1}},
    }  # fmt: skip
    Path("own.yaml").write_text(yaml.safe_dump(settings))

    def trained() -> tuple[str, bytes, str]:
        tables, _, (child,) = sweep("own.yaml")
        assert list(dict.fromkeys(cell["row"] for cell in tables["cells"])) == ["1", "2"]
        assert all(cell["environment_steps"] for cell in tables["cells"])
        assert {f"{row}/success_rate/meta-testing/1-shot" for row in "12"} <= child.data.metrics.keys()
        (home,), (log,) = workplace.glob("runs/trained/*"), workplace.glob("runs/run/trials/*/log.txt")
        newest = Checkpoints(home / "checkpoints", 1).newest()
        return newest.digest, (home / "metrics.json").read_bytes(), log.read_text()

    digest, curves, log = trained()
    assert "trained already" not in log
    shutil.rmtree(workplace / "runs")
    again = trained()
    assert again[:2] == (digest, curves)
    assert f"fetched from {(tmp_path / 'storage').as_uri()}" in again[2]
    assert "trained already" in again[2]


@pytest.mark.thorough
def test_a_search_stops_the_worse_and_names_the_best(sweep, workplace: Path) -> None:
    settings = yaml.safe_load((CONFIGS / "search.yaml").read_text())
    settings["search"]["space"]["method.hidden_units"] = [8]
    settings["presets"]["smoke"]["samples"] = 3
    smoke = settings["presets"]["smoke"]["settings"]
    smoke["training"] = {"iterations": 4, "checkpoint_every": 2}
    smoke["evaluation"] = {"every": 2, **SHORT["evaluation"]}
    Path("own.yaml").write_text(yaml.safe_dump(settings))
    tables, _, children = sweep("own.yaml")
    assert len(tables["samples"]) == len(children) == 3
    assert tables["samples"][0]["status"] == "finished"
    assert {child.info.status for child in children} == {"FINISHED"}
    assert all(sample["held_out"] is not None for sample in tables["samples"])
    folder = SweepFolder(workplace / "runs" / "run")
    assert set(yaml.safe_load((folder.path / "tables/best.yaml").read_text())) == {"method", "training"}
    assert {cell["split"] for cell in tables["cells"]} <= {"meta-training", "meta-testing"}
    results = [folder.result(name) for name in folder.trials]
    evaluated = [folder.runs / path for result in results if result for path in result.evaluated.values()]
    rows = [line for path in evaluated for line in (path / "episodes.jsonl").read_text().splitlines()]
    tasks = {json.loads(row)["task"] for row in rows}
    assert tasks == {"reach", "drawer-close", "push"}


def test_help_lists_the_sweeps(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tune_sweep.run(["--help"])
    printed = capsys.readouterr().out
    for name in NAMES:
        assert f"  {name} " in printed
    assert "(Table 4)" in printed
