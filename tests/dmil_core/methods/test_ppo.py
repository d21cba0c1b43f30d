"""Advantages and the clipped surrogate, against their sums and RLlib's own."""

import warnings

import numpy as np
import pytest
import torch

from dmil_core.methods.ppo import (
    clipped_surrogate,
    generalised_advantages,
    normalised,
    scaled,
    trajectory_advantages,
)


def sums_of_errors(rewards: np.ndarray, values: np.ndarray, discount: float, trace: float) -> list[float]:
    """Return the advantages of one episode, each summed anew; `values` has one more, of the state beyond the end."""
    errors = rewards + discount * values[1:] - values[:-1]
    return [sum((discount * trace) ** n * error for n, error in enumerate(errors[t:])) for t in range(len(errors))]


@pytest.mark.parametrize("steps", [1, 2, 7])
@pytest.mark.parametrize("discount", [0.0, 0.9])
@pytest.mark.parametrize("smoothing", [0.0, 0.5, 1.0])
def test_advantages_are_the_discounted_sum_of_errors(steps: int, discount: float, smoothing: float) -> None:
    draw = np.random.default_rng(steps)
    rewards, values = draw.normal(size=steps), draw.normal(size=steps + 1)
    expected = sums_of_errors(rewards, values, discount, smoothing)
    np.testing.assert_allclose(generalised_advantages(rewards, values, discount, smoothing), expected)


def test_without_smoothing_away_advantages_are_returns_less_values() -> None:
    draw = np.random.default_rng(0)
    rewards, values = draw.normal(size=4), draw.normal(size=5)
    returns = [sum(0.9 ** (later - t) * rewards[later] for later in range(t, 4)) for t in range(4)]
    beyond = [0.9 ** (4 - t) * values[4] for t in range(4)]
    found = generalised_advantages(rewards, values, 0.9, 1.0)
    np.testing.assert_allclose(found, np.array(returns) + beyond - values[:4])


def test_advantages_are_those_of_rllib() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from ray.rllib.utils.postprocessing.value_predictions import compute_value_targets
    draw = np.random.default_rng(1)
    episodes = [(draw.normal(size=steps), draw.normal(size=steps + 1)) for steps in (5, 1, 9)]
    # RLlib takes all episodes in a row, each with one more step whose value is of the state beyond its end.
    rewards, values = (
        np.concatenate(column) for column in zip(*((np.append(r, 0), v) for r, v in episodes), strict=True)
    )
    cut = np.concatenate([np.eye(len(v))[-2] for _, v in episodes])
    targets = compute_value_targets(values, rewards, np.zeros_like(cut), cut, gamma=0.99, lambda_=0.95)
    places = np.cumsum([len(v) for _, v in episodes])[:-1]
    for (r, v), of in zip(episodes, np.split(targets, places), strict=True):
        found = generalised_advantages(r, v, 0.99, 0.95)
        np.testing.assert_allclose(found + v[:-1], of[:-1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "value", "derivative"),
    [
        (1.0, 2.0, 2.0, 2.0),
        (1.1, 2.0, 2.2, 2.0),
        (1.5, 2.0, 2.4, 0.0),
        (0.5, 2.0, 1.0, 2.0),
        (1.5, -2.0, -3.0, -2.0),
        (0.5, -2.0, -1.6, 0.0),
    ],
)
def test_the_surrogate_stops_rising_beyond_the_clip(
    ratio: float, advantage: float, value: float, derivative: float
) -> None:
    log_ratio = torch.tensor([ratio]).log().requires_grad_()
    found = clipped_surrogate(log_ratio, torch.tensor([advantage]), 0.2)
    assert found.item() == pytest.approx(value)
    (gradient,) = torch.autograd.grad(found, log_ratio)
    assert gradient.item() == pytest.approx(derivative * ratio)  # d ρ / d log ρ = ρ


def test_the_surrogate_is_the_mean_over_steps() -> None:
    log_ratios, advantages = torch.tensor([0.0, 0.1, -0.1]), torch.tensor([1.0, -1.0, 3.0])
    each = [clipped_surrogate(log_ratios[t : t + 1], advantages[t : t + 1], 0.2) for t in range(3)]
    torch.testing.assert_close(clipped_surrogate(log_ratios, advantages, 0.2), torch.stack(each).mean())


@pytest.mark.parametrize("discount", [0.0, 0.5, 0.99])
@pytest.mark.parametrize("trace", [0.0, 0.9])
def test_advantages_are_the_discounted_sums_of_surprises(discount: float, trace: float) -> None:
    lengths = [4, 1, 6, 2]
    random = np.random.default_rng(0)
    rewards, values = random.normal(size=(2, sum(lengths)))
    expected, start = [], 0
    for length in lengths:
        end = start + length
        expected += sums_of_errors(rewards[start:end], np.append(values[start:end], 0.0), discount, trace)
        start = end
    found = trajectory_advantages(
        torch.from_numpy(rewards), torch.from_numpy(values), torch.tensor(lengths), discount, trace
    )
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)
    if not discount:
        np.testing.assert_array_equal(found.numpy(), rewards - values)


def test_rewards_are_scaled_and_advantages_standardised() -> None:
    draws = torch.tensor([-3.0, -4.0, 0.0, 5.0])
    np.testing.assert_allclose(scaled(draws), draws / (50 / 4) ** 0.5, rtol=1e-6)
    np.testing.assert_allclose(normalised(draws), (draws + 0.5) / 12.25**0.5, rtol=1e-6)
    assert scaled(torch.zeros(2)).tolist() == normalised(torch.full((2,), 3.0)).tolist() == [0.0, 0.0]
