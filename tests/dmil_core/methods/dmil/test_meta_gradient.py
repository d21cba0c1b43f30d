"""The outer gradient against a plain reference and against finite differences, and the tree that adds gradients."""

import itertools
from collections.abc import Callable, Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional

from benchmarks.masked_reference import MaskedReference, Sets
from dmil_core.losses import Steps
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.losses import hard_labels
from dmil_core.methods.dmil.meta_gradient import task_gradient
from dmil_core.networks import BLOCK, flatten, unflatten
from dmil_core.outer_loop import tree_sum

LENGTHS = ([12, 1, 9], [3, 19], [1, 1, 16, 5], [11, 7])
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}


def relative_error(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return float((got - wanted).norm() / wanted.norm())


def settings(sub_skills: int, **changes) -> DmilConfig:
    return DmilConfig(**{"sub_skills": sub_skills, "inner_learning_rate": 0.05, "continuity_weight": 0.5, **changes})


def draw_sets(make_steps: Callable[..., Steps], dtype: torch.dtype) -> Sets:
    """Draw τ1 to τ4."""
    one, two, three, four = (make_steps(seed, lengths, dtype) for seed, lengths in enumerate(LENGTHS))
    return one, two, three, four


@pytest.fixture
def sets(make_steps) -> Sets:
    return draw_sets(make_steps, torch.float64)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("order", ["first", "second"])
@pytest.mark.parametrize(("inner_steps", "continuity_weight"), [(1, 0.5), (2, 0.0), (3, 0.1), (3, 0.0)])
@pytest.mark.parametrize("sub_skills", [1, 2, 3, 5, 8, 10])
def test_equals_the_plain_reference(
    make_parameters, make_steps, sub_skills, inner_steps, continuity_weight, order, dtype
) -> None:
    config = settings(sub_skills, inner_steps=inner_steps, continuity_weight=continuity_weight, order=order)
    parameters = make_parameters(sub_skills, sub_skills, dtype=dtype)
    sets = draw_sets(make_steps, dtype)
    got = task_gradient(parameters, *sets, config)
    gradient, high, low = MaskedReference(config).gradient(parameters, sets)
    assert got.gradient.dtype == dtype
    assert relative_error(got.gradient, gradient) <= TOLERANCE[dtype]
    assert got.metrics["high_loss_after"] == pytest.approx(high, rel=TOLERANCE[dtype], abs=TOLERANCE[dtype])
    assert got.metrics["low_loss_after"] == pytest.approx(low, rel=TOLERANCE[dtype])


@pytest.mark.parametrize("order", ["first", "second"])
@pytest.mark.parametrize("continuity", ["expected", "reference"])
@pytest.mark.parametrize("em", ["hard", "soft", "reference_soft"])
@pytest.mark.parametrize("adapted", ["both", "high", "low"])
def test_every_variant_equals_the_plain_reference(make_parameters, sets: Sets, adapted, em, continuity, order) -> None:
    config = settings(
        3, inner_steps=2, adapted=adapted, em=em, continuity=continuity, order=order, posterior_deviation=1.5
    )
    parameters = make_parameters(0, 3)
    got, (gradient, high, low) = (
        task_gradient(parameters, *sets, config),
        MaskedReference(config).gradient(parameters, sets),
    )
    assert relative_error(got.gradient, gradient) <= 1e-10
    assert got.metrics["high_loss_after"] == pytest.approx(high, rel=1e-10)
    assert got.metrics["low_loss_after"] == pytest.approx(low, rel=1e-10)


def test_every_variant_is_another(make_parameters, sets: Sets) -> None:
    variants = [{}, {"adapted": "high"}, {"adapted": "low"}, {"em": "soft"}, {"em": "reference_soft"}]
    variants += [{"em": "soft", "posterior_deviation": 0.1}, {"continuity": "reference"}]
    gradients = [task_gradient(make_parameters(0, 3), *sets, settings(3, **variant)).gradient for variant in variants]
    for one, other in itertools.combinations(gradients, 2):
        assert relative_error(one, other) > 1e-4


def test_the_reference_continuity_loss_has_no_gradient(make_parameters, sets: Sets) -> None:
    without, reference = (
        task_gradient(make_parameters(0, 3), *sets, settings(3, continuity="reference", continuity_weight=weight))
        for weight in (0.0, 2.0)
    )
    assert torch.equal(without.gradient, reference.gradient)
    assert reference.metrics["high_loss_after"] > without.metrics["high_loss_after"]


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("order", ["first", "second"])
@pytest.mark.parametrize("hidden", [(), (8,), (9, 6, 7, 8)], ids=lambda hidden: f"{len(hidden)} hidden")
def test_equals_the_plain_reference_at_any_depth(make_parameters, make_steps, hidden, order, dtype) -> None:
    config, parameters = settings(3, inner_steps=3, order=order), make_parameters(0, 3, hidden, dtype)
    sets = draw_sets(make_steps, dtype)
    got, wanted = (
        task_gradient(parameters, *sets, config).gradient,
        MaskedReference(config).gradient(parameters, sets)[0],
    )
    assert relative_error(got, wanted) <= TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("order", ["first", "second"])
def test_equals_the_plain_reference_on_several_blocks_of_steps(make_parameters, make_steps, order, dtype) -> None:
    config, parameters = settings(3, inner_steps=2, order=order), make_parameters(0, 3, dtype=dtype)
    one, two, three, four = (make_steps(seed, [BLOCK // 2, 2 * BLOCK + seed], dtype) for seed in range(4))
    got = task_gradient(parameters, one, two, three, four, config).gradient
    assert (
        relative_error(got, MaskedReference(config).gradient(parameters, (one, two, three, four))[0])
        <= TOLERANCE[dtype]
    )


@given(
    seed=st.integers(0, 10**6),
    sub_skills=st.integers(1, 6),
    lengths=st.lists(st.lists(st.integers(1, 4), min_size=1, max_size=3), min_size=4, max_size=4),
    inner_steps=st.integers(1, 4),
    order=st.sampled_from(["first", "second"]),
)
def test_equals_the_plain_reference_on_few_states(
    make_parameters, make_steps, seed, sub_skills, lengths, inner_steps, order
) -> None:
    """Sub-skills are left without states in some of the inner steps, in the outer one, or in all."""
    config, parameters = settings(sub_skills, inner_steps=inner_steps, order=order), make_parameters(seed, sub_skills)
    one, two, three, four = (make_steps(seed + index, own) for index, own in enumerate(lengths))
    gradient, high, low = MaskedReference(config).gradient(parameters, (one, two, three, four))
    got = task_gradient(parameters, one, two, three, four, config)
    torch.testing.assert_close(got.gradient, gradient, rtol=1e-9, atol=1e-10)
    assert got.metrics["high_loss_after"] == pytest.approx(high, rel=1e-9, abs=1e-10)
    assert got.metrics["low_loss_after"] == pytest.approx(low, rel=1e-9)


@pytest.mark.parametrize("order", ["first", "second"])
@pytest.mark.parametrize("continuity_weight", [0.0, 0.5])
@pytest.mark.parametrize("sub_skills", [2, 5])
def test_equals_the_plain_reference_where_only_the_last_sub_skill_is_used(
    make_parameters, sets: Sets, sub_skills, continuity_weight, order
) -> None:
    parameters = make_parameters(0, sub_skills)
    parameters["high.2.bias"][-1] += 8
    config = settings(sub_skills, continuity_weight=continuity_weight, order=order)
    got = task_gradient(parameters, *sets, config)
    assert relative_error(got.gradient, MaskedReference(config).gradient(parameters, sets)[0]) <= 1e-10
    assert got.metrics[f"sub_skill_share/{sub_skills - 1}"] == 1
    unused = unflatten(got.gradient, {name: tensor.shape for name, tensor in parameters.items()})["low.0.weight"][:-1]
    assert torch.equal(unused, torch.zeros_like(unused))


@pytest.mark.parametrize("inner_steps", [1, 3])
@pytest.mark.parametrize("sub_skills", [1, 3])
def test_second_order_equals_central_differences(
    make_parameters, sets: Sets, sub_skills: int, inner_steps: int
) -> None:
    parameters = make_parameters(3, sub_skills)
    shapes = {name: tensor.shape for name, tensor in parameters.items()}
    origin, generator, step = flatten(parameters), torch.Generator().manual_seed(0), 1e-6

    def outer_loss(vector: torch.Tensor) -> float:
        metrics = task_gradient(unflatten(vector, shapes), *sets, settings(sub_skills, order="first")).metrics
        return metrics["high_loss_after"] + metrics["low_loss_after"]

    def gradient(order: str) -> torch.Tensor:
        return task_gradient(parameters, *sets, settings(sub_skills, order=order)).gradient

    directions = torch.randn(6, len(origin), generator=generator, dtype=torch.float64)
    directions = functional.normalize(directions, dim=1)
    differences = torch.tensor(
        [(outer_loss(origin + step * d) - outer_loss(origin - step * d)) / (2 * step) for d in directions],
        dtype=torch.float64,
    )
    assert relative_error(directions @ gradient("second"), differences) < 1e-6
    assert relative_error(directions @ gradient("first"), differences) > 1e-2


def test_orders_agree_as_the_inner_learning_rate_vanishes(make_parameters, sets: Sets) -> None:
    parameters = make_parameters(0, 3)

    def gap(learning_rate: float) -> float:
        first, second = (
            task_gradient(parameters, *sets, settings(3, inner_learning_rate=learning_rate, order=order)).gradient
            for order in ("first", "second")
        )
        return relative_error(first, second)

    assert gap(0.05) > 1e-2
    assert gap(1e-8) < 1e-5


@pytest.mark.parametrize("order", ["first", "second"])
def test_is_a_pure_function(make_parameters, sets: Sets, order: str) -> None:
    parameters = make_parameters(0, 3)
    tensors = [*parameters.values(), *(tensor for steps in sets for tensor in steps)]
    before = [tensor.clone() for tensor in tensors]
    once, again = (task_gradient(parameters, *sets, settings(3, order=order)) for _ in range(2))
    assert torch.equal(once.gradient, again.gradient)
    assert once.metrics == again.metrics
    assert not once.gradient.requires_grad
    assert all(map(torch.equal, tensors, before))
    assert not any(tensor.requires_grad or tensor.grad is not None for tensor in tensors)


@pytest.mark.parametrize("order", ["first", "second"])
def test_is_flat_in_the_order_of_the_parameters(make_parameters, sets: Sets, order: str) -> None:
    parameters = make_parameters(0, 3)
    low_first = dict(sorted(parameters.items(), key=lambda entry: entry[0].startswith("high")))
    assert next(iter(low_first)).startswith("low")
    gradients = [
        unflatten(
            task_gradient(given, *sets, settings(3, order=order)).gradient,
            {name: tensor.shape for name, tensor in given.items()},
        )
        for given in (parameters, low_first)
    ]
    torch.testing.assert_close(*gradients)


def test_metrics_say_how_the_sub_skills_are_used(make_parameters, sets: Sets) -> None:
    metrics = task_gradient(make_parameters(1, 3), *sets, settings(3)).metrics
    shares = [metrics[f"sub_skill_share/{k}"] for k in range(3)]
    assert sum(shares) == pytest.approx(1)
    assert all(share * sum(LENGTHS[3]) == pytest.approx(round(share * sum(LENGTHS[3]))) for share in shares)
    assert 0 <= metrics["agreement"] <= 1
    assert 0 <= metrics["continuity_loss"] <= 1


def recursive_sum(terms: Sequence[torch.Tensor]) -> torch.Tensor:
    """Split at the greatest power of two below the length."""
    if len(terms) == 1:
        return terms[0]
    half = 1 << (len(terms) - 1).bit_length() - 1
    return recursive_sum(terms[:half]) + recursive_sum(terms[half:])


@given(st.integers(1, 17), st.integers(0, 2**31))
def test_tree_sum_adds_neighbours_first(count: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    terms = [10 ** (6 * torch.rand(5, generator=generator)) * torch.randn(5, generator=generator) for _ in range(count)]
    before = torch.stack(terms)
    total = tree_sum(terms)
    assert torch.equal(total, recursive_sum(terms))
    assert torch.equal(total, tree_sum(tuple(term.clone() for term in terms)))
    assert torch.equal(torch.stack(terms), before)
    torch.testing.assert_close(total.double(), before.double().sum(0), rtol=1e-5, atol=10)


def test_tree_sum_takes_its_order_from_the_terms_alone() -> None:
    large, one = torch.tensor([1e8]), torch.tensor([1.0])
    assert tree_sum([large, one, -large, one]).item() == 0
    assert tree_sum([large, -large, one, one]).item() == 2


@pytest.mark.parametrize("balance", ["none", "sinkhorn"])
def test_on_labels_each_sub_skill_descends_where_it_has_the_label(make_parameters, sets, balance) -> None:
    """Against automatic differentiation through one inner step; the labels have no gradient."""
    config = settings(3, inner_steps=1, continuity_weight=0.0, order="second", balance=balance)
    parameters = make_parameters(3, 3, dtype=torch.float64)
    first, support, third, query = sets
    got = task_gradient(parameters, first, support, third, query, config, on_labels=True)
    theta = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}

    def loss(values, steps: Steps) -> torch.Tensor:
        predictions = []
        for k in range(3):
            outputs, layers = steps.states, [t[k] for n, t in values.items() if n.startswith("low")]
            for weight, bias in zip(layers[::2], layers[1::2], strict=True):
                outputs = functional.linear(outputs, weight, bias)
                outputs = outputs if weight is layers[-2] else functional.relu(outputs)
            predictions.append(outputs)
        errors = torch.stack([(own - steps.actions).square().sum(1) for own in predictions])
        labels = hard_labels(errors.detach(), config)
        return torch.stack([errors[k][labels == k].mean() for k in labels.unique().tolist()]).sum()

    low = {name: tensor for name, tensor in theta.items() if name.startswith("low")}
    inner = torch.autograd.grad(loss(low, support), list(low.values()), create_graph=True)
    adapted = {
        name: tensor - config.inner_learning_rate * slope
        for (name, tensor), slope in zip(low.items(), inner, strict=True)
    }
    wanted = torch.autograd.grad(loss(adapted, query), list(low.values()))
    views = unflatten(got.gradient, {name: tensor.shape for name, tensor in parameters.items()})
    for name, gradient in zip(low, wanted, strict=True):
        torch.testing.assert_close(views[name], gradient, rtol=1e-9, atol=1e-12)
