"""What else is done with demonstrations: experts verified, data sets inspected, rollouts stored and learned from."""

import json
from pathlib import Path

import numpy as np
import pytest

from dmil_core.demonstrations import DemonstrationError, digest
from dmil_core.errors import RunError
from services import collect_demos, meta_train
from services.demonstrations.store import DemoStore, TaskDemonstrations
from services.evaluation.results import EpisodeResult, read_rows


def write_npz(path: Path, parts: list[tuple[np.ndarray, np.ndarray]]) -> str:
    observations, actions = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    np.savez(path, observations=observations, actions=actions, episode_lengths=np.array([len(a) for _, a in parts]))
    return str(path)


def table(printed: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines() if "│" in line]


@pytest.fixture
def rollouts(data: dict[str, TaskDemonstrations], tmp_path: Path) -> str:
    """The demonstrations of push, as somebody else may have them."""
    push = data["push"].demonstrations
    return write_npz(tmp_path / "mine.npz", [(one.observations, one.actions) for one in push])


def test_verify_counts_successes(capsys: pytest.CaptureFixture[str]):
    collect_demos.run(
        ["verify", "--suite", "ml1-reach", "--seeds", "6", "--first-seed", "3", "--noise", "0", "--runner", "local"]
    )
    printed = capsys.readouterr().out
    assert "noise 0; seeds 3 to 8" in printed
    assert [row[:3] for row in table(printed)] == [["reach", "6/6", "1.000"], ["all", "6/6", "1.000"]]


@pytest.mark.thorough
def test_verify_shows_scores_where_there_are_any(capsys: pytest.CaptureFixture[str]):
    tasks = ["--suite", "kitchen", "--tasks", "light", "slide-light", "--runner", "local"]
    collect_demos.run(["verify", *tasks, "--seeds", "2"])
    found = [(row[0], row[1], row[4]) for row in table(capsys.readouterr().out)]
    assert found == [("light", "2/2", "1.00"), ("slide-light", "2/2", "2.00"), ("all", "4/4", "1.50")]


def test_inspect_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    draw = np.random.default_rng(0)
    good = draw.normal(size=(5, 39)).astype(np.float32), draw.uniform(-1, 1, (5, 4)).astype(np.float32)
    wide = good[0][:3], 2 * np.ones((3, 4), np.float32)
    path = write_npz(tmp_path / "a.npz", [good, wide, good])
    with pytest.raises(RunError, match="3 things are wrong with 3 episodes"):
        collect_demos.run(["inspect", path])
    printed = capsys.readouterr().out
    assert "3 episodes; numbers a step: 39 observed, 4 done" in printed
    assert "episode 1: actions of up to 2; wanted -1 to 1" in printed
    assert "episode 1: the same action at every step" in printed
    assert "episode 2: the same as episode 0" in printed
    assert "to mend it: actions = np.clip(actions, -1, 1)" in printed
    assert "episodes = [one for n, one in enumerate(episodes) if n not in [1, 2]]" in printed
    collect_demos.run(["inspect", write_npz(tmp_path / "b.npz", [good]), "--suite", "ml10"])
    assert f"nothing is wrong with it; to use it: --demos npz:{tmp_path / 'b.npz'}" in capsys.readouterr().out
    collect_demos.run(["inspect", str(tmp_path / "b.npz")])
    np.save(tmp_path / "alone.npy", good[0])
    with pytest.raises(DemonstrationError, match=r"one array of a pair; wanted minari:ID, hdf5:PATH, .*lerobot:FOLDER"):
        collect_demos.run(["inspect", str(tmp_path / "alone.npy")])
    (tmp_path / "folder").mkdir()
    np.savez(tmp_path / "folder" / "one.npz", observations=good[0], actions=good[1])
    collect_demos.run(["inspect", str(tmp_path / "folder")])
    capsys.readouterr()
    with pytest.raises(RunError):
        collect_demos.run(["inspect", str(tmp_path / "b.npz"), "--suite", "kitchen"])
    assert "wanted the 30 of a state" in capsys.readouterr().out


def test_inspect_replays_in_the_kitchen(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch):
    monkeypatch.setenv("DMIL_DATA", str(tmp_path))
    flags = (
        "--suite kitchen --suite.train-tasks light --suite.test-tasks light --runner local --demonstrations.per-task 2 "
        "--demonstrations.held-out 1 --demonstrations.noise 0"
    )
    collect_demos.run(flags.split())
    (folder,) = tmp_path.glob("kitchen/light/*")
    capsys.readouterr()
    collect_demos.run(["inspect", f"kitchen/light/{folder.name}", "--suite", "kitchen"])
    assert [row[-1] for row in table(capsys.readouterr().out)] == ["light", "light"]


def test_rollouts_become_demonstrations_that_a_run_learns_from(
    rollouts: str, store: DemoStore, data, train, workplace: Path, capsys: pytest.CaptureFixture[str]
):
    collect_demos.run(["record", "--suite", "ml10", "--task", "push", "--from", f"npz:{rollouts}"])
    flag = capsys.readouterr().out.split("--demos ")[1].split()[0]
    dataset_id = flag.partition("=")[2]
    recorded = store.load(dataset_id, "push")
    assert recorded is not None
    assert recorded.digest == data["push"].digest
    for name, demos in (("stored", flag), ("file", f"npz:push={rollouts}")):
        checkpoint = train(name, "--training.iterations", "1", "--demos", demos)
        assert checkpoint.manifest.data["push"] == digest(data["push"].demonstrations)
        assert checkpoint.manifest.config.demonstrations.source == demos
        rows = read_rows(workplace / f"runs/{name}/episodes.jsonl", EpisodeResult)
        assert {row.data for row in rows if row.task == "push"} == {data["push"].digest}
    config = json.loads((workplace / "runs/file/config.json").read_text())
    assert config["demonstrations"]["source"] == f"npz:push={rollouts}"


@pytest.mark.usefixtures("workplace")
def test_demonstrations_that_cannot_be_used_are_reported_in_words(rollouts: str, complaint, tmp_path: Path):
    draw = np.random.default_rng(0)
    parts = [(draw.normal(size=(5, 39)), draw.uniform(-1, 1, (5, 4))) for _ in range(2)]
    few = write_npz(tmp_path / "few.npz", parts)
    for name, (demos, said) in enumerate(
        (
            (f"npz:{rollouts}", "got data sets of mine; ml10-part has the tasks reach, push, drawer-close, door-close"),
            (f"npz:push={few}", "few.npz: got 2 demonstrations of push; wanted at least 5"),
            (f"npz:door-close={few}", "got 2 demonstrations of door-close; wanted at least 3"),
            ("csv:push=a.csv", "demonstrations.source: got csv:push=a.csv"),
        )
    ):
        flags = ("--preset", "ml10-smoke", "--runner", "local", "--name", str(name))
        printed = complaint(meta_train.run, *flags, "--demos", demos)
        assert said in printed, printed
    assert not Path("runs").exists(), "refused before anything is made"
    printed = complaint(collect_demos.run, "record", "--suite", "ml10", "--task", "push", "--from", rollouts)
    assert "--from: got" in printed
    printed = complaint(collect_demos.run, "inspect", str(tmp_path / "none.npz"))
    assert "none.npz" in printed
