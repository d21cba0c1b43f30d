"""PEMIRL as the services use it, and that it learns; its losses have their own tests."""

import itertools
from typing import Literal

import numpy as np
import pytest
import torch

from dmil_core.configs import BASE_PRESETS, TrainingConfig
from dmil_core.demonstrations import Demonstration, DemonstrationError, Normalisation
from dmil_core.methods.base import FineTuning, MetaLearner, Policy
from dmil_core.methods.behaviour_cloning.config import BehaviourCloningConfig
from dmil_core.methods.behaviour_cloning.method import BehaviourCloning
from dmil_core.methods.pemirl.config import PemirlConfig
from dmil_core.methods.pemirl.losses import Transitions, action_distribution, infer, losses_of
from dmil_core.methods.pemirl.method import ContextBatch, Pemirl
from dmil_core.networks import flatten, network
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.toys import STEPS, collect_rollouts, meta_trained, record, training_sets

SMALL = PemirlConfig(
    hidden_layers=2, reward_layers=1, hidden_units=8, context_dim=2, trajectories=5, contexts=2, discount=0.9
)
NO_TUNING = FineTuning(steps=0, learning_rate=0.1)


@pytest.fixture
def method(demonstrations) -> Pemirl:
    return Pemirl(SMALL, action_dim=3, normalise=Normalisation.of(demonstrations))


def test_defaults_are_those_of_table_12() -> None:
    config = PemirlConfig()
    assert (config.trajectories, config.discount, config.information_weight) == (16, 1.0, 0.1)
    assert (config.hidden_layers, config.reward_layers, config.hidden_units) == (4, 3, 512)
    assert BASE_PRESETS["paper"].training.learning_rate == 1e-4
    for size in PemirlConfig.presets.values():
        PemirlConfig.model_validate(size["method"])


def test_initial_parameters_have_the_sizes_of_the_settings(method) -> None:
    shapes = {name: tuple(tensor.shape) for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()}
    assert shapes == {
        "encoder.0.weight": (8, 7),
        "encoder.0.bias": (8,),
        "encoder.1.weight": (8, 8),
        "encoder.1.bias": (8,),
        "encoder.2.weight": (4, 8),
        "encoder.2.bias": (4,),
        "policy.0.weight": (8, 6),
        "policy.0.bias": (8,),
        "policy.1.weight": (8, 8),
        "policy.1.bias": (8,),
        "policy.2.weight": (3, 8),
        "policy.2.bias": (3,),
        "reward.0.weight": (8, 6),
        "reward.0.bias": (8,),
        "reward.1.weight": (1, 8),
        "reward.1.bias": (1,),
        "potential.0.weight": (8, 6),
        "potential.0.bias": (8,),
        "potential.1.weight": (1, 8),
        "potential.1.bias": (1,),
        "log_deviation": (3,),
    }


@pytest.mark.parametrize("deviation", [0.01, 0.3, 10.0])
def test_the_policys_deviation_begins_as_set(method, deviation: float) -> None:
    method = Pemirl(SMALL.model_copy(update={"initial_deviation": deviation}), 3, method.normalise)
    policy = action_distribution(
        method.initial_parameters(named_rng(0, "initial")), torch.zeros(5, 4), torch.zeros(5, 2)
    )
    torch.testing.assert_close(policy.log_deviation.exp(), torch.full((1, 3), deviation))


def test_a_sample_has_different_demonstrations_where_there_are_enough(method, demonstrations) -> None:
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    assert (len(batch.contexts), len(batch.explained)) == (2, 5)
    assert len(set(batch.ids)) == 7
    again, other = (method.sample(demonstrations, 0, named_rng(seed, "batch")) for seed in (0, 1))
    assert (batch.ids, batch.seed) == (again.ids, again.seed)
    assert (batch.ids, batch.seed) != (other.ids, other.seed)


def test_a_sample_of_few_demonstrations_has_each_about_as_often(method, demonstrations) -> None:
    ids = method.sample(demonstrations[:3], 0, named_rng(0, "batch")).ids
    assert sorted(ids.count(one.id) for one in demonstrations[:3]) == [2, 2, 3]
    with pytest.raises(DemonstrationError, match="got none"):
        method.sample([], 0, named_rng(0, "batch"))


def test_task_gradient_is_that_of_the_weighted_sum(demonstrations) -> None:
    config = SMALL.model_copy(
        update={"information_weight": 0.3, "divergence_weight": 0.7, "policy_weight": 0.2, "steps_per_trajectory": 4}
    )
    method = Pemirl(config, action_dim=3, normalise=Normalisation.of(demonstrations))
    parameters = method.initial_parameters(named_rng(0, "initial"))
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    found = method.task_gradient(parameters, batch)

    generator = torch.Generator().manual_seed(batch.seed)
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
    contexts, explained = (
        Transitions.of(drawn, method.normalise).thinned(4, generator) for drawn in (batch.contexts, batch.explained)
    )
    parts = losses_of(leaves, contexts, explained, 0.9, "same", generator)
    total = parts.likelihood + 0.7 * parts.divergence + parts.discriminator + 0.2 * parts.policy
    total += 0.3 * parts.information + 0.3 * parts.information_surrogate
    total.backward()
    expected = flatten({name: tensor.grad for name, tensor in leaves.items() if tensor.grad is not None})
    torch.testing.assert_close(found.gradient, expected, rtol=1e-4, atol=1e-6)
    assert found.metrics["loss"] == pytest.approx(total.item(), rel=1e-5)


@pytest.mark.parametrize("negatives", ["same", "mismatched"])
def test_task_gradient_is_pure(method, demonstrations, negatives: Literal["same", "mismatched"]) -> None:
    method = Pemirl(SMALL.model_copy(update={"negatives": negatives, "steps_per_trajectory": 3}), 3, method.normalise)
    parameters = method.initial_parameters(named_rng(0, "initial"))
    before, state = flatten(parameters), torch.get_rng_state()
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    one, two = (method.task_gradient(parameters, batch) for _ in range(2))
    assert torch.equal(one.gradient, two.gradient)
    assert one.metrics == two.metrics
    assert torch.equal(flatten(parameters), before)
    assert torch.equal(torch.get_rng_state(), state)
    renamed = ContextBatch(batch.contexts, batch.explained, batch.seed + 1)
    assert not torch.equal(method.task_gradient(parameters, renamed).gradient, one.gradient)


@pytest.mark.parametrize("steps", [None, 2])
@pytest.mark.parametrize("negatives", ["same", "mismatched"])
@pytest.mark.parametrize("lengths", [[1], [1, 1, 1], [1, 40, 2]])
def test_single_steps_and_ragged_trajectories_can_be_learned_from(
    make_demonstrations, lengths: list[int], negatives: Literal["same", "mismatched"], steps: int | None
) -> None:
    demonstrations = make_demonstrations(0, lengths)
    config = SMALL.model_copy(update={"negatives": negatives, "steps_per_trajectory": steps})
    method = Pemirl.prepared(config, 3, demonstrations)
    assert isinstance(method, MetaLearner)
    parameters = method.initial_parameters(named_rng(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch")))
    assert found.gradient.shape == flatten(parameters).shape
    assert torch.isfinite(found.gradient).all()
    assert found.gradient.any()
    assert all(np.isfinite(value) for value in found.metrics.values())
    policy = method.adapt(parameters, demonstrations, NO_TUNING)
    assert np.isfinite(policy.act(demonstrations[0].observations, policy.start(1)).actions).all()


def test_a_batch_of_one_step_can_be_learned_from(make_demonstrations) -> None:
    demonstrations = make_demonstrations(0, [1])
    method = Pemirl.prepared(SMALL.model_copy(update={"trajectories": 1, "contexts": 1}), 3, demonstrations)
    parameters = method.initial_parameters(named_rng(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch")))
    assert torch.isfinite(found.gradient).all()
    assert found.gradient.any()


def test_the_policy_acts_by_the_mean_of_the_shots_contexts(method, demonstrations, plain_mlp) -> None:
    parameters = method.initial_parameters(named_rng(1, "initial"))
    policy = method.adapt(parameters, demonstrations[:3], NO_TUNING)
    means = [infer(parameters, Transitions.of([one], method.normalise)).mean[0] for one in demonstrations[:3]]
    context = torch.stack(means).mean(0)
    observations = demonstrations[4].observations
    memory = policy.start(len(observations))
    decision = policy.act(observations, memory)
    states = torch.from_numpy(method.normalise(observations))
    for state, action in zip(states, decision.actions, strict=True):
        expected = plain_mlp(network(parameters, "policy"), torch.cat([state, context]))
        np.testing.assert_allclose(action, expected, rtol=1e-4, atol=1e-6)
    assert decision.actions.dtype == np.float32
    assert memory.shape == (6, 0)
    assert not decision.sub_skills.any()
    other = method.adapt(parameters, demonstrations[5:6], NO_TUNING)
    assert not np.allclose(decision.actions, other.act(observations, memory).actions)


def test_adaptation_is_pure_and_takes_no_gradient_step(method, demonstrations) -> None:
    parameters = method.initial_parameters(named_rng(0, "initial"))
    before, state, observations = flatten(parameters), torch.get_rng_state(), demonstrations[5].observations
    one, two = (
        method.adapt(parameters, demonstrations[:2], FineTuning(steps, 0.5)).act(
            observations, np.zeros((5, 0), np.int64)
        )
        for steps in (0, 20)
    )
    assert np.array_equal(one.actions, two.actions)
    assert torch.equal(flatten(parameters), before)
    assert torch.equal(torch.get_rng_state(), state)


class WithoutContext(Pemirl):
    """Whatever the support set, m = 0."""

    def context(self, parameters, support):
        return torch.zeros(self.config.context_dim)


def action_error(policy: Policy, demonstrations: list[Demonstration]) -> float:
    errors = [
        np.square(policy.act(one.observations, policy.start(len(one))).actions - one.actions).sum(1).mean()
        for one in demonstrations
    ]
    return float(np.mean(errors))


@pytest.mark.thorough
@pytest.mark.usefixtures("unchecked")
def test_new_tasks_are_inferred_from_one_or_two_demonstrations() -> None:
    sets = training_sets(16)
    every = list(itertools.chain(*sets.values()))
    config = PemirlConfig(
        hidden_layers=2,
        reward_layers=2,
        hidden_units=32,
        output_scale=0.1,
        trajectories=8,
        steps_per_trajectory=16,
    )
    training = TrainingConfig(iterations=500, tasks_per_iteration=4, learning_rate=3e-3, gradient_clip=10.0)
    method = Pemirl.prepared(config, 2, every)
    parameters = meta_trained(method, sets, training)
    cloning = BehaviourCloning.prepared(
        BehaviourCloningConfig(hidden_layers=2, hidden_units=32, output_scale=0.1, trajectories=4, window=16), 2, every
    )
    cloned = meta_trained(cloning, sets, training)
    without = WithoutContext(config, 2, method.normalise)

    errors, successes = [], []
    for task in range(100, 108):
        demonstrations = record(task, 10).demonstrations
        policies = [
            method.adapt(parameters, demonstrations[:1], NO_TUNING),
            method.adapt(parameters, demonstrations[:2], NO_TUNING),
            without.adapt(parameters, demonstrations[:2], NO_TUNING),
            cloning.adapt(cloned, demonstrations[:2], NO_TUNING),
        ]
        errors.append([action_error(policy, demonstrations[2:]) for policy in policies])
        successes += [rollout.success for rollout in collect_rollouts(policies[1], f"task-{task}", 0, 6 * STEPS)]
    one_shot, two_shot, no_context, behaviour_cloning = np.mean(errors, 0)
    assert max(one_shot, two_shot) < 0.5 * min(no_context, behaviour_cloning)
    assert np.mean(successes) > 0.5
