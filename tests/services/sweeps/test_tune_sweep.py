"""Sweeps as a user runs them: real Tune, real MLflow, real deaths."""

import json
import shutil
import signal
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml
from mlflow import MlflowClient
from mlflow.entities import Run

from dmil_core.configs import ExperimentConfig
from services import tune_sweep
from services.checkpoints import Checkpoint, Checkpoints
from services.demo_store import TaskDemonstrations, open_store
from services.experiment import Experiment, open_runner
from services.storage import STORAGE
from services.sweeps.folders import SweepFolder
from services.tracking import Tracker

ROWS = {
    "bilevel": ["DMIL", "DMIL-High", "DMIL-Low", "OptionGAIL"],
    "continuity": ["DMIL_nc", "λ = 0.01", "DMIL", "λ = 1"],
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
    "negatives": ["same", "mismatched"],
    "sub_skills": ["K=2", "K=3", "K=5", "K=8", "K=10"],
}
WITHOUT_PAPER = ("continuity", "methods", "negatives", "sub_skills")
"""Sweeps with rows, or all of them, that the paper does not have."""

FLAT = {"MIL", "PEMIRL", "same", "mismatched", "behaviour cloning", "per task", "nearest neighbour"}
"""Rows of methods without sub-skills."""


def write_sweep(variants: dict[str, object], **changes: object) -> str:
    """Write a small sweep in the working directory."""
    settings = {
        "what": "a test", "suites": ["ml10"], "seeds": [0], "variants": variants, "shots": [1],
        "settings": {"training": {"iterations": 40, "checkpoint_every": 5}}, **changes,
    }  # fmt: skip
    Path("small.yaml").write_text(yaml.safe_dump(settings, allow_unicode=True))
    return "small.yaml"


def runs_of(uri: str, sweep: Path) -> tuple[Run, list[Run]]:
    """Return the sweep's MLflow run and its children."""
    client = MlflowClient(uri)
    parent_id = json.loads((sweep / "mlflow_run.json").read_text())["run_id"]
    parent = client.get_run(parent_id)
    found = client.search_runs([parent.info.experiment_id], f"tags.`mlflow.parentRunId` = '{parent_id}'")
    return parent, list(found)


@pytest.fixture
def sweep(programs, workplace: Path, mlflow_file: str, joined) -> Callable[[str], tuple[dict, Run, list[Run]]]:
    """Run one of the project's sweeps at scale smoke; return its tables and its MLflow runs."""

    def run(name: str) -> tuple[dict, Run, list[Run]]:
        code, printed = programs("tune_sweep", name, "--scale", "smoke", "--name", name)
        assert code == 0, printed
        folder = workplace / "runs" / name
        tables = json.loads((folder / "tables" / "tables.json").read_text())
        assert set(tables["trials"]) <= {"finished", "stopped"}, printed
        assert tables["what"] in printed
        parent, children = runs_of(mlflow_file, folder)
        (link,) = [line for line in printed.splitlines() if line.startswith("its trials side by side: ")]
        assert link.startswith("its trials side by side: http://127.0.0.1:5000/#/compare-runs?runs=")
        assert all(child.info.run_id in link for child in children)
        return tables, parent, children

    return run


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_each_sweep_ends_with_its_table(sweep, mlflow_file: str, name: str) -> None:
    tables, parent, children = sweep(name)
    artifacts = [found.path for found in MlflowClient(mlflow_file).list_artifacts(parent.info.run_id, "tables")]
    assert {"tables/report.html", "tables/table.png"} <= set(artifacts)
    assert list(dict.fromkeys(cell["row"] for cell in tables["cells"])) == ROWS[name]
    assert all(cell["episodes"] and cell["seeds"] == [0] for cell in tables["cells"])
    papers = [cell["paper"] for cell in tables["cells"]]
    assert all(papers) if name not in WITHOUT_PAPER else name == "continuity" or not any(papers)
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
    practised = {cell["row"] for cell in tables["cells"] if cell["environment_steps"]}
    assert practised == {"OptionGAIL"} & set(ROWS[name])
    flat = {cell["row"] for cell in tables["cells"] if cell["sub_skills_in_use"] is None}
    assert flat == FLAT & set(ROWS[name])


@pytest.mark.slow
def test_a_search_stops_the_worse_and_names_the_best(sweep, workplace: Path) -> None:
    tables, _, children = sweep("search")
    assert len(tables["samples"]) == len(children) == 4
    assert tables["samples"][0]["status"] == "finished"
    assert {child.info.status for child in children} == {"FINISHED"}
    assert all(sample["held_out"] is not None for sample in tables["samples"])
    assert set(yaml.safe_load((workplace / "runs/search/tables/best.yaml").read_text())) == {"method", "training"}
    assert {cell["split"] for cell in tables["cells"]} <= {"meta-training", "meta-testing"}
    folder = SweepFolder(workplace / "runs" / "search")
    rows = "".join(path.read_text() for path in folder.runs.glob("trained/*/evaluated/*/episodes.jsonl"))
    tasks = {json.loads(line)["task"] for line in rows.splitlines()}
    assert tasks == {"reach", "drawer-close", "push"}


def steps_of(uri: str, run: Run, metric: str) -> list[int]:
    return sorted(point.step for point in MlflowClient(uri).get_metric_history(run.info.run_id, metric))


@pytest.mark.slow
def test_a_killed_sweep_goes_on_where_it_was(
    programs, workplace: Path, mlflow_file: str, wait_for, data: dict[str, TaskDemonstrations]
) -> None:
    """Finished trials stay, those under way go on from their checkpoints to the same bits, MLflow holds each once."""
    file = write_sweep({name: {"method": {"sub_skills": k}} for k, name in enumerate("abc", 1)})
    program = programs.start("tune_sweep", file, "--scale", "smoke", "--name", "killed")
    folder = workplace / "runs" / "killed"

    def one_is_over_and_the_last_under_way() -> bool:
        over = list(folder.glob("trials/*/result.json"))
        homes = list(folder.parent.glob("trained/*"))
        return program.poll() is not None or (
            bool(over) and len(homes) == 3 and all(list(home.glob("checkpoints/iteration-*")) for home in homes)
        )

    wait_for(one_is_over_and_the_last_under_way, "two trials", 200)
    assert program.poll() is None, program.communicate()[0]
    program.kill()
    program.communicate()
    before = {path: path.stat().st_mtime_ns for path in folder.glob("trials/*/result.json")}
    assert len(before) < 3
    begun = {
        home.name: Checkpoints(home / "checkpoints", 1).newest().manifest.iteration
        for home in folder.parent.glob("trained/*")
    }

    code, printed = programs("tune_sweep", "--resume", "killed")
    assert code == 0, printed
    assert all(path.stat().st_mtime_ns == written for path, written in before.items())
    sweep = SweepFolder(folder)
    for name, trial in sweep.trials.items():
        result = sweep.result(name)
        assert result is not None
        assert result.status == "finished"
        assert result.trained is not None
        home = sweep.runs / result.trained
        assert begun[home.name] > 0
        np.testing.assert_array_equal(
            newest(home).state.parameters, undisturbed(trial.config, data, workplace / "alone" / name)
        )
    parent, children = runs_of(mlflow_file, folder)
    assert parent.info.status == "FINISHED"
    assert sorted(str(child.info.run_name) for child in children) == sorted(sweep.trials)
    for child in children:
        assert child.info.status == "FINISHED"
        assert steps_of(mlflow_file, child, "gradient_norm") == list(range(1, 41))


@pytest.mark.slow
@pytest.mark.usefixtures("joined")
@pytest.mark.usefixtures("joined")
def test_what_a_sweep_trained_is_fetched_elsewhere(programs, workplace: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv(STORAGE, (tmp_path / "storage").as_uri())
    file = write_sweep({"DMIL": {}}, settings={"training": {"iterations": 4, "checkpoint_every": 2}})

    def trained() -> tuple[str, bytes, str]:
        code, printed = programs("tune_sweep", file, "--scale", "smoke", "--name", "once")
        assert code == 0, printed
        (home,), (log,) = workplace.glob("runs/trained/*"), workplace.glob("runs/once/trials/*/log.txt")
        return newest(home).digest, (home / "metrics.json").read_bytes(), log.read_text()

    digest, curves, told = trained()
    assert "trained already" not in told
    shutil.rmtree(workplace / "runs")
    again = trained()
    assert again[:2] == (digest, curves)
    assert f"fetched from {(tmp_path / 'storage').as_uri()}" in again[2]
    assert "trained already" in again[2]


def newest(home: Path) -> Checkpoint:
    return Checkpoints(home / "checkpoints", 1).newest()


def undisturbed(config: ExperimentConfig, data: dict[str, TaskDemonstrations], folder: Path) -> np.ndarray:
    """Return the parameters that the configuration has when it is trained in this process."""
    folder.mkdir(parents=True)
    experiment = Experiment(config, open_store())
    tracker = Tracker(folder, "alone", print)
    with open_runner("local", experiment.suite, None) as runner:
        checkpoint = experiment.train(runner, data, Checkpoints(folder / "checkpoints", 1), tracker)
    tracker.close("FINISHED")
    return checkpoint.state.parameters


def named(processes: Iterable[psutil.Process], name: str) -> list[psutil.Process]:
    found = []
    for process in processes:
        try:
            if " ".join(process.cmdline()).startswith(name):
                found.append(process)
        except psutil.Error:
            continue
    return found


@pytest.mark.slow
def test_a_trial_that_fails_or_dies_leaves_the_others_alone(
    programs, workplace: Path, mlflow_file: str, wait_for
) -> None:
    """One has an error, which is told; one loses its process, and is begun again; trials of two CPUs each."""
    variants = {"good": {}, "spoilt": {"training": {"learning_rate": 1e30}}}
    file = write_sweep(variants, resources={"workers": 2})
    program = programs.start("tune_sweep", file, "--scale", "smoke", "--name", "hurt")
    folder = workplace / "runs" / "hurt"
    wait_for(
        lambda: program.poll() is not None or any(folder.parent.glob("trained/*/checkpoints/iteration-*")),
        "a trial",
        200,
    )
    trials = named(psutil.Process(program.pid).children(recursive=True), "ray::ImplicitFunc")
    assert trials
    for process in trials:
        process.send_signal(signal.SIGKILL)
    printed, _ = program.communicate(timeout=240)
    assert program.returncode == 1, printed
    assert "1 of 2 trials failed" in printed
    assert "ml10-spoilt-seed-0: iteration" in printed
    assert "is not finite" in printed
    assert "Traceback" not in printed
    assert "its process ended; it is begun again" in printed
    tables = json.loads((folder / "tables" / "tables.json").read_text())
    assert tables["trials"] == {"finished": 1, "failed": 1}
    assert {cell["row"] for cell in tables["cells"]} == {"good"}
    _, children = runs_of(mlflow_file, folder)
    assert {child.data.tags["variant"]: child.info.status for child in children} == {
        "good": "FINISHED",
        "spoilt": "FAILED",
    }
    assert "is not finite" in next(child.data.tags["error"] for child in children if child.info.status == "FAILED")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "SWEEP: got none; wanted a file"),
        (["nope"], "SWEEP: got nope"),
        (["em", "--suites", "ml11"], "suite.name: got ml11"),
        (["em", "--seeds", "0", "0"], "--seeds: got 0 0; wanted each once"),
        (["em", "--seeds", "-1"], "--seeds.0: got -1"),
        (["--resume", "nope"], "--resume: got 'nope'"),
        (["em", "--resume", "nope"], "--resume: got SWEEP"),
        (["em", "--name", "a/b"], "--name: got 'a/b'"),
    ],
)
@pytest.mark.usefixtures("workplace")
def test_mistakes_are_told(complaint, arguments: list[str], told: str) -> None:
    assert told in complaint(tune_sweep.run, *arguments)
    assert not Path("runs").exists()


@pytest.mark.usefixtures("workplace")
def test_a_mistake_in_a_file_is_told_with_its_place(complaint) -> None:
    file = write_sweep({"one": {"method": {"sub_skill": 3}}})
    assert "variants.one: got the unknown key method.sub_skill" in complaint(tune_sweep.run, file)
    Path(file).write_text("what: [")
    assert "small.yaml" in complaint(tune_sweep.run, file)
    file = write_sweep({})
    assert f"{file}: " in complaint(tune_sweep.run, file)


def test_help_lists_the_sweeps(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tune_sweep.run(["--help"])
    printed = capsys.readouterr().out
    for name in (*ROWS, "search"):
        assert f"  {name} " in printed
    assert "(Table 4)" in printed
