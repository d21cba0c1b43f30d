"""First and second derivatives of a perceptron's loss as bare matrix products.

Automatic differentiation twice through an inner loop keeps every intermediate of two graphs, writes each gradient out
and reads it again to take the step. A perceptron is simple enough to do without: a layer's weight gradient is the
product δᵀx of what came back and what went in, and a product can be subtracted from a weight while it is computed.
Neither the networks nor their inputs may ask autograd for a gradient.

All of it also computes several networks at once: every tensor then has a first axis for them, the losses' values too,
and each product is one product of stacks of matrices.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dmil_core.losses import OutputLoss
from dmil_core.networks import Network, activations, add_product, affine, blocks, each_tensor

_relu_backward = torch.ops.aten.threshold_backward.grad_input


class LossGradient(NamedTuple):
    """Loss of a network at given parameters: the value, the gradient in factors, and the Hessian."""

    network: Network
    inputs: list[list[Float[Tensor, "*networks block _"]]]
    """For each block of steps, what went into each layer, x_l."""
    deltas: list[list[Float[Tensor, "*networks block _"]]]
    """The loss's gradient with respect to what each layer put out before its ReLU, δ_l: ∇W_l = Σ δ_lᵀ x_l."""
    outputs: Float[Tensor, "*networks steps outputs"]
    loss: OutputLoss

    def add_to(self, vector: Network, scale: float = 1.0) -> None:
        """Add `scale` times the gradient to `vector`, in place."""
        for inputs, deltas in zip(self.inputs, self.deltas, strict=True):
            for (weight, bias), value, delta in zip(vector, inputs, deltas, strict=True):
                add_product(weight, delta.mT, value, scale)
                bias.add_(delta.sum(-2), alpha=scale)

    def descend(self, learning_rate: float, *, in_place: bool = False) -> Network:
        """Return the network after one step of gradient descent; with `in_place`, `self.network` is overwritten."""
        stepped = self.network if in_place else each_tensor(self.network, torch.clone)
        self.add_to(stepped, -learning_rate)
        return stepped

    def jacobian_product(self, vector: Network, learning_rate: float) -> None:
        """Multiply `vector` in place by the Jacobian of `descend`, I − αH, which is symmetric.

        H v is the derivative of the gradient along v (Pearlmutter, "Fast exact multiplication by the Hessian",
        1994): forward R{z_l} = x_l V_lᵀ + R{x_l} W_lᵀ and backward R{δ_{l-1}} = R{δ_l} W_l + δ_l V_l behind the
        ReLU's mask, then R{∇W_l} = R{δ_l}ᵀ x_l + δ_lᵀ R{x_l}: six products a layer.
        """
        tangents = [_tangents(self.network, vector, inputs) for inputs in self.inputs]
        changes = blocks(self.loss.curvature(torch.cat([block.pop() for block in tangents], -2)))
        for index in reversed(range(len(vector))):
            steps = list(zip(changes, self.inputs, self.deltas, tangents, strict=True))
            if index:
                changes = [
                    _masked(
                        add_product(change @ self.network[index].weight, deltas[index], vector[index].weight),
                        inputs[index],
                    )
                    for change, inputs, deltas, _ in steps
                ]
            weight, bias = vector[index]
            for change, inputs, deltas, tangent in steps:
                add_product(weight, change.mT, inputs[index], -learning_rate)
                bias.sub_(change.sum(-2), alpha=learning_rate)
                if index:
                    add_product(weight, deltas[index].mT, tangent[index - 1], -learning_rate)


def loss_gradient(
    network: Network,
    inputs: Float[Tensor, "*networks steps inputs"],
    loss: Callable[[Float[Tensor, "*networks steps outputs"]], OutputLoss],
) -> LossGradient:
    """Return a network's loss and its gradient: one forward and one backward pass."""
    values = [activations(network, block) for block in blocks(inputs)]
    outputs = torch.cat([block.pop() for block in values], -2)
    at_outputs = loss(outputs)
    deltas = [
        _deltas(network, block, gradient) for block, gradient in zip(values, blocks(at_outputs.gradient), strict=True)
    ]
    return LossGradient(network, values, deltas, outputs, at_outputs)


def _deltas(network: Network, inputs: list[Tensor], gradient: Tensor) -> list[Tensor]:
    """Return δ_l of each layer from the last layer's."""
    deltas = [gradient]
    for (weight, _), value in zip(network[:0:-1], inputs[:0:-1], strict=True):
        deltas.append(_masked(deltas[-1] @ weight, value))
    return deltas[::-1]


def _tangents(network: Network, vector: Network, inputs: list[Tensor]) -> list[Tensor]:
    """Return the derivative along `vector` of what each layer puts out, R{x_{l+1}}, and last R{z_L}."""
    tangents: list[Tensor] = []
    for index, ((weight, _), along) in enumerate(zip(network, vector, strict=True)):
        tangent = affine(along, inputs[index])
        if index:
            add_product(tangent, tangents[-1], weight.mT)
        tangents.append(_masked(tangent, inputs[index + 1]) if index + 1 < len(network) else tangent)
    return tangents


def _masked(gradient: Tensor, activation: Tensor) -> Tensor:
    """Multiply in place by the derivative of the ReLU that gave `activation`."""
    return _relu_backward(gradient, activation, 0, grad_input=gradient)
