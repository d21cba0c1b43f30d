"""One experiment, two runners: in this process or on any number of Ray workers, the same bits come out."""

import os
import signal
from pathlib import Path

import numpy as np
import psutil
import pytest

from dmil_core.configs import ExperimentConfig
from dmil_core.networks import flatten
from dmil_core.outer_loop import OuterState, tasks_of
from services.demo_store import DemoStore
from services.experiment import Experiment, open_runner
from services.results import EpisodeResult
from services.runners import MetaTraining, RayRunner, Runner

ITERATIONS = 4


def training(config: ExperimentConfig, slots: int, group: int) -> ExperimentConfig:
    settings = {"iterations": ITERATIONS, "tasks_per_iteration": slots, "slots_per_group": group, "gradient_clip": 1.0}
    return config.model_copy(update={"training": config.training.model_copy(update=settings)})


def iterate(runner: Runner, experiment: Experiment, data, disturb=lambda iteration: None):
    """Return the learner's state, and the metrics and norms on the way, after a few iterations."""
    config = experiment.config
    sets = experiment.training_sets(data)
    method = experiment.method(sets)
    initial = experiment.initial_parameters(method)
    shapes = {name: tensor.shape for name, tensor in initial.items()}
    state = OuterState.start(flatten(initial).numpy())
    runner.start_training(MetaTraining(method, shapes, sets, state, config.training, config.seed))
    seen = []
    for iteration in range(ITERATIONS):
        disturb(iteration)
        tasks = tasks_of(iteration, experiment.suite.train_tasks, config.seed, config.training.tasks_per_iteration)
        seen.append(runner.iterate(iteration, tasks))
    state = runner.state()
    runner.end_training()
    return state, seen


def assert_same_bits(one, other) -> None:
    assert one[0].iteration == other[0].iteration == ITERATIONS
    assert all(map(np.array_equal, one[0][1:], other[0][1:]))
    assert one[1] == other[1]


@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize(("slots", "group", "workers"), [(5, 1, (1, 2, 3)), (7, 3, (2,))])
def test_any_number_of_workers_ends_with_the_same_bits(config, store: DemoStore, data, slots, group, workers):
    experiment = Experiment(training(config, slots, group), store)
    with open_runner("local", experiment.suite, None) as runner:
        alone = iterate(runner, experiment, data)
    assert np.isfinite(alone[0].parameters).all()
    assert len(alone[1][0][0]) == slots
    for count in workers:
        with open_runner("ray", experiment.suite, count) as runner:
            assert_same_bits(iterate(runner, experiment, data), alone)


def test_the_groups_are_part_of_the_result(config, store: DemoStore, data):
    """Else the test above would show nothing: the order of addition matters to the last bits."""
    found = []
    for group in (1, 3):
        experiment = Experiment(training(config, 7, group), store)
        with open_runner("local", experiment.suite, None) as runner:
            found.append(iterate(runner, experiment, data)[0].parameters)
    assert not np.array_equal(*found)
    assert np.allclose(*found, atol=1e-3)


def adaptation_workers() -> list[psutil.Process]:
    return [process for process in psutil.process_iter() if "ray::AdaptationWorker" in " ".join(cmdline(process))]


def cmdline(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


@pytest.mark.usefixtures("joined")
def test_a_killed_worker_changes_nothing(config, store: DemoStore, data, monkeypatch: pytest.MonkeyPatch):
    experiment = Experiment(training(config, 5, 1), store)
    with open_runner("local", experiment.suite, None) as runner:
        alone = iterate(runner, experiment, data)
    killed = []

    with open_runner("ray", experiment.suite, 2) as runner:
        assert isinstance(runner, RayRunner)

        def kill(iteration: int) -> None:
            if iteration == 2:
                assert runner._adaptation is not None
                (pid,) = runner._ray.get([runner._adaptation._actors[0].__ray_call__.remote(lambda _: os.getpid())])
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        pools = []
        start = runner.start_training
        monkeypatch.setattr(runner, "start_training", lambda *given: (start(*given), pools.append(runner._adaptation)))
        disturbed = iterate(runner, experiment, data, kill)
    assert (len(killed), [pool.restarts for pool in pools]) == (1, [1])
    assert not psutil.pid_exists(killed[0])
    assert_same_bits(disturbed, alone)


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
