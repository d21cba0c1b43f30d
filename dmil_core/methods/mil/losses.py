"""The two losses of MIL, its inner loop and its outer gradient, as functions of named tensors; see `mil`."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.losses import squared_errors
from dmil_core.methods.base import FineTuning, TaskGradient
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mil.transformer import Dropout, cached, decode, dropout, encode, no_dropout, position_encoding
from dmil_core.networks import Parameters, flat_gradient, leaves


class Pairs(NamedTuple):
    """State-action pairs of the query set."""

    states: Float[Tensor, "pairs obs_dim"]
    actions: Float[Tensor, "pairs action_dim"]


class Support(NamedTuple):
    """The steps of the support demonstrations, one after the other."""

    states: Float[Tensor, "steps obs_dim"]
    actions: Float[Tensor, "steps action_dim"]
    positions: Float[Tensor, "steps units"]
    """The encoding of each step's place."""
    demonstrations: Int[Tensor, " steps"]
    """Which one each step belongs to."""

    @classmethod
    def of(
        cls, demonstrations: Sequence[Demonstration], normalise: Normalisation, positions: int, units: int
    ) -> "Support":
        """Copy demonstrations into fresh tensors, at most `positions` evenly spaced steps of each."""
        places = [_evenly(len(demonstration), positions) for demonstration in demonstrations]
        counts = [len(kept) for kept in places]
        observations, actions = (
            np.concatenate([values[kept] for values, kept in zip(arrays, places, strict=True)])
            for arrays in ([one.observations for one in demonstrations], [one.actions for one in demonstrations])
        )
        return cls(
            torch.from_numpy(normalise(observations)),
            torch.from_numpy(actions),
            position_encoding(torch.cat([torch.arange(count) for count in counts]), units),
            torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)),
        )

    def only(self, steps: Int[Tensor, " kept"]) -> "Support":
        """Return some of the steps, each with its own place."""
        return Support(*(values[steps] for values in self))


class HeldOut(NamedTuple):
    """Actions predicted for steps of the support that were not in the encoder."""

    steps: Int[Tensor, " asked"]
    predictions: Float[Tensor, "asked action_dim"]


def held_out(parameters: Parameters, support: Support, config: MilConfig) -> HeldOut:
    """Predict the actions of every other step from the remaining ones, and the other way round."""
    steps = torch.arange(len(support.states))
    asked = torch.from_numpy(_evenly(len(steps), config.batch_pairs))
    halves = [half for half in (asked[asked % 2 == 0], asked[asked % 2 == 1]) if len(half)]
    predictions = [
        _predictions(parameters, support.only(steps[steps % 2 != half[0] % 2]), support.states[half], config)
        for half in halves
    ]
    return HeldOut(torch.cat(halves), torch.cat(predictions))


def inner_loss(parameters: Parameters, support: Support, config: MilConfig) -> Float[Tensor, ""]:
    """Return the mean squared error at the support's steps, each predicted without itself."""
    asked, predictions = held_out(parameters, support, config)
    return squared_errors(predictions, support.actions[asked]).mean()


def outer_loss(
    parameters: Parameters, support: Support, query: Pairs, config: MilConfig, drop: Dropout = no_dropout
) -> Float[Tensor, ""]:
    """Return the mean squared error at the query pairs, with the whole support in the encoder."""
    predictions = _predictions(parameters, support, query.states, config, drop)
    return squared_errors(predictions, query.actions).mean()


class Adapted(NamedTuple):
    """Where the inner loop ends, and how it began."""

    parameters: Parameters
    loss: float | None
    """The inner loss before the first step, if there was any."""
    clipped: float
    """The part of the numbers in the inner gradients that were clipped."""


def adapted(parameters: Parameters, support: Support, config: MilConfig, tuning: FineTuning, *, keep: bool) -> Adapted:
    """Take steps down the inner loss on a support set, as `tuning` says.

    With `keep` the result keeps the graph from `parameters`, which then must ask for a gradient; else it is a leaf.
    """
    fast, first, clipped = dict(parameters), None, 0
    for _ in range(tuning.steps):
        if not keep:
            fast = leaves(fast)
        with torch.enable_grad():
            loss = inner_loss(fast, support, config)
            gradients = torch.autograd.grad(loss, tuple(fast.values()), create_graph=keep)
            if config.inner_clip is not None:
                limit = config.inner_clip
                clipped += sum(int((gradient.detach().abs() > limit).sum()) for gradient in gradients)
                gradients = [gradient.clamp(-limit, limit) for gradient in gradients]
            fast = {
                name: tensor - tuning.learning_rate * gradient
                for (name, tensor), gradient in zip(fast.items(), gradients, strict=True)
            }
        first = loss.item() if first is None else first
    numbers = max(1, tuning.steps * sum(tensor.numel() for tensor in parameters.values()))
    return Adapted(fast if keep else leaves(fast), first, clipped / numbers)


def outer_gradient(
    parameters: Parameters, support: Support, query: Pairs, config: MilConfig, seed: int
) -> TaskGradient:
    """Return ∇_θ L_outer(θ') of one task, exact or, with ``config.order == "first"``, taken at θ'.

    The metrics hold the outer loss with and without the inner loop, under the same dropout.
    """
    start = leaves(parameters)
    second = config.order == "second"
    tuning = FineTuning(config.inner_steps, config.inner_learning_rate)
    end = adapted(start, support, config, tuning, keep=second)
    with torch.enable_grad():
        loss = outer_loss(end.parameters, support, query, config, dropout(config.dropout, seed))
    gradient = flat_gradient(loss, start if second else end.parameters)
    with torch.no_grad():
        before = outer_loss(parameters, support, query, config, dropout(config.dropout, seed))
    assert end.loss is not None  # there is an inner step at least
    metrics = {
        "loss": loss.item(),
        "loss_unadapted": before.item(),
        "inner_loss": end.loss,
        "inner_clipped": end.clipped,
    }
    return TaskGradient(gradient, metrics)


def _predictions(
    parameters: Parameters, context: Support, states: Tensor, config: MilConfig, drop: Dropout = no_dropout
) -> Float[Tensor, "queries action_dim"]:
    """Return f_θ(s | D) at some states."""
    encoded = encode(parameters, *context, config.heads, drop)
    return decode(parameters, states, cached(parameters, encoded, config.heads), drop)


def _evenly(count: int, most: int) -> Int64[np.ndarray, " kept"]:
    """Return indices of all, or of `most` evenly spaced ones from the first to the last."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).round().astype(np.int64)
