"""A transformer that predicts an action for each state from a set of demonstrated steps, as pure functions.

The encoder reads the steps, the decoder is asked for one state at a time (Vaswani et al. 2017). Of each layer there are
    x ← x + Attention(LN(x)),    x ← x + W₂ ReLU(W₁ LN(x) + b₁) + b₂,
where the encoder's attention goes to its own tokens and the decoder's to what the encoder put out. Departures from the
original, all for training without a warm-up of the learning rate or for speed:

- Layer normalisation comes before each part of a layer and once at the end (Xiong et al. 2020), not after it.
- The decoder has no self-attention: its query is a single token, whose attention to itself would be a linear map.
- Dropout applies to what each part of a layer adds and to the sum of embeddings, not to attention weights.

Attention is written out as products and a softmax: PyTorch's fused one has no second derivative on a CPU. Names of
parameters end in ``.weight`` for matrices, ``.bias`` for vectors, ``.scale`` and ``.shift`` for layer normalisation.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.methods.mil.config import MilConfig
from dmil_core.networks import Parameters

Dropout: TypeAlias = Callable[[Tensor], Tensor]
"""What happens to the values that each part of a layer adds."""

Cache: TypeAlias = tuple[tuple[Float[Tensor, "heads key_units tokens"], Float[Tensor, "heads tokens value_units"]], ...]
"""Keys and values of the encoder's output, for each layer of the decoder."""


def initialise(config: MilConfig, obs_dim: int, action_dim: int, rng: np.random.Generator) -> Parameters:
    """Draw the parameters: uniform weights that keep the variance (LeCun et al. 1998), zero biases, plain norms."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    parameters: dict[str, Tensor] = {}

    def weight(name: str, outputs: int, inputs: int, *, bias: bool = True, scale: float = 1.0) -> None:
        bound = scale * (3 / inputs) ** 0.5
        parameters[f"{name}.weight"] = (2 * torch.rand(outputs, inputs, generator=generator) - 1) * bound
        if bias:
            parameters[f"{name}.bias"] = torch.zeros(outputs)

    def norm(name: str) -> None:
        parameters[f"{name}.scale"], parameters[f"{name}.shift"] = torch.ones(units), torch.zeros(units)

    units = config.units
    weight("encoder.embedding", units, obs_dim + action_dim)
    parameters["encoder.start.bias"] = torch.randn(units, generator=generator)
    parameters["encoder.demonstration.weight"] = torch.randn(config.shots, units, generator=generator)
    weight("decoder.embedding", units, obs_dim)
    for part in ("encoder", "decoder"):
        for layer in range(config.layers):
            prefix = f"{part}.{layer}"
            norm(f"{prefix}.attention.norm")
            weight(f"{prefix}.attention.query", config.heads * config.key_units, units, bias=False)
            weight(f"{prefix}.attention.key", config.heads * config.key_units, units, bias=False)
            weight(f"{prefix}.attention.value", config.heads * config.value_units, units, bias=False)
            weight(f"{prefix}.attention.output", units, config.heads * config.value_units, bias=False)
            norm(f"{prefix}.feed_forward.norm")
            weight(f"{prefix}.feed_forward.0", config.feed_forward_units, units)
            weight(f"{prefix}.feed_forward.1", units, config.feed_forward_units)
        norm(f"{part}.norm")
    weight("output", action_dim, units, scale=config.output_scale)
    return parameters


def dropout(rate: float, seed: int) -> Dropout:
    """Return a dropout (Srivastava et al. 2014) whose draws follow from the seed and the order of its calls."""
    generator = torch.Generator().manual_seed(seed)

    def drop(values: Tensor) -> Tensor:
        kept = torch.empty_like(values).bernoulli_(1 - rate, generator=generator)
        return values * kept / (1 - rate)

    return drop if rate else no_dropout


def no_dropout(values: Tensor) -> Tensor:
    """Keep all values."""
    return values


def position_encoding(places: Int[Tensor, " steps"], units: int) -> Float[Tensor, "steps units"]:
    """Return sin and cos of each place at wavelengths from 2π to 10,000·2π (Vaswani et al. 2017, section 3.5)."""
    even = torch.arange(0, units, 2)
    angles = places[:, None] / 10_000 ** (even / units)
    return torch.stack([angles.sin(), angles.cos()], -1).flatten(1)[:, :units]


def attention(
    queries: Float[Tensor, "queries _"],
    keys: Float[Tensor, "heads key_units tokens"],
    values: Float[Tensor, "heads tokens value_units"],
) -> Float[Tensor, "queries heads*value_units"]:
    """Return softmax(Q Kᵀ / √d_k) V of each head; heads stand side by side (Vaswani et al. 2017, equation 1)."""
    heads, key_units, _ = keys.shape
    by_head = queries.view(len(queries), heads, key_units).transpose(0, 1)
    weights = torch.matmul(by_head * key_units**-0.5, keys).softmax(-1)
    return torch.matmul(weights, values).transpose(0, 1).flatten(1)


def encode(
    parameters: Parameters,
    states: Float[Tensor, "steps obs_dim"],
    actions: Float[Tensor, "steps action_dim"],
    positions: Float[Tensor, "steps units"],
    demonstrations: Int[Tensor, " steps"],
    heads: int,
    drop: Dropout = no_dropout,
) -> Float[Tensor, "steps+1 units"]:
    """Return what the encoder makes of demonstrated steps, of which there may be none.

    A learned token comes first, so that there is always one to attend to. The states are standardised; `positions`
    encode each step's place in its demonstration, and `demonstrations` says which one that is. `drop` is applied to the
    embeddings and to what each part of a layer adds.
    """
    embedded = _affine(parameters, "encoder.embedding", torch.cat([states, actions], -1))
    embedded = embedded + positions + parameters["encoder.demonstration.weight"][demonstrations]
    tokens = drop(torch.cat([parameters["encoder.start.bias"][None], embedded]))
    for layer in range(_layers(parameters)):
        prefix = f"encoder.{layer}"
        normed = _norm(parameters, f"{prefix}.attention.norm", tokens)
        keys, values = _keys_and_values(parameters, prefix, normed, heads)
        tokens = tokens + drop(_attend(parameters, prefix, normed, keys, values))
        tokens = tokens + drop(_feed_forward(parameters, prefix, tokens))
    return _norm(parameters, "encoder.norm", tokens)


def cached(parameters: Parameters, encoded: Float[Tensor, "tokens units"], heads: int) -> Cache:
    """Return all that the decoder needs of the encoder's output."""
    return tuple(
        _keys_and_values(parameters, f"decoder.{layer}", encoded, heads) for layer in range(_layers(parameters))
    )


def decode(
    parameters: Parameters, states: Float[Tensor, "queries obs_dim"], cache: Cache, drop: Dropout = no_dropout
) -> Float[Tensor, "queries action_dim"]:
    """Return the action at each state, of which none knows of the others."""
    tokens = drop(_affine(parameters, "decoder.embedding", states))
    for layer, (keys, values) in enumerate(cache):
        prefix = f"decoder.{layer}"
        normed = _norm(parameters, f"{prefix}.attention.norm", tokens)
        tokens = tokens + drop(_attend(parameters, prefix, normed, keys, values))
        tokens = tokens + drop(_feed_forward(parameters, prefix, tokens))
    return _affine(parameters, "output", _norm(parameters, "decoder.norm", tokens))


def _layers(parameters: Parameters) -> int:
    """Return how many layers the encoder has, which is as many as the decoder."""
    return sum(name.startswith("encoder.") and name.endswith(".query.weight") for name in parameters)


def _affine(parameters: Parameters, name: str, inputs: Tensor) -> Tensor:
    return functional.linear(inputs, parameters[f"{name}.weight"], parameters[f"{name}.bias"])


def _norm(parameters: Parameters, name: str, tokens: Tensor) -> Tensor:
    scale, shift = parameters[f"{name}.scale"], parameters[f"{name}.shift"]
    return functional.layer_norm(tokens, scale.shape, scale, shift)


def _keys_and_values(parameters: Parameters, prefix: str, tokens: Tensor, heads: int) -> tuple[Tensor, Tensor]:
    keys, values = (
        (tokens @ parameters[f"{prefix}.attention.{name}.weight"].mT).unflatten(-1, (heads, -1)).transpose(0, 1)
        for name in ("key", "value")
    )
    return keys.mT, values


def _attend(parameters: Parameters, prefix: str, tokens: Tensor, keys: Tensor, values: Tensor) -> Tensor:
    queries = tokens @ parameters[f"{prefix}.attention.query.weight"].mT
    return attention(queries, keys, values) @ parameters[f"{prefix}.attention.output.weight"].mT


def _feed_forward(parameters: Parameters, prefix: str, tokens: Tensor) -> Tensor:
    normed = _norm(parameters, f"{prefix}.feed_forward.norm", tokens)
    hidden = _affine(parameters, f"{prefix}.feed_forward.0", normed).relu()
    return _affine(parameters, f"{prefix}.feed_forward.1", hidden)
