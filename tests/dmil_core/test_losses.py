"""Equations 3, 4 and 15 against plain loops."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional

from dmil_core.demonstrations import Standardisation
from dmil_core.losses import (
    Steps,
    behaviour_cloning_loss,
    continuity_loss,
    high_level_loss,
    sub_skill_labels,
    switching,
)

SUB_SKILLS = 3
trajectories = st.lists(st.lists(st.integers(0, SUB_SKILLS - 1), min_size=1, max_size=8), min_size=1, max_size=6)


def certain(choices: list[list[int]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return one-hot probabilities of the chosen sub-skills, and the trajectories' lengths."""
    chosen = torch.tensor([choice for trajectory in choices for choice in trajectory])
    return functional.one_hot(chosen, SUB_SKILLS).double(), torch.tensor([len(trajectory) for trajectory in choices])


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("sub_skills", [1, 2, 5])
def test_label_is_the_sub_skill_with_the_least_squared_error(sub_skills: int) -> None:
    predictions, actions = normal(sub_skills, 20, 2), normal(20, 2, seed=1)
    expected = []
    for t in range(20):
        errors = [sum(float(predictions[k, t, d] - actions[t, d]) ** 2 for d in range(2)) for k in range(sub_skills)]
        expected.append(errors.index(min(errors)))
    labels = sub_skill_labels(predictions.requires_grad_(), actions)
    assert labels.tolist() == expected
    assert not labels.requires_grad


def test_labels_pass_no_gradient_to_the_sub_skills() -> None:
    predictions, logits = normal(SUB_SKILLS, 6, 2).requires_grad_(), normal(6, SUB_SKILLS).requires_grad_()
    loss = high_level_loss(logits, sub_skill_labels(predictions, normal(6, 2, seed=1)), torch.tensor([2, 4]), 0.5)
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
    assert loss.item() == pytest.approx(entropy + weight * switches, rel=1e-12)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=5).filter(any))
def test_behaviour_cloning_averages_each_sub_skill_over_its_own_states(counts: list[int]) -> None:
    predictions = [normal(count, 2, seed=k) for k, count in enumerate(counts)]
    actions = [normal(count, 2, seed=10 + k) for k, count in enumerate(counts)]
    expected = 0.0
    for own, wanted in zip(predictions, actions, strict=True):
        errors = [
            sum((a - b) ** 2 for a, b in zip(*rows, strict=True))
            for rows in zip(own.tolist(), wanted.tolist(), strict=True)
        ]
        expected += sum(errors) / len(errors) if errors else 0.0
    assert behaviour_cloning_loss(predictions, actions).item() == pytest.approx(expected, rel=1e-12)


def test_repeating_the_states_of_one_sub_skill_changes_nothing() -> None:
    predictions, actions = [normal(2, 3), normal(4, 3, seed=1)], [normal(2, 3, seed=2), normal(4, 3, seed=3)]
    repeated = behaviour_cloning_loss(
        [predictions[0].repeat(5, 1), predictions[1]], [actions[0].repeat(5, 1), actions[1]]
    )
    torch.testing.assert_close(repeated, behaviour_cloning_loss(predictions, actions), rtol=1e-12, atol=0)


def test_a_sub_skill_without_states_gets_a_zero_gradient_and_no_nan() -> None:
    bank = normal(2, 4, 3).requires_grad_()
    loss = behaviour_cloning_loss([bank[0], bank[1, :0]], [normal(4, 3, seed=1), torch.zeros(0, 3).double()])
    (gradient,) = torch.autograd.grad(loss, bank)
    assert gradient[0].abs().sum() > 0
    assert torch.equal(gradient[1], torch.zeros(4, 3).double())


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


def test_steps_are_standardised_copies_in_order(make_demonstrations) -> None:
    demonstrations = make_demonstrations(0, [3, 1, 2])
    standardise = Standardisation.of(demonstrations)
    steps = Steps.of(demonstrations, standardise)
    assert steps.lengths.tolist() == [3, 1, 2]
    states = torch.cat([torch.from_numpy(standardise(d.observations)) for d in demonstrations])
    assert torch.equal(steps.states, states)
    before = demonstrations[0].actions.copy()
    for tensor in (steps.states, steps.actions):
        tensor.zero_()
    assert (demonstrations[0].actions == before).all()
    assert demonstrations[0].observations.any()


def test_steps_of_one_demonstration_share_no_memory_with_it(make_demonstrations) -> None:
    (demonstration,) = make_demonstrations(0, [4])
    steps = Steps.of([demonstration], Standardisation.identity(demonstration.observations.shape[1]))
    observed, acted = demonstration.observations.copy(), demonstration.actions.copy()
    for tensor in (steps.states, steps.actions):
        tensor.zero_()
    assert (demonstration.observations == observed).all()
    assert (demonstration.actions == acted).all()
