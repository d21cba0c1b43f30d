"""Two copies of one truth: a damaged one is taken from the other, and what contradicts is told with file and key."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest

from dmil_core.checkpoint import Checkpoint
from dmil_core.errors import RunError
from services import meta_train, reproduce
from services.cli.arguments import exit_code
from services.experiments.finished_run import FinishedRun
from services.local_cluster import Started
from services.reporting.comparison import compare_runs
from services.storage.checkpoints import Checkpoints
from services.storage.remote import STORAGE, Storage
from services.storage.replication import Replica, restored
from tests.faults.conftest import TOY


def damage(checkpoint: Path) -> None:
    """Change a byte, and no size."""
    path = checkpoint / "parameters.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


def newest(folder: Path) -> Checkpoint:
    return Checkpoints(folder / "checkpoints", 3).newest()


@pytest.fixture
def copied(train: Callable[..., Path], workplace: Path, monkeypatch) -> tuple[Path, Path]:
    """A run of two checkpoints, and its copy in a storage."""
    folder, store = train("run"), workplace / "storage"
    Replica(folder, Storage(store.as_uri())).copy()
    monkeypatch.setenv(STORAGE, store.as_uri())
    return folder, store / "runs" / "run"


def test_a_checkpoint_that_is_damaged_here_is_fetched(copied: tuple[Path, Path]):
    here, _ = copied
    before = newest(here)
    damage(before.path)
    assert restored(here)
    assert newest(here).digest == before.digest
    assert not restored(here), "all is here"


def test_older_checkpoints_are_fetched_too_and_stay_there(copied: tuple[Path, Path]):
    here, there = copied
    before = {path.name: Checkpoint(path).digest for path in (here / "checkpoints").iterdir()}
    shutil.rmtree(here)
    assert restored(here)
    Replica(here, Storage(there.parents[1].as_uri())).copy()
    for folder in copied:
        assert {path.name: Checkpoint(path).digest for path in (folder / "checkpoints").iterdir()} == before
    assert len(before) == 2


def test_what_was_evaluated_on_the_way_is_fetched_too(train: Callable[..., Path], workplace: Path, monkeypatch):
    store = workplace / "storage"
    monkeypatch.setenv(STORAGE, store.as_uri())
    folder = train("run", "--evaluation.every", "2", "--training.checkpoints-kept", "1")
    rows = {path.relative_to(folder): path.read_bytes() for path in folder.glob("evaluations/*/*.jsonl")}
    assert len(rows) >= 2, "the first checkpoint is gone, so nothing can be evaluated there again"
    (store / "runs" / "run" / "evaluations" / ".DS_Store").write_text("not ours")
    shutil.rmtree(folder)
    assert restored(folder)
    assert {path.relative_to(folder): path.read_bytes() for path in folder.glob("evaluations/*/*.jsonl")} == rows


def test_what_is_damaged_there_is_not_taken_and_not_kept(copied: tuple[Path, Path], logged):
    here, there = copied
    whole = newest(here)
    shutil.rmtree(here)
    damage(there / "checkpoints" / whole.path.name)
    assert restored(here)
    assert newest(here).path.name == "iteration-0000002"
    assert any("iteration-0000004: not taken" in line for line in logged())
    damage(there / "checkpoints" / whole.path.name)  # which mends it
    assert restored(here)
    assert newest(here).digest == whole.digest


def test_a_copy_without_a_whole_checkpoint_is_none(copied: tuple[Path, Path]):
    here, there = copied
    shutil.rmtree(here)
    for path in (there / "checkpoints").iterdir():
        damage(path)
    with pytest.raises(RunError, match="no whole checkpoint"):
        restored(here)
    assert not (here / "config.json").exists(), "or the run would begin anew without a word"


@pytest.mark.parametrize("url", ["file:///dev/null/x", "s3://bucket/x"])
def test_a_storage_that_is_away_stops_no_run_that_is_here(train, monkeypatch, logged, url: str):
    folder = train("run")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "hunter2")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setenv(STORAGE, url)
    assert not restored(folder)
    (line,) = [line for line in logged() if "does not give" in line]
    assert "going on with what is here" in line
    assert "hunter2" not in line
    with pytest.raises(RunError, match="wanted the run; try again"):
        restored(folder.with_name("elsewhere"))


def test_a_kind_of_storage_that_cannot_be_opened_is_a_mistake(train, monkeypatch, complaint):
    train("run")
    monkeypatch.setenv(STORAGE, "ftp://user:hunter2@127.0.0.1:1/x")
    printed = complaint(meta_train.run, "--resume", "run", "--runner", "local")
    assert "DMIL_STORAGE: got ftp://...@127.0.0.1:1/x" in printed
    assert "hunter2" not in printed


def test_every_reader_passes_damaged_checkpoints_over(train, logged):
    folder = train("run", "--evaluation.every", "2")
    shutil.rmtree(folder / "evaluations")
    damage(folder / "checkpoints" / "iteration-0000002")
    damage(newest(folder).path)
    for path in (folder / "checkpoints").glob("*4"):
        shutil.rmtree(path)
    shutil.copytree(folder / "checkpoints" / "iteration-0000002", folder / "checkpoints" / "iteration-0000001")
    for _ in range(2):
        code = exit_code(meta_train.run, ["--resume", "run", "--runner", "local"])
        assert code == 2, "none of them is whole"
    shutil.rmtree(folder / "checkpoints")
    train("run", resume=True)
    damage(folder / "checkpoints" / "iteration-0000002")
    shutil.rmtree(folder / "evaluations")
    train("run", "--training.iterations", "5", resume=True)
    assert any("iteration-0000002/parameters.safetensors: got" in line and "not evaluated" in line for line in logged())
    assert newest(folder).manifest.iteration == 5


def test_names_that_are_not_ours_are_passed_over_and_numbers_are_in_order(train):
    folder = train("run")
    checkpoints = folder / "checkpoints"
    shutil.copytree(checkpoints / "iteration-0000004", checkpoints / "iteration-0000004.bak")
    shutil.copytree(checkpoints / "iteration-0000004", checkpoints / "iteration-0000004 copy")
    (checkpoints / ".DS_Store").write_bytes(b"\0")
    (checkpoints / "iteration-note").write_text("keep")
    (folder / "evaluations").mkdir(exist_ok=True)
    (folder / "evaluations" / ".DS_Store").write_bytes(b"\0")
    before = {path.name for path in checkpoints.iterdir()}
    train("run", "--training.iterations", "6", resume=True)
    assert {path.name for path in checkpoints.iterdir()} == before | {"iteration-0000006"}
    (checkpoints / "iteration-0000006").rename(checkpoints / "iteration-10000000")
    assert [path.name for path in Checkpoints(checkpoints, 3).all()][-2:] == ["iteration-0000004", "iteration-10000000"]


@pytest.mark.parametrize(
    ("section", "key", "value", "words"),
    [("training", "learning_rate", 0.5, "training.learning_rate 0.001, not 0.5"), (None, "seed", 7, "seed 0, not 7")],
)
def test_an_edited_config_is_told_with_file_and_key(train, complaint, section, key, value, words):
    path = train("run") / "config.json"
    config = json.loads(path.read_text())
    (config if section is None else config[section])[key] = value
    path.write_text(json.dumps(config))
    before = {file: file.read_bytes() for file in path.parent.rglob("*") if file.is_file() and file.name != ".lock"}
    printed = complaint(meta_train.run, "--resume", "run", "--runner", "local", "--training.iterations", "6")
    assert (
        "runs/run/config.json: got other settings than runs/run/checkpoints/iteration-0000004/manifest.json" in printed
    )
    assert words in printed
    assert all(file.read_bytes() == content for file, content in before.items())


def test_another_run_s_checkpoint_and_rows_are_told(train, complaint):
    one, other = train("one"), train("other", "--seed", "9", "--training.iterations", "6")
    shutil.copy(other / "episodes.jsonl", one / "episodes.jsonl")
    with pytest.raises(ValueError, match=r"one/episodes\.jsonl: checkpoint: got rows of .*summary\.json says"):
        _ = FinishedRun(one).episodes
    with pytest.raises(ValueError, match=r"one/episodes\.jsonl: checkpoint: got rows of"):
        _ = compare_runs([FinishedRun(other), FinishedRun(one)]).cells
    assert FinishedRun(one).adaptations
    shutil.copytree(other / "checkpoints" / "iteration-0000006", one / "checkpoints" / "iteration-0000006")
    printed = complaint(meta_train.run, "--resume", "one", "--runner", "local", "--training.iterations", "8")
    assert "seed 9, not 0" in printed
    assert "iteration-0000006/manifest.json" in printed


def test_fewer_iterations_than_are_done_are_refused(train, complaint):
    folder = train("run")
    before = (folder / "config.json").read_bytes()
    printed = complaint(meta_train.run, "--resume", "run", "--runner", "local", "--training.iterations", "3")
    assert "--training.iterations: got 3; wanted at least the 4 that are done" in printed
    assert (folder / "config.json").read_bytes() == before


def test_a_failure_is_not_reproduced_with_other_data(workplace: Path, monkeypatch, complaint):
    def write(scale: float) -> None:
        draw = np.random.default_rng(0)
        actions = scale * draw.uniform(-1, 1, (240, 2)).astype(np.float32)
        observations = draw.normal(size=(240, 4)).astype(np.float32)
        np.savez("a.npz", observations=observations, actions=actions, episode_lengths=np.full(12, 20))

    from dmil_core.methods.dmil.method import Dmil

    def failing(*arguments: object) -> None:
        raise ArithmeticError("bad demonstration")

    write(1.0)
    with monkeypatch.context() as patch:
        patch.setattr(Dmil, "task_gradient", failing)
        assert exit_code(meta_train.run, [*TOY, "--name", "run", "--demos", "npz:a=a.npz"]) == 1
    write(0.5)
    assert "trained on other demonstrations of a" in complaint(reproduce.run, "runs/run/failure.json")


def test_a_process_is_known_by_more_than_the_wall_clock():
    pid = psutil.Process().pid
    started = Started.of("this", pid)
    assert started.model_copy(update={"began": started.began + 3600}).process() is not None, "the clock was set"
    assert started.model_copy(update={"ticks": f"{started.ticks} other"}).process() is None
    assert started.model_copy(update={"ticks": None}).process() is not None, "a record of an older version"
