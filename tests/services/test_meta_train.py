"""The main program from end to end: what it leaves behind, and that stopping and going on changes no bit."""

import hashlib
import json
import os
import signal
from collections import Counter
from pathlib import Path

import minari
import numpy as np
import psutil
import pytest
from mlflow import MlflowClient

from dmil_core import files
from dmil_core.checkpoint import Checkpoint
from dmil_core.errors import UserError
from services import meta_train
from services.evaluation.results import EpisodeResult
from services.storage.checkpoints import Checkpoints
from services.tracking.models import models_of
from services.tracking.spool import read_spool
from tests.services.programs import shared_memory_of

LOSSES = {"high_loss_before", "high_loss_after", "low_loss_before", "low_loss_after", "continuity_loss"}


def same(one: Checkpoint, other: Checkpoint) -> bool:
    """Tell whether two checkpoints hold the same bits."""
    return one.state.iteration == other.state.iteration and all(map(np.array_equal, one.state[1:], other.state[1:]))


def rows(folder: Path) -> list[EpisodeResult]:
    return [EpisodeResult.model_validate_json(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]


def test_a_run_from_end_to_end(programs, workplace: Path, data, mlflow_file: str):
    code, printed = programs("meta_train", "--preset", "ml10-smoke", "--runner", "local", "--name", "whole")
    assert code == 0, printed
    folder = workplace / "runs" / "whole"

    summary = json.loads((folder / "summary.json").read_text())
    assert {"collect", "train", "evaluate", "total"} <= set(summary["seconds"])
    assert [(row["split"], row["shots"], row["episodes"]) for row in summary["rows"]] == [
        ("meta-training", 1, 6),
        ("meta-training", 3, 6),
        ("meta-testing", 1, 2),
        ("meta-testing", 3, 2),
    ]
    for row in summary["rows"]:
        assert row["low"] <= row["success_rate"] <= row["high"]
        assert np.isclose(np.mean(list(row["per_task"].values())), row["success_rate"])
    assert set(summary["sub_skills"]) == {"meta-training", "meta-testing"}
    for use in summary["sub_skills"].values():
        assert np.isclose(sum(use["share"]), 1)
        assert 0 <= use["agreement"] <= 1

    for row in summary["rows"]:
        successes = f"{round(row['success_rate'] * row['episodes'])}/{row['episodes']}"
        assert any(row["split"] in line and successes in line for line in printed.splitlines())
    for place in ("checkpoint: runs/whole/checkpoints/iteration-0000020", "report: runs/whole/report/report.html"):
        assert place in printed
    assert f"MLflow run: {summary['mlflow_run_id']} at {mlflow_file}" in printed
    assert f"to look at it: MLFLOW_TRACKING_URI={mlflow_file} dmil tracking ui" in printed
    assert "its page: http://127.0.0.1:5000/#/experiments/" in printed
    assert "meta-training 20/20" in printed
    page = (folder / "report" / "report.html").read_text()
    assert all(
        f">{title}</h2>" in page for title in ("Success of each task", "Training curves", "Settings", "Episodes")
    )
    assert "drawer-close" in (folder / "report" / "table.md").read_text()

    checkpoint = Checkpoint(folder / "checkpoints" / "iteration-0000020")
    assert checkpoint.digest == summary["checkpoint_digest"]
    assert checkpoint.manifest.mlflow_run_id == summary["mlflow_run_id"]
    assert checkpoint.manifest.data == {task: dataset.digest for task, dataset in data.items()}

    episodes = rows(folder)
    assert Counter(row.checkpoint for row in episodes) == {checkpoint.digest: 16}
    held_out = {f"{index:03d}" for index in range(8, 12)}
    for row in episodes:
        assert set(row.support) <= held_out
        assert len(row.support) == row.shots

    client = MlflowClient(mlflow_file)
    run = client.get_run(summary["mlflow_run_id"])
    assert run.info.status == "FINISHED"
    assert run.data.params["method.sub_skills"] == "3"
    assert run.data.params["suite.test_tasks"] == "['door-close']"
    assert set(run.data.params) >= {"seed", "training.iterations", "demonstrations.noise", "evaluation.shots"}
    assert {"git_commit", "version.torch", "version.ray", "version.mujoco"} <= set(run.data.tags)
    assert run.inputs is not None
    inputs = {entry.dataset.name: entry.dataset.digest for entry in run.inputs.dataset_inputs}
    assert inputs == {dataset.id: dataset.digest[:32] for dataset in data.values()}
    shares = {f"sub_skill_share/{index}" for index in range(3)}
    for name in LOSSES | shares | {"sub_skill_entropy", "gradient_norm", "iterations_per_second"}:
        assert [point.step for point in client.get_metric_history(run.info.run_id, name)] == list(range(1, 21)), name
    for row in summary["rows"]:
        name = f"{row['split']}/{row['shots']}-shot"
        assert run.data.metrics[f"success_rate/{name}"] == row["success_rate"]
        assert run.data.metrics[f"success_rate_low/{name}"] == row["low"]
        assert run.data.metrics[f"episodes/{name}"] == row["episodes"]
        for task, rate in row["per_task"].items():
            assert run.data.metrics[f"task_success_rate/{name}/{task}"] == rate
    artifacts = {entry.path for path in (None, "report") for entry in client.list_artifacts(run.info.run_id, path)}
    assert artifacts >= {"summary.json", "episodes.jsonl", "report/table.md", "report/report.html"}
    (model,) = models_of(client, run)
    assert model.tags["checkpoint"] == summary["checkpoint_digest"]


def test_episodes_start_from_goals_that_no_demonstration_holds(workplace: Path, train, store, data, monkeypatch):
    train("run", "--training.iterations", "0", "--evaluation.episodes", "4", "--evaluation.shots", "1")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(store.root))
    episodes = rows(workplace / "runs" / "run")
    for task, dataset in data.items():
        kept = minari.load_dataset(dataset.id).storage.get_episode_metadata(range(12))
        demonstrated = {tuple(episode["options"]["goal"]) for episode in kept}
        evaluated = {row.goal for row in episodes if row.task == task}
        assert len(demonstrated) == 12
        assert len(evaluated) == 4
        assert demonstrated.isdisjoint(evaluated)


def test_going_on_ends_with_the_same_bits(workplace: Path, train, mlflow_file: str):
    seeing = ("--method.features", "relative", "--method.context", "path")
    undisturbed = train("whole", *seeing, "--training.iterations", "7")
    half = train("parts", *seeing, "--training.iterations", "4")
    resumed = train("parts", "--training.iterations", "7", resume=True)
    assert half.manifest.iteration == 4
    assert same(resumed, undisturbed)
    assert resumed.manifest.mlflow_run_id == half.manifest.mlflow_run_id != undisturbed.manifest.mlflow_run_id
    client = MlflowClient(mlflow_file)
    history = client.get_metric_history(str(half.manifest.mlflow_run_id), "gradient_norm")
    assert [point.step for point in history] == list(range(1, 8))
    assert client.get_run(str(half.manifest.mlflow_run_id)).info.status == "FINISHED"
    episodes = [(workplace / "runs" / name / "episodes.jsonl").read_bytes() for name in ("whole", "parts")]
    assert episodes[0] == episodes[1], "also the checkpoint's digest"


@pytest.mark.thorough
def test_a_run_that_was_stopped_before_its_first_checkpoint_begins_anew(workplace: Path, train):
    undisturbed = train("whole", "--training.iterations", "3")
    train("other", "--training.iterations", "3")
    for path in Checkpoints(workplace / "runs" / "other" / "checkpoints", 3).all():
        path.rename(path.with_name(".writing-1"))
    assert same(train("other", resume=True), undisturbed)


@pytest.mark.parametrize(
    ("flag", "key"),
    [
        (("--method.sub-skills", "4"), "method.sub_skills"),
        (("--seed", "1"), "seed"),
        (("--training.learning-rate", "0.5"), "training.learning_rate"),
        (("--demonstrations.held-out", "5"), "demonstrations.held_out"),
    ],
)
def test_going_on_with_other_settings_is_refused(copied_run, train, flag: tuple[str, str], key: str):
    copied_run(0)
    with pytest.raises(UserError, match=f"--resume: got other settings of {key} than the run began with"):
        train("run", *flag, resume=True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--resume", "nowhere"), ("--resume: got 'nowhere'", "in runs")),
        (("--resume", "run", "--name", "other"), ("--name: got other with --resume",)),
        (("--preset", "ml10-smoke", "--name", "run"), ("--name: got runs/run", "--resume runs/run")),
        (("--runner", "local", "--device", "cuda:99"), ("device: got cuda:99; wanted cpu or auto", "sees ")),
        (("--device", "cuda:99"), ("--device: got cuda:99 with Ray", "wanted cuda")),
        (("--gpus", "2"), ("--gpus: got 2.0; wanted above 0 and at most 1",)),
        (("--method", "mil", "--path", "batched"), ("--path: got batched for mil", "wanted loop or auto")),
    ],
    ids=[
        "no such run",
        "another name",
        "a name that is taken",
        "no such GPU",
        "a GPU by number",
        "two GPUs",
        "no such path",
    ],
)
def test_a_run_that_cannot_be_is_refused(copied_run, complaint, arguments, words):
    copied_run(0)
    printed = complaint(meta_train.run, *arguments)
    assert all(word in printed for word in words), printed
    assert [path.name for path in Path("runs").iterdir()] == ["run"]


def descendants(session: str) -> list[psutil.Process]:
    """Return every process that a program started, also those whose parent is gone."""
    found = []
    for process in psutil.process_iter():
        try:
            mine = process.environ().get("DMIL_TEST_SESSION") == session
            if mine and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except psutil.Error:
            continue
    return found


@pytest.mark.parametrize(
    ("runner", "number", "wanted"),
    [
        ("local", signal.SIGINT, 130),
        pytest.param("ray", signal.SIGINT, 130, marks=pytest.mark.thorough),
    ],
)
def test_a_stopped_run_goes_on_with_the_same_bits(
    programs, train, wait_for, mlflow_file, workplace: Path, monkeypatch, runner: str, number: int, wanted: int
):
    session = f"{runner}-{wanted}-{os.getpid()}"
    monkeypatch.setenv("DMIL_TEST_SESSION", session)
    arguments = ["--preset", "ml10-smoke", "--runner", runner, "--name", "run", "--training.checkpoint-every", "5"]
    if runner == "ray":
        arguments += ["--workers", "1", "--evaluation.every", "5"]  # one is under way then, and dropped
    program = programs.start("meta_train", *arguments, "--training.iterations", "100000")
    checkpoints = Checkpoints(workplace / "runs" / "run" / "checkpoints", 3)
    wait_for(lambda: bool(checkpoints.all()) or program.poll() is not None, "the first checkpoint")
    shared = shared_memory_of(descendants(session))
    (os.killpg if number == signal.SIGINT else os.kill)(program.pid, number)
    printed, _ = program.communicate()
    assert program.returncode == wanted, printed
    assert "stopped; to go on: dmil meta-train --resume runs/run" in printed
    assert "Traceback" not in printed
    monkeypatch.delenv("DMIL_TEST_SESSION")
    wait_for(lambda: not descendants(session), f"the end of {descendants(session)}")
    assert shared or runner == "local"
    assert not [path for path in shared if path.exists()]

    stopped = checkpoints.newest()
    mlflow_run = json.loads((workplace / "runs" / "run" / "mlflow_run.json").read_text())["run_id"]
    assert MlflowClient(mlflow_file).get_run(mlflow_run).info.status == "KILLED"
    until = str(stopped.manifest.iteration + 3)
    resumed = train("run", "--training.iterations", until, resume=True)
    undisturbed = train("undisturbed", "--training.iterations", until)
    assert same(resumed, undisturbed)
    assert resumed.manifest.mlflow_run_id == mlflow_run


def test_other_demonstrations_than_it_was_trained_on_are_refused(complaint, copied_run):
    manifest = copied_run(0) / "checkpoints" / "iteration-0000000" / "manifest.json"
    was = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(was | {"data": was["data"] | {"push": "0" * 64}}))
    digest = hashlib.sha256(manifest.read_bytes()).hexdigest()
    manifest.with_name("manifest.sha256").write_text(f"{digest}  manifest.json\n")
    printed = complaint(meta_train.run, "--resume", "run", "--training.iterations", "2", "--runner", "local")
    assert "trained on other demonstrations of push" in printed
    assert "DMIL_DATA" in printed


@pytest.mark.usefixtures("workplace")
@pytest.mark.parametrize("name", ["..", ".", "../run", "a/b", "/tmp/run", "run/"])
def test_a_run_stays_inside_the_folder_of_runs(complaint, name: str):
    printed = complaint(meta_train.run, "--preset", "ml10-smoke", "--name", name)
    assert f"--name: got '{name}'; wanted the name of a folder in runs" in printed
    assert not Path("runs").exists()


def test_a_link_out_of_the_folder_of_runs_is_not_followed(complaint, copied_run):
    copied_run(0)
    Path("runs/run").rename("elsewhere")
    Path("runs/run").symlink_to("../elsewhere")
    before = sorted(Path("elsewhere").rglob("*"))
    for arguments in (("--resume", "run"), ("--resume", "runs/run"), ("--preset", "ml10-smoke", "--name", "run")):
        assert "got runs/run, a link out of runs" in complaint(meta_train.run, *arguments)
    assert sorted(Path("elsewhere").rglob("*")) == before


def test_a_run_has_one_process_at_a_time_and_goes_on_when_that_is_killed(
    programs, train, complaint, workplace: Path, wait_for
):
    train("run", "--training.iterations", "1")
    endless = ("--runner", "local", "--training.iterations", "100000", "--training.checkpoint-every", "5")
    first = programs.start("meta_train", "--resume", "run", *endless)
    folder = workplace / "runs" / "run"
    checkpoints = Checkpoints(folder / "checkpoints", 3)
    wait_for(lambda: len(checkpoints.all()) > 1 or first.poll() is not None, "a checkpoint")
    assert f"got process {first.pid} of " in complaint(meta_train.run, "--resume", "run", "--runner", "local")
    os.kill(first.pid, signal.SIGKILL)
    first.communicate()
    reached = checkpoints.newest().manifest.iteration
    assert train("run", "--training.iterations", str(reached + 1), resume=True).manifest.iteration == reached + 1
    measured = [line.value for line in read_spool(folder / "tracking.jsonl") if line.kind == "metrics"]
    steps = [metrics.step for metrics in measured if "gradient_norm" in metrics.values]
    assert steps == sorted(set(steps)), "none twice"


def test_a_stop_amid_a_checkpoint_leaves_that_checkpoint(train, workplace: Path, monkeypatch):
    checkpoints = Checkpoints(workplace / "runs" / "run" / "checkpoints", 3)
    sync, stops = files.sync, iter([KeyboardInterrupt])

    def stopped_once(path: Path) -> None:
        for stop in stops if checkpoints.all() else ():
            raise stop
        sync(path)

    monkeypatch.setattr(files, "sync", stopped_once)
    with pytest.raises(KeyboardInterrupt):
        train("run", "--training.iterations", "8", "--training.checkpoint-every", "2")
    assert [path.name for path in checkpoints.all()] == ["iteration-0000002", "iteration-0000004"]


def test_nothing_is_written_through_links_in_a_run_s_folder(copied_run, train, complaint, workplace: Path):
    folder = copied_run(0)
    victim = workplace / "victim"
    victim.mkdir()
    for name in ("summary.json", "report/table.md", "report/report.html"):
        (folder / name).unlink(missing_ok=True)
        (victim / Path(name).name).write_text("precious")
        (folder / name).symlink_to(victim / Path(name).name)
    (folder / "episodes.jsonl").unlink()
    (folder / "episodes.jsonl").symlink_to(victim / "new")
    (folder / "checkpoints" / ".writing-1").symlink_to(victim)
    train("run", "--training.iterations", "1", resume=True)
    assert not (folder / "episodes.jsonl").is_symlink(), "replaced"
    assert {path.read_text() for path in victim.iterdir()} == {"precious"}
    assert len(list(victim.iterdir())) == 3
    (folder / "tracking.jsonl").rename(victim / "tracking.jsonl")
    before = (victim / "tracking.jsonl").read_bytes()
    (folder / "tracking.jsonl").symlink_to(victim / "tracking.jsonl")
    assert "runs/run/tracking.jsonl: got a link" in complaint(meta_train.run, "--resume", "run", "--runner", "local")
    (folder / "tracking.jsonl").unlink()
    os.mkfifo(folder / "tracking.jsonl")
    assert "tracking.jsonl: got no regular file" in complaint(meta_train.run, "--resume", "run", "--runner", "local")
    (folder / "config.json").unlink()
    os.mkfifo(folder / "config.json")
    assert "config.json" in complaint(meta_train.run, "--resume", "run", "--runner", "local")
    assert (victim / "tracking.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "settings: got "),
        ("{}x", "settings: got "),
        ('{"seed": -1}', "seed: got -1"),
        ("[" * 9**5, "settings: got "),
    ],
    ids=["empty", "no JSON", "impossible", "deep"],
)
def test_a_damaged_config_of_a_run_is_named(complaint, copied_run, text: str, words: str):
    copied_run(0)
    Path("runs/run/config.json").write_text(text)
    printed = complaint(meta_train.run, "--resume", "run")
    assert "runs/run/config.json: " + words in printed
    assert len(printed) < 500


@pytest.mark.thorough
def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_it_used(train, capsys):
    undisturbed = train("whole", "--training.iterations", "7")
    newest = train("parts", "--training.iterations", "4", "--training.checkpoint-every", "2").path
    damaged = newest / "parameters.safetensors"
    damaged.write_bytes(damaged.read_bytes()[:-1])
    capsys.readouterr()
    resumed = train("parts", "--training.iterations", "7", resume=True)
    (warning,) = [line for line in capsys.readouterr().out.splitlines() if damaged.name in line]
    assert warning.startswith("warning: runs/parts/checkpoints/iteration-0000004/parameters.safetensors: got ")
    assert warning.endswith("taking runs/parts/checkpoints/iteration-0000002 instead")
    assert same(resumed, undisturbed)
