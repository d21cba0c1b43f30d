"""Every method of the registry as the services use it: equal bits, going on, rollouts, and mistakes in words."""

import json
import os
import signal
import subprocess
import sys
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch

from dmil_core.configs import ExperimentConfig, preset_of
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import (
    Decision,
    FineTuning,
    MetaLearner,
    OnlineMetaLearner,
    Policy,
    Rollout,
)
from dmil_core.methods.behaviour_cloning.policy import NetworkPolicy
from dmil_core.methods.registry import OURS, method_type
from dmil_core.networks import initialise, network, unflatten
from dmil_core.seeding import named_rng
from services import meta_train
from services.demonstrations.store import DemoStore
from services.distributed.ray_meta_training import RayMetaTraining
from services.distributed.ray_runner import open_runner
from services.distributed.simulation_worker import SimulationWorker
from services.experiments.experiment import Experiment
from services.storage.checkpoints import Checkpoints
from services.suites.metaworld import MetaWorldSuite
from tests.services.distributed.courses import alone, assert_same_bits, follow, pid_of, plan_of
from tests.services.programs import QUICK_EVALUATION

PROJECT = Path(__file__).parents[3]
LEARNERS = [name for name, kind in OURS.items() if issubclass(kind, MetaLearner)]
ONLINE = [name for name in LEARNERS if issubclass(OURS[name], OnlineMetaLearner)]


def smoke(method: str, iterations: int) -> ExperimentConfig:
    config = preset_of("ml10", "smoke", method)
    return config.model_copy(update={"training": config.training.model_copy(update={"iterations": iterations})})


@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize(
    "method",
    [method if method == "option-gail" else pytest.param(method, marks=pytest.mark.thorough) for method in ONLINE],
)
def test_here_and_on_workers_that_are_killed_the_same_bits_come_out(store: DemoStore, data, method: str):
    """Of methods that need more than gradients, and of one of them with a worker that is killed; the others have one.

    Of those that need gradients alone, `test_a_slot_is_a_pure_function`, and `test_runner` has dmil.
    """
    mortal = method == "option-gail"
    experiment = Experiment(smoke(method, 4), store)
    wanted = alone(experiment, data)
    assert np.isfinite(wanted.states[-1].parameters).all()
    assert any(map(np.not_equal, wanted.states[-1].parameters, wanted.states[0].parameters))
    steps = [slot.get("environment_steps", 0) for slots in wanted.slots for slot in slots]
    assert any(steps)
    with open_runner("ray", experiment.suite, 2 if mortal else 1) as runner:
        meta_training = runner.meta_train(plan_of(experiment, data))
        assert isinstance(meta_training, RayMetaTraining)

        def strike(done: int) -> None:
            if mortal and done == 2:
                os.kill(pid_of(meta_training._pool._workers[0].actor), signal.SIGKILL)

        assert_same_bits(follow(meta_training, disturb=strike), wanted)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ONLINE)
def test_a_killed_online_run_goes_on_to_the_same_bits(programs, wait_for, workplace: Path, method: str):
    settings = ("--method", method, "--preset", "smoke", "--runner", "local", *QUICK_EVALUATION)
    begin = (*settings, "--training.checkpoint-every", "2")
    program = programs.start("meta_train", *begin, "--name", "killed", "--training.iterations", "100000")
    checkpoints = Checkpoints(workplace / "runs" / "killed" / "checkpoints", 3)
    wait_for(lambda: len(checkpoints.all()) == 3 or program.poll() is not None, "the third checkpoint")
    os.kill(program.pid, signal.SIGKILL)
    program.communicate()
    done = checkpoints.newest().manifest
    assert done.environment_steps > 0
    until = ("--training.iterations", str(done.iteration + 3))
    meta_train.run(["--resume", "killed", "--runner", "local", *until])
    meta_train.run([*begin, "--name", "whole", *until])
    states = [Checkpoints(workplace / "runs" / name / "checkpoints", 1).newest() for name in ("killed", "whole")]
    assert states[0].digest == states[1].digest
    assert states[0].manifest.environment_steps == states[1].manifest.environment_steps


@pytest.mark.usefixtures("checked_shapes")
@pytest.mark.parametrize("method", LEARNERS)
def test_a_slot_is_a_pure_function(store: DemoStore, data, method: str):
    """Again in another worker, which has done other things before: the same bits, and the parameters as they were."""
    experiment = Experiment(smoke(method, 4), store)
    plan = plan_of(experiment, data)
    sets = experiment.training_sets(data)
    parameters = unflatten(torch.tensor(plan.state.parameters), plan.shapes)
    learner = experiment.method(sets)
    assert isinstance(learner, MetaLearner)
    found = []
    for _ in range(2):
        batch = learner.sample(sets["push"], 0, named_rng(3, "batch"))
        found.append(learner.task_gradient(parameters, batch))
        torch.rand(3)
        learner = deepcopy(learner)  # as one that travels to a worker
    assert torch.equal(found[0].gradient, found[1].gradient)
    assert found[0].metrics == found[1].metrics
    assert "loss" in found[0].metrics
    assert np.array_equal(plan.state.parameters, plan_of(experiment, data).state.parameters)


@pytest.mark.usefixtures("checked_shapes")
@pytest.mark.parametrize("method", OURS)
def test_constants_and_a_single_step_are_enough_to_act(experiment: Experiment, data, method: str):
    kind = method_type(method)
    settings, suite = preset_of("ml10", "smoke", method).method, experiment.suite
    sets = experiment.training_sets(data)
    made = kind.prepared(settings, suite.action_dim, sets["push"], MetaWorldSuite.points)
    again = kind.restored(settings, suite.action_dim, made.constants(), MetaWorldSuite.points)
    parameters = made.initial_parameters(named_rng(0, "initial"))
    step = sets["push"][0].window(0, 1)
    tuning = tuning_of(method)
    observations = sets["reach"][0].observations[:5]
    actions = []
    for learner in (made, again):
        policy = learner.adapt(parameters, [step], tuning)
        decision = policy.act(observations, policy.start(5))
        assert decision.actions.shape == (5, suite.action_dim)
        assert np.isfinite(decision.actions).all()
        use = policy.sub_skill_use(sets["push"][1])
        assert len(use.chosen) == len(use.best) == len(sets["push"][1])
        actions.append(decision.actions)
    assert np.array_equal(*actions)


def tuning_of(method: str) -> FineTuning:
    evaluation = preset_of("ml10", "smoke", method).evaluation
    return FineTuning(evaluation.fine_tuning_steps, evaluation.learning_rate)


# Practice


@pytest.fixture
def wanderer(experiment: Experiment, data) -> Policy:
    method = experiment.method(experiment.training_sets(data))
    random = initialise("policy", [method.obs_dim, 16, method.action_dim], named_rng(0, "wanderer"))
    return NetworkPolicy(network(random, "policy"), method.normalise)


def test_practice_is_a_pure_function_that_takes_its_steps(experiment: Experiment, wanderer: Policy):
    worker = SimulationWorker(experiment.suite)
    found: list[list[Rollout]] = [worker.collect_rollouts(wanderer, "push", 7, 700) for _ in range(2)]
    other = worker.collect_rollouts(wanderer, "push", 8, 700)
    lengths = [len(rollout.actions) for rollout in found[0]]
    assert sum(lengths) == 700
    assert lengths == [300, 300, 100]
    assert [rollout.ended for rollout in found[0]] == [True, True, False]
    for one, again in zip(*found, strict=True):
        assert one.observations.shape == (len(one.actions) + 1, experiment.suite.obs_dim)
        assert np.array_equal(one.observations, again.observations)
        assert np.array_equal(one.actions, again.actions)
    assert not np.array_equal(found[0][0].observations, other[0].observations)
    assert not np.array_equal(found[0][0].observations, found[0][1].observations)


class Replay(Policy):
    """Does what a demonstration did."""

    def __init__(self, demonstration: Demonstration) -> None:
        self.actions = demonstration.actions

    def start(self, episodes: int) -> np.ndarray:
        return np.zeros((episodes, 1), np.int64)

    def act(self, observations: np.ndarray, memory: np.ndarray) -> Decision:
        steps = np.minimum(memory[:, 0], len(self.actions) - 1)
        return Decision(self.actions[steps], np.zeros(len(memory), np.int64), memory + 1)


def test_practice_ends_an_episode_at_its_success(experiment: Experiment, data):
    task, worker = "drawer-close", SimulationWorker(experiment.suite)
    rollouts = worker.collect_rollouts(Replay(data[task].demonstrations[0]), task, 0, 650)
    assert sum(len(rollout.actions) for rollout in rollouts) == 650
    solved = [rollout for rollout in rollouts if rollout.success]
    assert solved
    assert all(rollout.ended and len(rollout.actions) < 300 for rollout in solved)


# Mistakes


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--method", "foo"), "method.name: got 'foo'; wanted one of dmil, "),
        (("--method", "nearest-neighbour", "--training.iterations", "3"), "wanted 0: nearest-neighbour has no meta-tr"),
        (("--method", "per-task", "--method.hidden-units", "0"), "--method.hidden-units: got 0"),
    ],
)
@pytest.mark.usefixtures("workplace")
def test_a_mistake_is_reported_in_words(complaint, workplace: Path, arguments: tuple[str, ...], said: str):
    assert said in complaint(meta_train.run, *arguments, "--preset", "smoke", "--runner", "local")
    assert not (workplace / "runs").exists()


@pytest.mark.usefixtures("workplace")
def test_settings_of_another_method_are_refused(complaint, workplace: Path):
    Path("mine.yaml").write_text("method: {name: foo}\n")
    assert "mine.yaml: method.name: got 'foo'; wanted one of dmil" in complaint(meta_train.run, "--config", "mine.yaml")
    Path("mine.yaml").write_text("method: {name: behaviour-cloning, sub_skills: 3}\n")
    printed = complaint(meta_train.run, "--config", "mine.yaml", "--preset", "smoke")
    assert "mine.yaml: got the unknown key method.sub_skills; wanted one of" in printed


# A package's method

EXAMPLE = PROJECT / "docs" / "examples" / "reptile"


@pytest.mark.thorough
@pytest.mark.usefixtures("plain_pages")
def test_an_installed_method_is_meta_trained_to_its_table(workplace: Path, complaint, capsys, monkeypatch):
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    source = workplace / "source"
    source.mkdir()
    for file in ("pyproject.toml", "reptile.py"):
        (source / file).write_bytes((EXAMPLE / file).read_bytes())
    command += ["--no-build-isolation", "--no-index", "--target", str(workplace / "lib"), str(source)]
    subprocess.run(command, check=True)
    monkeypatch.syspath_prepend(workplace / "lib")
    begin = ("--method", "reptile", "--preset", "smoke", "--runner", "local")
    short = ("--training.iterations", "2", "--training.checkpoint-every", "2", *QUICK_EVALUATION)
    meta_train.run([*begin, *short, "--name", "run", "--method.inner-steps", "3"])
    assert "Success rates of reptile" in capsys.readouterr().out
    config = json.loads((workplace / "runs/run/config.json").read_text())
    assert (config["method"]["name"], config["method"]["inner_steps"]) == ("reptile", 3)
    assert "--method.inner-steps" in complaint(meta_train.run, *begin, "--method.inner-steps", "none")


def test_a_package_s_method_with_a_name_of_ours_is_reported_in_words(programs, workplace: Path, monkeypatch):
    """In a process of its own: nothing goes wrong before there is somebody to tell."""
    information = workplace / "lib" / "more-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: more\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[dmil.methods]\nnearest-neighbour = more_methods:Nearest\n")
    paths = filter(None, (os.environ.get("PYTHONPATH"), str(workplace / "lib")))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    code, printed = programs("meta_train", "--method", "nearest-neighbour", "--preset", "smoke", "--runner", "local")
    assert code == 2, printed
    assert "error: entry points dmil.methods: got nearest-neighbour twice, a method of our own and " in printed
    assert "Traceback" not in printed
    assert not (workplace / "runs").exists()


def test_the_page_says_what_the_example_does():
    page = (PROJECT / "docs" / "your-own-method.md").read_text()
    source = (EXAMPLE / "reptile.py").read_text()
    for block in page.split("```python\n")[1:]:
        for line in block.partition("```")[0].splitlines():
            assert line.strip() in ("", "...") or line in source, line
