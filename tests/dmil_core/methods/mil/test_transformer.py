"""The transformer against PyTorch's own layers, and closed forms of its parts."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mil.transformer import (
    attention,
    cached,
    decode,
    dropout,
    encode,
    initialise,
    no_dropout,
    position_encoding,
)
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.seeding import named_rng

CONFIG = MilConfig(
    layers=2,
    heads=2,
    units=12,
    key_units=6,
    value_units=6,
    feed_forward_units=10,
    output_scale=1.0,
)


def drawn(seed: int = 0) -> Parameters:
    """Draw all parameters, biases and norms too, so that nothing hides behind a zero or a one."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: (tensor + 0.3 * torch.randn(tensor.shape, generator=generator)).double()
        for name, tensor in initialise(CONFIG, 5, 3, named_rng(seed, "initial")).items()
    }


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def steps(count: int, seed: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    positions = position_encoding(torch.arange(count), CONFIG.units).double()
    return random(count, 5, seed=seed), random(count, 3, seed=seed + 1), positions, torch.arange(count) % 3


def load(module: nn.Module, values: dict[str, Tensor]) -> nn.Module:
    module.load_state_dict(values)
    return module


def multihead(parameters: Parameters, prefix: str) -> dict[str, Tensor]:
    projections = [parameters[f"{prefix}.attention.{name}.weight"] for name in ("query", "key", "value")]
    return {
        "in_proj_weight": torch.cat(projections),
        "in_proj_bias": torch.zeros(3 * CONFIG.units).double(),
        "out_proj.weight": parameters[f"{prefix}.attention.output.weight"],
        "out_proj.bias": torch.zeros(CONFIG.units).double(),
    }


def norm(parameters: Parameters, name: str, values: Tensor) -> Tensor:
    return functional.layer_norm(values, (CONFIG.units,), parameters[f"{name}.scale"], parameters[f"{name}.shift"])


def embedded(parameters: Parameters, demonstrated: tuple[Tensor, Tensor, Tensor, Tensor]) -> Tensor:
    states, actions, positions, demonstrations = demonstrated
    weight, bias = parameters["encoder.embedding.weight"], parameters["encoder.embedding.bias"]
    rows = [parameters["encoder.start.bias"]]
    for t in range(len(states)):
        row = weight @ torch.cat([states[t], actions[t]]) + bias + positions[t]
        rows.append(row + parameters["encoder.demonstration.weight"][int(demonstrations[t])])
    return torch.stack(rows)


def test_the_encoder_is_that_of_pytorch_with_normalisation_first() -> None:
    parameters, demonstrated = drawn(), steps(7)
    tokens = embedded(parameters, demonstrated)[None]
    for layer in range(CONFIG.layers):
        prefix = f"encoder.{layer}"
        values = {f"self_attn.{name}": value for name, value in multihead(parameters, prefix).items()}
        for theirs, ours in (("norm1", "attention.norm"), ("norm2", "feed_forward.norm")):
            values |= {
                f"{theirs}.weight": parameters[f"{prefix}.{ours}.scale"],
                f"{theirs}.bias": parameters[f"{prefix}.{ours}.shift"],
            }
        for theirs, ours in (("linear1", "feed_forward.0"), ("linear2", "feed_forward.1")):
            values |= {f"{theirs}.{part}": parameters[f"{prefix}.{ours}.{part}"] for part in ("weight", "bias")}
        reference = nn.TransformerEncoderLayer(CONFIG.units, 2, 10, 0.0, batch_first=True, norm_first=True).double()
        tokens = load(reference, values)(tokens)
    expected = norm(parameters, "encoder.norm", tokens[0])
    torch.testing.assert_close(encode(parameters, *demonstrated, 2), expected)


def test_the_decoder_attends_to_the_encoder_alone() -> None:
    parameters, encoded, states = drawn(), random(8, 12), random(4, 5, seed=3)
    tokens = states @ parameters["decoder.embedding.weight"].T + parameters["decoder.embedding.bias"]
    for layer in range(CONFIG.layers):
        prefix = f"decoder.{layer}"
        reference = load(nn.MultiheadAttention(CONFIG.units, 2).double(), multihead(parameters, prefix))
        tokens = tokens + reference(norm(parameters, f"{prefix}.attention.norm", tokens), encoded, encoded)[0]
        hidden = (
            norm(parameters, f"{prefix}.feed_forward.norm", tokens) @ parameters[f"{prefix}.feed_forward.0.weight"].T
        )
        hidden = (hidden + parameters[f"{prefix}.feed_forward.0.bias"]).relu()
        tokens = tokens + hidden @ parameters[f"{prefix}.feed_forward.1.weight"].T
        tokens = tokens + parameters[f"{prefix}.feed_forward.1.bias"]
    expected = norm(parameters, "decoder.norm", tokens) @ parameters["output.weight"].T + parameters["output.bias"]
    found = decode(parameters, states, cached(parameters, encoded, 2))
    torch.testing.assert_close(found, expected)
    alone = [decode(parameters, state[None], cached(parameters, encoded, 2)) for state in states]
    torch.testing.assert_close(found, torch.cat(alone))


def test_attention_with_keys_and_values_of_different_sizes() -> None:
    queries, keys, values = random(5, 2 * 3), random(2, 3, 7, seed=1), random(2, 7, 4, seed=2)
    found = attention(queries, keys, values)
    assert found.shape == (5, 8)
    for query, head in itertools.product(range(5), range(2)):
        weights = [math.exp(queries[query, 3 * head : 3 * head + 3] @ keys[head, :, t] / 3**0.5) for t in range(7)]
        expected = sum(weight * values[head, t] for t, weight in enumerate(weights)) / sum(weights)
        torch.testing.assert_close(found[query, 4 * head : 4 * head + 4], expected)


def test_without_steps_there_is_one_token() -> None:
    encoded = encode(drawn(), *steps(0), 2)
    assert encoded.shape == (1, 12)
    assert encoded.isfinite().all()


def test_positions_are_sines_and_cosines() -> None:
    found = position_encoding(torch.tensor([0, 3, 249]), 8)
    for place, row in zip((0, 3, 249), found.tolist(), strict=True):
        angles = [place / 10_000 ** (2 * pair / 8) for pair in range(4)]
        expected = [function(angle) for angle in angles for function in (math.sin, math.cos)]
        np.testing.assert_allclose(row, expected, atol=1e-5)
    assert position_encoding(torch.arange(2), 7).shape == (2, 7)


def test_dropout_follows_from_its_seed() -> None:
    values, state = torch.full((100, 100), 3.0), torch.get_rng_state()
    one, again, other = (dropout(0.25, seed)(values) for seed in (1, 1, 2))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    assert set(one.unique().tolist()) == {0.0, 4.0}
    assert abs((one == 0).float().mean().item() - 0.25) < 0.03
    assert torch.equal(torch.get_rng_state(), state)
    assert dropout(0.0, 1) is no_dropout
    assert no_dropout(values) is values


@pytest.mark.parametrize("part", ["encode", "decode"])
def test_every_part_of_a_layer_has_dropout(part: str) -> None:
    parameters, calls = drawn(), []

    def count(values: Tensor) -> Tensor:
        calls.append(values.shape)
        return values

    encoded = encode(parameters, *steps(4), 2, count if part == "encode" else no_dropout)
    decode(parameters, random(6, 5), cached(parameters, encoded, 2), count if part == "decode" else no_dropout)
    assert calls == [(5 if part == "encode" else 6, 12)] * (1 + 2 * CONFIG.layers)


def test_initial_parameters_survive_flattening_and_keep_the_variance() -> None:
    config = CONFIG.model_copy(update={"units": 64, "feed_forward_units": 256, "output_scale": 0.5})
    parameters = initialise(config, 5, 3, named_rng(0, "initial"))
    back = unflatten(flatten(parameters), {name: tensor.shape for name, tensor in parameters.items()})
    assert all(torch.equal(back[name], tensor) for name, tensor in parameters.items())
    for name, tensor in parameters.items():
        if name.endswith((".bias", ".shift")) and name != "encoder.start.bias":
            assert not tensor.any()
        if name.endswith(".scale"):
            assert (tensor == 1).all()
        if name.endswith(".weight") and name != "encoder.demonstration.weight":
            gain = tensor.square().mean().item() * tensor.shape[1]
            assert abs(gain / (0.25 if name == "output.weight" else 1.0) - 1) < 0.3, name


@pytest.mark.parametrize("function", [lambda x: x.sum(), lambda x: x.square().sum()])
def test_there_is_a_second_derivative(function: Callable[[Tensor], Tensor]) -> None:
    """A fused attention would raise here."""
    parameters, demonstrated, states = drawn(), steps(4), random(2, 5)

    def of(scale: Tensor) -> Tensor:
        moved = {name: tensor * scale for name, tensor in parameters.items()}
        return function(decode(moved, states, cached(moved, encode(moved, *demonstrated, 2), 2)))

    assert torch.autograd.gradgradcheck(of, torch.ones((), dtype=torch.float64, requires_grad=True))
