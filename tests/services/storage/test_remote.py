"""Storages that all machines reach: a folder, and a real S3 server on loopback."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from dmil_core.checkpoint import MARKER, Checkpoint
from dmil_core.configs import PRESETS
from dmil_core.errors import RunError, UserError
from services import meta_train
from services.demonstrations.store import DemoStore, open_store
from services.distributed.ray_runner import open_runner
from services.experiments.experiment import Experiment
from services.storage.checkpoints import Checkpoints
from services.storage.remote import STORAGE, Storage
from services.storage.replication import Replica, replicated
from tests.services.programs import QUICK_EVALUATION

S3 = {"AWS_ACCESS_KEY_ID": "any", "AWS_SECRET_ACCESS_KEY": "any", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="module")
def server(free_port: Callable[[], int], answers, wait_for, tmp_path_factory) -> Iterator[str]:
    """The address of an S3 server, empty at first."""
    port = free_port()
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with (tmp_path_factory.mktemp("s3") / "log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    wait_for(lambda: answers(f"http://127.0.0.1:{port}"), "the S3 server")
    yield f"http://127.0.0.1:{port}"
    process.terminate()
    process.wait()


@pytest.fixture(params=[pytest.param("file", marks=pytest.mark.thorough), "s3"])
def url(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A storage of each kind, which programs receive too."""
    if request.param == "file":
        url = (tmp_path / "storage").as_uri()
    else:
        for name, value in {**S3, "AWS_ENDPOINT_URL": request.getfixturevalue("server")}.items():
            monkeypatch.setenv(name, value)
        url = f"s3://bucket-{os.urandom(4).hex()}/lab"
        files, _ = fsspec.core.url_to_fs(url)
        files.mkdir(url.split("/")[2])
    monkeypatch.setenv(STORAGE, url)
    yield url
    fsspec.filesystem(request.param).clear_instance_cache()


def names(storage: Storage) -> set[str]:
    """Return the seals that are there."""
    return set(storage.committed("runs/run/checkpoints", MARKER, r"iteration-\d+"))


def test_a_sealed_folder_is_whole_or_not_there(url: str, tmp_path: Path):
    storage = Storage(url)
    assert storage.get("a/b", 10) is None
    assert storage.committed("a", "seal", ".*") == {}
    storage.put_folder("a/b", {"seal": b"s", "one": b"1", "deep/two": b"22"}, "seal")
    assert storage.committed("a", "seal", ".*") == {"b": b"s"}
    assert storage.committed("a", "seal", "c") == {}
    assert storage.get_folder("a/b", tmp_path, "here", {"one": 1, "deep/two": 2}, "seal")
    assert (tmp_path / "here" / "deep" / "two").read_bytes() == b"22"
    with pytest.raises(RunError, match="got 2 bytes; wanted at most 1"):
        storage.get_folder("a/b", tmp_path, "other", {"deep/two": 1}, "seal")
    with pytest.raises(RunError, match="three: got nothing"):
        storage.get_folder("a/b", tmp_path, "other", {"three": 1}, "seal")
    assert {path.name for path in tmp_path.iterdir()} <= {"here", "storage"}
    storage.put("a/c/one", b"unsealed")
    assert not storage.get_folder("a/c", tmp_path, "other", {"one": 10}, "seal")
    assert storage.committed("a", "seal", ".*") == {"b": b"s"}
    storage.remove("a/b", "seal")
    storage.remove("a/never", "seal")
    assert storage.committed("a", "seal", ".*") == {}


def test_a_run_goes_on_elsewhere_to_the_same_bits(url: str, train, workplace: Path, monkeypatch, capsys):
    whole = train("whole", "--training.iterations", "8", "--training.checkpoint-every", "2")
    train("run", "--training.iterations", "6", "--training.checkpoint-every", "2", "--training.checkpoints-kept", "1")
    local = {path.name for path in (workplace / "runs" / "run" / "checkpoints").iterdir()}
    assert names(Storage(url)) == local
    shutil.rmtree(workplace / "runs" / "run")
    capsys.readouterr()
    resumed = train("run", "--training.iterations", "8", resume=True)
    assert f"fetched from {url}" in capsys.readouterr().out
    np.testing.assert_array_equal(resumed.state.parameters, whole.state.parameters)
    assert "iteration-0000008" in names(Storage(url))
    summary = Storage(url).get("runs/run/summary.json", 10**6)
    assert summary == (workplace / "runs" / "run" / "summary.json").read_bytes()


@pytest.mark.thorough
def test_a_run_whose_folder_is_as_far_is_left_alone(url: str, train, workplace: Path, capsys):
    train("run", "--training.iterations", "2")
    capsys.readouterr()
    train("run", "--training.iterations", "3", resume=True)
    assert "fetched" not in capsys.readouterr().out


def test_of_two_writers_of_a_file_one_is_told_that_it_is_another_s(url: str):
    storage = Storage(url)
    assert storage.create("runs/run/claim", b"one", 10) == b"one"
    assert storage.create("runs/run/claim", b"other", 10) == b"one"
    assert storage.create("runs/run/claim", b"one", 10) == b"one"


class WithoutNew(MemoryFileSystem):
    """Files in memory, of a library that has no mode for a file that must not be there yet."""

    protocol = "without-new"

    def _open(self, path, mode="rb", block_size=None, autocommit=True, cache_options=None, **kwargs):
        if "x" in mode:
            raise NotImplementedError(mode)
        return super()._open(path, mode, block_size, autocommit, cache_options, **kwargs)


def test_a_file_is_made_once_too_where_no_mode_is_for_that():
    fsspec.register_implementation("without-new", WithoutNew, clobber=True)
    storage = Storage("without-new://a-lab")
    assert storage.create("runs/run/claim", b"one", 10) == b"one"
    assert storage.create("runs/run/claim", b"other", 10) == b"one"


def stored(storage: Storage) -> list[bytes | None]:
    files = [f"runs/run/checkpoints/{name}/{MARKER}" for name in sorted(names(storage))]
    return [storage.get(name, 10**6) for name in (*files, "runs/run/config.json", "runs/run/claim")]


def test_a_name_that_is_taken_in_the_storage_is_refused(url: str, train, complaint, workplace: Path, monkeypatch):
    train("run", "--training.iterations", "2")
    before = stored(Storage(url))
    monkeypatch.chdir(workplace)
    arguments = ("--preset", "ml10-smoke", "--runner", "local", "--name", "run", "--seed", "1")
    said = complaint(meta_train.run, *arguments, "--runs", "elsewhere")
    assert f"--name: got run, which another run has in {url}" in said
    assert "--resume run" in said
    assert not list(Path("elsewhere").iterdir())
    assert stored(Storage(url)) == before
    Storage(url).remove("runs/run", "claim")
    Storage(url).put("runs/run/config.json", b"of an older version, without a claim")
    assert "which another run has" in complaint(meta_train.run, *arguments, "--runs", "elsewhere")


def test_a_copy_of_another_run_is_neither_replaced_nor_fetched(url: str, shared_run, workplace: Path, monkeypatch):
    monkeypatch.delenv(STORAGE)
    source = shared_run("after-2", "--training.iterations", "2", *QUICK_EVALUATION)
    storage, ours = Storage(url), Path(shutil.copytree(source, workplace / "one" / "run"))
    Replica(ours, storage).copy()
    before = stored(storage)
    theirs = Path(shutil.copytree(shared_run("after-0", "--training.iterations", "0", *QUICK_EVALUATION), "run"))
    for _ in range(2):  # a storage that was away at its start is asked later
        with pytest.raises(UserError, match="which another run has"):
            Replica(theirs, storage).copy()
    assert not Replica(theirs, storage).restore()
    assert stored(storage) == before
    shutil.rmtree(ours)
    assert Replica(ours, storage).restore()
    Replica(ours, storage).copy()


KILLED = """
import os, signal, sys
from pathlib import Path
from services.storage.replication import Replica
from services.storage.remote import Storage

class Dying(Storage):
    left = int(sys.argv[3])
    def put(self, name, content):
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        self.left -= 1
        super().put(name, content)

Replica(Path(sys.argv[1]), Dying(sys.argv[2])).copy()
"""


@pytest.mark.parametrize("parts", [0, *(pytest.param(parts, marks=pytest.mark.thorough) for parts in (1, 5, 6, 10)), 8])
def test_killed_between_parts_it_leaves_whole_checkpoints_only(
    url: str, shared_run, workplace: Path, monkeypatch, parts: int
):
    """What was measured, then two checkpoints of five parts each: the newest that is whole is gone on from."""
    monkeypatch.delenv(STORAGE)
    twice = ("--training.iterations", "4", "--training.checkpoint-every", "2", *QUICK_EVALUATION)
    folder = Path(shutil.copytree(shared_run("saved-twice", *twice), workplace / "runs" / "run"))
    storage = Storage(url)
    first, second = sorted(path.name for path in (folder / "checkpoints").iterdir())
    killed = subprocess.run([sys.executable, "-c", KILLED, str(folder), url, str(parts)])
    assert killed.returncode == -signal.SIGKILL
    assert names(storage) == set([first, second][: max(0, parts - 1) // 5])
    elsewhere = workplace / "elsewhere" / "run"
    assert not Replica(elsewhere, storage).restore()  # the settings come last of all
    Replica(folder, storage).copy()
    assert names(storage) == {first, second}
    assert Replica(elsewhere, storage).restore()
    found = Checkpoints(elsewhere / "checkpoints", kept=1).newest()
    assert found.digest == Checkpoint(folder / "checkpoints" / second).digest


def test_what_was_changed_in_the_storage_is_refused_by_name(url: str, train, workplace: Path, logged):
    train("run", "--training.iterations", "2")
    storage, elsewhere = Storage(url), workplace / "elsewhere" / "run"
    name = max(names(storage))
    storage.put(f"runs/run/checkpoints/{name}/parameters.safetensors", b"other")
    with pytest.raises(RunError, match="got no whole checkpoint"):
        Replica(elsewhere, storage).restore()
    assert any("parameters.safetensors: got 5 bytes" in line for line in logged())
    assert not (elsewhere / "checkpoints" / name).exists()


def test_demonstrations_are_fetched_in_place_of_collected_anew(
    url: str, store: DemoStore, workplace: Path, monkeypatch
):
    experiment = Experiment(PRESETS["ml10-smoke"], store)

    def collected(root: str) -> dict[str, str]:
        monkeypatch.setenv("DMIL_DATA", str(workplace / root))
        with open_runner("local", experiment.suite, None) as runner:
            found = Experiment(experiment.config, open_store()).collect(runner)
        return {task: dataset.digest for task, dataset in found.items()}

    first = collected("one")
    began = time.time()
    assert collected("two") == first
    arrays = list((workplace / "two").rglob("main_data.hdf5"))
    assert len(arrays) == len(first)
    originals = {path.relative_to(workplace / "one"): path.read_bytes() for path in (workplace / "one").rglob("*.hdf5")}
    fetched = {path.relative_to(workplace / "two"): path.read_bytes() for path in arrays}
    assert fetched == originals  # HDF5 has times in it: the same bytes were not made twice
    assert all(path.stat().st_mtime >= began - 1 for path in arrays)


def test_a_storage_that_is_away_is_reported_once_and_stops_nothing(
    workplace: Path, monkeypatch, free_port, train, capsys
):
    for name, value in {**S3, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{free_port()}", "AWS_MAX_ATTEMPTS": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv(STORAGE, "s3://bucket/lab")
    train("run", "--training.iterations", "2")
    said = capsys.readouterr().out
    assert "s3://bucket/lab does not take the copy of" in said
    assert "has no whole copy of" in said
    assert (workplace / "runs" / "run" / "summary.json").exists()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("nothing://bucket", "DMIL_STORAGE: got nothing://bucket"),
        ("gs://bucket/lab", "pip install gcsfs"),
        ("s3://", "DMIL_STORAGE: got s3://, which names no folder and no bucket; wanted a URL as "),
        ("bucket/lab", "DMIL_STORAGE: got bucket/lab, which names no folder"),
    ],
)
def test_a_url_that_names_no_storage_is_a_mistake(url: str, message: str, monkeypatch, workplace: Path, complaint):
    monkeypatch.setenv(STORAGE, url)
    with pytest.raises(UserError), replicated(workplace / "run"):
        pass
    assert message in complaint(meta_train.run, "--preset", "ml10-smoke", "--runner", "local")
