"""Evaluation on its own: the rows that the run itself found, other shots by flag, and damage reported by file."""

import json
import os
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mlflow import MlflowClient

from services import evaluate
from services.demonstrations.store import DemoStore
from services.evaluation.results import EpisodeResult, read_rows


def made() -> Path:
    """Return the folder of the one evaluation that was made beside the run."""
    (folder,) = Path("runs/run/evaluations").iterdir()
    return folder


@pytest.fixture
def trained(copied_run: Callable[[int], Path]) -> Path:
    return copied_run(3)


def test_it_finds_what_the_run_itself_found(programs, trained: Path):
    code, printed = programs("evaluate", "run", "--output", "again", "--runner", "local")
    assert code == 0, printed
    for name in ("episodes.jsonl", "adaptations.jsonl"):
        assert Path("again", name).read_bytes() == (trained / name).read_bytes()
    again, before = (json.loads(Path(folder, "summary.json").read_text()) for folder in ("again", "runs/run"))
    for key in ("rows", "sub_skills", "checkpoint_digest", "protocol", "seed"):
        assert again[key] == before[key]
    assert Path("again/report/table.md").read_text() == (trained / "report" / "table.md").read_text()
    page = Path("again/report/report.html").read_text()
    assert "evaluation again: dmil on ml10" in page
    assert "Success of each task" in page
    (run_id,) = re.findall(r"MLflow run: (\w+) at", printed)
    run = MlflowClient(os.environ["MLFLOW_TRACKING_URI"]).get_run(run_id)
    assert run.data.tags["evaluation_of"] == "runs/run/checkpoints/iteration-0000003"
    assert run.data.metrics["success_rate/meta-testing/1-shot"] == again["rows"][1]["success_rate"]


@pytest.mark.usefixtures("trained")
def test_controls_stand_beside_the_run(programs):
    names = ("no-adaptation", "other-support", "shuffled-actions", "nearest-neighbour", "tracking")
    flags = ("--evaluation.controls", *names, "--runner", "local", "--output", "again")
    code, printed = programs("evaluate", "--checkpoint", "runs/run", *flags)
    assert code == 0, printed
    run = read_rows(Path("again/episodes.jsonl"), EpisodeResult)
    summary = json.loads(Path("again/summary.json").read_text())
    assert [row["control"] for row in summary["controls"]] == list(names)
    for row in summary["controls"]:
        rows = read_rows(Path("again/controls", row["control"], "episodes.jsonl"), EpisodeResult)
        new = [one for one in run if one.split == "meta-testing"]
        assert [(one.task, one.episode, one.seed) for one in rows] == [(one.task, one.episode, one.seed) for one in new]
        assert row["episodes"] == len(rows) > 0
        assert row["success_rate"] == np.mean([one.success for one in rows])
        assert row["difference"] == pytest.approx(np.mean([one.success for one in new]) - row["success_rate"])
        assert row["low"] <= row["difference"] <= row["high"]
    assert "1-shot on new tasks: fine-tuning adds " in printed.replace("\n", " ")
    assert "the best control, " in Path("again/report/table.md").read_text()


@pytest.mark.thorough
@pytest.mark.usefixtures("trained")
def test_settings_of_the_evaluation_may_differ():
    flags = ["--evaluation.shots", "2", "4", "--evaluation.episodes", "2", "--evaluation.fine-tuning-steps", "3"]
    evaluate.run(["--checkpoint", "runs/run/checkpoints/iteration-0000003", "--runner", "local", *flags])
    rows = [json.loads(line) for line in (made() / "episodes.jsonl").read_text().splitlines()]
    assert Counter((row["shots"], len(row["support"])) for row in rows) == {(2, 2): 8, (4, 4): 8}
    assert {row["fine_tuning_steps"] for row in rows} == {3}


@pytest.mark.usefixtures("trained")
def test_other_tasks_are_meta_testing_tasks(store: DemoStore):
    evaluate.run(["run", "--runner", "local", "--tasks", "push-around-wall"])
    rows = read_rows(made() / "episodes.jsonl", EpisodeResult)
    assert {(row.suite, row.split, row.task, row.shots) for row in rows} == {
        ("ml10-part", "meta-testing", "push-around-wall", 1)
    }
    (folder,) = store.root.glob("metaworld/push-around-wall/*")
    assert (folder / "SHA256SUMS").is_file(), "its demonstrations are collected for it"


@pytest.mark.usefixtures("trained", "plain_pages")
def test_support_sets_are_drawn_from_demonstrations_of_ones_own_and_no_evaluation_is_overwritten(data):
    own = data["door-close"].demonstrations[:3]
    observations, actions = (
        np.concatenate([getattr(one, name) for one in own]) for name in ("observations", "actions")
    )
    np.savez("mine.npz", observations=observations, actions=actions, episode_lengths=[len(one) for one in own])
    for task in ("reach", "door-close"):  # one is a meta-training task of the run
        evaluate.run(["run", "--runner", "local", "--demos", f"npz:{task}=mine.npz", "--evaluation.shots", "2"])
    one, other = sorted(Path("runs/run/evaluations").iterdir())
    assert one != other
    for folder, task in ((one, "reach"), (other, "door-close")):
        rows = read_rows(folder / "episodes.jsonl", EpisodeResult)
        assert {(row.split, row.task, row.support) for row in rows} == {("meta-testing", task, ("000", "001"))}
        again = json.loads((folder / "evaluation.json").read_text())
        assert again["demonstrations"]["source"] == f"npz:{task}=mine.npz"


@pytest.mark.usefixtures("trained")
def test_a_folder_that_is_there_is_refused_and_nothing_is_left(complaint):
    Path("there").mkdir()
    assert "--output: got there, which is there already" in complaint(evaluate.run, "run", "--output", "there")
    assert "got nothing" in complaint(evaluate.run, "run", "--demos", "minari:reach=none")
    assert not list(Path("there").iterdir())
    assert not Path("runs/run/evaluations").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--checkpoint", "nowhere"), ("--checkpoint: got 'nowhere'", "a run in runs")),
        (("rum",), ("--checkpoint: got 'rum'", "the nearest are run")),
        (("--checkpoint", "runs/run"), ("iteration-0000003/parameters.safetensors", "got 0 bytes")),
        (("--checkpoint", "runs/run", "--evaluation.shots", "5"), ("held_out", "got 4", "wanted at least 5")),
        (
            ("--checkpoint", "runs/run", "--evaluation.episodes", "0"),
            ("error: --evaluation.episodes: got 0; input should be greater than or equal to 1",),
        ),
        (("--checkpoint", "runs/run", "--tasks", "fly"), ("suite.test_tasks", "got fly", "reach")),
        (
            ("--checkpoint", "runs/run", "--runner", "local", "--device", "cuda:99"),
            ("device: got cuda:99", "wanted cpu"),
        ),
        ((), ("--checkpoint",)),
    ],
    ids=[
        "missing",
        "a typo",
        "damaged",
        "more shots than held out",
        "no episode",
        "unknown task",
        "no GPU",
        "not given",
    ],
)
def test_a_mistake_is_answered_with_what_is_allowed(complaint, trained: Path, arguments, words):
    if "parameters.safetensors" in words[0]:
        (trained / "checkpoints" / "iteration-0000003" / "parameters.safetensors").write_bytes(b"")
    printed = complaint(evaluate.run, *arguments)
    assert all(word in printed for word in words), printed
