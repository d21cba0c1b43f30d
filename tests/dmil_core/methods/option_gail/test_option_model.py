"""The option model and its recursions, against sums over every sequence of options."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from dmil_core.methods.option_gail.option_model import (
    Chain,
    OptionModel,
    _forward,
    options_before,
    pairs_of,
    posterior,
    viterbi,
    weighted_log_likelihood,
)
from dmil_core.networks import Parameters, initialise

RAGGED = [4, 1, 5, 2]


def log_likelihood(chain: Chain) -> torch.Tensor:
    """Return log p of the actions by the forward algorithm, with a gradient."""
    return _forward(chain)[-1].logsumexp(-1)


def draw_scores(seed: int, options: int, steps: int, scale: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    high = scale * torch.randn(steps, options + 1, options, generator=generator, dtype=torch.float64)
    low = scale * torch.randn(steps, options, generator=generator, dtype=torch.float64)
    return high.log_softmax(-1), low


def trajectories(high: torch.Tensor, low: torch.Tensor, lengths: list[int]) -> Iterator[tuple[torch.Tensor, ...]]:
    return zip(high.split(lengths), low.split(lengths), strict=True)


def every_sequence(high: torch.Tensor, low: torch.Tensor) -> dict[tuple[int, ...], torch.Tensor]:
    """Return log p of each sequence of options of one trajectory, term by term."""
    steps, options = low.shape
    found = {}
    for sequence in itertools.product(range(options), repeat=steps):
        before = (options, *sequence[:-1])
        found[sequence] = sum(high[t, before[t], sequence[t]] + low[t, sequence[t]] for t in range(steps))
    return found


@pytest.fixture(params=[*itertools.product([2, 3], [[1], [5], [1, 1, 1], RAGGED], [1.0, 30.0])], ids=str)
def case(request) -> tuple[torch.Tensor, torch.Tensor, list[int]]:
    options, lengths, scale = request.param
    return *draw_scores(options, options, sum(lengths), scale), lengths


def test_likelihood_is_the_sum_over_all_sequences(case) -> None:
    high, low, lengths = case
    expected = [torch.stack(list(every_sequence(*of).values())).logsumexp(0) for of in trajectories(*case)]
    found = log_likelihood(Chain.of(high, low, torch.tensor(lengths)))
    torch.testing.assert_close(found, torch.stack(expected))
    torch.testing.assert_close(posterior(Chain.of(high, low, torch.tensor(lengths)))[0], found)


def test_viterbi_finds_the_best_of_all_sequences(case) -> None:
    high, low, lengths = case
    found = viterbi(Chain.of(high, low, torch.tensor(lengths))).split(lengths)
    for of, options in zip(trajectories(*case), found, strict=True):
        scores = every_sequence(*of)
        assert tuple(options.tolist()) == max(scores, key=lambda sequence: scores[sequence].item())


def test_posteriors_are_the_shares_of_all_sequences(case) -> None:
    high, low, lengths = case
    options = low.shape[1]
    found = posterior(Chain.of(high, low, torch.tensor(lengths)))[1]
    torch.testing.assert_close(found.sum((1, 2)), torch.ones(sum(lengths), dtype=torch.float64))
    for of, pairs in zip(trajectories(*case), found.split(lengths), strict=True):
        scores = every_sequence(*of)
        total = torch.stack(list(scores.values())).logsumexp(0)
        expected = torch.zeros_like(pairs)
        for sequence, score in scores.items():
            for t, (before, option) in enumerate(zip((options, *sequence[:-1]), sequence, strict=True)):
                expected[t, before, option] += (score - total).exp()
        torch.testing.assert_close(pairs, expected)


def test_weights_of_the_posterior_give_the_gradient_of_the_likelihood() -> None:
    high, low = (scores.requires_grad_() for scores in draw_scores(0, 3, sum(RAGGED)))
    each = [torch.stack(list(every_sequence(*of).values())).logsumexp(0) for of in trajectories(high, low, RAGGED)]
    brute = torch.stack(each).sum()
    expected = torch.autograd.grad(brute, [high, low])
    chain = Chain.of(high, low, torch.tensor(RAGGED))
    by_forward = torch.autograd.grad(log_likelihood(chain).sum(), [high, low])
    weights = posterior(chain)[1]
    by_fisher = torch.autograd.grad(weighted_log_likelihood(high, low, weights), [high, low])
    torch.testing.assert_close(by_forward, expected)
    torch.testing.assert_close(by_fisher, expected)


def test_certain_weights_give_the_complete_data_log_likelihood() -> None:
    high, low = draw_scores(1, 3, sum(RAGGED))
    lengths = torch.tensor(RAGGED)
    options = viterbi(Chain.of(high, low, lengths))
    scores = [every_sequence(*of) for of in trajectories(high, low, RAGGED)]
    expected = sum(max(of.values()) for of in scores)
    found = weighted_log_likelihood(high, low, pairs_of(options, lengths, 3))
    torch.testing.assert_close(found, expected)
    assert found < log_likelihood(Chain.of(high, low, lengths)).sum()


def test_recursions_of_single_precision_scores_are_in_double() -> None:
    high, low = draw_scores(2, 2, 300, 30.0)
    lengths = torch.tensor([300])
    chain = Chain.of(high.float(), low.float(), lengths)
    assert chain.first.dtype == chain.links.dtype == torch.float64
    found, expected = posterior(chain)[1], posterior(Chain.of(high, low, lengths))[1]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.sum((1, 2)), torch.ones(300, dtype=torch.float64), rtol=0, atol=1e-9)


def test_the_option_before_is_the_start_at_each_first_step() -> None:
    options = torch.tensor([0, 1, 2, 2, 1, 0])
    assert options_before(options, torch.tensor([3, 1, 2]), 3).tolist() == [3, 0, 1, 3, 3, 1]
    pairs = pairs_of(options, torch.tensor([3, 1, 2]), 3)
    assert pairs.shape == (6, 4, 3)
    assert pairs.nonzero().tolist() == [[0, 3, 0], [1, 0, 1], [2, 1, 2], [3, 3, 2], [4, 3, 1], [5, 1, 0]]


@pytest.fixture
def parameters() -> Parameters:
    rng = np.random.default_rng(3)
    return {
        **initialise("high", [4, 8, 12], rng),
        **initialise("low", [4, 8, 2], rng, copies=3),
        "log_deviations": torch.tensor([[0.5, -1.0], [-3.0, 0.0], [-25.0, -0.5]]),
    }


def test_densities_are_those_of_normal_distributions(parameters, plain_mlp) -> None:
    model = OptionModel.of(parameters, -2.0)
    torch.testing.assert_close(model.log_deviations, torch.tensor([[0.0, -1.0], [-2.0, 0.0], [-2.0, -0.5]]))
    generator = torch.Generator().manual_seed(0)
    states, actions = torch.randn(7, 4, generator=generator), torch.randn(7, 2, generator=generator)
    found = model.log_low(states, actions)
    for k, sub_skill in enumerate(model.low):
        distribution = Normal(plain_mlp(sub_skill, states), model.log_deviations[k].exp())
        torch.testing.assert_close(found[:, k], distribution.log_prob(actions).sum(-1))
    options = torch.tensor([2, 0, 2, 2, 0, 0, 2])  # one is chosen nowhere
    torch.testing.assert_close(model.log_chosen(states, actions, options), found[torch.arange(7), options])


def test_the_high_level_has_a_row_for_each_last_option_and_the_start(parameters, plain_mlp) -> None:
    model = OptionModel.of(parameters, -20.0)
    states = torch.randn(5, 4, generator=torch.Generator().manual_seed(1))
    found = model.log_high(states)
    logits = plain_mlp(model.high, states)
    for before in range(4):
        torch.testing.assert_close(found[:, before], logits[:, 3 * before : 3 * before + 3].log_softmax(-1))


def test_what_lies_beyond_a_bound_of_the_deviations_comes_back(parameters) -> None:
    free = parameters["log_deviations"].clone().requires_grad_()
    bound = OptionModel.of({**parameters, "log_deviations": free}, -2.0).log_deviations
    (gradient,) = torch.autograd.grad(bound.square().sum(), free)
    torch.testing.assert_close(gradient, 2 * bound.detach())
    assert (gradient[free.detach() < -2] != 0).all()
