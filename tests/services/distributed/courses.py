"""What tests of meta-training share: a small plan, and its course from one state to the next, seen from outside."""

import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import ray

from dmil_core.configs import ExperimentConfig
from dmil_core.methods.base import MetaLearner
from dmil_core.networks import flatten
from dmil_core.outer_loop import OuterState
from services.distributed.ray_runner import open_runner
from services.distributed.runner import MetaTraining, Plan
from services.experiments.experiment import Experiment

ITERATIONS = 4


def training(config: ExperimentConfig, slots: int, group: int) -> ExperimentConfig:
    settings = {"iterations": ITERATIONS, "tasks_per_iteration": slots, "slots_per_group": group, "gradient_clip": 1.0}
    return config.model_copy(update={"training": config.training.model_copy(update=settings)})


def plan_of(experiment: Experiment, data) -> Plan:
    config = experiment.config
    sets = experiment.training_sets(data)
    method = experiment.method(sets)
    assert isinstance(method, MetaLearner)
    initial = experiment.initial_parameters(method)
    shapes = {name: tensor.shape for name, tensor in initial.items()}
    return Plan(
        method,
        shapes,
        sets,
        OuterState.start(flatten(initial).numpy()),
        config.training,
        config.seed,
        suite=experiment.suite,
    )


class Course(NamedTuple):
    """What was to be seen of a meta-training from outside, iteration by iteration."""

    numbers: list[int]
    slots: list[list[Mapping[str, float]]]
    norms: list[float]
    states: list[OuterState]


def follow(
    training: MetaTraining, count: int = ITERATIONS, disturb: Callable[[int], None] = lambda done: None
) -> Course:
    """Do a few iterations, looking at the state after each."""
    course = Course([], [], [], [])
    for iteration in training.iterations(count):
        course.numbers.append(iteration.number)
        course.slots.append(iteration.slots)
        course.norms.append(iteration.gradient_norm)
        course.states.append(training.state())
        disturb(iteration.number)
    return course


def pid_of(actor: Any) -> int:
    """Return the process of one of Ray's actors."""
    return ray.get(actor.__ray_call__.remote(lambda worker: os.getpid()))


def alone(experiment: Experiment, data) -> Course:
    """Do the same in this process."""
    with open_runner("local", experiment.suite, None) as runner:
        return follow(runner.meta_train(plan_of(experiment, data)))


def assert_same_bits(one: Course, other: Course) -> None:
    assert one[:3] == other[:3]
    for state, wanted in zip(one.states, other.states, strict=True):
        assert state.iteration == wanted.iteration
        assert all(map(np.array_equal, state[1:], wanted[1:]))
