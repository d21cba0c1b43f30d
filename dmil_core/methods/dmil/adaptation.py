"""The dual inner loop of Algorithm 1: the high level first, then the sub-skills under the adapted high level."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.fine_tuning import fixed, free, mean_error, on_batches
from dmil_core.loss_gradients import LossGradient, loss_gradient
from dmil_core.losses import Steps, bank_errors, behaviour_cloning_loss, squared_errors, sub_skill_labels
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.losses import Targets, hard_labels, high_level_loss, targets_of
from dmil_core.networks import (
    Network,
    Parameters,
    bank,
    mlp,
    network,
    own_states,
    parameters_of,
    routed,
    stacked,
    without_graph,
)
from dmil_core.settings import FineTuning


class Hierarchy(NamedTuple):
    """The networks of both levels."""

    high: Network
    low: tuple[Network, ...]

    @classmethod
    def of(cls, parameters: Parameters) -> "Hierarchy":
        """Return views of the high level (``high.*``) and of the bank of sub-skills (``low.*``), without graph."""
        parameters = without_graph(parameters)
        return cls(network(parameters, "high"), bank(parameters, "low"))

    @property
    def parameters(self) -> Parameters:
        """The named parameters, the sub-skills stacked into a bank."""
        return {**parameters_of(self.high, "high"), **parameters_of(stacked(self.low), "low")}


class InnerStep(NamedTuple):
    """One step of the dual inner loop: what each level goes down, if it is adapted, and where they arrived."""

    high: LossGradient
    low: Mapping[int, LossGradient]
    """Of each sub-skill that was given any states."""
    adapted: Hierarchy


def choose(high: Network, states: Float[Tensor, "steps obs_dim"]) -> Int[Tensor, " steps"]:
    """Return for each step the sub-skill that the high level takes: argmax_k π_h(k|s)."""
    return mlp(high, states).argmax(-1)


def act(
    hierarchy: Hierarchy, states: Float[Tensor, "steps obs_dim"]
) -> tuple[Float[Tensor, "steps action_dim"], Int[Tensor, " steps"]]:
    """Return for each state the action of the sub-skill that the high level takes, and which one that is."""
    chosen = choose(hierarchy.high, states)
    return routed(hierarchy.low, states, chosen), chosen


def high_level_gradient(high: Network, steps: Steps, targets: Targets, config: DmilConfig) -> LossGradient:
    """Return L_h of the high level on `steps` (equation 3 with Appendix C's term)."""
    weight, continuity = config.continuity_weight, config.continuity
    return loss_gradient(
        high, steps.states, lambda logits: high_level_loss(logits, targets, steps.lengths, weight, continuity)
    )


def sub_skill_gradients(low: Sequence[Network], steps: Steps, chosen: Int[Tensor, " steps"]) -> dict[int, LossGradient]:
    """Return L_BC of each sub-skill on the states that the high level gave it, where there are any (equation 4)."""
    indices = own_states(chosen, len(low))

    def of(k: int) -> LossGradient:
        actions = steps.actions[indices[k]]
        return loss_gradient(low[k], steps.states[indices[k]], lambda p: behaviour_cloning_loss(p, actions))

    return {k: of(k) for k in range(len(low)) if len(indices[k])}


def inner_loop(
    hierarchy: Hierarchy,
    support_high: Steps,
    support_low: Steps,
    config: DmilConfig,
    *,
    keep: bool = False,
    on_labels: bool = False,
) -> Iterator[InnerStep]:
    """Yield the steps of the dual inner loop, without end (Algorithm 1); `hierarchy` stays unchanged.

    Args:
        hierarchy: where to start.
        support_high: τ1, which adapts the high level; its labels come from the current sub-skills.
        support_low: τ2, which adapts each sub-skill on the states that the high level gives it by then. At test both
            are the support set.
        config: α, which levels are adapted, and to what; the other level stays as it is.
        keep: leave each step's networks unchanged, for `LossGradient.jacobian_product`; else the next step overwrites
            them.
        on_labels: each sub-skill learns on the states that the labels give it, not on those of the high level.
    """
    high, low = hierarchy

    def descend(gradient: LossGradient, origin: Network) -> Network:
        return gradient.descend(config.inner_learning_rate, in_place=not keep and gradient.network is not origin)

    def errors_of(sub_skill: Network) -> Float[Tensor, " steps"]:
        return squared_errors(mlp(sub_skill, support_high.states), support_high.actions)

    errors = [errors_of(sub_skill) for sub_skill in low]
    while True:
        of_high = high_level_gradient(high, support_high, targets_of(torch.stack(errors), config, inner=True), config)
        if config.adapted != "low":
            high = descend(of_high, hierarchy.high)
        own = hard_labels(bank_errors(low, support_low), config) if on_labels else choose(high, support_low.states)
        of_low = sub_skill_gradients(low, support_low, own)
        if config.adapted != "high":
            low = tuple(descend(of_low[k], hierarchy.low[k]) if k in of_low else low[k] for k in range(len(low)))
        yield InnerStep(of_high, of_low, Hierarchy(high, low))
        if config.adapted != "high":  # a sub-skill that was given no states is still the same
            for k in of_low:
                errors[k] = errors_of(low[k])


def adapt(
    hierarchy: Hierarchy, support_high: Steps, support_low: Steps, config: DmilConfig, *, steps: int
) -> Hierarchy:
    """Return the networks after `steps` steps of the `inner_loop`."""
    for step in itertools.islice(inner_loop(hierarchy, support_high, support_low, config), steps):
        hierarchy = step.adapted
    return hierarchy


def adapt_by_adam(hierarchy: Hierarchy, steps: Steps, config: DmilConfig, tuning: FineTuning) -> Hierarchy:
    """Return the networks after steps of Adam down both levels' losses on batches of states.

    On each batch the labels and the choice are those of the networks as they are; there is no continuity loss, for the
    states of a batch do not follow each other.
    """
    high, low = free(hierarchy.high), tuple(map(free, hierarchy.low))

    def loss(batch: Steps) -> Float[Tensor, ""]:
        logits = mlp(high, batch.states)
        chosen, terms = own_states(logits.argmax(-1), len(low)), []
        if config.adapted != "low" and len(low) > 1:
            with torch.no_grad():
                labels = sub_skill_labels(bank_errors(low, batch))
            terms.append(functional.cross_entropy(logits, labels))
        if config.adapted != "high":
            terms += [
                mean_error(mlp(low[k], batch.states[index]), batch.actions[index])
                for k, index in enumerate(chosen)
                if len(index)
            ]
        return torch.stack(terms).sum()

    on_batches([high, *low], loss, steps, tuning)
    return Hierarchy(fixed(high), tuple(map(fixed, low)))
