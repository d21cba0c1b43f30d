"""From a checkpoint and a few arrays to a policy: whatever was meant works, whatever was not is named."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dmil_core as dmil
from dmil_core.checkpoint import Range
from dmil_core.settings import FineTuning
from tests.dmil_core.old_models import FOLDER, METHODS, old_model, recorded


@pytest.mark.parametrize("method", METHODS)
def test_the_same_demonstrations_give_the_same_policy_and_the_model_stays(method: str):
    model = old_model(method)
    before = {name: tensor.clone() for name, tensor in model.checkpoint.tensors().items()}
    demonstrations = recorded(model, 2)
    one = model.adapt(demonstrations, steps=2)
    model.adapt(recorded(model, 1, seed=5), steps=2)
    other = model.adapt(demonstrations, steps=2)
    for observation in demonstrations[0][0][:12]:
        action = one(observation)
        assert action.shape == (4,)
        assert np.abs(action).max() <= 1
        np.testing.assert_array_equal(action, other(observation))
        assert one.sub_skill == other.sub_skill
    assert all(torch.equal(tensor, model._parameters[name]) for name, tensor in before.items())


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.longdouble, list])
def test_numbers_of_any_type_are_taken(kind):
    model = old_model()
    (observations, actions), *_ = recorded(model)
    observations, actions = (values.astype(np.float16) for values in (observations, actions))
    wanted = model.adapt([(observations, actions)], steps=1)(observations[3])
    of_kind = tuple(values.tolist() if kind is list else values.astype(kind) for values in (observations, actions))
    np.testing.assert_array_equal(model.adapt([of_kind], steps=1)(observations[3]), wanted)


def test_an_observation_after_the_last_action_is_left_out():
    model = old_model()
    (observations, actions), *_ = recorded(model)
    more = np.concatenate([observations, observations[:1]])
    assert len(model.adapt([(more, actions)], steps=1).support[0].observations) == len(actions)


def test_more_steps_come_nearer_to_what_was_demonstrated():
    model = old_model()
    assert model.fine_tuning == FineTuning(5, 0.01)
    (observations, actions), *_ = recorded(model)

    def error(steps: int) -> float:
        policy = model.adapt([(observations, np.tile(actions[:1], (20, 1)))], steps=steps)
        return float(np.square(policy(observations) - actions[0]).sum())

    assert error(100) < 0.5 * error(0)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda o, a: (o, a), "got one pair of arrays; wanted a list of them"),
        (lambda o, a: [], "got none; wanted at least one"),
        (lambda o, a: [o], r"demonstration 0: got array.*; wanted a pair of arrays"),
        (
            lambda o, a: [(o.T, a)],
            r"got the shape \(39, 20\); wanted \(steps, 39\), .*transposed: give its",
        ),
        (
            lambda o, a: [(o, a), (o[:, :7], a)],
            r"demonstration 1: observations: got the shape \(20, 7\);",
        ),
        (
            lambda o, a: [(o, a[:, :3])],
            r"got the shape \(20, 3\); wanted \(steps, 4\), as ml10 has it",
        ),
        (lambda o, a: [(o[None], a[None])], "of several demonstrations give a list of pairs"),
        (lambda o, a: [(o, a[:-3])], "20 observations for 17 actions"),
        (lambda o, a: [(o, np.where(a > 0.5, np.nan, a))], "actions at step 0 is not finite"),
        (lambda o, a: [(1e300 * o, a)], "observations at step 0 is not finite"),
        (lambda o, a: [(o.astype(str), a)], "got an array of <U32.*; wanted real numbers"),
        (lambda o, a: [(o, a > 0)], "got an array of bool"),
        (lambda o, a: [([[1.0], [1.0, 2.0]], a)], r"observations: got \[\[1.0\], \[1.0, 2.0\]\]; wanted an array"),
    ],
)
def test_what_is_no_demonstration_of_such_a_robot_is_told(make, says: str):
    model = old_model()
    (observations, actions), *_ = recorded(model)
    with pytest.raises(dmil.DemonstrationError, match=says):
        model.adapt(make(observations, actions))


@pytest.mark.parametrize("setting", [{"steps": -1}, {"learning_rate": 0.0}, {"learning_rate": float("nan")}])
def test_settings_without_sense_are_refused(setting: dict):
    with pytest.raises(dmil.UserError, match=r"adapt: got FineTuning.*; wanted steps of at least 0"):
        old_model().adapt(recorded(old_model()), **setting)


@pytest.mark.parametrize("rate", [3.0, 1e4])
def test_adaptation_that_diverges_is_an_error(rate: float):
    with pytest.raises(dmil.DivergedError, match=r"adaptation diverged: got .* after 60 steps .*; give fewer steps"):
        old_model().adapt(recorded(old_model()), steps=60, learning_rate=rate)


def test_numbers_that_stand_out_are_named():
    model = old_model()
    (observations, actions), *_ = recorded(model)
    seen = Range.of(observations.min(0), observations.max(0))
    model.checkpoint.manifest = model.checkpoint.manifest.model_copy(update={"observed": seen})
    model.adapt([(observations, actions)], steps=0)
    in_millimetres = np.concatenate([observations[:, :5], 1000 * observations[:, 5:7], observations[:, 7:]], 1)
    with pytest.warns(dmil.UnlikeTrainingWarning, match=r"number 5 from .*, meta-training saw .*, number 6 from"):
        model.adapt([(in_millimetres, actions)], steps=0)
    with pytest.warns(dmil.UnlikeTrainingWarning, match=r"action: number 2 from .*, wanted -1 to 1; see to units"):
        model.adapt([(observations, actions * [1, 1, 50, 1])], steps=0)


def test_a_model_is_found_by_a_runs_name_its_folder_or_a_checkpoints(tmp_path: Path, monkeypatch):
    checkpoint = tmp_path / "runs" / "mine" / "checkpoints" / "iteration-0000001"
    shutil.copytree(FOLDER / "dmil", checkpoint)
    monkeypatch.chdir(tmp_path)
    for name in ("mine", "runs/mine", checkpoint):
        assert dmil.load(name).checkpoint.path.name == checkpoint.name
    shutil.copytree(FOLDER / "dmil", damaged := checkpoint.with_name("iteration-0000002"))
    (damaged / "parameters.safetensors").write_bytes(b"x" * 99999)
    with pytest.warns(UserWarning, match=r"0000002/parameters.safetensors: got damaged.*; taking .*0000001"):
        dmil.load("mine")
    for name in ("yours", tmp_path):
        with pytest.raises(dmil.UserError, match="wanted the folder of a run or of a checkpoint, the name of a run in"):
            dmil.load(name)
    with pytest.raises(dmil.UserError, match=r"got 'ftp:/.*; wanted a scheme out of"):
        dmil.load("ftp://example.org/model")
    assert dmil.load(FOLDER / "nearest-neighbour")
    with pytest.raises(dmil.UserError, match=r"got no actions; wanted their bounds, which version 0.1 did not write"):
        dmil.load(FOLDER / "nearest-neighbour").adapt([])


@pytest.mark.parametrize("page", ["README.md", "docs/use-a-policy.md", "docs/data.md"])
def test_the_code_of_a_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copytree(FOLDER / "dmil", tmp_path / "runs" / "ml45" / "checkpoints" / "iteration-0000001")
    monkeypatch.chdir(tmp_path)
    (observations, actions), *_ = recorded(old_model())
    robot = SimpleNamespace(send=len, observe=lambda: observations[0], stop=list)
    namespace = {"observations": observations, "actions": actions, "observation": observations[0], "robot": robot}
    blocks = re.findall(r"```python\n(.*?)```", (FOLDER.parents[3] / page).read_text(), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(block.replace("range(400)", "range(2)"), namespace)
    if page == "docs/data.md":
        assert dict(np.load("mine.npz"))["episode_lengths"].tolist() == [20] * 3


def test_the_door_knows_no_simulator_no_ray_and_no_mlflow_and_opens_without_torch():
    code = (
        "import sys, dmil_core as dmil; assert 'torch' not in sys.modules; "
        "assert set(dmil.__all__) == set(dir(dmil)); [getattr(dmil, name) for name in dmil.__all__]; "
        "print({name.partition('.')[0] for name in sys.modules} & set(sys.argv))"
    )
    foreign = ["ray", "mlflow", "gymnasium", "mujoco", "minari", "pandas", "services"]
    assert subprocess.check_output([sys.executable, "-c", code, *foreign], text=True) == "set()\n"
    with pytest.raises(AttributeError, match="has no attribute 'lode'"):
        dmil.lode  # pyright: ignore[reportAttributeAccessIssue]  # noqa: B018
