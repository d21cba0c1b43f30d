"""Whatever is killed, hangs or goes wrong in meta-training: the same bits come out, or what went wrong is named."""

import json
import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from ray.cluster_utils import Cluster as Nodes

from dmil_core.configs import ExperimentConfig
from dmil_core.errors import WorkError
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.method import Dmil
from dmil_core.methods.registry import OURS
from dmil_core.trajectories import Episode
from services import meta_train, reproduce
from services.cli.arguments import exit_code
from services.demonstrations.store import DemoStore, TaskDemonstrations
from services.distributed.failures import read_failure
from services.distributed.ray_meta_training import RayMetaTraining
from services.distributed.ray_runner import RayRunner, open_runner
from services.distributed.runner import LocalRunner
from services.distributed.simulation_worker import SimulationWorker
from services.experiments.experiment import Experiment
from services.experiments.meta_training import CollapseWatch
from services.storage.checkpoints import Checkpoints
from tests.services.distributed.courses import ITERATIONS, alone, assert_same_bits, follow, pid_of, plan_of, training

SLOTS = 5


@pytest.fixture
def small(config: ExperimentConfig, store: DemoStore) -> Experiment:
    return Experiment(training(config, SLOTS, 1), store)


# Killed and hung


@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=[pytest.mark.thorough, pytest.mark.alone])]
)
def test_a_lost_learner_changes_nothing(small: Experiment, data, how: int, monkeypatch: pytest.MonkeyPatch):
    if how == signal.SIGSTOP:
        monkeypatch.setattr("services.distributed.stragglers.MIN_OUTSIDE_TIMEOUT_SECONDS", 2.0)
        monkeypatch.setattr("services.distributed.stragglers.INITIAL_TIMEOUT_SECONDS", 20.0)
    wanted = alone(small, data)
    with open_runner("ray", small.suite, 2) as runner:
        meta_training = runner.meta_train(plan_of(small, data))
        assert isinstance(meta_training, RayMetaTraining)

        def strike(done: int) -> None:
            if done in (1, 3):
                os.kill(pid_of(meta_training._learner), how)

        found = follow(meta_training, disturb=strike)
    assert_same_bits(found, wanted)


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_what_was_done_since_the_last_state_is_done_again(small: Experiment, data):
    wanted = alone(small, data)
    with open_runner("ray", small.suite, 2) as runner:
        meta_training = runner.meta_train(plan_of(small, data))
        assert isinstance(meta_training, RayMetaTraining)
        numbers = []
        for iteration in meta_training.iterations(ITERATIONS):
            numbers.append(iteration.number)
            assert iteration.slots == wanted.slots[iteration.number - 1]
            if iteration.number == 3:
                os.kill(pid_of(meta_training._learner), signal.SIGKILL)
        state = meta_training.state()
    assert numbers == list(range(1, ITERATIONS + 1))
    assert all(map(np.array_equal, state[1:], wanted.states[-1][1:]))


@pytest.mark.thorough
@pytest.mark.alone
@pytest.mark.usefixtures("joined")
def test_a_hung_worker_is_overtaken_and_the_log_says_so(
    small: Experiment, data, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr("services.distributed.stragglers.MIN_TIMEOUT_SECONDS", 0.5)
    wanted = alone(small, data)
    with open_runner("ray", small.suite, 2) as runner:
        meta_training = runner.meta_train(plan_of(small, data))
        assert isinstance(meta_training, RayMetaTraining)

        # Asked beforehand: an actor that waits for the gradient of one that hangs does not answer.
        pids = [pid_of(worker.actor) for worker in meta_training._pool._workers]

        def strike(done: int) -> None:
            if done in (2, 3):
                os.kill(pids[done % 2], signal.SIGSTOP)

        found = follow(meta_training, disturb=strike)
    assert_same_bits(found, wanted)
    assert "is slow: iteration " in caplog.text
    assert "a backup runs it too" in caplog.text


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_a_slot_that_ends_its_workers_is_named(small: Experiment, data):
    class Deadly(Dmil):
        def task_gradient(self, parameters, batch):
            if batch.task == "push" and len(list(folder.iterdir())) >= 2:
                os.kill(os.getpid(), signal.SIGSEGV)
            if batch.task == "push":
                (folder / str(time.time())).touch()
            return super().task_gradient(parameters, batch)

    plan = plan_of(small, data)
    folder = small.store.root / "seen"
    folder.mkdir()
    method = plan.method
    assert isinstance(method, Dmil)
    deadly = plan._replace(method=Deadly(method.config, method.action_dim, method.normalise))
    with open_runner("ray", small.suite, 2) as runner:
        meta_training = runner.meta_train(deadly)
        with pytest.raises(WorkError, match=r"iteration \d, slot \d, task push, seed 0: .*3 workers ended") as error:
            follow(meta_training)
        key = error.value.key
        assert deadly.tasks(int(key["iteration"]))[int(key["slot"])] == "push"
        assert meta_training.state().iteration == key["iteration"]


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_a_trial_that_ends_its_workers_is_named(
    train, workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    train("run", "--training.iterations", "1")

    class Deadly(SimulationWorker):
        def run(self, item):
            if item.key["task"] == "push":
                os.kill(os.getpid(), signal.SIGKILL)
            return super().run(item)

    monkeypatch.setattr("services.distributed.ray_runner.SimulationWorker", Deadly)
    assert exit_code(meta_train.run, ["--resume", "run", "--runner", "ray", "--workers", "2"]) == 1
    said = capsys.readouterr().err
    assert "meta-training task push, 1-shot, support set 0" in said
    assert "3 workers ended in the course of it" in said
    assert read_failure(Path("runs/run")).piece["task"] == "push"


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Nodes]:
    folder = Path("/tmp") / f"dmil-{os.getpid()}"  # Ray's sockets lie in it: a path of over 107 bytes is too long
    (folder / "ray").mkdir(parents=True)
    monkeypatch.setenv("RAY_TMPDIR", str(folder))
    settings = {"object_store_memory": 100_000_000, "include_dashboard": False}
    nodes = Nodes(initialize_head=True, head_node_args={"num_cpus": 2, **settings})
    monkeypatch.setenv("RAY_ADDRESS", str(nodes.address))
    yield nodes
    nodes.shutdown()
    shutil.rmtree(folder)


@pytest.mark.thorough
@pytest.mark.parametrize("asked", [None, 4])
def test_nodes_may_leave_and_join(
    config: ExperimentConfig, store: DemoStore, data, nodes: Nodes, wait_for, asked: int | None
):
    several = Experiment(training(config, 7, 1), store)
    wanted = alone(several, data)
    leaving = nodes.add_node(num_cpus=1, object_store_memory=100_000_000)
    with open_runner("ray", several.suite, asked) as runner:
        assert isinstance(runner, RayRunner)
        assert runner.workers == 3
        meta_training = runner.meta_train(plan_of(several, data))
        assert isinstance(meta_training, RayMetaTraining)
        up = [len(meta_training)]

        def joined() -> bool:
            meta_training._pool.grow(meta_training._wanted_workers)
            meta_training._pool.poll()
            return len(meta_training) == 4

        def change(done: int) -> None:
            if done == 1:
                nodes.remove_node(leaving, allow_graceful=False)
                wait_for(lambda: runner.workers == 2, "the node to leave")
            if done == 3:  # what the lost worker was to do for the third was done by another
                up.append(len(meta_training))
                nodes.add_node(num_cpus=2, object_store_memory=100_000_000)
                wait_for(joined, "workers on the new node")
                up.append(len(meta_training))

        found = follow(meta_training, disturb=change)
        assert runner.workers == 4
    assert up == [3, 2, 4]
    assert_same_bits(found, wanted)


# Errors in the work


class FailingDmil(Dmil):
    """Fails at a task, from the third iteration on."""

    calls = 0

    def task_gradient(self, parameters, batch):
        FailingDmil.calls += 1
        if FailingDmil.calls > 2 * 3 and batch.task == "push":
            raise ArithmeticError("out of numbers")
        return super().task_gradient(parameters, batch)


def test_an_error_is_reported_with_the_command_that_repeats_it(
    train, workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(OURS, "dmil", FailingDmil)
    monkeypatch.setattr(FailingDmil, "calls", 0)
    arguments = ["--preset", "ml10-smoke", "--runner", "local", "--name", "run"]
    assert exit_code(meta_train.run, arguments) == 1
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert "iteration 3, slot " in said
    assert "task push, seed 0: ArithmeticError: out of numbers" in said
    command = said.strip().splitlines()[-1].partition("dmil reproduce ")[2]
    assert command == "runs/run/failure.json"
    failure = read_failure(Path(command))
    assert failure.piece["iteration"] == 2
    assert "task_gradient" in failure.trace
    assert failure.checkpoint is not None
    assert failure.checkpoint.endswith("iteration-0000002")

    with pytest.raises(WorkError, match="out of numbers"):
        reproduce.run([command])


@pytest.mark.thorough
@pytest.mark.usefixtures("joined")
def test_an_error_in_a_worker_arrives_whole(small: Experiment, data):
    class Failing(Dmil):
        def task_gradient(self, parameters, batch):
            if batch.task == "push":
                raise ArithmeticError("out of numbers")
            return super().task_gradient(parameters, batch)

    plan = plan_of(small, data)
    method = plan.method
    assert isinstance(method, Dmil)
    failing = plan._replace(method=Failing(method.config, method.action_dim, method.normalise))
    with open_runner("ray", small.suite, 2) as runner:
        meta_training = runner.meta_train(failing)
        with pytest.raises(WorkError, match=r"iteration 1, slot .*, task push.*: ArithmeticError: out of n") as error:
            follow(meta_training)
        assert "in task_gradient" in error.value.trace
        assert meta_training.state().iteration == 0


def test_a_failing_expert_and_a_failing_trial_are_named(
    train, workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    train("run", "--training.iterations", "1")
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr("services.distributed.work_items.rollout", lambda *given: 1 / 0)
        assert exit_code(meta_train.run, ["--resume", "run", "--runner", "local"]) == 1
        said = capsys.readouterr().err
        assert "meta-training task reach, 1-shot, support set 0, seed 0: ZeroDivisionError: division by zero" in said
        with pytest.raises(WorkError, match="division by zero"):
            reproduce.run(["runs/run"])
    reproduce.run(["runs/run/failure.json"])
    assert "it comes to its end here" in capsys.readouterr().out

    monkeypatch.setenv("DMIL_DATA", str(workplace / "data"))
    with monkeypatch.context() as patch:
        patch.setattr("services.distributed.work_items.demonstrate", lambda *given: 1 / 0)
        arguments = ["--preset", "ml10-smoke", "--runner", "local", "--name", "other"]
        assert exit_code(meta_train.run, arguments) == 1
    said = capsys.readouterr().err
    assert "task reach, attempt 0, seed " in said
    assert f"dmil reproduce {workplace / 'data' / 'failure.json'}" in said
    reproduce.run([str(workplace / "data")])


def test_no_failure_is_reported_as_a_users_mistake(complaint, workplace: Path):
    (workplace / "failure.json").write_text('{"where": 1}')
    for given in ("nowhere", "failure.json"):
        assert f"{workplace / given}: got" in complaint(reproduce.run, given)


# Numbers that go wrong


@pytest.fixture
def nonfinite(data: dict[str, TaskDemonstrations], workplace: Path, monkeypatch: pytest.MonkeyPatch) -> DemoStore:
    """A store in which one demonstration of push has an action whose square is too large for a float."""
    store = DemoStore(workplace / "nonfinite")
    for task, dataset in data.items():
        attempts = []
        for index, demonstration in enumerate(dataset.demonstrations):
            actions = demonstration.actions.copy()
            if task == "push" and index == 3:
                actions[:] = 1e30
            observations = np.concatenate([demonstration.observations, demonstration.observations[-1:]])
            attempts.append(Episode(observations, actions, index, [0.0], len(actions) - 1))
        store.save(dataset.id, task, attempts, failed=0, settings={})
    monkeypatch.setenv("DMIL_DATA", str(store.root))
    return store


@pytest.mark.usefixtures("nonfinite")
def test_numbers_that_are_not_finite_stop_a_run_before_the_step(train, capsys: pytest.CaptureFixture[str]):
    arguments = ["--preset", "ml10-smoke", "--runner", "local", "--name", "run", "--training.iterations", "40"]
    assert exit_code(meta_train.run, arguments) == 1
    said = capsys.readouterr().err
    iteration = int(said.partition("iteration ")[2].partition(":")[0])
    assert "task push, demonstrations" in said
    assert "003" in said
    assert "--resume runs/run --on-nonfinite skip" in said
    newest = Checkpoints(Path("runs/run/checkpoints"), 3).newest()
    assert newest.manifest.iteration == iteration - 1
    assert np.isfinite(newest.state.parameters).all()

    assert exit_code(meta_train.run, ["--resume", "run", "--runner", "local"]) == 1
    assert f"iteration {iteration}: a loss or a gradient is not finite" in capsys.readouterr().err


@pytest.mark.thorough
@pytest.mark.usefixtures("nonfinite")
def test_a_run_may_go_on_without_the_steps_that_are_not_finite(train, capsys: pytest.CaptureFixture[str]):
    finished = train("run", "--training.iterations", "20", "--on-nonfinite", "skip")
    assert finished.manifest.iteration == 20
    assert np.isfinite(finished.state.parameters).all()
    printed = capsys.readouterr().out
    assert "warning: iteration " in printed
    assert "the step is not taken" in printed
    for line in Path("runs/run/tracking.jsonl").read_text().splitlines():
        json.loads(line, parse_constant=pytest.fail)
    half = train("parts", "--training.iterations", "11", "--on-nonfinite", "skip")
    assert half.manifest.iteration == 11
    whole = train("parts", "--training.iterations", "20", "--on-nonfinite", "skip", resume=True)
    assert all(map(np.array_equal, whole.state[1:], finished.state[1:]))


def test_a_collapse_is_reported_once_when_it_has_lasted():
    watch = CollapseWatch(DmilConfig())

    def update(number: int, share: float) -> str | None:
        return watch.update(number, {"sub_skill_share/0": share, "sub_skill_share/1": 1 - share, "agreement": 1.0})

    assert [update(number, 0.995) for number in range(99)] == [None] * 99
    assert update(99, 0.6) is None
    assert [update(number, 0.001) for number in range(100, 199)] == [None] * 99
    message = update(199, 0.001)
    assert message is not None
    assert "sub-skill 1 has taken over 99% of the states for 100 iterations, up to 199" in message
    assert "--training.learning-rate" in message
    assert update(200, 0.001) is None
    assert all(CollapseWatch(DmilConfig()).update(number, {"sub_skill_share/0": 1.0}) is None for number in range(150))


# Evaluations on the way


@pytest.mark.thorough
def test_evaluations_that_were_dropped_are_made_up(train, workplace: Path):
    schedule = ("--training.checkpoint-every", "2", "--evaluation.every", "2")
    train("run", "--training.iterations", "6", *schedule)
    made = sorted((workplace / "runs" / "run" / "evaluations").rglob("*.jsonl"))
    assert len(made) == 4
    wanted = [path.read_bytes() for path in made]
    for path in made:
        path.unlink()
    train("run", resume=True)
    assert [path.read_bytes() for path in made] == wanted


def test_checkpoints_wait_for_their_evaluation(workplace: Path, train, monkeypatch: pytest.MonkeyPatch):
    """However few are kept: else a run that is stopped could not make it up."""

    class Never(NamedTuple):
        def done(self) -> bool:
            return False

        def result(self) -> list:
            raise KeyboardInterrupt

    monkeypatch.setattr(LocalRunner, "simulate_in_background", lambda *given: Never())
    schedule = ("--training.checkpoint-every", "1", "--training.checkpoints-kept", "1", "--evaluation.every", "2")
    with pytest.raises(KeyboardInterrupt):
        train("run", "--training.iterations", "6", *schedule)
    checkpoints = Checkpoints(workplace / "runs" / "run" / "checkpoints", 1).all()
    assert "iteration-0000002" in [path.name for path in checkpoints]
