"""Networks as pure functions of named tensors: a multi-layer perceptron, and a bank of K of them.

Parameters are a flat mapping of names to tensors: ``high.0.weight``, ``low.2.bias`` and so on; `part` picks one
network out of it. A bank stacks its K networks along the first axis of every tensor.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

__all__ = ["Parameters", "bank", "bank_each", "flatten", "initialise", "mlp", "own_states", "part", "unflatten"]

Parameters: TypeAlias = Mapping[str, Tensor]


def initialise(
    prefix: str,
    sizes: Sequence[int],
    stream: np.random.Generator,
    copies: int | None = None,
    output_scale: float = 1.0,
) -> Parameters:
    """Draw the parameters of a perceptron: He-uniform weights (He et al. 2015), zero biases.

    Args:
        prefix: what the names begin with: ``{prefix}.{layer}.weight`` and ``{prefix}.{layer}.bias``.
        sizes: units from the input to the output, both included.
        stream: where the weights are drawn from.
        copies: draw a bank of so many networks, stacked along a first axis.
        output_scale: scale of the output layer's weights, against He's.
    """
    generator = torch.Generator().manual_seed(int(stream.integers(2**63)))
    batch = () if copies is None else (copies,)
    parameters: dict[str, Tensor] = {}
    for layer, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
        bound = (6 / fan_in) ** 0.5 * (1 if layer < len(sizes) - 2 else output_scale)
        weight = torch.rand(*batch, fan_out, fan_in, generator=generator)
        parameters[f"{prefix}.{layer}.weight"] = (2 * weight - 1) * bound
        parameters[f"{prefix}.{layer}.bias"] = torch.zeros(*batch, fan_out)
    return parameters


def part(parameters: Parameters, prefix: str) -> Parameters:
    """Return the entries whose names begin with `prefix` and a dot, in their order: layer by layer, weight first."""
    return {name: tensor for name, tensor in parameters.items() if name.startswith(f"{prefix}.")}


def _layers(parameters: Parameters) -> Iterator[tuple[Tensor, Tensor, bool]]:
    """Yield each layer's weight and bias, and whether a ReLU follows."""
    tensors = list(parameters.values())
    for index in range(0, len(tensors), 2):
        yield tensors[index], tensors[index + 1], index + 2 < len(tensors)


def mlp(parameters: Parameters, inputs: Float[Tensor, "steps inputs"]) -> Float[Tensor, "steps outputs"]:
    """Apply one perceptron with ReLU between its layers (F.2)."""
    for weight, bias, rectified in _layers(parameters):
        inputs = functional.linear(inputs, weight, bias)
        inputs = torch.relu(inputs) if rectified else inputs
    return inputs


def bank(parameters: Parameters, inputs: Float[Tensor, "steps inputs"]) -> Float[Tensor, "networks steps outputs"]:
    """Apply every network of a bank to every input."""
    networks = next(iter(parameters.values())).shape[0]
    outputs = inputs.expand(networks, *inputs.shape)
    for weight, bias, rectified in _layers(parameters):
        outputs = torch.baddbmm(bias.unsqueeze(1), outputs, weight.mT)
        outputs = (
            outputs.relu_() if rectified and not outputs.requires_grad else outputs.relu() if rectified else outputs
        )
    return outputs


def own_states(chosen: Int[Tensor, " steps"], networks: int) -> list[Int[Tensor, " _"]]:
    """Return, for each network of a bank, the indices of the steps where it is the chosen one, in their order."""
    order = torch.argsort(chosen, stable=True)
    return list(order.split(torch.bincount(chosen, minlength=networks).tolist()))


def bank_each(parameters: Parameters, inputs: Sequence[Float[Tensor, "_ inputs"]]) -> list[Float[Tensor, "_ outputs"]]:
    """Apply each network of a bank to its own inputs alone; none at all is allowed."""
    networks = zip(*(tensor.unbind(0) for tensor in parameters.values()), strict=True)
    return [
        mlp(dict(zip(parameters, tensors, strict=True)), own) for tensors, own in zip(networks, inputs, strict=True)
    ]


def flatten(parameters: Parameters) -> Float[Tensor, " size"]:
    """Copy all parameters into one vector, in their order."""
    return torch.cat([tensor.reshape(-1) for tensor in parameters.values()])


def unflatten(vector: Float[Tensor, " size"], like: Mapping[str, torch.Size]) -> Parameters:
    """Return views into `vector` with the names and shapes of `like`; the inverse of `flatten`."""
    pieces = vector.split([shape.numel() for shape in like.values()])
    return {name: piece.view(shape) for (name, shape), piece in zip(like.items(), pieces, strict=True)}
