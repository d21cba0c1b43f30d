"""A full disk is reported with the file and the bytes it needs, nothing half-written counts, and the run can go on."""

import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from dmil_core.files import DiskFullError
from dmil_core.trajectories import Episode
from services import meta_train
from services.cli.arguments import exit_code
from services.demonstrations.store import DemoStore
from services.evaluation.results import EpisodeResult, write_rows
from services.storage.checkpoints import Checkpoints
from tests.services.programs import QUICK_EVALUATION


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1 MB."""
    path = tmp_path / "disk"
    path.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(path)], capture_output=True)
    if mounted.returncode:
        pytest.skip(f"no right to mount a small disk: {mounted.stderr.decode()}")
    yield path
    subprocess.run(["umount", "-l", str(path)], check=True)


def fill(disk: Path, but: int) -> Path:
    """Leave so many bytes free."""
    filler = disk / "filler"
    free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_bsize
    filler.write_bytes(b"0" * (free - but))
    return filler


@pytest.mark.thorough
@pytest.mark.parametrize("left", [0, 20_000])
def test_a_full_disk_stops_a_run_which_goes_on_when_there_is_space(
    train, small_disk: Path, left: int, capsys: pytest.CaptureFixture[str]
):
    undisturbed = train("whole", "--training.iterations", "4")
    runs = ("--runs", str(small_disk), "--name", "run", "--preset", "ml10-smoke", "--runner", "local")
    meta_train.run([*runs, "--training.iterations", "2", *QUICK_EVALUATION])
    filler = fill(small_disk, but=left)
    capsys.readouterr()
    arguments = ["--resume", str(small_disk / "run"), "--training.iterations", "4", "--runner", "local"]
    assert exit_code(meta_train.run, arguments) == 1
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert f"error: {small_disk / 'run'}" in said
    assert " needs " in said
    assert "bytes" in said
    assert [path.name for path in Checkpoints(small_disk / "run" / "checkpoints", 3).all()] == ["iteration-0000002"]
    filler.unlink()
    meta_train.run(arguments)
    resumed = Checkpoints(small_disk / "run" / "checkpoints", 3).newest()
    assert all(map(np.array_equal, resumed.state[1:], undisturbed.state[1:]))


def test_a_run_that_finds_no_room_for_its_folder_says_so(small_disk: Path, capsys: pytest.CaptureFixture[str]):
    fill(small_disk, but=0)
    runs = ("--runs", str(small_disk), "--name", "run", "--preset", "ml10-smoke", "--runner", "local")
    assert exit_code(meta_train.run, runs) == 1
    assert f"error: {small_disk / 'run'}: needs " in capsys.readouterr().err
    assert [path.name for path in small_disk.iterdir()] == ["filler"]


def test_a_full_disk_is_told_where_nothing_says_whose_it_is(capsys: pytest.CaptureFixture[str]):
    def program(arguments: Sequence[str]) -> None:
        Path("/dev/full").write_bytes(b"x" * 100_000)

    assert exit_code(program, []) == 1
    assert "error: a disk: got No space left on device; wanted room" in capsys.readouterr().err


def test_no_half_of_a_data_set_or_of_rows_counts(small_disk: Path, data):
    dataset = data["reach"]
    draw = np.random.default_rng(0)
    attempts = [
        Episode(draw.normal(size=(300, 39)).astype(np.float32), np.zeros((299, 4), np.float32), index, [0.0], 10)
        for index in range(20)
    ]
    with pytest.raises(DiskFullError, match=rf"{small_disk}.*needs \d+ bytes"):
        DemoStore(small_disk).save(dataset.id, "reach", attempts, failed=0, settings={})
    assert DemoStore(small_disk).load(dataset.id, "reach") is None
    filler = fill(small_disk, but=0)
    row = EpisodeResult.model_construct(suite="x" * 10_000)
    with pytest.raises(DiskFullError, match=r"rows.jsonl: needs \d+ bytes"):
        write_rows(small_disk / "rows.jsonl", [row])
    assert not (small_disk / "rows.jsonl").exists()
    filler.unlink()
