"""The dual inner loop of Algorithm 1: the high level first, then the sub-skills under the adapted high level."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmil_core.losses import (
    Steps,
    Targets,
    behaviour_cloning_loss,
    high_level_loss,
    soft_labels,
    squared_errors,
    sub_skill_labels,
)
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.networks import Network, Parameters, bank, mlp, network, own_states, stacked
from dmil_core.slopes import Slope, slope


class Hierarchy(NamedTuple):
    """The networks of both levels."""

    high: Network
    low: tuple[Network, ...]

    @classmethod
    def of(cls, parameters: Parameters) -> "Hierarchy":
        """Return views of the high level (``high.*``) and of the bank of sub-skills (``low.*``), without graph."""
        parameters = {name: tensor.detach() for name, tensor in parameters.items()}
        return cls(network(parameters, "high"), bank(parameters, "low"))

    @property
    def parameters(self) -> Parameters:
        """The named parameters, the sub-skills stacked into a bank."""
        levels = {"high": self.high, "low": stacked(self.low)}
        return {
            f"{level}.{index}.{name}": tensor
            for level, layers in levels.items()
            for index, layer in enumerate(layers)
            for name, tensor in layer._asdict().items()
        }


class InnerStep(NamedTuple):
    """One step of the dual inner loop: what each level goes down, if it is adapted, and where they arrived."""

    high: Slope
    low: Mapping[int, Slope]
    """Of each sub-skill that was given any states."""
    adapted: Hierarchy


class Adapted(NamedTuple):
    """Adapted networks, and each level's loss before each inner step."""

    hierarchy: Hierarchy
    high_losses: tuple[float, ...]
    low_losses: tuple[float, ...]


def errors_of(low: Sequence[Network], steps: Steps) -> Float[Tensor, "sub_skills steps"]:
    """Return ‖π_k(s_t) − a_t‖² of every sub-skill at every step."""
    return torch.stack([_errors(sub_skill, steps) for sub_skill in low])


def _errors(sub_skill: Network, steps: Steps) -> Float[Tensor, " steps"]:
    return squared_errors(mlp(sub_skill, steps.states), steps.actions)


def label(low: Sequence[Network], steps: Steps) -> Int[Tensor, " steps"]:
    """Return for each step the sub-skill that explains its action best, the target of equation 3."""
    return sub_skill_labels(errors_of(low, steps))


def targets_of(errors: Float[Tensor, "sub_skills steps"], config: DmilConfig, *, inner: bool) -> Targets:
    """Return what the high level should predict; in the outer loop, the reference's labels are hard."""
    if config.em == "hard" or (config.em == "reference_soft" and not inner):
        return sub_skill_labels(errors)
    return soft_labels(errors, config.posterior_deviation, transposed=config.em == "soft")


def choose(high: Network, states: Float[Tensor, "steps obs_dim"]) -> Int[Tensor, " steps"]:
    """Return for each step the sub-skill that the high level takes: argmax_k π_h(k|s)."""
    return mlp(high, states).argmax(-1)


def act(
    hierarchy: Hierarchy, states: Float[Tensor, "steps obs_dim"]
) -> tuple[Float[Tensor, "steps action_dim"], Int[Tensor, " steps"]]:
    """Return for each state the action of the sub-skill that the high level takes, and which one that is."""
    chosen = choose(hierarchy.high, states)
    first, *others = set(chosen.tolist()) or {0}  # no states are an answer too
    if not others:
        return mlp(hierarchy.low[first], states), chosen
    own = own_states(chosen, len(hierarchy.low))
    actions = [mlp(sub_skill, states[index]) for sub_skill, index in zip(hierarchy.low, own, strict=True) if len(index)]
    return torch.cat(actions)[torch.cat(own).argsort()], chosen


def high_level_slope(high: Network, steps: Steps, targets: Targets, config: DmilConfig) -> Slope:
    """Return L_h of the high level on `steps` (equation 3 with Appendix C's term)."""
    weight, continuity = config.continuity_weight, config.continuity
    return slope(high, steps.states, lambda logits: high_level_loss(logits, targets, steps.lengths, weight, continuity))


def sub_skill_slopes(low: Sequence[Network], steps: Steps, chosen: Int[Tensor, " steps"]) -> dict[int, Slope]:
    """Return L_BC of each sub-skill on the states that the high level gave it, where there are any (equation 4)."""
    own = own_states(chosen, len(low))

    def of(k: int) -> Slope:
        actions = steps.actions[own[k]]
        return slope(low[k], steps.states[own[k]], lambda p: behaviour_cloning_loss(p, actions))

    return {k: of(k) for k in range(len(low)) if len(own[k])}


def inner_loop(
    hierarchy: Hierarchy,
    support_high: Steps,
    support_low: Steps,
    config: DmilConfig,
    *,
    keep: bool = False,
) -> Iterator[InnerStep]:
    """Go down both levels' losses in turn, step after step without end (Algorithm 1); `hierarchy` stays as it is.

    Args:
        hierarchy: where to start.
        support_high: τ1, which adapts the high level; its labels come from the current sub-skills.
        support_low: τ2, which adapts each sub-skill on the states that the high level gives it by then. At test both
            are the support set.
        config: α, which levels are adapted, and to what; the other level stays as it is.
        keep: keep each step's networks as they were, for `Slope.pull_back`; else the next step overwrites them.
    """
    high, low = hierarchy

    def descend(slope: Slope, origin: Network) -> Network:
        return slope.descend(config.inner_learning_rate, in_place=not keep and slope.network is not origin)

    errors = [_errors(sub_skill, support_high) for sub_skill in low]
    while True:
        of_high = high_level_slope(high, support_high, targets_of(torch.stack(errors), config, inner=True), config)
        if config.adapted != "low":
            high = descend(of_high, hierarchy.high)
        of_low = sub_skill_slopes(low, support_low, choose(high, support_low.states))
        if config.adapted != "high":
            low = tuple(descend(of_low[k], hierarchy.low[k]) if k in of_low else low[k] for k in range(len(low)))
        yield InnerStep(of_high, of_low, Hierarchy(high, low))
        if config.adapted != "high":  # a sub-skill that was given no states is still the same
            errors = [_errors(low[k], support_high) if k in of_low else errors[k] for k in range(len(low))]


def adapt(
    hierarchy: Hierarchy,
    support_high: Steps,
    support_low: Steps,
    config: DmilConfig,
    *,
    steps: int,
) -> Adapted:
    """Run so many steps of the `inner_loop`."""
    high_losses, low_losses = [], []
    for step in itertools.islice(inner_loop(hierarchy, support_high, support_low, config), steps):
        hierarchy = step.adapted
        high_losses.append(step.high.loss.value.item())
        low_losses.append(sum(of_low.loss.value.item() for of_low in step.low.values()))
    return Adapted(hierarchy, tuple(high_losses), tuple(low_losses))
