"""MIL's losses, of which nothing can be copied in the inner one, and its gradients against plain references."""

from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.methods.base import FineTuning
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mil.losses import (
    Pairs,
    Support,
    adapted,
    held_out,
    inner_loss,
    outer_gradient,
    outer_loss,
)
from dmil_core.methods.mil.method import Mil
from dmil_core.methods.mil.transformer import cached, decode, encode
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.seeding import named_rng
from tests.dmil_core.methods.conftest import SMALL_MIL


@pytest.fixture
def parameters() -> Parameters:
    return Mil(SMALL_MIL, 3, Normalisation.identity(4)).initial_parameters(named_rng(0, "initial"))


def support_of(demonstrations: list[Demonstration], config: MilConfig = SMALL_MIL) -> Support:
    identity = Normalisation.identity(demonstrations[0].observations.shape[1])
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
    assert inner_loss(parameters, support, SMALL_MIL).item() == pytest.approx(expected, rel=1e-5)


def test_the_inner_loss_asks_for_so_many_steps_at_most(parameters, make_demonstrations) -> None:
    config = SMALL_MIL.model_copy(update={"positions": 50, "batch_pairs": 5})
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
        asked, predictions = held_out(parameters, support._replace(actions=actions), SMALL_MIL)
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
    config = SMALL_MIL.model_copy(update={"units": 32, "key_units": 16, "value_units": 16, "feed_forward_units": 32})
    method = Mil(config, 2, Normalisation.identity(3))

    def trained(hide: bool) -> float:
        leaves = {
            name: tensor.requires_grad_() for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()
        }
        adam, random, losses = torch.optim.Adam(leaves.values(), lr=3e-3), named_rng(0, "actions"), []
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


@pytest.mark.parametrize("order", ["first", "second"])
@pytest.mark.parametrize("steps", [1, 2])
def test_the_outer_gradient_is_that_of_a_plain_reference(
    parameters, make_demonstrations, order: Literal["first", "second"], steps: int
) -> None:
    config = SMALL_MIL.model_copy(update={"order": order, "inner_steps": steps, "dropout": 0.0, "inner_clip": None})
    support, query = double(support_of(make_demonstrations(0, [5, 4]))), pairs_of(make_demonstrations(1, [6])[0])
    start, query = precise(parameters), double(query)
    fast = start
    for _ in range(steps):
        gradients = torch.autograd.grad(inner_loss(fast, support, config), list(fast.values()), create_graph=True)
        fast = {name: fast[name] - 0.05 * gradient for name, gradient in zip(fast, gradients, strict=True)}
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
    """With dropout, which is the same at both ends; clipped numbers have no gradient, and some are clipped."""
    config = SMALL_MIL.model_copy(update={"inner_clip": clip})
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
        gradient = (found.gradient @ direction).item()
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(gradient, rel=1e-4, abs=1e-6)


def test_the_inner_gradient_is_clipped_number_by_number(parameters, make_demonstrations) -> None:
    support = support_of(make_demonstrations(0, [5, 4]))
    config = SMALL_MIL.model_copy(update={"inner_clip": 0.1})
    end = adapted(parameters, support, config, FineTuning(1, 1.0), keep=False)
    moved = (flatten(end.parameters) - flatten(parameters)).detach().abs()
    at_limit = (moved > 0.0999).float().mean().item()
    assert moved.max().item() == pytest.approx(0.1, abs=1e-5)
    assert 0.05 < at_limit < 0.95
    assert end.clipped == pytest.approx(at_limit, abs=0.01)
