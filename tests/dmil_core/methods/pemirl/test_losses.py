"""PEMIRL's models and losses against closed forms, enumeration and differences, and who trains whom."""

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from dmil_core.demonstrations import Normalisation
from dmil_core.methods.pemirl.config import PemirlConfig
from dmil_core.methods.pemirl.losses import (
    Gaussian,
    Losses,
    Transitions,
    action_distribution,
    discriminator_loss,
    infer,
    information_surrogate,
    log_reward,
    losses_of,
    policy_surrogate,
)
from dmil_core.methods.pemirl.method import Pemirl
from dmil_core.networks import Parameters, network
from dmil_core.seeding import named_rng

SMALL = PemirlConfig(
    hidden_layers=2,
    reward_layers=1,
    hidden_units=8,
    context_dim=2,
    initial_deviation=1.0,
    trajectories=5,
    contexts=2,
    discount=0.9,
)
MODELS = ("encoder", "policy", "log_deviation", "reward", "potential")
TRAINED = {
    "likelihood": {"encoder", "policy", "log_deviation"},
    "divergence": {"encoder"},
    "information": {"encoder"},
    "information_surrogate": {"reward"},
    "discriminator": {"reward", "potential"},
    "policy": {"policy", "log_deviation"},
}


@pytest.fixture
def method(demonstrations) -> Pemirl:
    return Pemirl(SMALL, action_dim=3, normalise=Normalisation.of(demonstrations))


@pytest.fixture
def parameters(method) -> Parameters:
    """Draw all parameters, biases and deviations too, so that nothing hides behind a zero."""
    generator = torch.Generator().manual_seed(3)
    return {
        name: (tensor + 0.3 * torch.randn(tensor.shape, generator=generator)).double()
        for name, tensor in method.initial_parameters(named_rng(0, "initial")).items()
    }


def doubled(transitions: Transitions) -> Transitions:
    states, actions, successors, lengths = transitions
    return Transitions(states.double(), actions.double(), successors.double(), lengths)


@pytest.fixture
def losses(method, demonstrations) -> Callable[..., Losses]:
    """Evaluate all losses at some parameters, always with the same draws."""
    contexts, explained = (
        doubled(Transitions.of(part, method.normalise)) for part in (demonstrations[:2], demonstrations[2:7])
    )

    def evaluate(at: Parameters, negatives: Literal["same", "mismatched"] = "same") -> Losses:
        generator = torch.Generator().manual_seed(11)
        return losses_of(at, contexts, explained, SMALL.discount, negatives, generator)

    return evaluate


def leaves_of(parameters: Parameters) -> dict[str, Tensor]:
    return {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}


def gradients(loss: Tensor, leaves: Mapping[str, Tensor]) -> dict[str, Tensor]:
    found = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True, materialize_grads=True)
    return dict(zip(leaves, found, strict=True))


def test_density_and_divergence_are_the_normal_distributions(make_steps) -> None:
    values, others = make_steps(0, [6])[:2]
    gaussian = Gaussian(others, values[:, :3] / 2)
    reference = torch.distributions.Normal(gaussian.mean, gaussian.log_deviation.exp())
    torch.testing.assert_close(gaussian.log_density(values[:, 1:]), reference.log_prob(values[:, 1:]).sum(-1))
    standard = torch.distributions.Normal(torch.zeros(3), torch.ones(3))
    expected = torch.distributions.kl_divergence(reference, standard).sum(-1)
    torch.testing.assert_close(gaussian.divergence(), expected)


def test_one_log_deviation_serves_all_rows(make_steps) -> None:
    values, means = make_steps(0, [6])[0][:, :3], make_steps(0, [6])[1]
    shared = Gaussian.bounded(means, torch.tensor([[0.1, -0.4, 2.0]], dtype=torch.float64))
    each = Gaussian(means, shared.log_deviation.expand(6, 3))
    assert torch.equal(shared.log_density(values), each.log_density(values))


def test_deviations_are_bounded_and_keep_a_gradient() -> None:
    raw = torch.tensor([[-12.0, -1e-3, 0.0, 1e-3, 12.0]], dtype=torch.float64, requires_grad=True)
    log_deviation = Gaussian.bounded(torch.zeros(1, 5, dtype=torch.float64), raw).log_deviation
    assert log_deviation.abs().max() < 5
    torch.testing.assert_close(log_deviation[0, 1:4], raw[0, 1:4], rtol=1e-6, atol=0)
    (gradient,) = torch.autograd.grad(log_deviation.sum(), raw)
    assert (gradient > 0).all()


def test_draws_have_the_mean_and_deviation_and_gradients_for_both() -> None:
    mean, log_deviation = torch.tensor([[2.0, -1.0]], requires_grad=True), torch.tensor([[0.5, -1.0]])
    drawn = Gaussian(mean.expand(20_000, 2), log_deviation).draw(torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn.mean(0), mean[0], rtol=0, atol=0.05)
    torch.testing.assert_close(drawn.std(0).log(), log_deviation[0], rtol=0, atol=0.02)
    (gradient,) = torch.autograd.grad(drawn.mean(0).sum(), mean)
    torch.testing.assert_close(gradient, torch.ones(1, 2), rtol=1e-3, atol=0)


def test_the_last_state_of_each_trajectory_is_its_own_successor(method, demonstrations) -> None:
    transitions = Transitions.of(demonstrations, method.normalise)
    expected = [
        observation
        for one in demonstrations
        for observation in (*method.normalise(one.observations)[1:], method.normalise(one.observations)[-1])
    ]
    assert np.array_equal(transitions.successors.numpy(), np.array(expected))
    assert transitions.lengths.tolist() == [len(one) for one in demonstrations]


def test_thinned_transitions_are_different_ones_of_each_trajectory_in_order(method, demonstrations) -> None:
    transitions = Transitions.of(demonstrations, method.normalise)
    generator = torch.Generator().manual_seed(0)
    thinned = transitions.thinned(4, generator)
    assert thinned.lengths.tolist() == [min(len(one), 4) for one in demonstrations]
    whole = [row.tolist() for row in torch.cat(transitions[:3], -1)]
    places = [whole.index(row.tolist()) for row in torch.cat(thinned[:3], -1)]
    assert places == sorted(set(places))
    trajectory = np.repeat(np.arange(9), [len(one) for one in demonstrations])
    assert np.bincount(trajectory[places]).tolist() == thinned.lengths.tolist()
    assert not torch.equal(thinned.states, transitions.thinned(4, generator).states)
    assert transitions.thinned(None, generator) is transitions


def test_q_is_the_mean_over_the_steps_of_each_trajectory(method, demonstrations, parameters, plain_mlp) -> None:
    transitions = doubled(Transitions.of(demonstrations, method.normalise))
    inferred = infer(parameters, transitions)
    for index, one in enumerate(demonstrations):
        pairs = np.concatenate([method.normalise(one.observations), one.actions], 1)
        mean, raw = plain_mlp(network(parameters, "encoder"), torch.from_numpy(pairs).double()).mean(0).chunk(2)
        torch.testing.assert_close(inferred.mean[index], mean)
        torch.testing.assert_close(inferred.log_deviation[index], 5 * torch.tanh(raw / 5))


def test_f_is_the_reward_shaped_by_the_potential(method, demonstrations, parameters, plain_mlp) -> None:
    transitions = doubled(Transitions.of(demonstrations, method.normalise))
    contexts = torch.randn(len(transitions.states), 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = log_reward(parameters, transitions, contexts, 0.9)
    for step in range(len(contexts)):
        state, successor = (torch.cat([part[step], contexts[step]]) for part in (transitions[0], transitions[2]))
        reward = plain_mlp(network(parameters, "reward"), state)[0]
        before, after = (plain_mlp(network(parameters, "potential"), inputs)[0] for inputs in (state, successor))
        torch.testing.assert_close(found.f[step], reward + 0.9 * after - before)
        torch.testing.assert_close(found.reward[step], reward)


def test_without_discounting_the_potential_telescopes(method, demonstrations, parameters, plain_mlp) -> None:
    transitions = doubled(Transitions.of(demonstrations[:1], method.normalise))
    contexts = torch.ones(7, 2, dtype=torch.float64)
    f, reward = log_reward(parameters, transitions, contexts, 1.0)
    ends = torch.cat([transitions.states[[0, -1]], contexts[:2]], -1)
    first, last = plain_mlp(network(parameters, "potential"), ends).squeeze(-1)
    torch.testing.assert_close(f.sum(), reward.sum() + last - first)


def test_discriminator_loss_is_the_cross_entropy_of_its_probabilities(make_steps) -> None:
    f, log_expert, log_pseudo, _ = make_steps(0, [9])[0].unbind(-1)
    expert, pseudo = (f.exp() / (f.exp() + log_density.exp()) for log_density in (log_expert, log_pseudo))
    expected = functional.binary_cross_entropy(expert, torch.ones_like(expert))
    expected += functional.binary_cross_entropy(pseudo, torch.zeros_like(pseudo))
    torch.testing.assert_close(discriminator_loss(f - log_expert, f - log_pseudo), expected)


def test_on_shared_states_f_settles_in_the_middle_of_the_two_log_probabilities() -> None:
    log_expert, log_pseudo = (torch.tensor(values, dtype=torch.float64) for values in ([0.7, -2.0], [-0.3, 1.0]))
    f = ((log_expert + log_pseudo) / 2).requires_grad_()
    (gradient,) = torch.autograd.grad(discriminator_loss(f - log_expert, f - log_pseudo), f)
    torch.testing.assert_close(gradient, torch.zeros(2, dtype=torch.float64))


def test_information_surrogate_has_the_gradient_of_the_expectation_under_the_rewards_distribution() -> None:
    # Two contexts, three trajectories of each with p(τ) = 1/3 and R_θ(τ) = log of a whole number: drawing each so often
    # is p_θ(τ|m) ∝ exp R_θ to the letter.
    counts = torch.tensor([[1, 2, 5], [4, 1, 3]])
    log_q = torch.tensor([[-0.3, -2.0, 0.4], [1.2, -0.7, -1.1]], dtype=torch.float64)
    returns = counts.double().log().requires_grad_()
    expectation = (returns.softmax(-1) * log_q).sum(-1).mean()
    (expected,) = torch.autograd.grad(expectation, returns)

    rows, columns = (index.flatten() for index in torch.meshgrid(torch.arange(2), torch.arange(3), indexing="ij"))
    chosen = torch.arange(6).repeat_interleave(counts.flatten())
    chosen = chosen[torch.randperm(16, generator=torch.Generator().manual_seed(0))]
    loss = information_surrogate(log_q[rows, columns][chosen], returns[rows, columns][chosen], 3 * rows[chosen])
    (found,) = torch.autograd.grad(loss, returns)
    torch.testing.assert_close(found, -expected)
    pair = torch.stack([log_q, returns.detach()])
    covariances = [np.cov(np.repeat(pair[:, m].numpy(), counts[m].numpy(), axis=1), bias=True)[0, 1] for m in range(2)]
    torch.testing.assert_close(loss.item(), -float(np.mean(covariances)))


def test_one_trajectory_of_a_context_says_nothing_of_the_reward() -> None:
    returns = torch.tensor([1.0, 2.0], requires_grad=True)
    loss = information_surrogate(torch.tensor([3.0, -4.0]), returns, torch.tensor([0, 1]))
    assert not torch.autograd.grad(loss, returns)[0].any()


def test_policy_surrogate_has_the_gradient_of_the_clipped_one_at_the_first_step(make_steps) -> None:
    log_probabilities, rewards, *_ = make_steps(0, [9])[0].unbind(-1)
    log_probabilities.requires_grad_()
    (found,) = torch.autograd.grad(policy_surrogate(log_probabilities, rewards), log_probabilities)
    advantages = (rewards - rewards.mean()) / rewards.std(correction=0)
    ratio = (log_probabilities - log_probabilities.detach()).exp()
    clipped = torch.minimum(ratio * advantages, ratio.clamp(0.98, 1.02) * advantages)
    (expected,) = torch.autograd.grad(-clipped.mean(), log_probabilities)
    torch.testing.assert_close(found, expected)
    assert found.abs().max() > 0.1


def test_policy_reward_teaches_width_and_nothing_of_the_mean() -> None:
    states, draws = 4, 50_000
    generator = torch.Generator().manual_seed(0)
    mean = torch.randn(states, 2, generator=generator, dtype=torch.float64).requires_grad_()
    raw = torch.tensor([[-0.5, 0.2]], dtype=torch.float64, requires_grad=True)
    f = torch.randn(states, generator=generator, dtype=torch.float64).repeat(draws)
    policy = Gaussian(mean.repeat(draws, 1), raw)
    log_probabilities = policy.log_density(policy.draw(generator).detach())
    rewards = f - log_probabilities.detach()
    of_mean, of_width = torch.autograd.grad(policy_surrogate(log_probabilities, rewards), [mean, raw])
    # The entropy's gradient is 1 in each log σ; the loss goes the other way, in units of the rewards' deviation.
    torch.testing.assert_close(of_width * rewards.std(), -torch.ones(1, 2, dtype=torch.float64), rtol=0, atol=0.05)
    assert of_mean.abs().max() < 0.01


@pytest.mark.parametrize("negatives", ["same", "mismatched"])
@pytest.mark.parametrize("name", TRAINED)
def test_each_loss_trains_its_own_models_only(
    losses, parameters, name: str, negatives: Literal["same", "mismatched"]
) -> None:
    leaves = leaves_of(parameters)
    found = gradients(getattr(losses(leaves, negatives), name), leaves)
    reached = {model for model in MODELS if any(found[key].any() for key in found if key.split(".")[0] == model)}
    assert reached == TRAINED[name]


@pytest.mark.parametrize("name", ["likelihood", "divergence", "discriminator"])
def test_gradients_are_finite_differences(losses, parameters, name: str) -> None:
    # Only along models that a loss trains: for the others it holds still what in truth would move.
    leaves, generator = leaves_of(parameters), torch.Generator().manual_seed(0)
    direction = {
        key: torch.randn(tensor.shape, generator=generator, dtype=torch.float64) * (key.split(".")[0] in TRAINED[name])
        for key, tensor in parameters.items()
    }
    found = gradients(getattr(losses(leaves), name), leaves)
    ahead, behind = (
        getattr(losses({key: parameters[key] + step * direction[key] for key in parameters}), name).item()
        for step in (1e-6, -1e-6)
    )
    assert sum((found[key] * direction[key]).sum().item() for key in found) == pytest.approx(
        (ahead - behind) / 2e-6, rel=1e-5
    )


@pytest.mark.parametrize("negatives", ["same", "mismatched"])
def test_information_policy_and_negatives_look_at_the_policys_own_actions(
    method, demonstrations, losses, parameters, negatives: Literal["same", "mismatched"]
) -> None:
    leaves, generator = leaves_of(parameters), torch.Generator().manual_seed(11)
    contexts, explained = (
        doubled(Transitions.of(part, method.normalise)) for part in (demonstrations[:2], demonstrations[2:7])
    )
    chosen = infer(leaves, contexts).draw(generator).detach()[[0, 1, 0, 1, 0]]
    of_steps = torch.arange(5).repeat_interleave(explained.lengths)
    policy = action_distribution(leaves, explained.states, chosen[of_steps])
    actions = policy.draw(generator).detach()
    log_probabilities = policy.log_density(actions)
    f = log_reward(leaves, explained, chosen[of_steps], SMALL.discount).f
    negative_logits = f - log_probabilities.detach()
    if negatives == "mismatched":
        m = torch.randn(5, 2, generator=generator, dtype=torch.float64)[of_steps]
        other = action_distribution(leaves, explained.states, m)
        log_other = other.log_density(other.draw(generator)).detach()
        negative_logits = log_reward(leaves, explained, m, SMALL.discount).f - log_other
    expected = {
        "information": -infer(leaves, explained._replace(actions=actions)).log_density(chosen).mean(),
        "policy": policy_surrogate(log_probabilities, f - log_probabilities),
        "discriminator": discriminator_loss(f - policy.log_density(explained.actions).detach(), negative_logits),
    }
    found = losses(leaves, negatives)
    for name, loss in expected.items():
        torch.testing.assert_close(getattr(found, name), loss)
        torch.testing.assert_close(gradients(getattr(found, name), leaves), gradients(loss, leaves))


def test_mismatched_negatives_change_the_discriminator_alone(losses, parameters) -> None:
    same, mismatched = losses(parameters), losses(parameters, "mismatched")
    assert same.discriminator != mismatched.discriminator
    for name in TRAINED.keys() - {"discriminator"}:
        assert getattr(same, name) == getattr(mismatched, name)


def test_likelihood_is_that_of_actions_given_the_context_of_another_trajectory(
    method, demonstrations, parameters
) -> None:
    # With σ of q at its least, m is its mean, and so known from outside.
    last = parameters["encoder.2.bias"].clone()
    last[2:] = -1e4
    certain = {**parameters, "encoder.2.bias": last}
    contexts, explained = (
        doubled(Transitions.of(part, method.normalise)) for part in (demonstrations[:2], demonstrations[2:7])
    )
    found = losses_of(certain, contexts, explained, 0.9, "same", torch.Generator().manual_seed(0))
    means, total, errors = infer(certain, contexts).mean, [], []
    for index, one in enumerate(demonstrations[2:7]):
        steps = doubled(Transitions.of([one], method.normalise))
        policy = action_distribution(certain, steps.states, means[index % 2].expand(len(one), 2))
        total.append(policy.log_density(steps.actions))
        errors.append((policy.mean - steps.actions).square().sum(-1))
    assert found.likelihood.item() == pytest.approx(-torch.cat(total).mean().item(), abs=0.05)
    assert found.metrics["action_error"] == pytest.approx(torch.cat(errors).mean().item(), abs=0.05)
