"""Perceptrons as pure functions of named tensors, alone or in a bank of K.

Parameters are a flat mapping of names to tensors: ``high.0.weight``, ``low.2.bias`` and so on. A bank stacks its K
networks along the first axis of every tensor; `bank` and `network` give views of them as tuples of layers.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.optim.adam import adam

Parameters: TypeAlias = Mapping[str, Tensor]


class Layer(NamedTuple):
    """An affine map."""

    weight: Float[Tensor, "outputs inputs"]
    bias: Float[Tensor, " outputs"]


Network: TypeAlias = tuple[Layer, ...]
"""A perceptron: ReLU between its layers (F.2)."""


def initialise(
    prefix: str, sizes: Sequence[int], rng: np.random.Generator, copies: int | None = None, output_scale: float = 1.0
) -> Parameters:
    """Draw the parameters of a perceptron: He-uniform weights (He et al. 2015), zero biases.

    They are named ``{prefix}.{layer}.weight`` and ``{prefix}.{layer}.bias``. `sizes` are units from the input to the
    output, both included; `copies` draws a bank of so many networks, stacked along a first axis; `output_scale` is that
    of the output layer's weights, against He's.
    """
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    batch = () if copies is None else (copies,)
    parameters: dict[str, Tensor] = {}
    for layer, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
        bound = (6 / fan_in) ** 0.5 * (1 if layer < len(sizes) - 2 else output_scale)
        weight = torch.rand(*batch, fan_out, fan_in, generator=generator)
        parameters[f"{prefix}.{layer}.weight"] = (2 * weight - 1) * bound
        parameters[f"{prefix}.{layer}.bias"] = torch.zeros(*batch, fan_out)
    return parameters


def network(parameters: Parameters, prefix: str) -> Network:
    """Return the layers of the network whose names begin with `prefix` and a dot; no copy."""
    tensors = [tensor for name, tensor in parameters.items() if name.startswith(f"{prefix}.")]
    return tuple(map(Layer, tensors[::2], tensors[1::2]))


def parameters_of(network: Network, prefix: str) -> dict[str, Tensor]:
    """Return the named parameters of a network, or of a bank's stacked layers: the inverse of `network`; no copy."""
    return {
        f"{prefix}.{index}.{name}": tensor
        for index, layer in enumerate(network)
        for name, tensor in layer._asdict().items()
    }


def each_tensor(network: Network, change: Callable[[Tensor], Tensor]) -> Network:
    """Return a network of what a function returns for each weight and bias."""
    return tuple(Layer(*map(change, layer)) for layer in network)


def bank(parameters: Parameters, prefix: str) -> tuple[Network, ...]:
    """Return each network of a bank; no copy."""
    layers = network(parameters, prefix)
    unbound = (map(Layer, weights.unbind(0), biases.unbind(0)) for weights, biases in layers)
    return tuple(zip(*unbound, strict=True))


def stacked(networks: Sequence[Network]) -> Network:
    """Return a bank's layers with its networks along the first axis: the inverse of `bank`, as a copy."""
    return tuple(Layer(*map(torch.stack, zip(*layers, strict=True))) for layers in zip(*networks, strict=True))


BLOCK = 320
"""Steps that go through all layers together: so few that what they leave behind stays in a core's own cache."""


def affine(layer: Layer, inputs: Float[Tensor, "*networks steps inputs"]) -> Float[Tensor, "*networks steps outputs"]:
    """Return what a layer puts out, or the same layer of several networks for the steps of each."""
    weight, bias = layer
    if inputs.ndim == 2:
        return torch.mm(inputs, weight.mT).add_(bias)
    return torch.baddbmm(bias[:, None], inputs, weight.mT)


def add_product(
    matrix: Float[Tensor, "*networks rows columns"],
    left: Float[Tensor, "*networks rows _"],
    right: Float[Tensor, "*networks _ columns"],
    scale: float = 1.0,
) -> Float[Tensor, "*networks rows columns"]:
    """Add `scale` times a product to a matrix in place, or to that of each of several networks, and return it."""
    add = Tensor.addmm_ if matrix.ndim == 2 else Tensor.baddbmm_
    return add(matrix, left, right, alpha=scale)


def activations(
    network: Network, inputs: Float[Tensor, "*networks steps inputs"]
) -> list[Float[Tensor, "*networks steps _"]]:
    """Return what goes into each layer, and last what the network puts out."""
    values = [inputs]
    for layer in network[:-1]:
        values.append(affine(layer, values[-1]).relu_())
    return [*values, affine(network[-1], values[-1])]


def blocks(values: Float[Tensor, "*networks steps _"]) -> Sequence[Float[Tensor, "*networks block _"]]:
    """Return views of so many steps at a time as go through all layers together; those of several networks stay one."""
    return (values,) if values.ndim == 3 or len(values) <= BLOCK else values.split(BLOCK)


def mlp(network: Network, inputs: Float[Tensor, "*networks steps inputs"]) -> Float[Tensor, "*networks steps outputs"]:
    """Return what the network puts out, or what each of a stack of networks does for its own steps."""
    first, *others = (activations(network, block)[-1] for block in blocks(inputs))
    return torch.cat([first, *others]) if others else first


def own_states(chosen: Int[Tensor, " steps"], networks: int) -> list[Int[Tensor, " _"]]:
    """Return, for each network of a bank, the indices of the steps where it is the chosen one, in their order."""
    order = torch.argsort(chosen, stable=True)
    return list(order.split(torch.bincount(chosen, minlength=networks).tolist()))


def routed(
    networks: Sequence[Network], states: Float[Tensor, "steps obs_dim"], chosen: Int[Tensor, " steps"]
) -> Float[Tensor, "steps outputs"]:
    """Return at each state the output of its chosen network, which alone is computed there."""
    if len(states) == 1:
        return mlp(networks[int(chosen)], states)
    indices = own_states(chosen, len(networks))
    used = [k for k, index in enumerate(indices) if len(index)] or [0]
    if len(used) == 1:
        return mlp(networks[used[0]], states)
    return torch.cat([mlp(networks[k], states[indices[k]]) for k in used])[torch.cat(indices).argsort()]


def on_default_device(values: np.ndarray) -> Tensor:
    """Return an array as a tensor on torch's default device: on the CPU without a copy."""
    return torch.as_tensor(values)


def leaves(parameters: Parameters, *, copy: bool = False) -> dict[str, Tensor]:
    """Return the parameters as leaves of a new graph; a copy may be changed in place."""
    detached = {name: tensor.detach() for name, tensor in parameters.items()}
    return {name: (tensor.clone() if copy else tensor).requires_grad_() for name, tensor in detached.items()}


def without_graph(parameters: Parameters) -> dict[str, Tensor]:
    """Return the parameters detached from any graph; no copy."""
    return {name: tensor.detach() for name, tensor in parameters.items()}


class Adam:
    """Adam with decoupled weight decay (Loshchilov and Hutter, ICLR 2019), the fused kernel of `torch.optim.AdamW`.

    The first step of an optimiser of `torch.optim` imports torch's compiler, which takes seconds in each process.
    """

    def __init__(self, parameters: Iterable[Tensor], learning_rate: float, weight_decay: float = 0.0) -> None:
        """Begin with moments of zero."""
        self.parameters = list(parameters)
        self.steps = [torch.tensor(0.0, device=tensor.device) for tensor in self.parameters]
        self.first_moments = [torch.zeros_like(tensor) for tensor in self.parameters]
        self.second_moments = [torch.zeros_like(tensor) for tensor in self.parameters]
        self.learning_rate, self._weight_decay = learning_rate, weight_decay

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for tensor in self.parameters:
            tensor.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Change in place all parameters that have a gradient."""
        state = zip(self.parameters, self.first_moments, self.second_moments, self.steps, strict=True)
        tensors = [(of[0], of[0].grad, *of[1:]) for of in state if of[0].grad is not None]
        parameters, gradients, first, second, steps = map(list, zip(*tensors, strict=True))
        adam(
            parameters, gradients, first, second, [], steps, fused=True, decoupled_weight_decay=True, amsgrad=False,
            beta1=0.9, beta2=0.999, lr=self.learning_rate, weight_decay=self._weight_decay, eps=1e-8, maximize=False,
        )  # fmt: skip


LAST_RATE = 0.01
"""The last learning rate of a cosine, as a part of the first."""


def cosine_rate(first: float, done: float) -> float:
    """Return the learning rate that falls from `first` along a cosine, when the part `done` of all steps is done."""
    along = 0.5 * (1 + math.cos(math.pi * done))
    return first * (LAST_RATE + (1 - LAST_RATE) * along)


def descend(optimiser: Adam | torch.optim.Optimizer, loss: Float[Tensor, ""]) -> None:
    """Take one step of an optimiser down a loss."""
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


def flatten(parameters: Parameters) -> Float[Tensor, " size"]:
    """Copy all parameters into one vector, in their order; of a matrix, one column after the other.

    So a weight's entries lie in the order in which a product with few states reads them fastest.
    """
    if not parameters:
        return torch.zeros(0)
    return torch.cat(
        [(tensor.mT if name.endswith(".weight") else tensor).reshape(-1) for name, tensor in parameters.items()]
    )


def flat_gradient(loss: Float[Tensor, ""], parameters: Parameters) -> Float[Tensor, " size"]:
    """Return the gradient of a loss with respect to leaves that it was computed from, flat as `flatten` has them."""
    gradients = torch.autograd.grad(loss, tuple(parameters.values()))
    return flatten(dict(zip(parameters, gradients, strict=True)))


def unflatten(vector: Float[Tensor, " size"], like: Mapping[str, torch.Size]) -> Parameters:
    """Return views into `vector` with the names and shapes of `like`; the inverse of `flatten`."""
    pieces = vector.split([shape.numel() for shape in like.values()])
    views = {}
    for (name, shape), piece in zip(like.items(), pieces, strict=True):
        if name.endswith(".weight"):
            *batch, rows, columns = shape
            views[name] = piece.view(*batch, columns, rows).mT
        else:
            views[name] = piece.view(shape)
    return views


def zeros_like(parameters: Parameters) -> tuple[Float[Tensor, " size"], Parameters]:
    """Return a flat vector of zeros, and views into it with the parameters' names and shapes."""
    first = next(iter(parameters.values()))
    vector = first.new_zeros(sum(tensor.numel() for tensor in parameters.values()))
    return vector, unflatten(vector, {name: tensor.shape for name, tensor in parameters.items()})
