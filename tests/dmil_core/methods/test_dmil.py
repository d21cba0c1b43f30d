"""The method as the services use it, and that it learns."""

import itertools
from typing import Literal

import numpy as np
import pytest
import torch

from dmil_core import meta_gradient
from dmil_core.configs import DmilConfig
from dmil_core.demonstrations import Demonstration, Standardisation
from dmil_core.losses import Steps
from dmil_core.meta_gradient import tree_sum
from dmil_core.methods.base import FineTuning
from dmil_core.methods.dmil import Dmil
from dmil_core.networks import flatten, unflatten
from dmil_core.seeding import stream

SMALL = DmilConfig(sub_skills=3, hidden_layers=2, hidden_units=8, trajectories=2, window=4, inner_learning_rate=0.05)


@pytest.fixture
def demonstrations(make_demonstrations) -> list[Demonstration]:
    return make_demonstrations(0, [7, 3, 9, 4, 6, 5, 8, 4, 5])


@pytest.fixture
def method(demonstrations) -> Dmil:
    return Dmil(SMALL, action_dim=3, standardise=Standardisation.of(demonstrations))


def test_initial_parameters_have_the_sizes_of_the_settings(method) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in method.initial_parameters(stream(0, "initial")).items()}
    assert shapes == {
        "high.0.weight": (8, 4),
        "high.0.bias": (8,),
        "high.1.weight": (8, 8),
        "high.1.bias": (8,),
        "high.2.weight": (3, 8),
        "high.2.bias": (3,),
        "low.0.weight": (3, 8, 4),
        "low.0.bias": (3, 8),
        "low.1.weight": (3, 8, 8),
        "low.1.bias": (3, 8),
        "low.2.weight": (3, 3, 8),
        "low.2.bias": (3, 3),
    }


def test_constants_restore_the_standardisation(method, demonstrations) -> None:
    constants = method.constants()
    restored = Standardisation(constants["observation_mean"], constants["observation_scale"])
    observations = demonstrations[0].observations
    assert np.array_equal(restored(observations), method.standardise(observations))


def test_a_sample_has_the_trajectories_and_windows_of_the_settings(method, demonstrations) -> None:
    batch = method.sample(demonstrations, stream(0, "batch"))
    assert [len(drawn) for drawn in batch.sets] == [2] * 4
    assert max(len(cut) for drawn in batch.sets for cut in drawn) == 4


def test_task_gradient_hands_the_four_sets_on_in_order(method, demonstrations) -> None:
    parameters, batch = (
        method.initial_parameters(stream(0, "initial")),
        method.sample(demonstrations, stream(0, "batch")),
    )
    one, two, three, four = (Steps.of(drawn, method.standardise) for drawn in batch.sets)
    expected = meta_gradient.task_gradient(parameters, one, two, three, four, SMALL)
    got = method.task_gradient(parameters, batch)
    assert torch.equal(got.gradient, expected.gradient)
    assert got.metrics == expected.metrics
    swapped = meta_gradient.task_gradient(parameters, two, one, four, three, SMALL)
    assert not torch.equal(got.gradient, swapped.gradient)


@pytest.mark.parametrize("order", ["first", "second"])
def test_a_single_step_can_be_learned_from(make_demonstrations, order: Literal["first", "second"]) -> None:
    demonstrations = make_demonstrations(0, [1] * 8)
    settings = SMALL.model_copy(update={"order": order, "continuity_weight": 0.1})
    method = Dmil(settings, action_dim=3, standardise=Standardisation.of(demonstrations))
    parameters = method.initial_parameters(stream(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, stream(0, "batch")))
    assert torch.isfinite(found.gradient).all()
    assert found.gradient.any()
    assert all(np.isfinite(value) for value in found.metrics.values())
    policy = method.adapt(parameters, demonstrations[:1], FineTuning(steps=2, learning_rate=0.05))
    assert torch.isfinite(flatten(policy.hierarchy.parameters)).all()


def test_the_chosen_sub_skill_acts(method, demonstrations, plain_mlp) -> None:
    parameters = method.initial_parameters(stream(1, "initial"))
    policy = method.adapt(parameters, demonstrations[:2], FineTuning(steps=2, learning_rate=0.05))
    observations = np.concatenate([demonstration.observations for demonstration in demonstrations])
    memory = policy.start(len(observations))
    decision = policy.act(observations, memory)
    assert decision.actions.dtype == np.float32
    assert len(set(decision.sub_skills.tolist())) > 1
    states = torch.from_numpy(method.standardise(observations))
    assert decision.sub_skills.tolist() == plain_mlp(policy.hierarchy.high, states).argmax(1).tolist()
    for state, k, action in zip(states, decision.sub_skills, decision.actions, strict=True):
        np.testing.assert_allclose(action, plain_mlp(policy.hierarchy.low[k], state), rtol=1e-5, atol=1e-6)
    assert np.array_equal(decision.memory, memory)
    assert memory.shape == (len(observations), 0)


def test_sub_skill_use_is_the_choice_and_the_best_fit(method, demonstrations, plain_mlp) -> None:
    policy = method.adapt(method.initial_parameters(stream(1, "initial")), demonstrations[:2], FineTuning(2, 0.05))
    observations, actions = demonstrations[2].observations, demonstrations[2].actions
    use = policy.sub_skill_use(demonstrations[2])
    assert np.array_equal(use.chosen, policy.act(observations, policy.start(len(observations))).sub_skills)
    states = torch.from_numpy(method.standardise(observations))
    outputs = torch.stack([plain_mlp(sub_skill, states) for sub_skill in policy.hierarchy.low]).numpy()
    assert use.best.tolist() == [
        int(np.square(outputs[:, t] - actions[t]).sum(1).argmin()) for t in range(len(actions))
    ]
    assert len(set(use.best.tolist())) > 1


@pytest.mark.parametrize("steps", [0, 3])
def test_adaptation_leaves_the_parameters(method, demonstrations, steps: int) -> None:
    parameters = method.initial_parameters(stream(0, "initial"))
    before = flatten(parameters)
    policy = method.adapt(parameters, demonstrations[:1], FineTuning(steps, 0.1))
    assert torch.equal(flatten(parameters), before)
    assert torch.equal(flatten(policy.hierarchy.parameters), before) == (steps == 0)


def point_mass(task: int, episodes: int, steps: int = 16) -> tuple[list[Demonstration], np.ndarray]:
    """Demonstrate one task: a point circles the origin, driven by one linear policy above the axis, another below.

    The policies differ from task to task, the side that each belongs to does not. Also returned: which policy acted.
    """
    random = stream(task, "point mass")
    turn, drift = np.array([[0, -1], [1, 0]]), np.array([[2.0, 0.5], [-2.0, -0.5]])
    gains, drifts = turn + random.normal(size=(2, 2, 2)) * 0.1, drift + random.normal(size=(2, 2)) * 0.3
    demonstrations, skills = [], []
    for episode in range(episodes):
        places, actions, position = [], [], random.uniform(-1, 1, 2)
        for _ in range(steps):
            skill = int(position[1] > 0)
            places.append(position)
            actions.append(gains[skill] @ position + drifts[skill])
            skills.append(skill)
            position = np.clip(position + 0.3 * actions[-1], -1, 1)
        demonstrations.append(
            Demonstration(f"d{episode}", f"t{task}", np.array(places, np.float32), np.array(actions, np.float32))
        )
    return demonstrations, np.array(skills)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("order", ["first", "second"])
def test_learns_to_tell_two_skills_apart_in_a_new_task(order: Literal["first", "second"]) -> None:
    config = DmilConfig(
        sub_skills=2,
        hidden_layers=1,
        hidden_units=16,
        trajectories=4,
        inner_learning_rate=0.05,
        inner_steps=2,
        continuity_weight=0.0,
        order=order,
    )
    training = [point_mass(task, 16)[0] for task in range(6)]
    method = Dmil(config, action_dim=2, standardise=Standardisation.of(list(itertools.chain(*training))))
    initial = method.initial_parameters(stream(0, "initial"))
    shapes = {name: tensor.shape for name, tensor in initial.items()}
    vector = flatten(initial).requires_grad_()
    optimiser = torch.optim.Adam([vector], lr=1e-2)
    for iteration in range(200):
        parameters, gradients = unflatten(vector.detach(), shapes), []
        for slot in range(3):
            random = stream(0, "batch", iteration, slot)
            material = method.sample(training[random.integers(len(training))], random)
            gradients.append(method.task_gradient(parameters, material).gradient)
        vector.grad = tree_sum(gradients)
        optimiser.step()

    demonstrations, skills = point_mass(100, 30)
    observations, actions = (
        np.concatenate([getattr(demonstration, field) for demonstration in demonstrations])
        for field in ("observations", "actions")
    )
    agreements, errors = [], []
    for steps in (0, 20):
        policy = method.adapt(unflatten(vector.detach(), shapes), demonstrations[:2], FineTuning(steps, 0.05))
        decision = policy.act(observations, policy.start(len(observations)))
        agreements.append((decision.sub_skills == skills).mean())
        errors.append(np.square(decision.actions - actions).sum(1).mean() / actions.var(0).sum())
    assert max(agreements[-1], 1 - agreements[-1]) >= 0.95
    assert errors[-1] < 0.05
    assert errors[-1] < errors[0] / 2
