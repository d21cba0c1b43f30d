"""DMIL in the plain style: every sub-skill on every state, masks, and automatic differentiation through it all.

Written from Algorithm 1 without a function of ``dmil_core``: what a reader of the paper would write first, and what
ours is held against, in speed by the benchmarks and in value by the tests.
"""

from typing import TypeAlias

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.losses import Steps
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.networks import Parameters, flatten

Sets: TypeAlias = tuple[Steps, Steps, Steps, Steps]
"""τ1 to τ4 of one task."""


class MaskedReference:
    """DMIL with the settings of `config`."""

    def __init__(self, config: DmilConfig) -> None:
        self.config = config

    def network(
        self, tensors: Parameters, prefix: str, states: Float[Tensor, "steps inputs"], k: int | None = None
    ) -> Float[Tensor, "steps outputs"]:
        """Run the high level, or sub-skill `k`."""
        layers = sum(name.startswith(f"{prefix}.") and name.endswith("weight") for name in tensors)
        for layer in range(layers):
            weight, bias = tensors[f"{prefix}.{layer}.weight"], tensors[f"{prefix}.{layer}.bias"]
            states = functional.linear(states, *((weight, bias) if k is None else (weight[k], bias[k])))
            states = functional.relu(states) if layer < layers - 1 else states
        return states

    def errors(self, tensors: Parameters, steps: Steps) -> Float[Tensor, "sub_skills steps"]:
        """Return ‖π_k(s_t) − a_t‖² of every sub-skill at every step."""
        skills = range(self.config.sub_skills)
        return torch.stack(
            [((self.network(tensors, "low", steps.states, k) - steps.actions) ** 2).sum(1) for k in skills]
        )

    @torch.no_grad()
    def choice(self, tensors: Parameters, states: Float[Tensor, "steps inputs"]) -> Int[Tensor, " steps"]:
        """Return argmax_k π_h(k|s)."""
        return self.network(tensors, "high", states).argmax(dim=1)

    @torch.no_grad()
    def targets(self, tensors: Parameters, steps: Steps, inner: bool) -> Float[Tensor, "steps sub_skills"]:
        """Return the weight of each sub-skill at each step."""
        errors, em = self.errors(tensors, steps), self.config.em
        if em == "hard" or (em == "reference_soft" and not inner):
            return functional.one_hot(errors.argmin(dim=0), self.config.sub_skills).to(errors.dtype)
        density = torch.exp(-errors / (2 * self.config.posterior_deviation**2))
        posterior = density / density.sum(dim=0)
        return posterior.reshape(-1, len(errors)) if em == "reference_soft" else posterior.T

    def high_loss(self, tensors: Parameters, steps: Steps, inner: bool) -> Float[Tensor, ""]:
        """Return the cross-entropy to the targets, and λ times the expected switches."""
        log_p = functional.log_softmax(self.network(tensors, "high", steps.states), dim=1)
        loss = -(log_p * self.targets(tensors, steps, inner)).sum() / len(log_p)
        if not self.config.continuity_weight:
            return loss
        if self.config.continuity == "reference":
            counts = [(z[1:] != z[:-1]).sum() / len(z) for z in log_p.argmax(1).split(steps.lengths.tolist())]
            return loss + self.config.continuity_weight * torch.stack(counts).mean()
        switches = [(1 - (p[:-1] * p[1:]).sum(1)).sum() / len(p) for p in log_p.exp().split(steps.lengths.tolist())]
        return loss + self.config.continuity_weight * torch.stack(switches).mean()

    def low_loss(self, tensors: Parameters, steps: Steps) -> Float[Tensor, ""]:
        """Return each sub-skill's mean squared error over the states that are its own, summed."""
        mask = functional.one_hot(self.choice(tensors, steps.states), self.config.sub_skills).T
        return ((self.errors(tensors, steps) * mask).sum(1) / mask.sum(1).clamp(min=1)).sum()

    def descend(
        self, tensors: Parameters, prefix: str, loss: Float[Tensor, ""], rate: float, graph: bool
    ) -> Parameters:
        """Return the parameters after one step of one level."""
        names = [name for name in tensors if name.startswith(f"{prefix}.")]
        gradients = torch.autograd.grad(loss, [tensors[name] for name in names], create_graph=graph)
        return {**tensors, **{name: tensors[name] - rate * g for name, g in zip(names, gradients, strict=True)}}

    def inner_loop(
        self, tensors: Parameters, support_high: Steps, support_low: Steps, steps: int, rate: float, graph: bool
    ) -> Parameters:
        """Return the adapted parameters."""
        for _ in range(steps):
            if self.config.adapted in ("both", "high"):
                tensors = self.descend(tensors, "high", self.high_loss(tensors, support_high, True), rate, graph)
            if self.config.adapted in ("both", "low"):
                tensors = self.descend(tensors, "low", self.low_loss(tensors, support_low), rate, graph)
        return tensors

    def gradient(self, parameters: Parameters, sets: Sets) -> tuple[Float[Tensor, " size"], float, float]:
        """Return the outer gradient and both outer losses."""
        config, second = self.config, self.config.order == "second"
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
        tensors = self.inner_loop(leaves, *sets[:2], config.inner_steps, config.inner_learning_rate, second)
        if not second:
            leaves = tensors = {name: tensor.detach().requires_grad_() for name, tensor in tensors.items()}
        high, low = self.high_loss(tensors, sets[2], False), self.low_loss(tensors, sets[3])
        gradients = torch.autograd.grad(high + low, list(leaves.values()))
        return flatten(dict(zip(leaves, gradients, strict=True))), high.item(), low.item()

    def adapt(self, parameters: Parameters, support: Steps, steps: int, rate: float) -> Parameters:
        """Return the parameters adapted to a support set, as at test."""
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in parameters.items()}
        return self.inner_loop(leaves, support, support, steps, rate, graph=False)

    @torch.no_grad()
    def act(self, tensors: Parameters, states: Float[Tensor, "steps inputs"]) -> Float[Tensor, "steps action_dim"]:
        """Return the chosen sub-skill's action for each state."""
        actions = torch.stack([self.network(tensors, "low", states, k) for k in range(self.config.sub_skills)])
        return actions[self.choice(tensors, states), torch.arange(len(states))]
