"""From a run and three recorded demonstrations to the folder of a policy, by one command."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import dmil_core as dmil
from dmil_core.checkpoint import Range
from dmil_core.demonstrations import Demonstration
from services import adapt
from services.demonstrations.store import TaskDemonstrations
from services.experiments.experiment import Experiment
from services.experiments.finished_run import FinishedRun


def save_npz(path: Path, demonstrations: Sequence[Demonstration]) -> None:
    np.savez(
        path,
        observations=np.concatenate([one.observations for one in demonstrations]),
        actions=np.concatenate([one.actions for one in demonstrations]),
        episode_lengths=[len(one) for one in demonstrations],
    )


@pytest.fixture
def mine(workplace: Path, experiment: Experiment, data: dict[str, TaskDemonstrations]) -> Sequence[Demonstration]:
    """Three demonstrations of a task that the run has not seen, in mine.npz of the working directory."""
    demonstrations = experiment.held_out_sets(data)["door-close"][:3]
    save_npz(workplace / "mine.npz", demonstrations)
    return demonstrations


def test_a_run_and_three_demonstrations_give_a_policy(finished: FinishedRun, mine, capsys: pytest.CaptureFixture[str]):
    settings = ["--demos", "npz:mine.npz", "--output", "peg", "--learning-rate", "1e-6"]
    adapt.run([finished.name, "--runs", str(finished.folder.parent), *settings])
    printed = capsys.readouterr().out
    chosen = re.search(r"left out, by steps: (.*); taking (\d+)", printed)
    assert chosen is not None, printed
    errors = {steps: float(error) for error, steps in re.findall(r"([\d.e+]+) after (\d+)", chosen[1])}
    assert sorted(map(int, errors)) == [0, 1, 2, 4]
    assert errors[chosen[2]] == min(errors.values())
    assert re.search(r"error on what was demonstrated: [\d.]+ before adaptation, [\d.]+ after", printed)
    assert re.search(r"sub-skills in use: \d of 3, with [\d., ]+ of the steps", printed)

    code = re.findall(r"^  (.*)", printed, re.MULTILINE)
    observation = mine[0].observations[0]
    namespace = {"observation": observation}
    exec("\n".join(code), namespace)
    model = dmil.load(finished.folder)
    with pytest.warns(dmil.UnlikeTrainingWarning, match="observation: number 0 from"):
        policy = model.adapt(mine, steps=int(chosen[2]), learning_rate=1e-6)
    np.testing.assert_array_equal(namespace["action"], policy(observation))


def test_one_demonstration_is_taken_with_the_runs_own_steps_and_success_is_measured(
    finished: FinishedRun, mine, workplace: Path, capsys: pytest.CaptureFixture[str]
):
    save_npz(workplace / "one.npz", [mine[0].__class__("a", "b", 1000 * mine[0].observations, mine[0].actions)])
    task = ["--suite", "ml10", "--task", "door-close", "--episodes", "1"]
    adapt.run([str(finished.folder), "--demos", "npz:one.npz", "--learning-rate", "1e-9", "--steps", "0", *task])
    printed = " ".join(capsys.readouterr().out.split())
    assert "warning: unlike meta-training, as ml10 has it (reach, push, drawer-close): observation" in printed
    assert "one demonstration: none can be left out" in printed
    assert re.search(r"success in door-close of ml10-part \(.*\): [01] of 1, [01].00, 95% interval 0\.\d+ to", printed)
    assert dmil.load_policy("policy").origin.fine_tuning[:2] == (0, 1e-9)


def test_a_checkpoint_holds_what_acting_needs(finished: FinishedRun, experiment: Experiment):
    manifest = finished.checkpoint.manifest
    assert manifest.actions == Range(low=(-1.0,) * 4, high=(1.0,) * 4)
    assert manifest.observed is not None
    sets = experiment.training_sets(finished.demonstrations)
    seen = np.concatenate([one.observations for task in sets.values() for one in task])
    np.testing.assert_array_equal(np.array(manifest.observed.low, np.float32), seen.min(0))
    np.testing.assert_array_equal(np.array(manifest.observed.high, np.float32), seen.max(0))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--demos", "npz:mine.npz", "--output", "mine.npz"], "--output: got mine.npz, which is there already"),
        (["--demos", "npz:mine.npz", "--suite", "ml10"], "wanted both: --suite ml45 --task door-lock"),
        (["--demos", "npz:mine.npz", "--suite", "ml10", "--task", "fly"], "got fly"),
        (["--demos", "npz:mine.npz,a=npz:other"], "--demos: got 2 data sets; wanted one, of one task"),
        (["--demos", "npz:mine.npz", "--steps", "-1"], "wanted steps of at least 0"),
        (["--demos", "npz:mine.npz", "--episodes", "0"], "--episodes: got 0; wanted at least 1"),
        (["--demos", "npz:mine.npz", "--learning-rate", "1e9"], "adaptation diverged"),
    ],
)
def test_a_mistake_is_told_and_leaves_no_folder(finished: FinishedRun, mine, complaint, arguments, words: str):
    said = complaint(adapt.run, str(finished.folder), *arguments) if words != "adaptation diverged" else None
    if said is None:
        with pytest.raises(dmil.DivergedError, match=words):
            adapt.run([str(finished.folder), *arguments, "--steps", "9"])
    else:
        assert words in said
    assert not Path("policy").exists()
