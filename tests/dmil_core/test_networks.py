"""Networks as functions of named tensors, against torch.nn and against loops."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dmil_core.networks import bank, bank_each, flatten, initialise, mlp, own_states, part, unflatten

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
    stream = np.random.default_rng(0)
    assert not torch.equal(initialise("a", SIZES, stream)["a.0.weight"], initialise("a", SIZES, stream)["a.0.weight"])


def test_part_takes_whole_names() -> None:
    tensor = torch.zeros(1)
    assert list(part({"high.0.weight": tensor, "higher.0.weight": tensor, "low.high.bias": tensor}, "high")) == [
        "high.0.weight"
    ]


def test_mlp_equals_a_torch_module() -> None:
    parameters = drawn()
    layers = [torch.nn.Linear(*pair) for pair in itertools.pairwise(SIZES)]
    module = torch.nn.Sequential(layers[0], torch.nn.ReLU(), layers[1], torch.nn.ReLU(), layers[2])
    with torch.no_grad():
        for target, value in zip(module.parameters(), parameters.values(), strict=True):
            target.copy_(value)
    torch.testing.assert_close(mlp(parameters, states(9)), module(states(9)).detach())


@pytest.mark.parametrize("networks", [1, 2, 5])
@pytest.mark.parametrize("requires_grad", [False, True])
def test_bank_equals_a_loop_over_mlp(networks: int, requires_grad: bool) -> None:
    parameters = {name: tensor.requires_grad_(requires_grad) for name, tensor in drawn(copies=networks).items()}
    inputs = states(7)
    outputs = bank(parameters, inputs)
    loop = torch.stack([mlp({name: t[k] for name, t in parameters.items()}, inputs) for k in range(networks)])
    torch.testing.assert_close(outputs, loop)
    assert torch.equal(inputs, states(7))
    if requires_grad:
        torch.testing.assert_close(
            torch.autograd.grad(outputs.square().sum(), list(parameters.values())),
            torch.autograd.grad(loop.square().sum(), list(parameters.values())),
            rtol=1e-4,
            atol=1e-5,
        )


@given(st.lists(st.integers(0, 3), min_size=1, max_size=20))
def test_bank_each_equals_bank_on_own_states(chosen: list[int]) -> None:
    parameters, inputs, choice = drawn(copies=4), states(len(chosen)), torch.tensor(chosen)
    everything = bank(parameters, inputs)
    outputs = bank_each(parameters, [inputs[choice == k] for k in range(4)])
    assert len(outputs) == 4
    for k, own in enumerate(outputs):
        torch.testing.assert_close(own, everything[k, choice == k])


def test_bank_each_refuses_a_wrong_number_of_inputs() -> None:
    with pytest.raises(ValueError, match="shorter"):
        bank_each(drawn(copies=3), [states(2), states(2)])


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
