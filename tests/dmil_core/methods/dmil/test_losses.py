"""Equations 3 and 15 against plain loops."""

import itertools
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional

from dmil_core.losses import behaviour_cloning_loss, differentiated, squared_errors, sub_skill_labels
from dmil_core.methods.dmil.losses import (
    balanced_labels,
    continuity_loss,
    cross_entropy,
    high_level_loss,
    soft_labels,
    switching,
)
from tests.dmil_core.test_losses import normal

SUB_SKILLS = 3
trajectories = st.lists(st.lists(st.integers(0, SUB_SKILLS - 1), min_size=1, max_size=8), min_size=1, max_size=6)


def certain(choices: list[list[int]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return one-hot probabilities of the chosen sub-skills, and the trajectories' lengths."""
    chosen = torch.tensor([choice for trajectory in choices for choice in trajectory])
    return functional.one_hot(chosen, SUB_SKILLS).double(), torch.tensor([len(trajectory) for trajectory in choices])


def test_labels_pass_no_gradient_to_the_sub_skills() -> None:
    predictions, logits = normal(SUB_SKILLS, 6, 2).requires_grad_(), normal(6, SUB_SKILLS).requires_grad_()
    errors = torch.stack([squared_errors(own, normal(6, 2, seed=1)) for own in predictions])
    loss = high_level_loss(logits, sub_skill_labels(errors), torch.tensor([2, 4]), 0.0).value
    to_logits, to_predictions = torch.autograd.grad(loss, [logits, predictions], allow_unused=True)
    assert to_logits.abs().sum() > 0
    assert to_predictions is None


@pytest.mark.parametrize("weight", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("lengths", [[7], [1, 3, 2, 1], [1] * 7])
def test_high_level_loss_is_mean_cross_entropy_plus_weighted_switches(weight: float, lengths: list[int]) -> None:
    logits, labels = normal(7, SUB_SKILLS), torch.tensor([0, 2, 1, 1, 0, 2, 2])
    probabilities = [[math.exp(x) / sum(map(math.exp, row)) for x in row] for row in logits.tolist()]
    entropy = -sum(math.log(row[label]) for row, label in zip(probabilities, labels.tolist(), strict=True)) / 7
    switches, start = 0.0, 0
    for length in lengths:
        for t in range(start, start + length - 1):
            same = sum(probabilities[t][k] * probabilities[t + 1][k] for k in range(SUB_SKILLS))
            switches += (1 - same) / length / len(lengths)
        start += length
    loss = high_level_loss(logits, labels, torch.tensor(lengths), weight)
    assert loss.value.item() == pytest.approx(entropy + weight * switches, rel=1e-12)


@pytest.mark.parametrize("weight", [0.0, 0.7])
@pytest.mark.parametrize("lengths", [[1], [5], [1, 3, 1], [1] * 5], ids=str)
def test_high_level_loss_and_differentiated_equal_autograd(weight: float, lengths: list[int]) -> None:
    """Within no_grad too, as it is used; the curvature against the full Hessian, row by row."""
    logits = normal(sum(lengths), SUB_SKILLS)
    labels = torch.tensor([2, 0, 1, 1, 0])[: len(logits)]

    def loss(outputs: torch.Tensor) -> torch.Tensor:
        switches = continuity_loss(outputs.softmax(-1), torch.tensor(lengths))
        return torch.nn.functional.cross_entropy(outputs, labels) + weight * switches

    leaf = logits.clone().requires_grad_()
    value = loss(leaf)
    (gradient,) = torch.autograd.grad(value, leaf)
    hessian: Any = torch.autograd.functional.hessian(loss, logits)
    hessian = hessian.reshape(logits.numel(), logits.numel())
    before = logits.clone()
    with torch.no_grad():
        for got in (differentiated(loss, logits), high_level_loss(logits, labels, torch.tensor(lengths), weight)):
            units = [unit.view_as(logits) for unit in torch.eye(len(hessian)).double()]
            rows = torch.stack([got.curvature(unit).flatten() for unit in units])
            torch.testing.assert_close(got[:2], (value.detach(), gradient), rtol=1e-12, atol=1e-14)
            torch.testing.assert_close(rows, hessian, rtol=1e-12, atol=1e-14)
            assert not any(tensor.requires_grad for tensor in (logits, rows, *got[:2]))
    assert hessian.abs().max() > 0.01
    assert torch.equal(logits, before)


@pytest.mark.parametrize("closed_form", [True, False])
def test_curvature_can_be_asked_again(closed_form: bool) -> None:
    outputs, actions = normal(6, SUB_SKILLS), normal(6, SUB_SKILLS, seed=1)

    if closed_form:
        at = behaviour_cloning_loss(outputs, actions)
    else:
        at = high_level_loss(outputs, actions.argmax(-1), torch.tensor([2, 4]), 0.5)
    one, other = normal(6, SUB_SKILLS, seed=2), normal(6, SUB_SKILLS, seed=3)
    before, first = one.clone(), at.curvature(one)
    kept = first.clone()
    assert not torch.equal(at.curvature(other), first)
    assert torch.equal(at.curvature(one), first)
    assert torch.equal(first, kept)
    assert torch.equal(one, before)


@given(trajectories)
def test_continuity_loss_of_a_certain_high_level_is_the_count_of_equation_15(choices: list[list[int]]) -> None:
    counts = [sum(a != b for a, b in itertools.pairwise(z)) / len(z) for z in choices]
    assert continuity_loss(*certain(choices)).item() == pytest.approx(sum(counts) / len(counts), rel=1e-12)


@given(trajectories, st.integers(0, 2**31))
def test_continuity_loss_is_the_mean_of_each_trajectory_alone(choices: list[list[int]], seed: int) -> None:
    _, lengths = certain(choices)
    probabilities = normal(int(lengths.sum()), SUB_SKILLS, seed=seed).softmax(-1)
    alone = [continuity_loss(own, lengths[i : i + 1]) for i, own in enumerate(probabilities.split(lengths.tolist()))]
    torch.testing.assert_close(
        continuity_loss(probabilities, lengths), torch.stack(alone).mean(), rtol=1e-12, atol=1e-14
    )


@pytest.mark.parametrize(
    ("choices", "expected"),
    [
        ([[0, 0, 0], [1, 1]], 0.0),
        ([[0], [1], [2]], 0.0),
        ([[1]], 0.0),
        ([[0, 1], [1]], 0.25),
        ([[0, 1, 0, 1]], 0.75),
    ],
    ids=["switch at an end", "single steps", "one step", "one switch", "all switch"],
)
def test_a_trajectory_end_is_no_switch(choices: list[list[int]], expected: float) -> None:
    assert continuity_loss(*certain(choices)).item() == expected


@pytest.mark.parametrize("lengths", [[5], [1, 3, 1], [2, 2, 1], [1] * 5])
@pytest.mark.parametrize("check", [torch.autograd.gradcheck, torch.autograd.gradgradcheck])
def test_continuity_loss_has_first_and_second_derivatives(check, lengths: list[int]) -> None:
    logits = normal(5, SUB_SKILLS).requires_grad_()
    assert check(lambda x: continuity_loss(x.softmax(-1), torch.tensor(lengths)), (logits,))


def test_continuity_loss_has_a_gradient_where_it_can_fall() -> None:
    logits = normal(6, SUB_SKILLS).requires_grad_()
    (gradient,) = torch.autograd.grad(continuity_loss(logits.softmax(-1), torch.tensor([6])), logits)
    assert (gradient.abs().sum(-1) > 0).all()


def test_switching_is_the_probability_that_two_draws_differ() -> None:
    probabilities = normal(2, SUB_SKILLS).softmax(-1)
    first, second = probabilities.tolist()
    differ = sum(first[i] * second[j] for i in range(SUB_SKILLS) for j in range(SUB_SKILLS) if i != j)
    assert switching(probabilities).item() == pytest.approx(differ)


@pytest.mark.parametrize("deviation", [0.3, 0.5**0.5, 2.0])
def test_soft_labels_are_the_posterior_of_equal_gaussians(deviation: float) -> None:
    errors = normal(SUB_SKILLS, 5).square()
    labels = soft_labels(errors, deviation)
    for step, column in enumerate(errors.T.tolist()):
        densities = [math.exp(-error / (2 * deviation**2)) for error in column]
        assert labels[step].tolist() == pytest.approx([density / sum(densities) for density in densities])
    assert torch.equal(soft_labels(errors, 1e-3).argmax(1), sub_skill_labels(errors))


def test_the_reference_soft_labels_mix_up_the_steps() -> None:
    errors = normal(SUB_SKILLS, 5).square()
    mixed, proper = soft_labels(errors, 1.0, transposed=False), soft_labels(errors, 1.0)
    assert mixed.shape == proper.shape
    assert mixed.flatten().tolist() == proper.T.flatten().tolist()
    assert not torch.allclose(mixed.sum(1), torch.ones(5).double())


@pytest.mark.parametrize("transposed", [True, False])
def test_cross_entropy_to_soft_labels_equals_autograd(transposed: bool) -> None:
    logits, direction = normal(5, SUB_SKILLS, seed=3), normal(5, SUB_SKILLS, seed=4)
    labels = soft_labels(normal(SUB_SKILLS, 5).square(), 1.0, transposed=transposed)
    got = cross_entropy(logits, labels)
    reference = differentiated(lambda outputs: -(labels * outputs.log_softmax(-1)).sum(1).mean(), logits)
    torch.testing.assert_close(got[:2], reference[:2], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(got.curvature(direction), reference.curvature(direction), rtol=1e-12, atol=1e-14)


def test_cross_entropy_to_certain_soft_labels_is_that_to_the_labels() -> None:
    logits, labels = normal(5, SUB_SKILLS), torch.tensor([2, 0, 1, 1, 0])
    certain = torch.nn.functional.one_hot(labels, SUB_SKILLS).double()
    torch.testing.assert_close(cross_entropy(logits, certain)[:2], cross_entropy(logits, labels)[:2])


def test_the_reference_continuity_loss_is_the_count() -> None:
    logits, labels, lengths = normal(7, SUB_SKILLS), torch.tensor([0, 2, 1, 1, 0, 2, 2]), torch.tensor([3, 4])
    plain, got = (high_level_loss(logits, labels, lengths, weight, "reference") for weight in (0.0, 0.5))
    chosen = logits.argmax(1).tolist()
    counts = [sum(a != b for a, b in itertools.pairwise(own)) / len(own) for own in (chosen[:3], chosen[3:])]
    assert got.value.item() == pytest.approx(plain.value.item() + 0.5 * sum(counts) / 2)
    assert torch.equal(got.gradient, plain.gradient)


def test_balanced_labels_leave_no_sub_skill_without_states() -> None:
    """One fits a little better everywhere; the others get the states where they lose least."""
    errors = 1 + 0.1 * normal(SUB_SKILLS, 90).abs()
    errors[0] -= 0.4
    assert torch.bincount(sub_skill_labels(errors), minlength=SUB_SKILLS).tolist() == [90, 0, 0]
    labels = balanced_labels(errors)
    assert torch.bincount(labels, minlength=SUB_SKILLS).min() >= 20
    order = torch.tensor([2, 0, 1])
    assert torch.equal(order[balanced_labels(errors[order])], labels), "their numbers do not matter"
    lost = errors.gather(0, labels[None]).sum() - errors.min(0).values.sum()
    even = torch.arange(90) % SUB_SKILLS
    assert lost < 0.8 * (errors.gather(0, even[None]).sum() - errors.min(0).values.sum())


def test_where_all_have_their_part_balanced_labels_are_the_best_fitting_ones() -> None:
    errors = torch.full((SUB_SKILLS, 30), 2.0)
    best = torch.arange(30) % SUB_SKILLS
    errors[best, torch.arange(30)] = 0.1
    assert torch.equal(balanced_labels(errors), best)
    assert torch.equal(balanced_labels(torch.zeros(SUB_SKILLS, 3)), torch.zeros(3, dtype=torch.int64))
