"""What the paper proves of its losses, as numbers: Lemma 1 and Theorem 2 (Appendix D)."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import Independent, Normal

from dmil_core.losses import Steps, bank_errors, sub_skill_labels
from dmil_core.methods.dmil.adaptation import Hierarchy, adapt, choose, high_level_gradient, sub_skill_gradients
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.networks import Parameters, bank, mlp, network

CONFIG = DmilConfig(inner_learning_rate=0.05, continuity_weight=0.0)

SUB_SKILLS = 3


def log_likelihoods(parameters: Parameters, steps: Steps, sigma: float) -> torch.Tensor:
    """log p(a_t | s_t, θ_k) of Gaussian sub-skills, a row for each."""
    means = torch.stack([mlp(sub_skill, steps.states) for sub_skill in bank(parameters, "low")])
    return Independent(Normal(means, sigma), 1).log_prob(steps.actions)


def log_mixture(parameters: Parameters, steps: Steps, sigma: float) -> torch.Tensor:
    """log Σ_k p(z_k | s_t, θ_h) p(a_t | s_t, θ_k), equation 23."""
    log_p = mlp(network(parameters, "high"), steps.states).log_softmax(-1)
    return (log_p.T + log_likelihoods(parameters, steps, sigma)).logsumexp(0)


@pytest.fixture
def leaves(make_parameters) -> Parameters:
    return {name: tensor.requires_grad_() for name, tensor in make_parameters(0, SUB_SKILLS).items()}


@pytest.fixture
def steps(make_steps) -> Steps:
    return make_steps(1, [6, 1, 9])


@pytest.mark.parametrize("sigma", [0.1, 1.0])
def test_theorem_2_the_low_m_step_ascends_the_likelihood(leaves, steps, gradient_of, sigma: float) -> None:
    """Equation 22: under a fixed assignment both gradients agree for each sub-skill, up to N_k / 2σ²."""
    high, low = Hierarchy.of(leaves)
    chosen = choose(high, steps.states)
    counts = torch.bincount(chosen, minlength=SUB_SKILLS).tolist()
    gradients = sub_skill_gradients(low, steps, chosen)
    assert len(gradients) > 1
    assert set(gradients) == {k for k, count in enumerate(counts) if count}
    likelihood = log_likelihoods(leaves, steps, sigma).gather(0, chosen[None]).sum()
    names = [name for name in leaves if name.startswith("low")]
    of_likelihood = torch.autograd.grad(likelihood, [leaves[name] for name in names])
    for k, of_loss in gradients.items():
        for ascent, descent in zip(of_likelihood, itertools.chain(*gradient_of(of_loss)), strict=True):
            torch.testing.assert_close(ascent[k], -counts[k] / (2 * sigma**2) * descent, rtol=1e-9, atol=1e-12)


@given(seed=st.integers(0, 2**31), sigma=st.floats(0.3, 3.0))
def test_theorem_2_no_assignment_beats_the_label(make_parameters, make_steps, seed: int, sigma: float) -> None:
    """Equation 24 is linear in p(z|s): its maximum over the simplex is one-hot at the label."""
    parameters, steps = make_parameters(seed % 1000, SUB_SKILLS), make_steps(seed, [20])
    densities = log_likelihoods(parameters, steps, sigma).exp()
    labels = sub_skill_labels(bank_errors(bank(parameters, "low"), steps))
    generator = torch.Generator().manual_seed(seed)
    anything = torch.rand(SUB_SKILLS, 20, generator=generator, dtype=torch.float64).pow(3)
    one_hot = torch.nn.functional.one_hot(labels, SUB_SKILLS).T
    best = (one_hot * densities).sum(0)
    assert ((anything / anything.sum(0) * densities).sum(0) <= best * (1 + 1e-12)).all()
    torch.testing.assert_close(best, densities.amax(0))


@pytest.mark.usefixtures("unchecked")
def test_theorem_2_cross_entropy_drives_the_mixture_to_its_maximum(leaves, steps, gradient_of) -> None:
    """Equation 21's use: log max − log mixture is never above the cross-entropy, and falls to zero with it."""
    high, low = Hierarchy.of(leaves)
    sigma, labels = 0.7, sub_skill_labels(bank_errors(low, steps))
    maximum = log_likelihoods(leaves, steps, sigma).amax(0).mean()
    optimiser, gaps = torch.optim.Adam(itertools.chain(*high), lr=0.05), []
    for _ in range(600):
        of_loss = high_level_gradient(high, steps, labels, CONFIG)
        gaps.append((maximum - log_mixture(leaves, steps, sigma).mean()).item())
        assert 0 <= gaps[-1] <= of_loss.loss.value.item()
        for leaf, gradient in zip(itertools.chain(*high), itertools.chain(*gradient_of(of_loss)), strict=True):
            leaf.grad = gradient
        optimiser.step()
    assert gaps[-1] < 0.01 * gaps[0]


def test_theorem_2_the_high_gradients_agree_as_the_sub_skills_get_certain(leaves, steps, gradient_of) -> None:
    """Equation 21 holds in the limit of small σ, where the responsibilities become the labels."""
    high, low = Hierarchy.of(leaves)
    of_loss = high_level_gradient(high, steps, sub_skill_labels(bank_errors(low, steps)), CONFIG)
    descent = torch.cat([gradient.flatten() for gradient in itertools.chain(*gradient_of(of_loss))])

    def gap(sigma: float) -> float:
        gradients = torch.autograd.grad(
            log_mixture(leaves, steps, sigma).mean(), list(itertools.chain(*network(leaves, "high")))
        )
        return ((torch.cat([g.flatten() for g in gradients]) + descent).norm() / descent.norm()).item()

    assert gap(1.0) > 0.1
    assert gap(0.01) < 1e-9


@pytest.fixture
def linear(make_parameters) -> Parameters:
    """One linear sub-skill, as in Lemma 1's proof."""
    return make_parameters(4, sub_skills=1, hidden=())


def as_matrix(parameters: Parameters) -> torch.Tensor:
    """Weights and bias of the linear sub-skill, acting on [s, 1]."""
    return torch.cat([parameters["low.0.weight"][0], parameters["low.0.bias"][0, :, None]], 1)


def test_lemma_1_one_inner_step_ascends_the_log_likelihood(linear, steps) -> None:
    """Equation 16 in closed form: μ + α ∇ log p(D | μ), for the variance N/2 that makes log p the negative loss."""
    inputs = torch.cat([steps.states, torch.ones(len(steps.states), 1).double()], 1)
    mean, variance = as_matrix(linear), len(inputs) / 2
    ascent = (steps.actions - inputs @ mean.T).T @ inputs / variance
    adapted = adapt(Hierarchy.of(linear), steps, steps, CONFIG, steps=1)
    torch.testing.assert_close(as_matrix(adapted.parameters), mean + 0.05 * ascent, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("inner_steps", [1, 3, 10])
def test_lemma_1_early_stopping_is_the_map_estimate_of_a_gaussian_prior(linear, steps, inner_steps: int) -> None:
    """Equation 17 with the prior N(μ, Σ), Σ⁻¹ = H D⁻¹ (I − D) for D = I − (I − αH)ⁿ (Santos, Inverse Problems 1996)."""
    rate, inputs = CONFIG.inner_learning_rate, torch.cat([steps.states, torch.ones(len(steps.states), 1).double()], 1)
    prior_mean, hessian = as_matrix(linear), 2 * inputs.T @ inputs / len(inputs)
    curvature, basis = torch.linalg.eigh(hessian)
    left = (1 - rate * curvature) ** inner_steps
    assert ((left > 0) & (left < 1)).all(), "the prior must be proper"
    precision = basis @ torch.diag(curvature * left / (1 - left)) @ basis.T

    # The posterior's mode: (H + Σ⁻¹) λ = 2/N Xᵀ A + Σ⁻¹ μ.
    data = 2 * inputs.T @ steps.actions / len(inputs)
    mode = torch.linalg.solve(hessian + precision, data + precision @ prior_mean.T).T
    adapted = adapt(Hierarchy.of(linear), steps, steps, CONFIG, steps=inner_steps)
    torch.testing.assert_close(as_matrix(adapted.parameters), mode, rtol=1e-9, atol=1e-10)
