"""Checkpoints: whole or not there, and with everything that the next iteration depends on."""

import errno
import hashlib
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from dmil_core.checkpoint import Checkpoint, CheckpointError, Manifest
from dmil_core.configs import ExperimentConfig, TrainingConfig
from dmil_core.files import DiskFullError
from dmil_core.outer_loop import OuterState, OuterStep, add
from services.storage.checkpoints import Checkpoints

SHAPES = {"high.0.weight": (3, 2), "high.0.bias": (3,), "a.comes.first.in.the.file": (4,)}
TENSORS = ("parameters.safetensors", "optimiser.safetensors", "constants.safetensors")
SIZE = sum(int(np.prod(shape)) for shape in SHAPES.values())


def gradients(iteration: int) -> list[np.ndarray]:
    return [np.random.default_rng([iteration, group]).normal(size=SIZE).astype(np.float32) for group in range(3)]


def advance(state: OuterState, iterations: int) -> OuterState:
    step = OuterStep(state, TrainingConfig(learning_rate=1e-2, gradient_clip=1.0))
    for iteration in range(state.iteration, state.iteration + iterations):
        step(add(gradients(iteration)))
    return step.state


def start() -> OuterState:
    return OuterState.start(np.random.default_rng(0).normal(size=SIZE).astype(np.float32))


def save(checkpoints: Checkpoints, state: OuterState, loss: float | None = None) -> Path:
    manifest = Manifest(
        iteration=state.iteration,
        loss=loss,
        config=ExperimentConfig(seed=7),
        shapes=SHAPES,
        data={"reach": "abc"},
        versions={"torch": "2"},
        mlflow_run_id="run",
    )
    return checkpoints.save(state, {"observation_mean": np.arange(2, dtype=np.float32)}, manifest)


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


HARMS = {
    "flipped bit": lambda path: path.write_bytes(path.read_bytes()[:-9] + b"?" + path.read_bytes()[-8:]),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-4]),
    "gone": lambda path: path.unlink(),
}


@pytest.mark.parametrize(
    "name",
    ["manifest.json", "manifest.sha256", "parameters.safetensors", "optimiser.safetensors", "constants.safetensors"],
)
@pytest.mark.parametrize("harm", HARMS.values(), ids=HARMS)
def test_where_the_newest_is_damaged_the_one_before_it_is_taken(tmp_path: Path, capsys, name: str, harm):
    checkpoints = Checkpoints(tmp_path, kept=3)
    _, before, newest = [save(checkpoints, start()._replace(iteration=iteration)) for iteration in (1, 2, 3)]
    harm(newest / name)
    assert checkpoints.newest().path == before
    (warning,) = capsys.readouterr().out.splitlines()
    assert warning.startswith("warning: ")
    assert str(newest / name) in warning or str(newest / "manifest.json") in warning
    assert warning.endswith(f"taking {before} instead")


def test_where_none_is_whole_the_folder_is_named_and_each_fault(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, kept=3)
    for iteration in (1, 2):
        (save(checkpoints, start()._replace(iteration=iteration)) / "optimiser.safetensors").unlink()
    with pytest.raises(CheckpointError, match=f"{tmp_path}: got 2 checkpoints, none of them whole") as error:
        checkpoints.newest()
    assert "remove them and begin anew" in str(error.value)
    assert str(error.value).count("optimiser.safetensors: got 0 bytes") == 2


def test_a_damaged_checkpoint_does_not_count_as_kept_or_best(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, kept=2)
    paths = [save(checkpoints, start()._replace(iteration=n), loss) for n, loss in ((1, 9.0), (2, 8.0), (3, 7.0))]
    (paths[2] / "manifest.json").write_text("{")
    save(checkpoints, start()._replace(iteration=4), float("nan"))
    assert [path.name[-1] for path in checkpoints.all()] == ["2", "3", "4"]
    save(checkpoints, start()._replace(iteration=5))
    assert [path.name[-1] for path in checkpoints.all()] == ["2", "4", "5"], "a damaged one goes with those of its age"


def test_what_a_resume_passed_over_does_not_drive_out_what_is_saved_since(tmp_path: Path):
    for iteration in (7, 9):
        path = save(Checkpoints(tmp_path, kept=2), start()._replace(iteration=iteration), 0.1)
        tensors = path / "parameters.safetensors"
        tensors.write_bytes(tensors.read_bytes()[:-1] + b"x")  # what only a digest shows
    checkpoints = Checkpoints(tmp_path, kept=1)
    for iteration in (5, 6):
        assert save(checkpoints, start()._replace(iteration=iteration), 2.0 / iteration).is_dir()
    assert [path.name[-1] for path in checkpoints.all()] == ["6", "7", "9"]
    assert checkpoints.newest().state.iteration == 6


def test_a_loss_and_a_run_id_are_no_part_of_the_digest(tmp_path: Path):
    one, other = Checkpoints(tmp_path / "one", kept=1), Checkpoints(tmp_path / "other", kept=1)
    manifests = [
        Checkpoint(save(checkpoints, start(), loss)).manifest for checkpoints, loss in ((one, 0.5), (other, 1))
    ]
    assert manifests[0].digest == manifests[1].digest
    assert manifests[0].model_copy(update={"mlflow_run_id": "another"}).digest == manifests[0].digest
    for change in (
        {"iteration": 9},
        {"data": {}},
        {"versions": {}},
        {"files": {}},
        {"config": ExperimentConfig(seed=8)},
    ):
        assert manifests[0].model_copy(update=change).digest != manifests[0].digest, change
    turned = dict(reversed(manifests[0].shapes.items()))
    assert manifests[0].model_copy(update={"shapes": turned}).digest != manifests[0].digest


def test_sha256sum_checks_a_manifest(tmp_path: Path):
    path = save(Checkpoints(tmp_path, kept=1), start())
    command = ["sha256sum", "--check", "--strict", "manifest.sha256"]
    assert subprocess.run(command, cwd=path, capture_output=True).returncode == 0
    (path / "manifest.json").write_text("{}")
    assert subprocess.run(command, cwd=path, capture_output=True).returncode == 1


def reseal(path: Path, **changes: object) -> None:
    """Change a manifest, and have its digest say so."""
    manifest = path / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | changes))
    digest = hashlib.sha256(manifest.read_bytes()).hexdigest()
    manifest.with_name("manifest.sha256").write_text(f"{digest}  manifest.json\n")


def test_tensors_of_ten_terabytes_are_refused_before_there_is_memory_for_them(tmp_path: Path):
    path = save(Checkpoints(tmp_path, kept=1), start())
    reseal(path, shapes={"high.0.weight": [2_500_000, 1_000_000]})
    os.truncate(path / "parameters.safetensors", 10**13)
    with pytest.raises(CheckpointError, match="shapes: got 10000000000000 bytes of parameters; wanted at most"):
        Checkpoint(path)


def test_a_gigabyte_that_is_not_there_is_not_waited_for(tmp_path: Path):
    path = save(Checkpoints(tmp_path, kept=1), start())
    reseal(path, shapes={"high.0.weight": [2**14, 2**14]})
    with pytest.raises(CheckpointError, match=r"parameters.safetensors: got \d+ bytes; wanted at least 1073741824"):
        Checkpoint(path)


def test_a_file_of_ten_terabytes_is_not_even_hashed(tmp_path: Path):
    path = save(Checkpoints(tmp_path, kept=1), start())
    os.truncate(path / "constants.safetensors", 10**13)
    with pytest.raises(CheckpointError, match=r"constants.safetensors: got .*10000000000000 bytes"):
        Checkpoint(path)


@pytest.mark.parametrize(
    ("name", "tensors", "words"),
    [
        ("parameters.safetensors", {"high.0.weight": np.zeros((3, 2), np.float32)}, "wanted the manifest's"),
        ("optimiser.safetensors", {"first_moment": np.zeros(SIZE, np.float32)}, "wanted the manifest's"),
        ("optimiser.safetensors", dict.fromkeys(("first_moment", "second_moment"), np.zeros(1, np.float32)), "tensors"),
        ("constants.safetensors", {"observation_mean": np.zeros(2)}, "float64 in 'observation_mean'; wanted float32"),
        ("constants.safetensors", {"observation_mean": np.zeros(2, np.int32)}, "wanted float32 only"),
    ],
    ids=["missing", "missing moment", "short moments", "float64", "integers"],
)
def test_tensors_that_are_not_as_the_manifest_says_are_refused(tmp_path: Path, name: str, tensors, words: str):
    path = save(Checkpoints(tmp_path, kept=1), start())
    (path / name).write_bytes(safetensors.numpy.save(tensors))
    files = {file: hashlib.sha256((path / file).read_bytes()).hexdigest() for file in TENSORS}
    reseal(path, files=files)
    with pytest.raises(CheckpointError, match=words) as error:
        Checkpoint(path)
    assert str(path / name) in str(error.value)


def test_a_type_that_numpy_does_not_have_is_refused(tmp_path: Path):
    path = save(Checkpoints(tmp_path, kept=1), start())
    header = json.dumps({"mean": {"dtype": "F8_E4M3", "shape": [8], "data_offsets": [0, 8]}}).encode()
    (path / "constants.safetensors").write_bytes(len(header).to_bytes(8, "little") + header + bytes(8))
    reseal(path, files={file: hashlib.sha256((path / file).read_bytes()).hexdigest() for file in TENSORS})
    with pytest.raises(CheckpointError, match=r"constants.safetensors: got "):
        Checkpoint(path)


def test_no_link_leads_out_of_a_checkpoint(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path / "checkpoints", kept=2)
    path = save(checkpoints, start())
    (path / "parameters.safetensors").rename(tmp_path / "elsewhere")
    (path / "parameters.safetensors").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="a link"):
        Checkpoint(path)
    other = save(Checkpoints(tmp_path / "others", kept=1), start()._replace(iteration=1))
    (checkpoints.folder / other.name).symlink_to(other)
    with pytest.raises(CheckpointError, match="got a link"):
        checkpoints.newest()
    whole = save(checkpoints, start()._replace(iteration=2))
    save(checkpoints, start()._replace(iteration=3))
    save(checkpoints, start()._replace(iteration=4))
    assert Checkpoint(other).manifest.iteration == 1, "what a link leads to is not let go of"
    assert not whole.exists()


def test_what_killed_writers_left_is_removed_and_a_failed_one_leaves_nothing(tmp_path: Path, monkeypatch):
    checkpoints = Checkpoints(tmp_path, kept=2)
    whole = save(checkpoints, start())
    (tmp_path / ".writing-99999").mkdir()
    (tmp_path / ".writing-99999" / "parameters.safetensors").write_bytes(b"half")

    def full(path: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr("dmil_core.files.sync", full)
        with pytest.raises(DiskFullError, match="iteration-0000001: needs"):
            save(checkpoints, start()._replace(iteration=1))
    assert list(tmp_path.iterdir()) == [whole]


def test_the_state_is_a_copy(tmp_path: Path):
    checkpoint = Checkpoint(save(Checkpoints(tmp_path, kept=1), start()))
    for array in checkpoint.state[1:]:
        assert isinstance(array, np.ndarray)
        array += 1
    assert same(checkpoint.state, start())
