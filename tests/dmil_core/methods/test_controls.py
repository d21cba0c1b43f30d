"""The controls: one network for all tasks, one for each, and copying."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import functional

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning, MetaLearner, Policy
from dmil_core.methods.behaviour_cloning.config import BehaviourCloningConfig
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.nearest_neighbour.config import NearestNeighbourConfig
from dmil_core.methods.nearest_neighbour.method import NearestNeighbour
from dmil_core.methods.per_task.config import PerTaskConfig
from dmil_core.methods.per_task.method import PerTask
from dmil_core.networks import flatten, unflatten
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.toys import meta_trained, record, training_sets

SMALL: dict[str, Any] = {"hidden_layers": 2, "hidden_units": 16}


@pytest.fixture
def cloning(demonstrations) -> BehaviourCloning:
    return BehaviourCloning.prepared(BehaviourCloningConfig(**SMALL, trajectories=2, window=4), 3, demonstrations)


def error(policy: Policy, demonstrations: list[Demonstration]) -> float:
    """Return the mean squared error of the actions."""
    decisions = [policy.act(one.observations, policy.start(len(one))) for one in demonstrations]
    pairs = zip(decisions, demonstrations, strict=True)
    return float(np.mean([np.square(did.actions - one.actions).sum(1).mean() for did, one in pairs]))


def plain_loss(vector: torch.Tensor, shapes, steps: Steps) -> torch.Tensor:
    outputs, tensors = steps.states, list(unflatten(vector, shapes).values())
    for weight, bias in zip(tensors[::2], tensors[1::2], strict=True):
        outputs = functional.linear(outputs, weight, bias)
        if weight is not tensors[-2]:
            outputs = functional.relu(outputs)
    return (outputs - steps.actions).square().sum(1).mean()


def test_the_gradient_is_that_of_the_error_on_all_that_was_drawn(cloning, demonstrations) -> None:
    parameters = cloning.initial_parameters(named_rng(0, "initial"))
    batch = cloning.sample(demonstrations, 0, named_rng(0, "batch"))
    steps = Steps.of(list(itertools.chain(*batch.sets)), cloning.normalise)
    assert len(steps.lengths) == 8
    vector = flatten(parameters).requires_grad_()
    loss = plain_loss(vector, {name: tensor.shape for name, tensor in parameters.items()}, steps)
    (wanted,) = torch.autograd.grad(loss, vector)
    found = cloning.task_gradient(parameters, batch)
    torch.testing.assert_close(found.gradient, wanted)
    assert found.metrics["loss"] == pytest.approx(loss.item(), rel=1e-5)


def test_fine_tuning_is_plain_gradient_descent_on_the_support_set(cloning, demonstrations) -> None:
    parameters, support = cloning.initial_parameters(named_rng(0, "initial")), demonstrations[:2]
    before = flatten(parameters)
    policy = cloning.adapt(parameters, support, FineTuning(3, 0.05))
    vector, shapes = before.clone(), {name: tensor.shape for name, tensor in parameters.items()}
    for _ in range(3):
        vector.requires_grad_()
        loss = plain_loss(vector, shapes, Steps.of(support, cloning.normalise))
        vector = (vector - 0.05 * torch.autograd.grad(loss, vector)[0]).detach()
    found = flatten({f"{n}.{k}": t for n, layer in enumerate(policy.network) for k, t in layer._asdict().items()})
    torch.testing.assert_close(found, vector)
    assert torch.equal(flatten(parameters), before)


@pytest.mark.usefixtures("unchecked")
def test_cloning_all_tasks_helps_a_new_one() -> None:
    """Both have the same support set; from scratch, it is all that there is."""
    sets = training_sets()
    everything = list(itertools.chain(*sets.values()))
    cloning = BehaviourCloning.prepared(BehaviourCloningConfig(**SMALL, trajectories=4), 2, everything)
    training = TrainingConfig(iterations=200, tasks_per_iteration=4, learning_rate=1e-2)
    parameters = meta_trained(cloning, sets, training)
    scratch = PerTask.prepared(PerTaskConfig(**SMALL), 2, everything)
    fresh = scratch.initial_parameters(named_rng(0, "initial"))
    for task in (100, 101):
        demonstrations, _ = record(task, 8)
        support, others = demonstrations[:2], demonstrations[2:]
        tuned = error(cloning.adapt(parameters, support, FineTuning(200, 0.02)), others)
        assert tuned < 0.9 * error(cloning.adapt(parameters, support, FineTuning(0, 0.05)), others)
        own = error(scratch.adapt(fresh, support, FineTuning(500, 1e-2)), others)
        assert own < 0.5 * error(scratch.adapt(fresh, support, FineTuning(0, 1e-2)), others)


def test_the_nearest_state_tells_what_to_do(demonstrations) -> None:
    method = NearestNeighbour.prepared(NearestNeighbourConfig(), 3, demonstrations)
    assert not isinstance(method, MetaLearner)
    assert method.initial_parameters(named_rng(0, "initial")) == {}
    policy = method.adapt({}, demonstrations[:3], FineTuning(5, 0.1))
    known = demonstrations[1].observations
    assert np.array_equal(policy.act(known, policy.start(len(known))).actions, demonstrations[1].actions)
    seen = np.concatenate([one.observations for one in demonstrations[:3]])
    did = np.concatenate([one.actions for one in demonstrations[:3]])
    asked = named_rng(0, "asked").normal(size=(20, 4)).astype(np.float32)
    scaled = [((state - seen) / method.normalise.scale) for state in asked]
    wanted = did[[int(np.square(way).sum(1).argmin()) for way in scaled]]
    assert np.array_equal(policy.act(asked, policy.start(20)).actions, wanted)
    assert not policy.sub_skill_use(demonstrations[0]).chosen.any()
