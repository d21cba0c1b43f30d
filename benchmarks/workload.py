"""Synthetic experiments of the sizes that the benchmarks measure: random states and actions, drawn by a seed."""

from typing import Literal, TypeAlias

import numpy as np
import torch

from benchmarks.masked_reference import Sets
from dmil_core.configs import PRESETS
from dmil_core.demonstrations import Demonstration
from dmil_core.losses import Steps
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.method import Dmil
from dmil_core.networks import Parameters, flatten, initialise, unflatten
from dmil_core.outer_loop import OuterState
from dmil_core.seeding import named_rng
from services.distributed.runner import Plan
from services.suites.metaworld import MetaWorldSuite

OBS_DIM, ACTION_DIM = 39, 4
Size: TypeAlias = Literal["paper", "quick"]
TRAJECTORY_STEPS = {"paper": 100, "quick": 24}


def settings(size: Size, sub_skills: int, order: Literal["first", "second"]) -> DmilConfig:
    """Return a preset's method with other sub-skills and order: width 512 for ``paper``, 256 for ``quick``.

    Its labels are the paper's, not balanced, as those of the reference are that it is compared with.
    """
    preset = PRESETS[f"ml10-{size}"].method.model_dump()
    return DmilConfig.model_validate({**preset, "sub_skills": sub_skills, "order": order, "balance": "none"})


def draw_steps(seed: int, trajectories: int, length: int) -> Steps:
    """Draw trajectories of one length."""
    generator = torch.Generator().manual_seed(seed)
    states = torch.randn(trajectories * length, OBS_DIM, generator=generator)
    actions = torch.rand(trajectories * length, ACTION_DIM, generator=generator) * 2 - 1
    return Steps(states, actions, torch.full((trajectories,), length))


def draw_sets(size: Size, config: DmilConfig, task: int) -> Sets:
    """Draw τ1 to τ4 of a task: 16 trajectories of 100 steps for ``paper``, 4 windows of 24 for ``quick``."""
    one, two, three, four = (
        draw_steps(4 * task + index, config.trajectories, TRAJECTORY_STEPS[size]) for index in range(4)
    )
    return one, two, three, four


def draw_parameters(config: DmilConfig) -> Parameters:
    """Draw He-initialised networks: their labels and choices use several of the sub-skills."""
    hidden, k = [config.hidden_units] * config.hidden_layers, config.sub_skills
    draw = named_rng(0, "benchmark parameters")
    return {
        **initialise("high", [OBS_DIM, *hidden, k], draw),
        **initialise("low", [OBS_DIM, *hidden, ACTION_DIM], draw, copies=k),
    }


def as_in_a_run(parameters: Parameters) -> Parameters:
    """Return a copy laid out in one vector, as a worker gets them."""
    return unflatten(flatten(parameters), {name: tensor.shape for name, tensor in parameters.items()})


def made_up_plan(preset: str, slots_per_group: int | None = None) -> Plan:
    """Return the plan of one of Meta-World's presets, with demonstrations of noise, 100 steps each."""
    config = PRESETS[preset]
    suite = MetaWorldSuite(config.suite)
    settings, training = config.demonstrations, config.training
    draw = np.random.default_rng(0)
    demonstrations = {
        task: [
            Demonstration(
                f"{index:03d}",
                task,
                draw.normal(size=(TRAJECTORY_STEPS["paper"], suite.obs_dim)).astype(np.float32),
                draw.uniform(-1, 1, size=(TRAJECTORY_STEPS["paper"], suite.action_dim)).astype(np.float32),
            )
            for index in range(settings.per_task - settings.held_out)
        ]
        for task in suite.train_tasks
    }
    assert isinstance(config.method, DmilConfig)
    everything = [one for task in demonstrations.values() for one in task]
    method = Dmil.prepared(config.method, suite.action_dim, everything, suite.points)
    initial = method.initial_parameters(named_rng(0, "initial parameters"))
    shapes = {name: tensor.shape for name, tensor in initial.items()}
    if slots_per_group is not None:
        training = training.model_copy(update={"slots_per_group": slots_per_group})
    return Plan(method, shapes, demonstrations, OuterState.start(flatten(initial).numpy()), training, seed=0)
