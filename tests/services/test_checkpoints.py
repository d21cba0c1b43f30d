"""Checkpoints: whole or not there, and with everything that the next iteration depends on."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dmil_core.configs import ExperimentConfig
from dmil_core.networks import unflatten
from dmil_core.outer_loop import OuterState, OuterStep, add
from services.checkpoints import Checkpoint, CheckpointError, Checkpoints, Manifest

SHAPES = {"high.0.weight": (3, 2), "high.0.bias": (3,), "a.comes.first.in.the.file": (4,)}
SIZE = sum(int(np.prod(shape)) for shape in SHAPES.values())


def gradients(iteration: int) -> list[np.ndarray]:
    return [np.random.default_rng([iteration, group]).normal(size=SIZE).astype(np.float32) for group in range(3)]


def advance(state: OuterState, iterations: int) -> OuterState:
    step = OuterStep(state, learning_rate=1e-2, gradient_clip=1.0)
    for iteration in range(state.iteration, state.iteration + iterations):
        step(add(gradients(iteration)))
    return step.state


def start() -> OuterState:
    return OuterState.start(np.random.default_rng(0).normal(size=SIZE).astype(np.float32))


def save(checkpoints: Checkpoints, state: OuterState, loss: float | None = None) -> Path:
    shapes = {name: torch.Size(shape) for name, shape in SHAPES.items()}
    parameters = {name: t.numpy() for name, t in unflatten(torch.tensor(state.parameters), shapes).items()}
    manifest = Manifest(
        iteration=state.iteration,
        loss=loss,
        config=ExperimentConfig(seed=7),
        shapes=SHAPES,
        data={"reach": "abc"},
        versions={"torch": "2"},
        mlflow_run_id="run",
    )
    return checkpoints.save(state, parameters, {"observation_mean": np.arange(2, dtype=np.float32)}, manifest)


def same(one: OuterState, other: OuterState) -> bool:
    return one.iteration == other.iteration and all(map(np.array_equal, one[1:], other[1:]))


def test_what_is_saved_is_read_to_the_bit(tmp_path: Path):
    state = advance(start(), 3)
    read = Checkpoint(save(Checkpoints(tmp_path, kept=3), state, loss=0.5))
    assert same(read.state, state)
    assert {name: value.shape for name, value in read.parameters.items()} == SHAPES
    assert list(read.parameters) == list(SHAPES)
    assert read.constants["observation_mean"].tolist() == [0, 1]
    assert (read.manifest.iteration, read.manifest.loss, read.manifest.mlflow_run_id) == (3, 0.5, "run")
    assert read.manifest.config == ExperimentConfig(seed=7)
    assert set(read.manifest.files) == {path.name for path in read.path.iterdir()} - {
        "manifest.json",
        "manifest.sha256",
    }


@pytest.mark.parametrize("before", [1, 4])
def test_going_on_from_a_checkpoint_ends_with_the_same_bits(tmp_path: Path, before: int):
    undisturbed = advance(start(), before + 3)
    read = Checkpoint(save(Checkpoints(tmp_path, kept=1), advance(start(), before)))
    assert same(advance(read.state, 3), undisturbed)
    assert not same(advance(OuterState.start(read.state.parameters), 3), undisturbed)


@pytest.mark.parametrize("name", ["parameters.safetensors", "optimiser.safetensors", "constants.safetensors"])
@pytest.mark.parametrize(
    "harm",
    [
        lambda path: path.write_bytes(path.read_bytes()[:-1] + bytes([path.read_bytes()[-1] ^ 1])),
        lambda path: path.write_bytes(path.read_bytes()[:-4]),
        lambda path: path.unlink(),
    ],
    ids=["flipped bit", "truncated", "gone"],
)
def test_a_damaged_file_is_refused_by_its_name(tmp_path: Path, name: str, harm):
    path = save(Checkpoints(tmp_path, kept=1), start())
    harm(path / name)
    with pytest.raises(CheckpointError) as error:
        Checkpoint(path)
    assert str(path / name) in str(error.value)


@pytest.mark.parametrize(
    "harm",
    [
        lambda path: path.unlink(),
        lambda path: path.write_text(path.read_text()[:-20]),
        lambda path: path.write_text(path.read_text().replace('"iteration"', '"iterations"')),
        lambda path: path.write_bytes(b"\xff\xfe"),
    ],
    ids=["gone", "truncated", "another key", "no text"],
)
def test_a_damaged_manifest_is_refused_by_its_name(tmp_path: Path, harm):
    path = save(Checkpoints(tmp_path, kept=1), start())
    harm(path / "manifest.json")
    with pytest.raises(CheckpointError) as error:
        Checkpoints(tmp_path, kept=1).newest()
    assert str(path / "manifest.json") in str(error.value)


def test_the_digest_covers_the_whole_checkpoint(tmp_path: Path):
    one, other = Checkpoints(tmp_path / "one", kept=1), Checkpoints(tmp_path / "other", kept=1)
    assert Checkpoint(save(one, start())).digest == Checkpoint(save(other, start())).digest
    state = start()
    state.second_moment[0] = 1e-9
    assert Checkpoint(save(other, state)).digest != Checkpoint(one.all()[0]).digest


def test_the_newest_and_the_best_are_kept(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, kept=2)
    for iteration, loss in [(2, 3.0), (4, 1.0), (6, None), (8, 2.0), (10, 4.0), (12, None)]:
        save(checkpoints, start()._replace(iteration=iteration), loss)
    assert [path.name for path in checkpoints.all()] == [f"iteration-{i:07d}" for i in (4, 10, 12)]
    assert checkpoints.newest().manifest.iteration == 12
    best = checkpoints.best()
    assert best is not None
    assert Checkpoint(best).manifest.iteration == 4


def test_saving_the_same_iteration_again_replaces_it(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, kept=2)
    save(checkpoints, start())
    save(checkpoints, start(), loss=0.25)
    assert checkpoints.newest().manifest.loss == 0.25
    assert [path.name for path in tmp_path.iterdir()] == ["iteration-0000000"]


def test_a_half_written_checkpoint_is_never_taken(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, kept=2)
    whole = save(checkpoints, start())
    half = tmp_path / ".writing-99999"
    half.mkdir()
    (half / "parameters.safetensors").write_bytes(b"half")
    assert checkpoints.all() == [whole]
    assert checkpoints.newest().path == whole


def test_without_a_checkpoint_its_folder_is_named(tmp_path: Path):
    with pytest.raises(CheckpointError, match="nowhere: got no checkpoint"):
        Checkpoints(tmp_path / "nowhere", kept=1).newest()
