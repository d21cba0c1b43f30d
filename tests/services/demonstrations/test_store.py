"""Demonstrations on disk: read back to the bit, readable with Minari, and never read when damaged."""

import json
import math
import os
import subprocess
import threading
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest

from dmil_core.checksums import write_listing
from dmil_core.configs import DemonstrationConfig, ExperimentConfig, SuiteConfig
from dmil_core.demonstrations import DemonstrationError
from dmil_core.trajectories import Episode
from services.demonstrations.store import DemoStore, TaskDemonstrations
from services.distributed.ray_runner import open_runner
from services.experiments.experiment import Experiment
from services.suites.metaworld import MetaWorldSuite
from services.suites.registry import open_suite

ID = "reach/scripted-test-v0"


@pytest.fixture
def attempts() -> list[Episode]:
    draw = np.random.default_rng(0)
    return [
        Episode(
            seed=10 + length,
            goal=[0.5, float(length)],
            solved_at=length - 2,
            observations=draw.normal(size=(length + 1, 5)).astype(np.float32),
            actions=draw.uniform(-1, 1, (length, 2)).astype(np.float32),
        )
        for length in (4, 9, 6)
    ]


@pytest.fixture
def saved(attempts: list[Episode], tmp_path: Path) -> TaskDemonstrations:
    return DemoStore(tmp_path).save(ID, "reach", attempts, failed=2, settings={"noise": 0.1})


def test_what_is_saved_is_loaded_to_the_bit(saved: TaskDemonstrations, attempts: list[Episode], tmp_path: Path):
    loaded = DemoStore(tmp_path).load(ID, "reach")
    assert loaded is not None
    assert (loaded.id, loaded.failed, loaded.digest) == (ID, 2, saved.digest)
    assert [demonstration.id for demonstration in loaded.demonstrations] == ["000", "001", "002"]
    for demonstration, attempt in zip(loaded.demonstrations, attempts, strict=True):
        assert demonstration.task == "reach"
        assert demonstration.observations.dtype == demonstration.actions.dtype == np.float32
        assert np.array_equal(demonstration.observations, attempt.observations[:-1])
        assert np.array_equal(demonstration.actions, attempt.actions)


def test_nothing_is_loaded_before_it_is_collected(tmp_path: Path):
    assert DemoStore(tmp_path).load(ID, "reach") is None


@pytest.mark.usefixtures("saved")
def test_minari_reads_it(attempts: list[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset(ID)
    assert dataset.total_episodes == len(attempts)
    assert dataset.total_steps == sum(len(attempt.actions) for attempt in attempts)
    for episode, attempt in zip(dataset.iterate_episodes(), attempts, strict=True):
        assert np.array_equal(episode.observations, attempt.observations)
        assert np.array_equal(episode.actions, attempt.actions)
        assert np.flatnonzero(episode.rewards).tolist() == [attempt.solved_at]


def flip_a_byte(path: Path) -> None:
    with h5py.File(path, "r") as file:
        array = file["episode_1/actions"]
        assert isinstance(array, h5py.Dataset)
        offset = array.id.get_offset() or array.id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[offset + 1] ^= 1
    path.write_bytes(content)


def reseal(folder: Path) -> None:
    """Have the digests say that all is as it was written."""
    write_listing(folder, "SHA256SUMS", ["data/main_data.hdf5", "data/metadata.json"])


def change_metadata(path: Path, **changes: object) -> None:
    metadata = path.with_name("metadata.json")
    found = {**json.loads(metadata.read_text()), **changes}
    metadata.write_text(json.dumps({key: value for key, value in found.items() if value is not None}))
    reseal(path.parents[1])


@pytest.mark.parametrize(
    "harm",
    [
        flip_a_byte,
        lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
        lambda path: path.write_bytes(b""),
        lambda path: path.unlink(),
        lambda path: path.with_name("metadata.json").unlink(),
        lambda path: path.with_name("metadata.json").write_text("{"),
        lambda path: change_metadata(path, digest=None),
        lambda path: change_metadata(path, total_episodes=4),
        lambda path: change_metadata(path, failed=-1),
        lambda path: (path.parents[1] / "SHA256SUMS").unlink(),
        lambda path: (path.parents[1] / "SHA256SUMS").write_text(""),
        lambda path: os.truncate(path, 10**13),
    ],
    ids=[
        "flipped byte",
        "truncated",
        "empty",
        "gone",
        "no metadata",
        "broken metadata",
        "no digest",
        "more episodes than there are",
        "impossible metadata",
        "no digests",
        "empty digests",
        "ten terabytes",
    ],
)
@pytest.mark.usefixtures("saved")
def test_a_damaged_data_set_is_refused_by_its_path(tmp_path: Path, harm):
    folder = tmp_path / ID
    harm(folder / "data" / "main_data.hdf5")
    with pytest.raises(DemonstrationError) as error:
        DemoStore(tmp_path).load(ID, "reach")
    assert str(folder) in str(error.value)
    assert "collect again" in str(error.value)


@pytest.mark.usefixtures("saved")
def test_what_the_digests_do_not_vouch_for_never_reaches_the_hdf5_library(tmp_path: Path, monkeypatch):
    flip_a_byte(tmp_path / ID / "data" / "main_data.hdf5")
    monkeypatch.setattr(h5py, "File", lambda *_: pytest.fail("opened all the same"))
    with pytest.raises(DemonstrationError, match="SHA-256"):
        DemoStore(tmp_path).load(ID, "reach")


@pytest.mark.usefixtures("saved")
def test_sha256sum_checks_a_data_set(tmp_path: Path):
    command = ["sha256sum", "--check", "--strict", "SHA256SUMS"]
    assert subprocess.run(command, cwd=tmp_path / ID, capture_output=True).returncode == 0
    flip_a_byte(tmp_path / ID / "data" / "main_data.hdf5")
    assert subprocess.run(command, cwd=tmp_path / ID, capture_output=True).returncode == 1


def put(name: str, value: np.ndarray):
    def edit(file: h5py.File) -> None:
        del file[name]
        file[name] = value

    return edit


def link_out(file: h5py.File) -> None:
    other = Path(file.filename).parents[3] / "other.hdf5"
    with h5py.File(other, "w") as elsewhere:
        elsewhere["secret"] = np.zeros((9, 2), np.float32)
    del file["episode_1/actions"]
    file["episode_1/actions"] = h5py.ExternalLink(str(other), "secret")


def blow_up(file: h5py.File) -> None:
    for name, shape in (("observations", (10**8 + 1, 5)), ("actions", (10**8, 2))):
        del file[f"episode_1/{name}"]
        file.create_dataset(f"episode_1/{name}", shape, "f4", compression="gzip")


EDITS = {
    "NaN": (put("episode_1/observations", np.full((10, 5), math.nan, np.float32)), "001 of reach: observations at"),
    "infinite": (put("episode_1/actions", np.full((9, 2), math.inf, np.float32)), "001 of reach: actions at step 0"),
    "double": (put("episode_1/actions", np.zeros((9, 2))), "episode_1/actions: got float64"),
    "one axis": (put("episode_1/actions", np.zeros(9, np.float32)), "episode_1/actions: got float32 of the shape (9,)"),
    "no step": (put("episode_0/actions", np.zeros((0, 2), np.float32)), "episode_0: got 5 observations of 0 actions"),
    "id twice": (lambda file: file["episode_1"].attrs.__setitem__("id", 0), "episode_1: got the id 0; wanted 1"),
    "outside": (link_out, "object 'secret' doesn't exist"),
    "bomb": (blow_up, "got arrays of 2800000"),
}


@pytest.mark.parametrize(("edit", "words"), EDITS.values(), ids=EDITS)
@pytest.mark.usefixtures("saved")
def test_what_cannot_be_learned_from_is_refused_by_name(tmp_path: Path, edit, words: str):
    with h5py.File(tmp_path / ID / "data" / "main_data.hdf5", "r+") as file:
        edit(file)
    reseal(tmp_path / ID)
    with pytest.raises(DemonstrationError) as error:
        DemoStore(tmp_path).load(ID, "reach")
    assert str(tmp_path / ID) in str(error.value)
    assert words in str(error.value)


def test_a_demonstration_that_cannot_be_learned_from_is_not_written(attempts: list[Episode], tmp_path: Path):
    attempts[1].observations[3, 2] = math.nan
    with pytest.raises(DemonstrationError, match="demonstration 001 of reach: observations at step 3 is not finite"):
        DemoStore(tmp_path).save(ID, "reach", attempts, failed=0, settings={})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dataset_id", ["../other", "/etc", "link/x"])
def test_a_data_set_lies_inside_the_root(tmp_path: Path, dataset_id: str):
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to(tmp_path)
    with pytest.raises(DemonstrationError, match=r"lies outside|got a link"):
        DemoStore(root).load(dataset_id, "reach")
    assert list(root.iterdir()) == [root / "link"]


def test_whoever_is_slower_takes_what_the_faster_one_wrote(attempts: list[Episode], tmp_path: Path, monkeypatch):
    writers = threading.Barrier(2)
    rename = os.rename

    def at_once(source: str, target: str, **folders: int) -> None:
        if source.startswith(".writing-"):
            writers.wait()
        rename(source, target, **folders)

    monkeypatch.setattr(os, "rename", at_once)
    found: list[TaskDemonstrations] = []

    def collect() -> None:
        found.append(DemoStore(tmp_path).save(ID, "reach", attempts, failed=2, settings={}))

    threads = [threading.Thread(target=collect) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [dataset.digest for dataset in found] == [found[0].digest] * 2
    assert [path.name for path in tmp_path.iterdir()] == ["reach"]
    assert DemoStore(tmp_path).load(ID, "reach") is not None


def test_other_settings_other_id():
    def name(task: str = "reach", suite: dict[str, object] | None = None, **settings: object) -> str:
        given = MetaWorldSuite(SuiteConfig.model_validate(suite or {}))
        return DemoStore.dataset_id(task, given, DemonstrationConfig.model_validate({"per_task": 50} | settings))

    others = [
        name("push"), name(suite={"horizon": 200}), name(suite={"goal_visible": False}), name(per_task=60),
        name(noise=0.2), name(trailing_steps=3), name(seed=1), name(labels="noisy"), name(longest="reference"),
    ]  # fmt: skip
    assert len({name(), *others}) == 10
    same = [name(held_out=10), name(source="npz:x.npz"), name(suite={"name": "ml45"}), name(suite={"horizon": 300})]
    assert {name(), *same, name(suite={"test_tasks": ("push-around-wall",)})} == {name()}
    assert name().startswith("metaworld/reach/scripted-")
    kitchens = (open_suite(SuiteConfig(name="kitchen", start_noise=noise)) for noise in (0.5, 1))
    ids = {DemoStore.dataset_id("microwave", kitchen, DemonstrationConfig()) for kitchen in kitchens}
    assert len(ids) == 2


def test_an_attempt_is_given_up_at_the_limit():
    given = DemonstrationConfig(longest="reference")
    assert [given.steps(task, 300) for task in ("reach", "peg-unplug-side", "bin-picking")] == [100, 140, 160]
    assert (given.steps("bin-picking", 120), DemonstrationConfig().steps("reach", 300)) == (120, 300)
    assert DemonstrationConfig(longest=40).steps("reach", 300) == 40


def digests(experiment: Experiment, kind, workers: int | None) -> dict[str, tuple[str, int]]:
    with open_runner(kind, experiment.suite, workers) as runner:
        return {task: (dataset.digest, dataset.failed) for task, dataset in experiment.collect(runner).items()}


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_whoever_collects_the_demonstrations_are_the_same(tmp_path: Path):
    settings = ExperimentConfig.model_validate(
        {
            "suite": {"train_tasks": ["reach", "basketball"], "test_tasks": ["door-close"], "horizon": 130},
            "demonstrations": {"per_task": 12, "held_out": 3},
            "evaluation": {"support_draws": 1},
        }
    )
    found = [
        digests(Experiment(settings, DemoStore(tmp_path / f"{kind}-{workers}")), kind, workers)
        for kind, workers in (("local", None), ("ray", 2))
    ]
    assert found[0] == found[1]
    assert any(failed for _, failed in found[0].values()), "no attempt failed: the test does not show what it could"


def test_an_expert_that_never_succeeds_is_given_up(tmp_path: Path, config: ExperimentConfig):
    suite = config.suite.model_copy(update={"horizon": 2, "train_tasks": ("reach",)})
    few = config.demonstrations.model_copy(update={"per_task": 5})
    hopeless = config.model_copy(update={"suite": suite, "demonstrations": few})
    experiment = Experiment(hopeless, DemoStore(tmp_path))
    with open_runner("local", experiment.suite, None) as runner, pytest.raises(DemonstrationError, match="task reach"):
        experiment.collect(runner)
    assert not list(tmp_path.iterdir())


def goals(demonstrations) -> set[tuple[float, ...]]:
    """Return where object and goal of each demonstration are at its start."""
    return {tuple(demonstration.observations[0, [4, 5, 6, -3, -2, -1]]) for demonstration in demonstrations}


def test_training_and_support_demonstrations_are_disjoint(experiment: Experiment, data):
    training, held_out = experiment.training_sets(data), experiment.held_out_sets(data)
    settings = experiment.config.demonstrations
    assert set(training) == set(experiment.suite.train_tasks)
    assert set(held_out) == {*experiment.suite.train_tasks, *experiment.suite.test_tasks}
    for demonstrations in held_out.values():
        assert len(goals(demonstrations)) == len(demonstrations) == settings.held_out
    for task, demonstrations in training.items():
        assert len(goals(demonstrations)) == len(demonstrations) == settings.per_task - settings.held_out
        assert goals(demonstrations).isdisjoint(goals(held_out[task]))
