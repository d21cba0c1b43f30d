"""MIL: that nothing can be copied in the inner loss, its gradients, its policy, and that it learns."""

import itertools
from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from dmil_core.configs import TrainingConfig
from dmil_core.demonstrations import Demonstration, DemonstrationError, Standardisation
from dmil_core.methods.base import FineTuning, MetaLearner
from dmil_core.methods.mil import Mil, MilBatch, MilConfig
from dmil_core.methods.mil_learning import (
    Pairs,
    Support,
    adapted,
    held_out,
    inner_loss,
    outer_gradient,
    outer_loss,
)
from dmil_core.methods.transformer import cached, decode, encode
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.seeding import stream
from tests.dmil_core.methods.toys import meta_trained, practise, record, training_sets

Order = Literal["first", "second"]
ORDERS = pytest.mark.parametrize("order", ["first", "second"])

SMALL = MilConfig(
    layers=1,
    heads=2,
    units=8,
    key_units=4,
    value_units=3,
    feed_forward_units=6,
    positions=6,
    batch_pairs=16,
    output_scale=1.0,
    inner_learning_rate=0.05,
)


@pytest.fixture
def demonstrations(make_demonstrations) -> list[Demonstration]:
    return make_demonstrations(0, [7, 3, 9, 4, 1, 5])


@pytest.fixture
def method(demonstrations) -> Mil:
    return Mil.prepared(SMALL, 3, demonstrations)


@pytest.fixture
def parameters(method) -> Parameters:
    return method.initial_parameters(stream(0, "initial"))


def support_of(demonstrations: list[Demonstration], config: MilConfig = SMALL) -> Support:
    identity = Standardisation.identity(demonstrations[0].observations.shape[1])
    return Support.of(demonstrations, identity, config.positions, config.units)


def double(values: Support | Pairs) -> Any:
    return type(values)(*(value.double() if value.is_floating_point() else value for value in values))


def precise(parameters: Parameters) -> dict[str, Tensor]:
    """Return parameters in double precision, moved off zero, asking for a gradient."""
    generator = torch.Generator().manual_seed(7)
    return {
        name: (tensor + 0.1 * torch.randn(tensor.shape, generator=generator)).double().requires_grad_()
        for name, tensor in parameters.items()
    }


def pairs_of(demonstration: Demonstration) -> Pairs:
    return Pairs(torch.tensor(demonstration.observations), torch.tensor(demonstration.actions))


def test_the_paper_s_sizes() -> None:
    method = Mil(MilConfig(), 4, Standardisation.identity(39))
    parameters = method.initial_parameters(stream(0, "initial"))
    attention, norms, feed_forward = 4 * 512 * 512, 4 * 512, 2 * 512 * 2048 + 2048 + 512
    layers = 6 * (attention + norms + feed_forward) + 2 * 2 * 512
    inputs = (39 + 4 + 1) * 512 + 512 + 3 * 512 + (39 + 1) * 512
    assert len(flatten(parameters)) == layers + inputs + 4 * 513
    assert isinstance(method, MetaLearner)


@pytest.mark.parametrize("size", ["paper", "quick", "smoke"])
def test_sizes_are_settings(size: str) -> None:
    wanted = MilConfig.sizes[size]
    config = MilConfig.model_validate(wanted.get("method", {}))
    TrainingConfig.model_validate(wanted.get("training", {}))
    assert wanted["evaluation"] == {
        "fine_tuning_steps": config.inner_steps,
        "learning_rate": config.inner_learning_rate,
    }


def test_a_sample_has_support_and_query_of_different_demonstrations(method, demonstrations) -> None:
    seen = []
    for iteration in range(60):
        batch = method.sample(demonstrations, iteration, stream(0, "batch", iteration))
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
        assert len(set(drawn)) == len(drawn) == min(SMALL.batch_pairs, sum(map(len, others)))
        assert {steps[pair] for pair in drawn} == set(batch.query_ids)
        seen.append(len(support))
    assert [seen.count(shots) > 10 for shots in (1, 2, 3)] == [True] * 3
    assert set(seen) == {1, 2, 3}


def test_query_pairs_are_drawn_evenly_from_all_steps(make_demonstrations) -> None:
    demonstrations = make_demonstrations(0, [2, 30, 10])
    config = SMALL.model_copy(update={"shots": 1, "batch_pairs": 1})
    method = Mil(config, 3, Standardisation.identity(4))
    counts: dict[str, int] = dict.fromkeys(("d0", "d1", "d2"), 0)
    for draw in range(900):
        batch = method.sample(demonstrations, 0, stream(0, "batch", draw))
        counts[batch.query_ids[0]] += batch.support[0].id == "d0"
    assert counts["d0"] == 0
    assert abs(counts["d1"] / (counts["d1"] + counts["d2"]) - 0.75) < 0.1


def test_a_task_needs_two_demonstrations(method, demonstrations) -> None:
    batch = method.sample(demonstrations[:2], 0, stream(0, "batch"))
    assert sorted(batch.ids) == ["d0", "d1"]
    with pytest.raises(DemonstrationError, match="got 1 for this task; wanted at least 2"):
        method.sample(demonstrations[:1], 0, stream(0, "batch"))


def test_places_restart_with_each_demonstration_and_long_ones_are_thinned(make_demonstrations) -> None:
    demonstrations = make_demonstrations(0, [3, 500, 6])
    support = support_of(demonstrations)
    assert support.demonstrations.tolist() == [0] * 3 + [1] * 6 + [2] * 6
    assert torch.equal(support.positions[:3], support.positions[3:6])
    assert torch.equal(support.positions[3:9], support.positions[9:])
    kept = [0, 100, 200, 299, 399, 499]
    assert np.array_equal(support.states[3:9].numpy(), demonstrations[1].observations[kept])
    assert np.array_equal(support.actions[3:9].numpy(), demonstrations[1].actions[kept])


def test_each_half_of_the_support_is_predicted_from_the_other(parameters, make_demonstrations) -> None:
    support = support_of(make_demonstrations(0, [4, 3]))
    expected = 0.0
    for t in range(7):
        context = support.only(torch.tensor([other for other in range(7) if other % 2 != t % 2]))
        cache = cached(parameters, encode(parameters, *context, 2), 2)
        prediction = decode(parameters, support.states[t : t + 1], cache)[0]
        expected += (prediction - support.actions[t]).square().sum().item() / 7
    assert inner_loss(parameters, support, SMALL).item() == pytest.approx(expected, rel=1e-5)


def test_the_inner_loss_asks_for_so_many_steps_at_most(parameters, make_demonstrations) -> None:
    config = SMALL.model_copy(update={"positions": 50, "batch_pairs": 5})
    support = support_of(make_demonstrations(0, [9, 12]), config)
    asked, predictions = held_out(parameters, support, config)
    assert sorted(asked.tolist()) == [0, 5, 10, 15, 20]
    whole = held_out(parameters, support, config.model_copy(update={"batch_pairs": 100}))
    for t, prediction in zip(asked.tolist(), predictions, strict=True):
        torch.testing.assert_close(prediction, whole.predictions[whole.steps.tolist().index(t)])


def test_no_path_leads_from_an_action_to_its_own_prediction(parameters, make_demonstrations) -> None:
    support = support_of(make_demonstrations(0, [5, 4]))
    count = len(support.states)

    def hidden(actions: Tensor) -> Tensor:
        asked, predictions = held_out(parameters, support._replace(actions=actions), SMALL)
        return predictions[asked.argsort()]

    def shown(actions: Tensor) -> Tensor:
        cache = cached(parameters, encode(parameters, *support._replace(actions=actions), 2), 2)
        return decode(parameters, support.states, cache)

    def reach(function: Any) -> Tensor:
        jacobian = torch.autograd.functional.jacobian(function, support.actions)
        assert isinstance(jacobian, Tensor)
        return jacobian.abs().sum((1, 3))

    own, other = torch.eye(count, dtype=torch.bool), (torch.arange(count)[:, None] + torch.arange(count)) % 2 == 1
    assert not reach(hidden)[own].any()
    assert (reach(hidden)[other] > 0).all()
    assert (reach(shown)[own] > 0).all()


@pytest.mark.usefixtures("unchecked")
def test_only_what_is_not_hidden_can_be_copied() -> None:
    """Actions are random, and others in each iteration: only who sees them knows them."""
    config = SMALL.model_copy(update={"units": 32, "key_units": 16, "value_units": 16, "feed_forward_units": 32})
    method = Mil(config, 2, Standardisation.identity(3))

    def trained(hide: bool) -> float:
        leaves = {
            name: tensor.requires_grad_() for name, tensor in method.initial_parameters(stream(0, "initial")).items()
        }
        adam, random, losses = torch.optim.Adam(leaves.values(), lr=3e-3), stream(0, "actions"), []
        for _ in range(600):
            states, actions = (random.uniform(-1, 1, (6, size)).astype(np.float32) for size in (3, 2))
            support = support_of([Demonstration("d", "t", states, actions)], config)
            if hide:
                loss = inner_loss(leaves, support, config)
            else:
                loss = outer_loss(leaves, support, Pairs(support.states, support.actions), config)
            adam.zero_grad()
            loss.backward()
            adam.step()
            losses.append(loss.item())
        return float(np.mean(losses[-100:]))

    variance = 2 / 3
    assert trained(hide=True) > 0.9 * variance
    assert trained(hide=False) < 0.5 * variance


@ORDERS
@pytest.mark.parametrize("steps", [1, 2])
def test_the_outer_gradient_is_that_of_a_plain_twin(parameters, make_demonstrations, order: Order, steps: int) -> None:
    config = SMALL.model_copy(update={"order": order, "inner_steps": steps, "dropout": 0.0, "inner_clip": None})
    support, query = double(support_of(make_demonstrations(0, [5, 4]))), pairs_of(make_demonstrations(1, [6])[0])
    start, query = precise(parameters), double(query)
    fast = start
    for _ in range(steps):
        slopes = torch.autograd.grad(inner_loss(fast, support, config), list(fast.values()), create_graph=True)
        fast = {name: fast[name] - 0.05 * slope for name, slope in zip(fast, slopes, strict=True)}
    loss = outer_loss(fast, support, query, config)
    of = start if order == "second" else fast
    expected = dict(zip(of, torch.autograd.grad(loss, list(of.values())), strict=True))
    found = outer_gradient(start, support, query, config, 0)
    torch.testing.assert_close(found.gradient, flatten(expected))
    assert found.metrics["loss"] == pytest.approx(loss.item())
    assert found.metrics["inner_loss"] == pytest.approx(inner_loss(start, support, config).item())
    assert found.metrics["loss_unadapted"] == pytest.approx(outer_loss(start, support, query, config).item())


@pytest.mark.parametrize("clip", [None, 0.05])
def test_the_second_order_gradient_against_finite_differences(parameters, make_demonstrations, clip) -> None:
    """With dropout, which is the same at both ends; clipped numbers have no slope, and some are clipped."""
    config = SMALL.model_copy(update={"inner_clip": clip})
    support = double(support_of(make_demonstrations(0, [5, 4])))
    query, start = double(pairs_of(make_demonstrations(1, [6])[0])), precise(parameters)
    found = outer_gradient(start, support, query, config, 3)
    assert (found.metrics["inner_clipped"] > 0.1) == (clip is not None)
    shapes = {name: tensor.shape for name, tensor in start.items()}
    vector = flatten(start).detach()
    for seed in range(5):
        direction = torch.randn(len(vector), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        ends = [
            outer_gradient(unflatten(vector + step * direction, shapes), support, query, config, 3).metrics["loss"]
            for step in (1e-6, -1e-6)
        ]
        slope = (found.gradient @ direction).item()
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(slope, rel=1e-4, abs=1e-6)


def test_first_and_second_order_differ(method, parameters, demonstrations) -> None:
    batch = method.sample(demonstrations, 0, stream(0, "batch"))
    gradients = []
    for order in ("first", "second"):
        other = Mil(SMALL.model_copy(update={"order": order}), 3, method.standardise)
        gradients.append(other.task_gradient(parameters, batch).gradient)
    assert not torch.allclose(*gradients, rtol=1e-2)


def test_the_inner_gradient_is_clipped_number_by_number(parameters, make_demonstrations) -> None:
    support = support_of(make_demonstrations(0, [5, 4]))
    config = SMALL.model_copy(update={"inner_clip": 0.1})
    end = adapted(parameters, support, config, FineTuning(1, 1.0), keep=False)
    moved = (flatten(end.parameters) - flatten(parameters)).detach().abs()
    at_limit = (moved > 0.0999).float().mean().item()
    assert moved.max().item() == pytest.approx(0.1, abs=1e-5)
    assert 0.05 < at_limit < 0.95
    assert end.clipped == pytest.approx(at_limit, abs=0.01)


@ORDERS
def test_a_task_gradient_is_pure(method, parameters, demonstrations, order: Order) -> None:
    method = Mil(SMALL.model_copy(update={"order": order}), 3, method.standardise)
    batch = method.sample(demonstrations, 0, stream(0, "batch"))
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
    batch = method.sample(demonstrations, 0, stream(0, "batch"))
    other = MilBatch(batch.support, batch.observations, batch.actions, batch.query_ids, batch.seed + 1)
    one, two = method.task_gradient(parameters, batch), method.task_gradient(parameters, other)
    assert one.metrics["inner_loss"] == two.metrics["inner_loss"]
    assert one.metrics["loss"] != two.metrics["loss"]
    assert one.metrics["loss_unadapted"] != two.metrics["loss_unadapted"]


@ORDERS
def test_a_single_step_can_be_learned_from(make_demonstrations, order: Order) -> None:
    demonstrations = make_demonstrations(0, [1] * 4)
    method = Mil.prepared(SMALL.model_copy(update={"order": order}), 3, demonstrations)
    parameters = method.initial_parameters(stream(0, "initial"))
    found = method.task_gradient(parameters, method.sample(demonstrations, 0, stream(0, "batch")))
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
    support = Support.of(demonstrations[:3], method.standardise, SMALL.positions, SMALL.units)
    expected = dict(parameters)
    for _ in range(steps):
        leaves = {name: tensor.detach().requires_grad_() for name, tensor in expected.items()}
        slopes = torch.autograd.grad(inner_loss(leaves, support, SMALL), list(leaves.values()))
        expected = {name: leaves[name].detach() - 0.1 * slope for name, slope in zip(leaves, slopes, strict=True)}
    torch.testing.assert_close(flatten(policy.parameters), flatten(expected))
    assert torch.equal(flatten(policy.parameters), before) == (steps == 0)
    cache = cached(expected, encode(expected, *support, 2), 2)
    observations = demonstrations[3].observations
    actions = decode(expected, torch.from_numpy(method.standardise(observations)), cache)
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
        successes += [rollout.success for rollout in practise(policy, f"task-{task}", 1, 5 * 40)]
    assert np.mean(errors) < 0.3 * np.mean(naive)
    assert np.mean(successes) >= 0.8
