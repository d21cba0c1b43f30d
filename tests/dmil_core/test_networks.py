"""Networks as views of named tensors, against torch.nn and against loops."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.networks import (
    BLOCK,
    activations,
    bank,
    flatten,
    initialise,
    mlp,
    network,
    own_states,
    stacked,
    unflatten,
)

SIZES = [4, 6, 5, 3]


def drawn(seed: int = 0, copies: int | None = None) -> dict[str, torch.Tensor]:
    """Draw a network whose biases are not zero."""
    parameters = initialise("net", SIZES, np.random.default_rng(seed), copies)
    generator = torch.Generator().manual_seed(seed)
    return {name: t + 0.1 * torch.randn(t.shape, generator=generator) for name, t in parameters.items()}


def states(steps: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(steps, SIZES[0], generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("copies", [None, 1, 3])
def test_initial_parameters_are_he_uniform_with_zero_biases(copies: int | None) -> None:
    sizes = [50, 40, 30, 20]
    parameters = initialise("high", sizes, np.random.default_rng(0), copies, output_scale=0.5)
    assert list(parameters) == [f"high.{layer}.{kind}" for layer in range(3) for kind in ("weight", "bias")]
    for layer, scale in enumerate([1, 1, 0.5]):
        weight, bias = parameters[f"high.{layer}.weight"], parameters[f"high.{layer}.bias"]
        batch = () if copies is None else (copies,)
        assert weight.shape == (*batch, sizes[layer + 1], sizes[layer])
        assert torch.equal(bias, torch.zeros(*batch, sizes[layer + 1]))
        bound = (6 / sizes[layer]) ** 0.5 * scale
        assert 0.95 * bound < weight.abs().max() <= bound
        assert weight.std().item() == pytest.approx(bound / 3**0.5, rel=0.1)
        assert weight.mean().item() == pytest.approx(0, abs=0.1 * bound)


def test_initial_parameters_follow_their_stream() -> None:
    one, same, other = (initialise("a", SIZES, np.random.default_rng(seed), 2) for seed in (0, 0, 1))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["a.0.weight"], other["a.0.weight"])
    assert not torch.equal(one["a.0.weight"][0], one["a.0.weight"][1])
    rng = np.random.default_rng(0)
    assert not torch.equal(initialise("a", SIZES, rng)["a.0.weight"], initialise("a", SIZES, rng)["a.0.weight"])


def module(layers: list[tuple[torch.Tensor, torch.Tensor]]) -> torch.nn.Sequential:
    """Return the perceptron of torch.nn with copies of these weights and biases."""
    modules: list[torch.nn.Module] = []
    for weight, bias in layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": weight, "bias": bias})
        modules += [linear, torch.nn.ReLU()]
    return torch.nn.Sequential(*modules[:-1])


def pairs(parameters: dict[str, torch.Tensor], k: int | None = None) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return weight and bias of each layer by their names, of one network of a bank where k is given."""
    named = [
        (parameters[f"net.{layer}.weight"], parameters[f"net.{layer}.bias"]) for layer in range(len(parameters) // 2)
    ]
    return named if k is None else [(weight[k], bias[k]) for weight, bias in named]


def test_a_network_takes_whole_names() -> None:
    weight, bias, other = torch.zeros(1, 1), torch.ones(1), torch.zeros(1)
    parameters = {
        "higher.0.weight": other,
        "high.0.weight": weight,
        "low.high.bias": other,
        "high.0.bias": bias,
        "high": other,
    }
    ((got_weight, got_bias),) = network(parameters, "high")
    assert got_weight is weight
    assert got_bias is bias


def test_a_network_is_its_layers_without_a_copy() -> None:
    parameters = drawn()
    layers = network(parameters, "net")
    assert [(layer.weight, layer.bias) for layer in layers] == pairs(parameters)
    for layer in layers:
        layer.weight.fill_(2)
        layer.bias.fill_(3)
    assert all((t == (2 if name.endswith("weight") else 3)).all() for name, t in parameters.items())


def test_writing_to_one_network_of_a_bank_shows_in_its_row_alone() -> None:
    parameters, before = drawn(copies=3), drawn(copies=3)
    for weight, bias in bank(parameters, "net")[1]:
        weight.zero_()
        bias.zero_()
    for name, tensor in parameters.items():
        assert torch.equal(tensor[[0, 2]], before[name][[0, 2]])
        assert not tensor[1].any()


@pytest.mark.parametrize("copies", [1, 3])
def test_stacked_is_the_inverse_of_bank_and_a_copy(copies: int) -> None:
    parameters, before = drawn(copies=copies), drawn(copies=copies)
    layers = stacked(bank(parameters, "net"))
    assert len(layers) == len(SIZES) - 1
    for (weight, bias), (wanted_weight, wanted_bias) in zip(layers, pairs(parameters), strict=True):
        assert torch.equal(weight, wanted_weight)
        assert torch.equal(bias, wanted_bias)
        weight.zero_()
        bias.zero_()
    assert all(torch.equal(tensor, before[name]) for name, tensor in parameters.items())


def test_networks_of_unequal_depth_make_no_bank() -> None:
    layers = network(drawn(), "net")
    with pytest.raises(ValueError, match="shorter"):
        stacked([layers, layers[:-1]])


@pytest.mark.parametrize("depth", [1, 2, 3])
@pytest.mark.parametrize("steps", [1, 9, BLOCK, BLOCK + 1, 2 * BLOCK + 3])
def test_mlp_equals_a_torch_module(depth: int, steps: int) -> None:
    parameters = dict(itertools.islice(drawn().items(), 2 * depth))
    expected = module(pairs(parameters))(states(steps)).detach()
    torch.testing.assert_close(mlp(network(parameters, "net"), states(steps)), expected)


@pytest.mark.parametrize("networks", [1, 2, 5])
def test_each_network_of_a_bank_equals_a_torch_module(networks: int) -> None:
    parameters = drawn(copies=networks)
    each = bank(parameters, "net")
    assert len(each) == networks
    outputs = [mlp(own, states(7)) for own in each]
    for k, output in enumerate(outputs):
        torch.testing.assert_close(output, module(pairs(parameters, k))(states(7)).detach())
    assert not any(torch.equal(*two) for two in itertools.combinations(outputs, 2))


def test_activations_are_the_inputs_of_every_layer_then_the_outputs() -> None:
    parameters, inputs = drawn(), states(9)
    reference, expected = module(pairs(parameters)), [inputs.clone()]
    for index, layer in enumerate(reference):
        value = layer(expected[-1]).detach()
        expected = [*expected[:-1], value] if index % 2 else [*expected, value]
    values = activations(network(parameters, "net"), inputs)
    assert values[0] is inputs
    assert torch.equal(inputs, states(9))
    assert len(values) == len(SIZES)
    torch.testing.assert_close(values, expected)
    assert all((value >= 0).all() and (value == 0).any() for value in values[1:-1])
    assert (values[-1] < 0).any()


@pytest.mark.parametrize("steps", [7, BLOCK + 7])
def test_mlp_can_be_differentiated(steps: int) -> None:
    """Its ReLU works in place, which autograd must not notice; the reference's gradients do not go through it."""
    parameters = {name: tensor.requires_grad_() for name, tensor in drawn().items()}
    reference, inputs = module(pairs(parameters)), states(steps).requires_grad_()
    got = torch.autograd.grad(
        mlp(network(parameters, "net"), inputs).square().sum() / steps,
        [inputs, *parameters.values()],
        create_graph=True,
    )
    wanted = torch.autograd.grad(
        reference(inputs).square().sum() / steps, [inputs, *reference.parameters()], create_graph=True
    )
    torch.testing.assert_close(got, wanted, rtol=1e-4, atol=1e-5)
    (again,) = torch.autograd.grad(got[1].square().sum(), parameters["net.1.weight"])
    (again_wanted,) = torch.autograd.grad(
        wanted[1].square().sum(), next(itertools.islice(reference.parameters(), 2, None))
    )
    torch.testing.assert_close(again, again_wanted, rtol=1e-4, atol=1e-4)


@given(st.integers(1, 6).flatmap(lambda n: st.tuples(st.just(n), st.lists(st.integers(0, n - 1), min_size=1))))
def test_own_states_is_a_partition_in_order(case: tuple[int, list[int]]) -> None:
    networks, chosen = case
    own = own_states(torch.tensor(chosen), networks)
    assert [indices.tolist() for indices in own] == [
        [step for step, choice in enumerate(chosen) if choice == k] for k in range(networks)
    ]


@pytest.mark.parametrize("copies", [None, 3])
def test_flatten_and_unflatten_are_inverse(copies: int | None) -> None:
    parameters = drawn(copies=copies)
    shapes = {name: tensor.shape for name, tensor in parameters.items()}
    vector = flatten(parameters)
    back = unflatten(vector, shapes)
    assert list(back) == list(parameters)
    assert all(torch.equal(back[name], tensor) for name, tensor in parameters.items())
    assert torch.equal(flatten(back), vector)
    vector.zero_()
    assert not any(tensor.any() for tensor in back.values()), "unflatten returns views"
    assert all(tensor.any() for tensor in parameters.values()), "flatten copies"
