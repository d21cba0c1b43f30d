"""The method as the services use it, and that it learns."""

import itertools
from typing import Literal

import numpy as np
import pytest
import torch

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Normalisation
from dmil_core.losses import Steps
from dmil_core.methods.base import FineTuning
from dmil_core.methods.dmil import meta_gradient
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.method import Dmil
from dmil_core.networks import flatten
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.toys import meta_trained, record, recovered, training_sets

SMALL = DmilConfig(sub_skills=3, hidden_layers=2, hidden_units=8, trajectories=2, window=4, inner_learning_rate=0.05)


@pytest.fixture
def method(demonstrations) -> Dmil:
    return Dmil(SMALL, action_dim=3, normalise=Normalisation.of(demonstrations))


def test_initial_parameters_have_the_sizes_of_the_settings(method) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()}
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
    restored = Normalisation(constants["observation_mean"], constants["observation_scale"])
    observations = demonstrations[0].observations
    assert np.array_equal(restored(observations), method.normalise(observations))


def test_a_sample_has_the_trajectories_and_windows_of_the_settings(method, demonstrations) -> None:
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    assert [len(drawn) for drawn in batch.sets] == [2] * 4
    assert max(len(cut) for drawn in batch.sets for cut in drawn) == 4


def test_task_gradient_hands_the_four_sets_on_in_order(method, demonstrations) -> None:
    parameters, batch = (
        method.initial_parameters(named_rng(0, "initial")),
        method.sample(demonstrations, 0, named_rng(0, "batch")),
    )
    one, two, three, four = (Steps.of(drawn, method.normalise) for drawn in batch.sets)
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
    method = Dmil(settings, action_dim=3, normalise=Normalisation.of(demonstrations))
    parameters = method.initial_parameters(named_rng(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch")))
    assert torch.isfinite(found.gradient).all()
    assert found.gradient.any()
    assert all(np.isfinite(value) for value in found.metrics.values())
    policy = method.adapt(parameters, demonstrations[:1], FineTuning(steps=2, learning_rate=0.05))
    assert torch.isfinite(flatten(policy.hierarchy.parameters)).all()


def test_the_chosen_sub_skill_acts(method, demonstrations, plain_mlp) -> None:
    parameters = method.initial_parameters(named_rng(1, "initial"))
    policy = method.adapt(parameters, demonstrations[:2], FineTuning(steps=2, learning_rate=0.05))
    observations = np.concatenate([demonstration.observations for demonstration in demonstrations])
    memory = policy.start(len(observations))
    decision = policy.act(observations, memory)
    assert decision.actions.dtype == np.float32
    assert len(set(decision.sub_skills.tolist())) > 1
    states = torch.from_numpy(method.normalise(observations))
    assert decision.sub_skills.tolist() == plain_mlp(policy.hierarchy.high, states).argmax(1).tolist()
    for state, k, action in zip(states, decision.sub_skills, decision.actions, strict=True):
        np.testing.assert_allclose(action, plain_mlp(policy.hierarchy.low[k], state), rtol=1e-5, atol=1e-6)
    assert np.array_equal(decision.memory, memory)
    assert memory.shape == (len(observations), 0)


def test_sub_skill_use_is_the_choice_and_the_best_fit(method, demonstrations, plain_mlp) -> None:
    policy = method.adapt(method.initial_parameters(named_rng(1, "initial")), demonstrations[:2], FineTuning(2, 0.05))
    observations, actions = demonstrations[2].observations, demonstrations[2].actions
    use = policy.sub_skill_use(demonstrations[2])
    assert np.array_equal(use.chosen, policy.act(observations, policy.start(len(observations))).sub_skills)
    states = torch.from_numpy(method.normalise(observations))
    outputs = torch.stack([plain_mlp(sub_skill, states) for sub_skill in policy.hierarchy.low]).numpy()
    assert use.best.tolist() == [
        int(np.square(outputs[:, t] - actions[t]).sum(1).argmin()) for t in range(len(actions))
    ]
    assert len(set(use.best.tolist())) > 1


@pytest.mark.parametrize("steps", [0, 3])
def test_adaptation_leaves_the_parameters(method, demonstrations, steps: int) -> None:
    parameters = method.initial_parameters(named_rng(0, "initial"))
    before = flatten(parameters)
    policy = method.adapt(parameters, demonstrations[:1], FineTuning(steps, 0.1))
    assert torch.equal(flatten(parameters), before)
    assert torch.equal(flatten(policy.hierarchy.parameters), before) == (steps == 0)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("order", [pytest.param("first", marks=pytest.mark.thorough), "second"])
def test_learns_to_tell_two_skills_apart_in_a_new_task(order: Literal["first", "second"]) -> None:
    config = DmilConfig(
        sub_skills=2,
        hidden_layers=1,
        hidden_units=32,
        output_scale=0.1,
        trajectories=4,
        inner_learning_rate=0.05,
        inner_steps=2,
        continuity_weight=0.0,
        order=order,
    )
    sets = training_sets()
    method = Dmil.prepared(config, 2, list(itertools.chain(*sets.values())))
    parameters = meta_trained(method, sets, TrainingConfig(iterations=120, tasks_per_iteration=4, learning_rate=1e-2))
    demonstrations, skills = record(101, 12)
    found, errors = [], []
    for steps in (0, 100):
        policy = method.adapt(parameters, demonstrations[:2], FineTuning(steps, 0.1))
        found.append(recovered(skills, [policy.sub_skill_use(one).chosen for one in demonstrations]))
        decisions = [policy.act(one.observations, policy.start(len(one))) for one in demonstrations]
        errors.append(
            np.mean(
                [
                    np.square(did.actions - one.actions).sum(1).mean()
                    for did, one in zip(decisions, demonstrations, strict=True)
                ]
            )
        )
    assert found[-1] >= 0.95
    assert errors[-1] < errors[0]
