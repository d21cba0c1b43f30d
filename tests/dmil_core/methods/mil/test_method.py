"""MIL: what a slot learns from, its policy, and that it learns; its losses have their own tests."""

import itertools
from typing import Literal

import numpy as np
import pytest
import torch

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import DemonstrationError, Normalisation
from dmil_core.methods.base import FineTuning, MetaLearner
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mil.losses import Support, inner_loss
from dmil_core.methods.mil.method import Mil, MilBatch
from dmil_core.methods.mil.transformer import cached, decode, encode
from dmil_core.networks import Parameters, flatten
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.conftest import SMALL_MIL
from tests.dmil_core.methods.toys import collect_rollouts, meta_trained, record, training_sets

Order = Literal["first", "second"]
ORDERS = pytest.mark.parametrize("order", ["first", "second"])


@pytest.fixture
def method(demonstrations) -> Mil:
    return Mil.prepared(SMALL_MIL, 3, demonstrations)


@pytest.fixture
def parameters(method) -> Parameters:
    return method.initial_parameters(named_rng(0, "initial"))


def test_the_paper_s_sizes() -> None:
    method = Mil(MilConfig(), 4, Normalisation.identity(39))
    parameters = method.initial_parameters(named_rng(0, "initial"))
    attention, norms, feed_forward = 4 * 512 * 512, 4 * 512, 2 * 512 * 2048 + 2048 + 512
    layers = 6 * (attention + norms + feed_forward) + 2 * 2 * 512
    inputs = (39 + 4 + 1) * 512 + 512 + 3 * 512 + (39 + 1) * 512
    assert len(flatten(parameters)) == layers + inputs + 4 * 513
    assert isinstance(method, MetaLearner)


@pytest.mark.parametrize("size", ["paper", "quick", "smoke"])
def test_sizes_are_settings(size: str) -> None:
    wanted = MilConfig.presets[size]
    config = MilConfig.model_validate(wanted.get("method", {}))
    TrainingConfig.model_validate(wanted.get("training", {}))
    assert wanted["evaluation"] == {
        "fine_tuning_steps": config.inner_steps,
        "learning_rate": config.inner_learning_rate,
    }


def test_a_sample_has_support_and_query_of_different_demonstrations(method, demonstrations) -> None:
    seen = []
    for iteration in range(60):
        batch = method.sample(demonstrations, iteration, named_rng(0, "batch", iteration))
        support = [demonstration.id for demonstration in batch.support]
        assert list(batch.ids) == support + list(batch.query_ids)
        assert not set(support) & set(batch.query_ids)
        others = [one for one in demonstrations if one.id not in support]
        steps = {
            (observation.tobytes(), action.tobytes()): one.id
            for one in others
            for observation, action in zip(one.observations, one.actions, strict=True)
        }
        drawn = [
            (observation.tobytes(), action.tobytes())
            for observation, action in zip(batch.observations, batch.actions, strict=True)
        ]
        assert len(set(drawn)) == len(drawn) == min(SMALL_MIL.batch_pairs, sum(map(len, others)))
        assert {steps[pair] for pair in drawn} == set(batch.query_ids)
        seen.append(len(support))
    assert [seen.count(shots) > 10 for shots in (1, 2, 3)] == [True] * 3
    assert set(seen) == {1, 2, 3}


def test_query_pairs_are_drawn_evenly_from_all_steps(make_demonstrations) -> None:
    demonstrations = make_demonstrations(0, [2, 30, 10])
    config = SMALL_MIL.model_copy(update={"shots": 1, "batch_pairs": 1})
    method = Mil(config, 3, Normalisation.identity(4))
    counts: dict[str, int] = dict.fromkeys(("d0", "d1", "d2"), 0)
    for draw in range(900):
        batch = method.sample(demonstrations, 0, named_rng(0, "batch", draw))
        counts[batch.query_ids[0]] += batch.support[0].id == "d0"
    assert counts["d0"] == 0
    assert abs(counts["d1"] / (counts["d1"] + counts["d2"]) - 0.75) < 0.1


def test_a_task_needs_two_demonstrations(method, demonstrations) -> None:
    batch = method.sample(demonstrations[:2], 0, named_rng(0, "batch"))
    assert sorted(batch.ids) == ["d0", "d1"]
    with pytest.raises(DemonstrationError, match="got 1 for this task; wanted at least 2"):
        method.sample(demonstrations[:1], 0, named_rng(0, "batch"))


def test_first_and_second_order_differ(method, parameters, demonstrations) -> None:
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    gradients = []
    for order in ("first", "second"):
        other = Mil(SMALL_MIL.model_copy(update={"order": order}), 3, method.normalise)
        gradients.append(other.task_gradient(parameters, batch).gradient)
    assert not torch.allclose(*gradients, rtol=1e-2)


@ORDERS
def test_a_task_gradient_is_pure(method, parameters, demonstrations, order: Order) -> None:
    method = Mil(SMALL_MIL.model_copy(update={"order": order}), 3, method.normalise)
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    before, state = flatten(parameters), torch.get_rng_state()
    one = method.task_gradient(parameters, batch)
    torch.manual_seed(1)
    two = method.task_gradient(parameters, batch)
    torch.set_rng_state(state)
    assert torch.equal(one.gradient, two.gradient)
    assert one.metrics == two.metrics
    assert torch.equal(flatten(parameters), before)
    assert one.gradient.shape == before.shape
    assert not one.gradient.requires_grad
    assert not any(tensor.requires_grad for tensor in parameters.values())


def test_dropout_is_in_the_outer_loss_alone(method, parameters, demonstrations) -> None:
    batch = method.sample(demonstrations, 0, named_rng(0, "batch"))
    other = MilBatch(batch.support, batch.observations, batch.actions, batch.query_ids, batch.seed + 1)
    one, two = method.task_gradient(parameters, batch), method.task_gradient(parameters, other)
    assert one.metrics["inner_loss"] == two.metrics["inner_loss"]
    assert one.metrics["loss"] != two.metrics["loss"]
    assert one.metrics["loss_unadapted"] != two.metrics["loss_unadapted"]


@ORDERS
def test_a_single_step_can_be_learned_from(make_demonstrations, order: Order) -> None:
    demonstrations = make_demonstrations(0, [1] * 4)
    method = Mil.prepared(SMALL_MIL.model_copy(update={"order": order}), 3, demonstrations)
    parameters = method.initial_parameters(named_rng(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, named_rng(0, "batch")))
    assert found.gradient.isfinite().all()
    assert found.gradient.any()
    assert all(np.isfinite(value) for value in found.metrics.values())
    policy = method.adapt(parameters, demonstrations[:1], FineTuning(2, 0.05))
    assert not torch.equal(flatten(policy.parameters), flatten(parameters))
    assert np.isfinite(policy.act(demonstrations[1].observations, policy.start(1)).actions).all()


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_adaptation_is_the_inner_loop(method, parameters, demonstrations, steps: int) -> None:
    before = flatten(parameters)
    policy = method.adapt(parameters, demonstrations[:3], FineTuning(steps, 0.1))
    assert torch.equal(flatten(parameters), before)
    support = Support.of(demonstrations[:3], method.normalise, SMALL_MIL.positions, SMALL_MIL.units)
    expected = dict(parameters)
    for _ in range(steps):
        leaves = {name: tensor.detach().requires_grad_() for name, tensor in expected.items()}
        gradients = torch.autograd.grad(inner_loss(leaves, support, SMALL_MIL), list(leaves.values()))
        expected = {
            name: leaves[name].detach() - 0.1 * gradient for name, gradient in zip(leaves, gradients, strict=True)
        }
    torch.testing.assert_close(flatten(policy.parameters), flatten(expected))
    assert torch.equal(flatten(policy.parameters), before) == (steps == 0)
    cache = cached(expected, encode(expected, *support, 2), 2)
    observations = demonstrations[3].observations
    actions = decode(expected, torch.from_numpy(method.normalise(observations)), cache)
    decision = policy.act(observations, policy.start(len(observations)))
    np.testing.assert_allclose(decision.actions, actions.numpy(), rtol=1e-5, atol=1e-6)
    assert decision.actions.dtype == np.float32
    assert decision.memory.shape == (len(observations), 0)
    assert decision.sub_skills.tolist() == [0] * len(observations)
    assert policy.sub_skill_use(demonstrations[0]).chosen.tolist() == [0] * 7


def test_the_policy_reads_its_demonstrations(method, parameters, demonstrations) -> None:
    """Without a gradient step, another support set is another policy."""
    observations = demonstrations[0].observations
    one, two = (method.adapt(parameters, [demonstrations[index]], FineTuning(0, 0.1)) for index in (1, 2))
    actions = [policy.act(observations, policy.start(7)).actions for policy in (one, two)]
    assert not np.allclose(*actions)


def test_demonstrations_from_one_step_to_500(method, parameters, make_demonstrations) -> None:
    policy = method.adapt(parameters, make_demonstrations(1, [1, 500, 37]), FineTuning(1, 0.01))
    assert policy.act(np.zeros((2, 4), np.float32), policy.start(2)).actions.shape == (2, 3)


def test_more_shots_than_embeddings_are_refused(method, parameters, demonstrations) -> None:
    with pytest.raises(DemonstrationError, match=r"got 4 demonstrations; wanted at most method.shots, 3"):
        method.adapt(parameters, demonstrations[:4], FineTuning(1, 0.1))


@pytest.mark.usefixtures("unchecked")
def test_learns_to_imitate_new_tasks() -> None:
    """Predicting the support's mean action has an error of 0.49 here, behaviour cloning without adaptation 0.28."""
    sets = training_sets()
    config = MilConfig(
        layers=1,
        heads=2,
        units=32,
        key_units=16,
        value_units=16,
        feed_forward_units=64,
        positions=40,
        batch_pairs=64,
        inner_learning_rate=1e-2,
        order="first",
    )
    method = Mil.prepared(config, 2, list(itertools.chain(*sets.values())))
    training = TrainingConfig(iterations=250, tasks_per_iteration=4, learning_rate=1e-3, gradient_clip=10.0)
    parameters = meta_trained(method, sets, training)
    errors, naive, successes = [], [], []
    for task in range(100, 106):
        support, others = np.split(np.array(record(task, 8).demonstrations, dtype=object), [2])
        policy = method.adapt(parameters, list(support), FineTuning(1, config.inner_learning_rate))
        mean = np.concatenate([one.actions for one in support]).mean(0)
        for one in others:
            decision = policy.act(one.observations, policy.start(len(one)))
            errors.append(np.square(decision.actions - one.actions).sum(1).mean())
            naive.append(np.square(mean - one.actions).sum(1).mean())
        successes += [rollout.success for rollout in collect_rollouts(policy, f"task-{task}", 1, 5 * 40)]
    assert np.mean(errors) < 0.3 * np.mean(naive)
    assert np.mean(successes) >= 0.8
