"""Evaluation on its own: the rows that the run itself found, other shots by flag, and damage reported by file."""

import json
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from services import evaluate
from services.demonstrations.store import DemoStore
from services.evaluation.results import EpisodeResult, read_rows
from services.storage.folder_lock import held


@pytest.fixture
def trained(copied_run: Callable[[int], Path]) -> Path:
    return copied_run(3)


def test_it_finds_what_the_run_itself_found(programs, trained: Path):
    code, printed = programs("evaluate", "--checkpoint", "runs/run", "--output", "again", "--runner", "local")
    assert code == 0, printed
    for name in ("episodes.jsonl", "adaptations.jsonl"):
        assert Path("again", name).read_bytes() == (trained / name).read_bytes()
    again, before = (json.loads(Path(folder, "summary.json").read_text()) for folder in ("again", "runs/run"))
    for key in ("rows", "sub_skills", "checkpoint_digest", "protocol", "seed"):
        assert again[key] == before[key]
    assert Path("again/report/table.md").read_text() == (trained / "report" / "table.md").read_text()


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
    rows = [json.loads(line) for line in Path("evaluation/episodes.jsonl").read_text().splitlines()]
    assert Counter((row["shots"], len(row["support"])) for row in rows) == {(2, 2): 8, (4, 4): 8}
    assert {row["fine_tuning_steps"] for row in rows} == {3}


@pytest.mark.usefixtures("trained")
def test_other_tasks_are_meta_testing_tasks(store: DemoStore):
    evaluate.run(["--checkpoint", "runs/run", "--runner", "local", "--tasks", "push-around-wall"])
    rows = read_rows(Path("evaluation/episodes.jsonl"), EpisodeResult)
    assert {(row.suite, row.split, row.task, row.shots) for row in rows} == {
        ("ml10-part", "meta-testing", "push-around-wall", 1)
    }
    (folder,) = store.root.glob("metaworld/push-around-wall/*")
    assert (folder / "SHA256SUMS").is_file(), "its demonstrations are collected for it"


@pytest.mark.thorough
@pytest.mark.usefixtures("trained")
def test_a_second_evaluation_replaces_the_rows_of_the_first():
    for _ in range(2):
        evaluate.run(["--checkpoint", "runs/run", "--runner", "local"])
    assert len(Path("evaluation/episodes.jsonl").read_text().splitlines()) == 4


@pytest.mark.usefixtures("trained")
def test_a_folder_that_another_evaluation_writes_to_is_refused(complaint):
    with held(Path("evaluation")):
        said = complaint(evaluate.run, "--checkpoint", "runs/run", "--runner", "local")
    assert f"evaluation: got process {os.getpid()} of" in said
    assert not Path("evaluation/episodes.jsonl").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--checkpoint", "nowhere"), ("error: nowhere/manifest.json: got ",)),
        (("--checkpoint", "runs/run"), ("iteration-0000003/parameters.safetensors", "got 0 bytes")),
        (("--checkpoint", "runs/run", "--evaluation.shots", "5"), ("held_out", "got 4", "wanted at least 5")),
        (
            ("--checkpoint", "runs/run", "--evaluation.episodes", "0"),
            ("episodes", "input_value=0", "greater than or equal to 1"),
        ),
        (("--checkpoint", "runs/run", "--tasks", "fly"), ("suite.test_tasks", "got fly", "reach")),
        ((), ("--checkpoint",)),
    ],
    ids=["missing", "damaged", "more shots than held out", "no episode", "unknown task", "not given"],
)
def test_a_mistake_is_answered_with_what_is_allowed(complaint, trained: Path, arguments, words):
    if "parameters.safetensors" in words[0]:
        (trained / "checkpoints" / "iteration-0000003" / "parameters.safetensors").write_bytes(b"")
    printed = complaint(evaluate.run, *arguments)
    assert all(word in printed for word in words), printed
