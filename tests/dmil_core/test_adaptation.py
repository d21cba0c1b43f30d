"""The dual inner loop: one step by hand, and what it must leave alone."""

from typing import Any

import pytest
import torch

from dmil_core.adaptation import adapt, choose, high_level_objective, label, sub_skill_objective
from dmil_core.losses import Steps
from dmil_core.networks import Parameters, mlp, part

SETTINGS: dict[str, Any] = {"learning_rate": 0.5, "continuity_weight": 0.3}


@pytest.fixture
def parameters(make_parameters) -> Parameters:
    return make_parameters(4, sub_skills=3)


@pytest.fixture
def support(make_steps) -> tuple[Steps, Steps]:
    return make_steps(1, [5, 1, 7]), make_steps(2, [4, 6])


def sub_skill(parameters: Parameters, k: int) -> Parameters:
    return {name: tensor[k] for name, tensor in part(parameters, "low").items()}


@pytest.mark.parametrize("differentiable", [False, True])
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_inputs_stay_bit_for_bit(parameters, support, steps: int, differentiable: bool) -> None:
    if differentiable:
        parameters = {name: tensor.requires_grad_() for name, tensor in parameters.items()}
    tensors = [*parameters.values(), *support[0], *support[1]]
    before = [tensor.detach().clone() for tensor in tensors]
    adapt(parameters, *support, steps=steps, differentiable=differentiable, **SETTINGS)
    assert all(map(torch.equal, tensors, before))
    assert all(tensor.grad is None for tensor in tensors)


@pytest.mark.parametrize("steps", [0, 1, 2, 5])
def test_one_loss_of_each_level_for_each_step(parameters, support, steps: int) -> None:
    adapted = adapt(parameters, *support, steps=steps, **SETTINGS)
    assert len(adapted.high_losses) == len(adapted.low_losses) == steps
    assert list(adapted.parameters) == list(parameters)
    unchanged = all(torch.equal(adapted.parameters[name], tensor) for name, tensor in parameters.items())
    assert unchanged == (steps == 0)


@pytest.mark.parametrize("differentiable", [False, True])
def test_only_a_differentiable_adaptation_carries_a_graph(parameters, support, differentiable: bool) -> None:
    origin = {name: tensor.requires_grad_() for name, tensor in parameters.items()}
    adapted = adapt(origin, *support, steps=2, differentiable=differentiable, **SETTINGS)
    assert all(tensor.requires_grad == differentiable for tensor in adapted.parameters.values())


def test_values_do_not_depend_on_keeping_the_graph(parameters, support) -> None:
    plain = adapt(parameters, *support, steps=3, **SETTINGS)
    origin = {name: tensor.requires_grad_() for name, tensor in parameters.items()}
    kept = adapt(origin, *support, steps=3, differentiable=True, **SETTINGS)
    torch.testing.assert_close(plain.parameters, {name: t.detach() for name, t in kept.parameters.items()})
    assert plain.high_losses == pytest.approx(kept.high_losses)
    assert plain.low_losses == pytest.approx(kept.low_losses)


def test_one_step_is_that_of_algorithm_1(parameters, support) -> None:
    """The labels of τ1 come from the sub-skills before the step, the choice on τ2 from the high level after it."""
    first, second = support
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
    high, low = part(leaves, "high"), part(leaves, "low")

    high_loss = high_level_objective(high, first, label(low, first), SETTINGS["continuity_weight"])
    gradients = torch.autograd.grad(high_loss, list(high.values()))
    expected = {name: t.detach() - 0.5 * g for (name, t), g in zip(high.items(), gradients, strict=True)}

    chosen = choose(expected, second.states)
    assert not torch.equal(chosen, choose(high, second.states)), "the order of the two steps must matter here"
    low_loss = sub_skill_objective(low, second, chosen)
    gradients = torch.autograd.grad(low_loss, list(low.values()))
    expected |= {name: t.detach() - 0.5 * g for (name, t), g in zip(low.items(), gradients, strict=True)}

    adapted = adapt(parameters, first, second, steps=1, **SETTINGS)
    torch.testing.assert_close(adapted.parameters, expected, rtol=1e-12, atol=1e-12)
    assert adapted.high_losses == (pytest.approx(high_loss.item()),)
    assert adapted.low_losses == (pytest.approx(low_loss.item()),)


def test_label_and_choice_by_plain_loops(parameters, support) -> None:
    steps = support[0]
    errors = torch.stack([(mlp(sub_skill(parameters, k), steps.states) - steps.actions).norm(dim=-1) for k in range(3)])
    assert label(part(parameters, "low"), steps).tolist() == [int(column.argmin()) for column in errors.T]
    logits = mlp(part(parameters, "high"), steps.states)
    assert choose(part(parameters, "high"), steps.states).tolist() == [int(row.argmax()) for row in logits]


def test_sub_skill_objective_masks_and_averages(parameters, support) -> None:
    steps, chosen = support[1], torch.tensor([0, 2, 2, 0, 0, 0, 2, 2, 2, 0])
    expected = sum(
        (mlp(sub_skill(parameters, k), steps.states) - steps.actions).square().sum(-1)[chosen == k].mean()
        for k in (0, 2)
    )
    torch.testing.assert_close(sub_skill_objective(part(parameters, "low"), steps, chosen), expected)


def test_a_sub_skill_that_is_never_chosen_stays(parameters, support) -> None:
    biased = {**parameters, "high.2.bias": torch.tensor([0.0, 50.0, 0.0]).double()}
    adapted = adapt(biased, *support, steps=2, learning_rate=0.01, continuity_weight=0.0).parameters
    for name, tensor in part(parameters, "low").items():
        assert torch.equal(adapted[name][[0, 2]], tensor[[0, 2]])
        assert not torch.equal(adapted[name][1], tensor[1])
