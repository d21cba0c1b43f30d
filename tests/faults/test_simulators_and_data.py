"""What a simulator or a file gives is named when it is odd."""

import copy
import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mlflow import MlflowClient

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from dmil_core.errors import RunError, UserError
from services import collect_demos, inspect_demos, meta_train, verify_experts
from services.cli.arguments import exit_code
from services.demonstrations.external import demonstrations, read_episodes
from services.distributed.ray_runner import put_suite
from services.evaluation.results import EpisodeResult, read_rows
from services.experiments import experiment
from services.rollouts.episodes import demonstrate
from tests.faults import toy_suite
from tests.faults.conftest import TOY

NOTHING = ("--training.iterations", "0", "--evaluation.fine-tuning-steps", "0", "--evaluation.shots", "1")


def test_arrays_in_infos_are_taken(train, workplace: Path, monkeypatch):
    monkeypatch.setenv("TOY_ODDITY", "arrays")
    collect_demos.run([*TOY])
    rows = read_rows(train("run", *NOTHING) / "episodes.jsonl", EpisodeResult)
    assert all(len(row.goal) == 2 for row in rows)


@pytest.mark.parametrize(
    "program", [collect_demos.run, lambda arguments: verify_experts.run([*arguments[:2], *arguments[4:]])]
)
def test_a_missing_success_is_one_message(workplace: Path, monkeypatch, complaint, program):
    monkeypatch.setenv("TOY_ODDITY", "no success")
    assert "info of a step: got no success; wanted success or is_success, whether" in complaint(program, *TOY)


class Odd(toy_suite.PointEnv):
    """Returns what `changed` makes of what gymnasium wants, from one of its methods."""

    def __init__(self, method: str, changed: Callable[[Any], Any]) -> None:
        super().__init__(1, "")
        self._method, self._changed = method, changed

    def reset(self, **given: Any) -> Any:
        returned = super().reset(**given)
        return self._changed(returned) if self._method == "reset" else returned

    def step(self, action: np.ndarray) -> Any:
        returned = super().step(action)
        return self._changed(returned) if self._method == "step" else returned


class Seedless(toy_suite.PointEnv):
    """Is reset as environments of the older gym are."""

    def reset(self) -> Any:  # type: ignore[override]
        return super().reset()


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (Odd("reset", lambda it: it[0]), r"reset: got a ndarray; wanted gymnasium's \(observation, info\)"),
        (Odd("step", lambda it: it[1:]), r"step: got 4 values; wanted gymnasium's \(observation, reward, terminated"),
        (
            Odd("step", lambda it: (it[0][None], *it[1:])),
            r"step: got an observation of the shape \(1, 4\); wanted \(4,\)",
        ),
        (
            Odd("reset", lambda it: ({"at": it[0]}, it[1])),
            r"reset: got an observation of the shape \(\); wanted \(4,\)",
        ),
        (Seedless(1, ""), r"reset: got .*'seed'; wanted gymnasium's reset\(\*, seed=None, options=None\)"),
    ],
)
def test_what_is_not_gymnasium_s_is_named(env: Any, words: str):
    with pytest.raises(UserError, match=words):
        demonstrate(toy_suite.Expert(1), env, 0, 30, DemonstrationConfig())


def test_lists_are_observations_too():
    listed = Odd("step", lambda it: (it[0].tolist(), *it[1:]))
    episodes = [demonstrate(toy_suite.Expert(1), env, 0, 30, DemonstrationConfig()) for env in (listed, Odd("", list))]
    assert np.array_equal(episodes[0].observations, episodes[1].observations)


def test_an_observation_that_the_simulator_spoils_is_no_failure_of_the_policy(
    workplace: Path, monkeypatch, capsys, mlflow_file: str
):
    monkeypatch.setenv("TOY_ODDITY", "nan")
    arguments = [*TOY, *NOTHING, "--evaluation.episodes", "2", "--name", "run"]
    assert exit_code(meta_train.run, arguments) == 1
    said = capsys.readouterr().err
    assert "do not count: the simulator gave an observation that is not finite, first in " in said
    assert "wanted at most 1%; mend the environment" in said
    rows = read_rows(workplace / "runs" / "run" / "episodes.jsonl", EpisodeResult)
    faulty = [row for row in rows if row.fault is not None]
    assert faulty
    assert all(row.fault == 22 and not row.success for row in faulty)
    assert f"first in {faulty[0].label}, after step 22" in said

    monkeypatch.setattr(experiment, "MOST_FAULTS", 1.0)
    assert exit_code(meta_train.run, ["--resume", "run", "--runner", "local"]) == 0
    words = f"{len(faulty)} of {len(rows)} episodes do not count"
    folder = workplace / "runs" / "run"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["faults"].startswith(words)
    assert sum(row["episodes"] for row in summary["rows"]) == len(rows) - len(faulty)
    assert f"warning: {words}" in capsys.readouterr().out
    assert words in (folder / "report" / "report.html").read_text()
    assert words in (folder / "report" / "table.md").read_text()
    assert MlflowClient(mlflow_file).get_run(summary["mlflow_run_id"]).data.tags["simulator_faults"].startswith(words)


def test_a_sound_episode_s_row_is_as_it_was(train):
    line = (train("run", *NOTHING) / "episodes.jsonl").read_text().splitlines()[0]
    assert "fault" not in json.loads(line)


def test_a_suite_that_cannot_travel_names_the_member():
    suite = toy_suite.ToySuite(SuiteConfig(name="toy"))
    assert put_suite(suite, copy.deepcopy)
    suite.simulator = threading.Lock()  # type: ignore[attr-defined]
    with pytest.raises(UserError, match=r"toy: simulator: got what cannot be pickled .* make it in make_env"):
        put_suite(suite, copy.deepcopy)


Steps = tuple[np.ndarray, np.ndarray]


@pytest.fixture
def steps() -> list[Steps]:
    draw = np.random.default_rng(0)
    return [(draw.normal(size=(9, 4)).astype("f4"), draw.uniform(-1, 1, (9, 2)).astype("f4")) for _ in range(6)]


def write_hdf5(path: Path, episodes: list[Steps], mark: Callable[[np.ndarray], None]) -> str:
    terminals = np.concatenate([np.arange(len(actions)) == len(actions) - 1 for _, actions in episodes])
    mark(terminals)
    with h5py.File(path, "w") as file:
        file["observations"], file["actions"] = map(np.concatenate, zip(*episodes, strict=True))
        file["terminals"] = terminals
    return f"hdf5:{path}"


def write_npz(path: Path, episodes: list[Steps]) -> str:
    observations, actions = map(np.concatenate, zip(*episodes, strict=True))
    lengths = np.array([len(one[1]) for one in episodes])
    np.savez(path, observations=observations, actions=actions, episode_lengths=lengths)
    return f"npz:{path}"


def found(place: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Return what `inspect` says of a data set with something wrong in it."""
    capsys.readouterr()
    with pytest.raises(RunError, match="things are wrong with"):
        inspect_demos.run([place])
    return " ".join(capsys.readouterr().out.split())


def test_ends_that_stay_marked_are_refused_and_listed(tmp_path: Path, steps, capsys):
    def stay(terminals: np.ndarray) -> None:
        terminals[[*range(6, 9), *range(14, 18)]] = True

    place = write_hdf5(tmp_path / "d.h5", steps, stay)
    printed = found(place, capsys)
    assert all(f"episode {index}: a single step after a marked one" in printed for index in (1, 2, 4, 5, 6))
    with pytest.raises(UserError, match="episode 1: a single step after a marked one"):
        demonstrations("a", place, toy_suite.ToySuite(SuiteConfig(name="toy")), 100)


def test_a_tail_without_a_mark_is_left_out_and_counted(tmp_path: Path, steps, capsys, logged):
    def cut(terminals: np.ndarray) -> None:
        terminals[-1] = False

    place = write_hdf5(tmp_path / "d.hdf5", steps, cut)
    assert "episode 5: its end is not marked; its 9 steps are left out" in found(place, capsys)
    read = demonstrations("a", place, toy_suite.ToySuite(SuiteConfig(name="toy")), 100)
    assert [len(one) for one in read.demonstrations] == [9] * 5
    assert any("9 steps after the last mark of an end are left out" in line for line in logged())
    whole = write_hdf5(tmp_path / "whole.hdf5", steps, lambda terminals: None)
    assert len(demonstrations("a", whole, toy_suite.ToySuite(SuiteConfig(name="toy")), 100).demonstrations) == 6
    inspect_demos.run([whole])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda one: (one[0][:1].repeat(9, 0), one[1]), "the same state at every step"),
        (lambda one: (one[0], one[1] * np.float32(1e7)), "actions: got"),
        (lambda one: (one[0] * np.float64(1e300), one[1]), "is not finite"),
        (lambda one: (np.where(np.arange(9)[:, None] == 3, np.nan, one[0]), one[1]), "observations at step 3"),
    ],
    ids=["states that repeat", "huge", "1e300", "nan"],
)
@pytest.mark.parametrize("form", ["npz", "hdf5"])
def test_odd_numbers_are_refused_and_all_listed(tmp_path: Path, steps, capsys, form: str, spoil, words: str):
    episodes = [spoil(one) if index in (2, 4) else one for index, one in enumerate(steps)]
    episodes = [(observations.astype("f8"), actions) for observations, actions in episodes]
    path = tmp_path / f"d.{form}"
    place = write_npz(path, episodes) if form == "npz" else write_hdf5(path, episodes, lambda terminals: None)
    printed = found(place, capsys)
    assert all(words in printed.partition(f"episode {index}: ")[2].partition("episode ")[0] for index in (2, 4)), (
        printed
    )
    with pytest.raises(UserError, match=rf"episode 2: .*{words}"):
        demonstrations("a", place, toy_suite.ToySuite(SuiteConfig(name="toy")), 100)


def test_episodes_that_stand_twice_or_have_one_step(tmp_path: Path, steps, capsys):
    place = write_npz(tmp_path / "d.npz", [*steps, steps[1], (steps[0][0][:1], steps[0][1][:1])])
    printed = found(place, capsys)
    assert "episode 6: the same as episode 1" in printed
    assert "episode 7: a single step" in printed
    with pytest.raises(UserError, match="episode 6: the same as episode 1"):
        demonstrations("a", place, toy_suite.ToySuite(SuiteConfig(name="toy")), 100)
    assert len(read_episodes(place)) == 8
