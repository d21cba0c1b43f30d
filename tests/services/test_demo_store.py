"""Demonstrations on disk: read back to the bit, readable with Minari, and never read when damaged."""

import json
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest

from dmil_core.configs import DemonstrationConfig, ExperimentConfig, SuiteConfig
from dmil_core.demonstrations import DemonstrationError
from services.demo_store import DemoStore, TaskDemonstrations
from services.experiment import Experiment, open_runner
from services.suites.base import Attempt

ID = "reach/scripted-test-v0"


@pytest.fixture
def attempts() -> list[Attempt]:
    draw = np.random.default_rng(0)
    return [
        Attempt(
            seed=10 + length,
            goal=[0.5, float(length)],
            solved_at=length - 2,
            observations=draw.normal(size=(length + 1, 5)).astype(np.float32),
            actions=draw.uniform(-1, 1, (length, 2)).astype(np.float32),
        )
        for length in (4, 9, 6)
    ]


@pytest.fixture
def saved(attempts: list[Attempt], tmp_path: Path) -> TaskDemonstrations:
    return DemoStore(tmp_path).save(ID, "reach", attempts, failed=2, settings={"noise": 0.1})


def test_what_is_saved_is_loaded_to_the_bit(saved: TaskDemonstrations, attempts: list[Attempt], tmp_path: Path):
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
def test_minari_reads_it(attempts: list[Attempt], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
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


def forget_the_digest(path: Path) -> None:
    metadata = path.with_name("metadata.json")
    metadata.write_text(json.dumps({k: v for k, v in json.loads(metadata.read_text()).items() if k != "digest"}))


@pytest.mark.parametrize(
    "harm",
    [
        flip_a_byte,
        lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
        lambda path: path.write_bytes(b""),
        lambda path: path.unlink(),
        lambda path: path.with_name("metadata.json").unlink(),
        lambda path: path.with_name("metadata.json").write_text("{"),
        forget_the_digest,
    ],
    ids=["flipped byte", "truncated", "empty", "gone", "no metadata", "broken metadata", "no digest"],
)
@pytest.mark.usefixtures("saved")
def test_a_damaged_data_set_is_refused_by_its_path(tmp_path: Path, harm):
    folder = tmp_path / ID / "data"
    harm(folder / "main_data.hdf5")
    with pytest.raises(DemonstrationError) as error:
        DemoStore(tmp_path).load(ID, "reach")
    assert str(folder) in str(error.value)
    assert "collect again" in str(error.value)


def test_other_settings_other_id():
    def name(task: str = "reach", horizon: int = 300, **settings: float) -> str:
        return DemoStore.dataset_id(
            task, SuiteConfig(horizon=horizon), DemonstrationConfig.model_validate({"per_task": 50} | settings)
        )

    others = [
        name("push"), name(horizon=200), name(per_task=60), name(noise=0.2), name(trailing_steps=3), name(seed=1)
    ]  # fmt: skip
    assert len({name(), *others}) == 7
    assert name() == name(held_out=10), "which are held out does not change what is collected"


def test_what_a_policy_may_see_is_part_of_the_id_and_the_rest_of_the_suite_is_not():
    def name(**settings: object) -> str:
        return DemoStore.dataset_id("reach", SuiteConfig.model_validate(settings), DemonstrationConfig())

    assert name() == "reach/scripted-5a967c1797-v1", "data sets that are there would be collected again"
    assert name() == name(name="ml45") == name(horizon=300) == name(test_tasks=("push-around-wall",))
    assert name(protocol="benchmark") == name(horizon=500) != name()
    assert name(goal_visible=False) != name()


def digests(experiment: Experiment, kind, workers: int | None) -> dict[str, tuple[str, int]]:
    with open_runner(kind, experiment.suite, workers) as runner:
        return {task: (dataset.digest, dataset.failed) for task, dataset in experiment.collect(runner).items()}


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
        for kind, workers in (("local", None), ("ray", 1), ("ray", 2))
    ]
    assert found[0] == found[1] == found[2]
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
