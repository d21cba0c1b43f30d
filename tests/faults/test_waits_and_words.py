"""Waits that end, and words that say what to do, with the right exit code."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from benchmarks import harness
from dmil_core.errors import UserError
from services import evaluate, inspect_demos, meta_train
from services.cli.arguments import exit_code
from services.cli.places import announce
from services.distributed import cluster
from services.distributed.node_info import usable_cpus
from tests.faults.conftest import SHORT, TOY


@pytest.mark.parametrize("place", ["file", "file/below", "/dev/null/x"])
def test_places_where_nothing_can_be_are_refused(workplace: Path, complaint, monkeypatch, place: str):
    Path("file").touch()
    assert "is no folder" in complaint(meta_train.run, *TOY, *SHORT, "--name", "run", "--runs", place)
    monkeypatch.setenv("DMIL_DATA", place)
    printed = complaint(meta_train.run, *TOY, *SHORT, "--name", "run")
    assert f"demonstrations: got {Path(place).resolve()}, where " in printed
    assert "wanted a place for it: DMIL_DATA=FOLDER" in printed
    assert not Path("runs").exists()


def test_what_cannot_be_written_is_refused_and_what_is_only_read_may_be_read(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # as for who is not root
    announce(demonstrations=(tmp_path, "DMIL_DATA=FOLDER"), MLflow=(tmp_path / "m.db", "MLFLOW_TRACKING_URI=…"))
    with pytest.raises(UserError, match="cannot be written to; wanted a place for it: --runs FOLDER"):
        announce(run=(tmp_path / "run", "--runs FOLDER"))


@pytest.mark.parametrize("place", ["folder", "file/below", "read-only/rows.json"])
def test_rows_that_cannot_be_written_are_refused_before_anything_is_measured(
    workplace, monkeypatch, capsys, place: str
):
    Path("folder").mkdir()
    Path("file").touch()
    if place.startswith("read-only"):
        monkeypatch.setattr(os, "access", lambda path, mode: False)  # as for who is not root
    monkeypatch.setattr(sys, "argv", ["benchmark", "--json", place])
    with pytest.raises(SystemExit) as end:
        harness.main(lambda arguments: pytest.fail("measured"), harness.BenchmarkArguments(), "")
    assert end.value.code == 2
    assert "wanted a place for it: --json FILE" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error", [PermissionError(13, "Permission denied", "/there/x"), OSError(30, "Read-only file system", b"/there/x")]
)
def test_a_file_that_cannot_be_used_is_one_line_and_a_bug_keeps_its_traceback(capsys, error: OSError):
    def fail(arguments) -> None:
        raise error

    def broken(arguments) -> None:
        raise OSError("no file at all")

    assert exit_code(fail, []) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"error: /there/x: got {error.strerror}; wanted ")
    assert len(said.splitlines()) == 1
    with pytest.raises(OSError, match="no file at all"):
        exit_code(broken, [])


@pytest.mark.parametrize("name", ["demo.pkl", "demo.npy", "demo", "demo.csv"])
def test_a_file_of_another_kind_is_named(workplace: Path, complaint, monkeypatch, name: str):
    monkeypatch.setenv("HOME", str(workplace / "home"))
    monkeypatch.delenv("MINARI_DATASETS_PATH", raising=False)
    np.save(workplace / "array.npy", np.zeros(3))
    (workplace / name).write_bytes((workplace / "array.npy").read_bytes())
    assert "wanted minari:ID, hdf5:PATH, npz:PATH, npz:FOLDER" in complaint(inspect_demos.run, name)
    assert "minari download" in complaint(inspect_demos.run, "no/such-v0")
    assert not (workplace / "home").exists(), "nothing is made in the user's home"


@pytest.mark.parametrize("content", [b"\x80\x02}q\x00.", b"PK\x03\x04"])
def test_a_checkpoint_of_another_program_is_named(workplace: Path, complaint, content: bytes):
    Path("model.pt").write_bytes(content)
    Path("folder").mkdir()
    (Path("folder") / "pytorch_model.bin").write_bytes(content)
    for place in ("model.pt", "folder"):
        printed = complaint(evaluate.run, "--checkpoint", place, "--runner", "local")
        assert f"--checkpoint: got '{place}'; wanted the folder of a run or of a checkpoint" in printed


def test_ray_that_does_not_come_up_is_one_line_and_leaves_nothing(monkeypatch, capsys):
    begun = []

    def slow(**options: object) -> None:
        wait = "import time; time.sleep(600)"
        begun.append(subprocess.Popen([sys.executable, "-c", wait, f"--temp-dir={options['_temp_dir']}"]))
        raise Exception("The current node timed out during startup.")

    import ray

    monkeypatch.setattr(ray, "init", slow)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)

    def join(arguments) -> None:
        with cluster.joined():
            raise AssertionError("not reached")

    assert exit_code(join, []) == 1
    said = capsys.readouterr().err
    assert "Ray does not start on this machine: Exception: The current node timed out" in said
    assert "--runner local" in said
    assert [psutil.pid_exists(process.pid) for process in begun] == [False] * 2
    assert not any(Path(str(process.args[-1]).partition("=")[2]).parent.exists() for process in begun)


def test_cpus_are_those_that_the_process_may_use():
    program = "from services.distributed.node_info import usable_cpus; print(usable_cpus())"
    first = str(min(os.sched_getaffinity(0)))
    found = subprocess.run(["taskset", "-c", first, sys.executable, "-c", program], capture_output=True, text=True)
    assert found.stdout.strip() == "1", found.stderr
    assert 1 <= usable_cpus() <= len(os.sched_getaffinity(0))


def test_cpus_are_those_that_the_control_group_grants():
    """Half a CPU is one, in a group of the kernel's own, which the process sees as a container sees its own."""
    group = Path("/sys/fs/cgroup/cpu") / f"test-{os.getpid()}"
    program = "from services.distributed.node_info import usable_cpus; print(usable_cpus())"
    own = "umount /sys/fs/cgroup/cpu && mount -t cgroup -o cpu none /sys/fs/cgroup/cpu"
    inside = f'{own} && exec {sys.executable} -c "{program}"'
    try:
        group.mkdir()
        (group / "cpu.cfs_quota_us").write_text("50000")
    except OSError as error:
        pytest.skip(f"no control group of version 1 can be made here: {error}")
    try:
        enter = f"echo $$ > {group}/cgroup.procs && exec unshare --cgroup --mount sh -c '{inside}'"
        found = subprocess.run(["sh", "-c", enter], capture_output=True, text=True)
        assert found.stdout.strip() == "1", found.stderr
    finally:
        group.rmdir()


def test_a_run_uses_no_more_cpus_than_it_may(monkeypatch):
    import ray

    asked: dict[str, object] = {}
    monkeypatch.setattr(ray, "init", lambda **options: asked.update(options))
    monkeypatch.setattr(ray, "shutdown", lambda: None)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(cluster, "usable_cpus", lambda: 1)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    handler = signal.getsignal(signal.SIGTERM)
    with cluster.joined():
        pass
    signal.signal(signal.SIGTERM, handler)
    assert asked["num_cpus"] == 1


def test_good_data_that_cannot_be_read_is_not_called_damaged(train, workplace: Path, monkeypatch, complaint):
    from services.demonstrations import store

    train("run")

    def refuse(*arguments: object) -> None:
        raise PermissionError(13, "Permission denied", "SHA256SUMS")

    monkeypatch.setattr(store, "check_listing", refuse)
    printed = complaint(meta_train.run, *TOY, *SHORT, "--name", "other")
    assert "Permission denied" in printed
    assert "collect again" not in printed
    assert json.loads((workplace / "runs" / "run" / "config.json").read_text())
