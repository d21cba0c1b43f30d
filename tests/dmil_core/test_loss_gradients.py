"""Derivatives of a perceptron as matrix products, against plain autograd and finite differences."""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional

from dmil_core.loss_gradients import LossGradient, loss_gradient
from dmil_core.losses import OutputLoss, behaviour_cloning_loss
from dmil_core.methods.dmil.adaptation import Hierarchy
from dmil_core.methods.dmil.losses import high_level_loss
from dmil_core.networks import BLOCK, Layer, Network

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}
WIDTHS = {1: (), 2: (7,), 4: (7, 5, 6)}
LENGTHS = {"one step": [1], "many steps": [9, 1, 7], "one block": [BLOCK], "three blocks": [BLOCK - 5, 1, BLOCK + 9]}
WEIGHTS = {"behaviour cloning": None, "cross-entropy": 0.0, "with continuity": 0.8}
SUB_SKILLS, RATE = 3, 0.5

PlainMlp: TypeAlias = Callable[[Network, torch.Tensor], torch.Tensor]


class Problem(NamedTuple):
    """A network, its inputs, and a loss of its outputs: as the package has it, and written out."""

    network: Network
    inputs: torch.Tensor
    loss: Callable[[torch.Tensor], OutputLoss]
    plain: Callable[[torch.Tensor], torch.Tensor]

    @property
    def gradient(self) -> LossGradient:
        return loss_gradient(self.network, self.inputs, self.loss)


def mean_squared_error(outputs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    return ((outputs - actions) ** 2).sum(1).mean()


def cross_entropy_and_switches(
    logits: torch.Tensor, labels: torch.Tensor, lengths: Sequence[int], weight: float
) -> torch.Tensor:
    log_p = functional.log_softmax(logits, dim=1)
    switches = [(1 - (p[:-1] * p[1:]).sum(1)).sum() / len(p) for p in log_p.exp().split(list(lengths))]
    return -log_p[torch.arange(len(labels)), labels].mean() + weight * sum(switches) / len(lengths)


@pytest.fixture(scope="session")
def make_problem(make_parameters, make_steps) -> Callable[..., Problem]:
    """Draw the high level with its loss, or a sub-skill, which is a view into a bank, where no weight is given."""

    def make(
        seed: int, hidden: Sequence[int], lengths: Sequence[int], weight: float | None, dtype=torch.float64
    ) -> Problem:
        hierarchy = Hierarchy.of(make_parameters(seed, SUB_SKILLS, hidden, dtype))
        states, actions, counts = make_steps(seed, lengths, dtype)
        if weight is None:
            loss = partial(behaviour_cloning_loss, actions=actions)
            return Problem(hierarchy.low[1], states, loss, partial(mean_squared_error, actions=actions))
        labels = torch.randint(SUB_SKILLS, (len(states),), generator=torch.Generator().manual_seed(seed))
        of_logits: Any = partial(high_level_loss, targets=labels, lengths=counts, continuity_weight=weight)
        plain = partial(cross_entropy_and_switches, labels=labels, lengths=lengths, weight=weight)
        return Problem(hierarchy.high, states, of_logits, plain)

    return make


@pytest.fixture(params=TOLERANCE, ids=str)
def dtype(request) -> torch.dtype:
    return request.param


@pytest.fixture(params=LENGTHS)
def lengths(request) -> list[int]:
    return LENGTHS[request.param]


@pytest.fixture(params=WEIGHTS)
def weight(request) -> float | None:
    return WEIGHTS[request.param]


@pytest.fixture(params=WIDTHS.values(), ids=[f"depth {depth}" for depth in WIDTHS])
def hidden(request) -> Sequence[int]:
    return request.param


@pytest.fixture
def problem(make_problem, hidden, lengths, weight, dtype) -> Problem:
    return make_problem(2, hidden, lengths, weight, dtype)


def flat(network: Network) -> torch.Tensor:
    return torch.cat([tensor.flatten() for layer in network for tensor in layer])


def shaped(vector: torch.Tensor, like: Network) -> Network:
    """Return a copy of `vector` in the shapes of `like`."""
    pieces = iter(vector.clone().split([tensor.numel() for layer in like for tensor in layer]))
    return tuple(Layer(next(pieces).view_as(weight), next(pieces).view_as(bias)) for weight, bias in like)


def normal_like(network: Network, seed: int) -> torch.Tensor:
    vector = flat(network)
    return torch.randn(vector.shape, generator=torch.Generator().manual_seed(seed), dtype=vector.dtype)


def relative_error(got: torch.Tensor, wanted: torch.Tensor) -> float:
    return float((got - wanted).norm() / wanted.norm())


def plain_loss(problem: Problem, plain_mlp: PlainMlp, vector: torch.Tensor) -> torch.Tensor:
    return problem.plain(plain_mlp(shaped(vector, problem.network), problem.inputs))


def plain_gradient(problem: Problem, plain_mlp: PlainMlp) -> torch.Tensor:
    vector = flat(problem.network).requires_grad_()
    return torch.autograd.grad(plain_loss(problem, plain_mlp, vector), vector)[0]


def pulled_back(of: LossGradient, vector: torch.Tensor, learning_rate: float = RATE) -> torch.Tensor:
    network = shaped(vector, of.network)
    of.jacobian_product(network, learning_rate)
    return flat(network)


def test_value_and_gradient_equal_autograd(problem, plain_mlp, gradient_of, dtype) -> None:
    got = problem.gradient
    expected = plain_mlp(problem.network, problem.inputs)
    torch.testing.assert_close(got.outputs, expected)
    assert got.loss.value.item() == pytest.approx(problem.plain(expected).item(), rel=TOLERANCE[dtype])
    gradient = flat(gradient_of(got))
    assert gradient.dtype == dtype
    assert relative_error(gradient, plain_gradient(problem, plain_mlp)) <= TOLERANCE[dtype]


def test_the_gradient_is_added_to_what_is_there(problem, plain_mlp, dtype) -> None:
    before, got = normal_like(problem.network, 4), problem.gradient
    vector = shaped(before, problem.network)
    got.add_to(vector, -3.0)
    wanted = before - 3 * plain_gradient(problem, plain_mlp)
    assert relative_error(flat(vector), wanted) <= TOLERANCE[dtype]
    got.add_to(vector, 3.0)
    assert relative_error(flat(vector), before) <= TOLERANCE[dtype]
    assert relative_error(wanted, before) > 1e-2


def test_descend_takes_one_step_and_leaves_the_network(problem, plain_mlp, dtype) -> None:
    before, got = flat(problem.network), problem.gradient
    wanted = before - RATE * plain_gradient(problem, plain_mlp)
    stepped = got.descend(RATE)
    assert relative_error(flat(stepped), wanted) <= TOLERANCE[dtype]
    assert relative_error(before, wanted) > 1e-2
    for tensor in itertools.chain(*stepped):
        tensor.zero_()
    assert torch.equal(flat(problem.network), before)


def test_descend_in_place_overwrites_the_networks_own_tensors(problem, dtype) -> None:
    got, own = problem.gradient, list(itertools.chain(*problem.network))
    expected = flat(got.descend(RATE))
    stepped = got.descend(RATE, in_place=True)
    assert all(one is other for one, other in zip(itertools.chain(*stepped), own, strict=True))
    # Some processors' products with and without a place of their own differ in the last bits.
    assert relative_error(flat(stepped), expected) <= TOLERANCE[dtype]
    assert torch.equal(flat(problem.network), flat(stepped))


def test_a_step_of_a_sub_skill_touches_its_row_of_the_bank_alone(make_parameters, make_steps) -> None:
    parameters, before = make_parameters(0, 3), make_parameters(0, 3)
    states, actions, _ = make_steps(0, [6])
    of = loss_gradient(Hierarchy.of(parameters).low[1], states, partial(behaviour_cloning_loss, actions=actions))
    of.descend(RATE, in_place=True)
    for name, tensor in parameters.items():
        if name.startswith("low"):
            assert torch.equal(tensor[[0, 2]], before[name][[0, 2]])
            assert not torch.equal(tensor[1], before[name][1])


@pytest.mark.parametrize("hidden", [(), (5,), (5, 3, 4)], ids=["depth 1", "depth 2", "depth 4"])
def test_pull_back_multiplies_by_identity_minus_the_scaled_hessian(problem, plain_mlp, dtype) -> None:
    """Column by column, against the Hessian of plain autograd."""
    origin, got = flat(problem.network), problem.gradient
    hessian: Any = torch.autograd.functional.hessian(partial(plain_loss, problem, plain_mlp), origin)
    identity = torch.eye(len(origin), dtype=dtype)
    columns = torch.stack([pulled_back(got, unit) for unit in identity], 1)
    assert relative_error(columns, identity - RATE * hessian) <= TOLERANCE[dtype]
    assert relative_error(columns - identity, -RATE * hessian) <= 20 * TOLERANCE[dtype]


def test_pull_back_equals_a_hessian_vector_product(problem, plain_mlp, dtype) -> None:
    vector = normal_like(problem.network, 3)
    leaf = flat(problem.network).requires_grad_()
    (gradient,) = torch.autograd.grad(plain_loss(problem, plain_mlp, leaf), leaf, create_graph=True)
    (product,) = torch.autograd.grad(gradient, leaf, vector)
    assert relative_error(pulled_back(problem.gradient, vector), vector - RATE * product) <= TOLERANCE[dtype]


@pytest.mark.parametrize("dtype", [torch.float64], ids=str)
def test_pull_back_is_the_derivative_of_descend(problem) -> None:
    origin, step = flat(problem.network), 1e-6
    direction = functional.normalize(normal_like(problem.network, 5), dim=0)

    def descended(vector: torch.Tensor) -> torch.Tensor:
        return flat(problem._replace(network=shaped(vector, problem.network)).gradient.descend(RATE))

    differences = (descended(origin + step * direction) - descended(origin - step * direction)) / (2 * step)
    assert relative_error(pulled_back(problem.gradient, direction), differences) < 1e-7
    assert relative_error(direction, differences) > 1e-2


problems = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 10**6),
        "hidden": st.lists(st.integers(1, 9), max_size=4),
        "lengths": st.lists(st.integers(1, 8) | st.integers(BLOCK - 2, BLOCK + 2), min_size=1, max_size=4),
        "weight": st.none() | st.sampled_from([0.0, 0.1, 2.0]),
    }
)


@given(problems, st.floats(1e-4, 1.0))
def test_any_network_and_loss(make_problem, plain_mlp, gradient_of, drawn: dict, learning_rate: float) -> None:
    """Gradient and curvature equal those of plain autograd, and the Jacobian is symmetric."""
    problem = make_problem(**drawn)
    got, one, other = problem.gradient, normal_like(problem.network, 0), normal_like(problem.network, 1)
    leaf = flat(problem.network).requires_grad_()
    (gradient,) = torch.autograd.grad(plain_loss(problem, plain_mlp, leaf), leaf, create_graph=True)
    (product,) = torch.autograd.grad(gradient, leaf, one)
    torch.testing.assert_close(flat(gradient_of(got)), gradient.detach(), rtol=1e-9, atol=1e-11)
    of_one, of_other = (pulled_back(got, vector, learning_rate) for vector in (one, other))
    torch.testing.assert_close(of_one, one - learning_rate * product, rtol=1e-9, atol=1e-10)
    assert float(other @ of_one) == pytest.approx(float(one @ of_other), rel=1e-10, abs=1e-10)


def test_pull_back_is_linear_and_leaves_the_gradient(problem, dtype) -> None:
    got, one, other = problem.gradient, normal_like(problem.network, 0), normal_like(problem.network, 1)
    blocks = itertools.chain(*got.inputs, *got.deltas)
    tensors = [*itertools.chain(*got.network), *blocks, got.outputs, got.loss.value, got.loss.gradient]
    before = [tensor.clone() for tensor in tensors]
    first = pulled_back(got, one)
    assert relative_error(pulled_back(got, one + 2 * other), first + 2 * pulled_back(got, other)) <= TOLERANCE[dtype]
    assert torch.equal(pulled_back(got, one), first)
    assert torch.equal(pulled_back(got, one, 0.0), one)
    assert all(map(torch.equal, tensors, before))


def test_no_gradient_changes_its_inputs_or_carries_a_graph(problem, gradient_of) -> None:
    inputs, before = problem.inputs.clone(), flat(problem.network)
    got = problem.gradient
    hidden = itertools.chain(*(block[1:] for block in got.inputs), *got.deltas)
    derived = [*hidden, got.outputs, *got.loss[:2], flat(gradient_of(got)), flat(got.descend(RATE))]
    assert not any(tensor.requires_grad for tensor in derived)
    assert not pulled_back(got, normal_like(problem.network, 0)).requires_grad
    assert torch.equal(problem.inputs, inputs)
    assert torch.equal(flat(problem.network), before)


def test_units_that_never_fire_have_no_gradient(make_problem, plain_mlp, gradient_of) -> None:
    """A ReLU at zero or below has derivative zero, as in torch: no gradient, no curvature, no NaN."""
    problem = make_problem(0, (6, 5), [8, 3], None)
    problem.network[0].weight[:2] = 0
    problem.network[0].bias[:2] = torch.tensor([0.0, -3.0])
    got = problem.gradient
    assert not got.inputs[0][1][:, :2].any()
    gradient, vector = gradient_of(got), normal_like(problem.network, 0)
    assert relative_error(flat(gradient), plain_gradient(problem, plain_mlp)) <= 1e-10
    assert not gradient[0].weight[:2].any()
    assert not gradient[0].bias[:2].any()
    kept = shaped(pulled_back(got, vector), problem.network)[0]
    assert torch.equal(kept.weight[:2], shaped(vector, problem.network)[0].weight[:2])
    assert torch.equal(kept.bias[:2], shaped(vector, problem.network)[0].bias[:2])
    for silent in problem.network[:-1]:
        silent.weight.zero_()
        silent.bias.fill_(-1)
    assert relative_error(flat(gradient_of(problem.gradient)), plain_gradient(problem, plain_mlp)) <= 1e-10
    assert flat(gradient_of(problem.gradient)[:-1]).count_nonzero() == 0
