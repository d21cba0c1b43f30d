"""Generalised advantages and the clipped surrogate, against their sums and RLlib's own."""

import warnings

import numpy as np
import pytest
import torch

from dmil_core.methods.ppo import clipped_surrogate, generalised_advantages


@pytest.mark.parametrize("steps", [1, 2, 7])
@pytest.mark.parametrize("discount", [0.0, 0.9])
@pytest.mark.parametrize("smoothing", [0.0, 0.5, 1.0])
def test_advantages_are_the_discounted_sum_of_errors(steps: int, discount: float, smoothing: float) -> None:
    draw = np.random.default_rng(steps)
    rewards, values = draw.normal(size=steps), draw.normal(size=steps + 1)
    expected = [
        sum(
            (discount * smoothing) ** (later - t) * (rewards[later] + discount * values[later + 1] - values[later])
            for later in range(t, steps)
        )
        for t in range(steps)
    ]
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
    ("ratio", "advantage", "value", "slope"),
    [
        (1.0, 2.0, 2.0, 2.0),
        (1.1, 2.0, 2.2, 2.0),
        (1.5, 2.0, 2.4, 0.0),
        (0.5, 2.0, 1.0, 2.0),
        (1.5, -2.0, -3.0, -2.0),
        (0.5, -2.0, -1.6, 0.0),
    ],
)
def test_the_surrogate_stops_rising_beyond_the_clip(ratio: float, advantage: float, value: float, slope: float) -> None:
    log_ratio = torch.tensor([ratio]).log().requires_grad_()
    found = clipped_surrogate(log_ratio, torch.tensor([advantage]), 0.2)
    assert found.item() == pytest.approx(value)
    (gradient,) = torch.autograd.grad(found, log_ratio)
    assert gradient.item() == pytest.approx(slope * ratio)  # d ρ / d log ρ = ρ


def test_the_surrogate_is_the_mean_over_steps() -> None:
    log_ratios, advantages = torch.tensor([0.0, 0.1, -0.1]), torch.tensor([1.0, -1.0, 3.0])
    each = [clipped_surrogate(log_ratios[t : t + 1], advantages[t : t + 1], 0.2) for t in range(3)]
    torch.testing.assert_close(clipped_surrogate(log_ratios, advantages, 0.2), torch.stack(each).mean())
