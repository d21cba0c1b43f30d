"""Squared errors, labels and equation 4 against plain loops."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.demonstrations import Normalisation
from dmil_core.losses import Steps, behaviour_cloning_loss, differentiated, squared_errors, sub_skill_labels

SUB_SKILLS = 3


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_squared_errors_by_plain_loops() -> None:
    predictions, actions = normal(7, 2), normal(7, 2, seed=1)
    expected = [sum(float(predictions[t, d] - actions[t, d]) ** 2 for d in range(2)) for t in range(7)]
    assert squared_errors(predictions, actions).tolist() == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("sub_skills", [1, 2, 5])
def test_label_is_the_sub_skill_with_the_least_squared_error(sub_skills: int) -> None:
    predictions, actions = normal(sub_skills, 20, 2), normal(20, 2, seed=1)
    expected = []
    for t in range(20):
        errors = [sum(float(predictions[k, t, d] - actions[t, d]) ** 2 for d in range(2)) for k in range(sub_skills)]
        expected.append(errors.index(min(errors)))
    labels = sub_skill_labels(torch.stack([squared_errors(own, actions) for own in predictions.requires_grad_()]))
    assert labels.tolist() == expected
    assert not labels.requires_grad


@given(st.integers(1, 9), st.integers(1, 4))
def test_behaviour_cloning_averages_over_the_states(count: int, action_dim: int) -> None:
    predictions, actions = normal(count, action_dim), normal(count, action_dim, seed=1)
    expected = sum(
        (a - b) ** 2
        for own, wanted in zip(predictions.tolist(), actions.tolist(), strict=True)
        for a, b in zip(own, wanted, strict=True)
    )
    assert behaviour_cloning_loss(predictions, actions).value.item() == pytest.approx(expected / count, rel=1e-12)


def test_repeating_the_states_of_a_sub_skill_changes_nothing() -> None:
    predictions, actions = normal(4, 3), normal(4, 3, seed=1)
    once = behaviour_cloning_loss(predictions, actions)
    repeated = behaviour_cloning_loss(predictions.repeat(5, 1), actions.repeat(5, 1))
    torch.testing.assert_close(repeated.value, once.value, rtol=1e-12, atol=0)
    torch.testing.assert_close(repeated.gradient.view(5, 4, 3).sum(0), once.gradient, rtol=1e-12, atol=1e-15)


@given(steps=st.integers(1, 12), action_dim=st.integers(1, 5), seed=st.integers(0, 2**31))
def test_behaviour_cloning_equals_its_formula_differentiated(steps: int, action_dim: int, seed: int) -> None:
    predictions, actions = normal(steps, action_dim, seed=seed), normal(steps, action_dim, seed=seed + 1)
    got = behaviour_cloning_loss(predictions, actions)
    reference = differentiated(lambda outputs: ((outputs - actions) ** 2).sum(1).mean(), predictions)
    direction = normal(steps, action_dim, seed=seed + 2)
    torch.testing.assert_close(got[:2], reference[:2], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(got.curvature(direction), reference.curvature(direction), rtol=1e-12, atol=1e-14)


def test_steps_are_standardised_copies_in_order(make_demonstrations) -> None:
    demonstrations = make_demonstrations(0, [3, 1, 2])
    normalise = Normalisation.of(demonstrations)
    steps = Steps.of(demonstrations, normalise)
    assert steps.lengths.tolist() == [3, 1, 2]
    states = torch.cat([torch.from_numpy(normalise(d.observations)) for d in demonstrations])
    assert torch.equal(steps.states, states)
    before = demonstrations[0].actions.copy()
    for tensor in (steps.states, steps.actions):
        tensor.zero_()
    assert (demonstrations[0].actions == before).all()
    assert demonstrations[0].observations.any()


def test_steps_of_one_demonstration_share_no_memory_with_it(make_demonstrations) -> None:
    (demonstration,) = make_demonstrations(0, [4])
    steps = Steps.of([demonstration], Normalisation.identity(demonstration.observations.shape[1]))
    observed, acted = demonstration.observations.copy(), demonstration.actions.copy()
    for tensor in (steps.states, steps.actions):
        tensor.zero_()
    assert (demonstration.observations == observed).all()
    assert (demonstration.actions == acted).all()
