"""One experiment, two runners: in this process or on any number of Ray workers, the same bits come out."""

import os
import signal
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import torch

from dmil_core.devices import Compute
from dmil_core.outer_loop import add, groups
from dmil_core.settings import GradientPath
from services.demonstrations.store import DemoStore
from services.distributed.adaptation_worker import AdaptationWorker, Block
from services.distributed.chunking import CHUNK_LENGTH, from_chunks, to_chunks
from services.distributed.cluster import RunnerKind
from services.distributed.learner import Learner
from services.distributed.ray_meta_training import RayMetaTraining
from services.distributed.ray_runner import open_runner
from services.distributed.runner import Runner
from services.distributed.timing import Span, Timing
from services.evaluation.results import EpisodeResult
from services.experiments.experiment import Experiment
from tests.services.distributed.courses import ITERATIONS, Course, alone, assert_same_bits, follow, plan_of, training


def cut(groups: int, size: int) -> list[slice]:
    return [slice(first, first + size) for first in range(0, groups, size)]


@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize(
    ("slots", "group", "workers", "fan_in"),
    [(7, 3, 3, 2), pytest.param(5, 1, 1, 8, marks=pytest.mark.thorough)],
)
def test_any_number_of_workers_ends_with_the_same_bits(
    config, store: DemoStore, data, slots: int, group: int, workers: int, fan_in: int
):
    experiment = Experiment(training(config, slots, group), store)
    wanted = alone(experiment, data)
    assert np.isfinite(wanted.states[-1].parameters).all()
    assert wanted.numbers == [state.iteration for state in wanted.states] == list(range(1, ITERATIONS + 1))
    assert len(wanted.slots[0]) == slots
    plan = plan_of(experiment, data)
    with open_runner("ray", experiment.suite, workers):
        assert_same_bits(follow(RayMetaTraining(plan, workers, fan_in)), wanted)


def test_groups_at_once_give_the_same_bits_whoever_computes_which(config, store: DemoStore, data):
    plan = plan_of(Experiment(training(config, 6, 2), store), data)
    every, threads = groups(plan.settings), torch.get_num_threads()

    def gradient(*some: range, path: GradientPath = "batched") -> list[np.ndarray]:
        given = plan.method, plan.shapes, plan.demonstrations, plan.seed, None, Compute("cpu", path)
        block = Block(0, plan.tasks(0), some)
        return list(AdaptationWorker(*given).gradient(to_chunks(plan.state.parameters), block)[1])

    whole, parts = gradient(*every), [gradient(one) for one in every]
    total = [add(chunks) for chunks in zip(*parts, strict=True)]
    torch.set_num_threads(threads)
    assert all(map(np.array_equal, total, whole))
    for one, other in zip(whole, gradient(*every, path="loop"), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")
@pytest.mark.usefixtures("joined")
def test_several_workers_on_one_card_end_with_the_same_bits(config, store: DemoStore, data):
    experiment, courses = Experiment(training(config, 6, 2), store), []
    runners: list[tuple[RunnerKind, int | None]] = [("local", None), ("ray", 3)]
    for kind, workers in runners:
        with open_runner(kind, experiment.suite, workers, Compute("cuda")) as runner:
            courses.append(follow(runner.meta_train(plan_of(experiment, data))))
    assert np.isfinite(courses[0].states[-1].parameters).all()
    assert_same_bits(*courses)


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_neither_the_fan_in_nor_the_blocks_change_a_bit(
    config, store: DemoStore, data, monkeypatch: pytest.MonkeyPatch
):
    experiment = Experiment(training(config, 11, 1), store)
    wanted = alone(experiment, data)
    all_groups = groups(experiment.config.training)
    blocks = [all_groups[part] for part in cut(len(all_groups), 4)]
    monkeypatch.setattr(RayMetaTraining, "blocks", blocks, raising=True)
    with open_runner("ray", experiment.suite, 2):
        assert_same_bits(follow(RayMetaTraining(plan_of(experiment, data), 2, 8)), wanted)


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_going_on_after_a_pause_changes_nothing(config, store: DemoStore, data):
    experiment = Experiment(training(config, 5, 1), store)
    wanted = alone(experiment, data)
    with open_runner("ray", experiment.suite, 2) as runner:
        meta_training = runner.meta_train(plan_of(experiment, data))
        parts = [follow(meta_training, count) for count in (1, 0, ITERATIONS - 1)]
    assert_same_bits(Course(*(list(chain(*lists)) for lists in zip(*parts, strict=True))), wanted)


def test_the_groups_are_part_of_the_result(config, store: DemoStore, data):
    """Else the tests above would show nothing: the order of addition matters to the last bits."""
    found = []
    for group in (1, 3):
        experiment = Experiment(training(config, 7, group), store)
        found.append(alone(experiment, data).states[-1].parameters)
    assert not np.array_equal(*found)
    assert np.allclose(*found, atol=1e-3)


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize("where", ["gradient", "add"])
def test_a_killed_worker_changes_nothing(
    config, store: DemoStore, data, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Between two iterations `test_methods` kills one."""
    experiment = Experiment(training(config, 5, 1), store)
    wanted = alone(experiment, data)
    note = tmp_path / "killed"

    class Mortal(AdaptationWorker):
        """One of them is killed in the middle of its work, in the third iteration."""

        _iteration = 0

        def gradient(self, parameters, block, previous=()):
            if where == "gradient" and block.iteration == 2:
                self._die_once()
            self._iteration = block.iteration
            return super().gradient(parameters, block, previous)

        def add(self, *gradients):
            if where == "add" and self._iteration >= 2:
                self._die_once()
            return super().add(*gradients)

        def _die_once(self):
            try:
                note.touch(exist_ok=False)
            except FileExistsError:
                return
            os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr("services.distributed.ray_meta_training.AdaptationWorker", Mortal)
    with open_runner("ray", experiment.suite, 2) as runner:
        meta_training = runner.meta_train(plan_of(experiment, data))
        disturbed = follow(meta_training)
    assert note.exists()
    assert isinstance(meta_training, RayMetaTraining)
    assert meta_training.counter.count.restarted == 1
    assert_same_bits(disturbed, wanted)


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_the_learner_receives_one_gradient(config, store: DemoStore, data, monkeypatch: pytest.MonkeyPatch):
    class Strict(Learner):
        def step(self, gradient):
            assert [len(piece) for piece in gradient] == [len(piece) for piece in self.parameters()[1]]
            return super().step(gradient)

    monkeypatch.setattr("services.distributed.ray_meta_training.Learner", Strict)
    experiment = Experiment(training(config, 9, 1), store)
    with open_runner("ray", experiment.suite, 3):
        meta_training = RayMetaTraining(plan_of(experiment, data), 3, fan_in=2)
        assert follow(meta_training).numbers == list(range(1, ITERATIONS + 1))


def test_the_local_runner_gives_torch_its_threads_back(experiment: Experiment, monkeypatch: pytest.MonkeyPatch):
    threads = [3]
    monkeypatch.setattr("torch.get_num_threads", lambda: threads[-1])
    monkeypatch.setattr("torch.set_num_threads", threads.append)
    with open_runner("local", experiment.suite, None):
        assert threads[-1] == 1
    assert threads[-1] == 3


@pytest.mark.parametrize("size", [1, CHUNK_LENGTH, CHUNK_LENGTH + 1, 3 * CHUNK_LENGTH])
def test_chunks_concatenate_to_the_vector(size: int):
    vector = np.random.default_rng(0).normal(size=size).astype(np.float32)
    chunks = to_chunks(vector)
    assert all(len(chunk) <= CHUNK_LENGTH for chunk in chunks)
    assert np.array_equal(from_chunks(chunks), vector)
    assert not any(np.shares_memory(chunk, from_chunks(chunks)) for chunk in chunks)


def test_the_time_of_an_iteration_is_divided_up_whole():
    work = {0: [Span(11, 13), Span(13.5, 15)], 4: [Span(12, 14)]}
    timing = Timing.of(10, work, Span(17, 18))
    assert timing == Timing(broadcast=1.5, compute=2.75, waiting=0.75, reduction=2, step=1)
    assert timing.iteration == 8
    assert timing.overhead_share == 1 - 3.75 / 8


def episodes_of(runner: Runner, experiment: Experiment, data, checkpoint, folder: Path) -> list[EpisodeResult]:
    folder.mkdir()
    found = experiment.evaluate(runner, data, checkpoint, folder)
    written = [EpisodeResult.model_validate_json(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    assert written == found.episodes
    return written


@pytest.mark.usefixtures("joined")
def test_the_rows_of_an_evaluation_do_not_depend_on_who_simulates(experiment, data, train, tmp_path: Path):
    checkpoint = train("base", "--training.iterations", "2")
    with open_runner("local", experiment.suite, None) as runner:
        local = episodes_of(runner, experiment, data, checkpoint, tmp_path / "local")
    with open_runner("ray", experiment.suite, 2) as runner:
        assert episodes_of(runner, experiment, data, checkpoint, tmp_path / "ray") == local
    settings = experiment.config.evaluation
    assert len(local) == len(experiment.tasks) * len(settings.shots) * settings.episodes
