"""MIL: model-agnostic meta-learning over a policy that reads the demonstrations (Finn et al. 2017; F.2, Table 10).

The policy f_θ(s | D) is a transformer (Vaswani et al. 2017): the steps [s, a] of the support demonstrations D go into
its encoder, the current state is the decoder's query, its output the action. Per task, with support steps (s_t, a_t),
    L_inner(θ) = mean over t of ‖f_θ(s_t | D without t) − a_t‖²,    θ' = θ − α clip(∇ L_inner(θ)),
    L_outer(θ) = mean over query pairs (s, a) of ‖f_θ'(s | D) − a‖²,
and the outer Adam descends Σ over tasks of L_outer (Finn et al. 2017, "One-shot visual imitation learning via
meta-learning"). At test the same inner steps are taken on the support set, and f_θ'(s | D) acts.

What the appendix leaves open, and what is done here:

- **Copying.** The support states are asked for with the support itself in the encoder, where each answer could be read
  off. Hiding step t from the decoder alone is no help: self-attention has carried a_t into all other tokens. So the
  steps at even places are predicted from those at odd places, and the other way round: what is asked for never enters
  the encoder, and no path leads from a_t to its prediction. It is two passes of half the size. A learned first token
  is there always, so that a support of one step can be learned from: it is asked for with nothing else to go by.
- **Pairs.** Table 10's batch of 512 state-action pairs bounds both losses: the inner one asks for all steps of the
  support, or so many evenly spaced ones, and the outer one for as many pairs, drawn evenly from all steps of the task's
  other demonstrations. The encoder sees the whole support in the outer loss, and half of it in each inner pass.
- **Positions.** Three demonstrations do not fit 250 positions: places count from 0 in each demonstration, and a learned
  embedding tells which one a step belongs to. A longer demonstration is thinned out to 250 evenly spaced steps.
- **Shots.** A support set of meta-training has one to `shots` demonstrations, each as often, so that one model serves
  both the 1-shot and the 3-shot test. There is one embedding for each, none for more: more is a `UserError`.
- **Feed-forward units** are 2,048, as is usual with d_model 512; with it the model has 18.9 M parameters. Positions are
  encoded by sines. Departures from the original transformer are told in `transformer`.
- **Dropout** applies in the outer loss only: the inner gradient should be of the model that acts.
- **Inner loop.** One step, inner gradients clipped number by number at ±10, and second order, as in MIL. α is 0.01, the
  upper end of MIL's 0.001 to 0.01. MIL's learned temporal loss is for videos without actions: here they are given.
- **Outer learning rate.** MIL's 1e-3 was for convolutions of 4 layers; with 512 units and no warm-up it is Table 9's
  1e-4 here, and 1e-3 for the small model of the size quick.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int64
from torch import Tensor

from dmil_core.demonstrations import Demonstration, DemonstrationError, Standardisation
from dmil_core.losses import squared_errors
from dmil_core.meta_gradient import TaskGradient
from dmil_core.methods import transformer
from dmil_core.methods.base import Decision, FineTuning, Standardised, SubSkillUse, no_sub_skills
from dmil_core.methods.transformer import Dropout, Sizes, cached, decode, dropout, encode, no_dropout, position_encoding
from dmil_core.networks import Parameters, flatten
from dmil_core.settings import MethodConfig, Positive, Probability, Size

__all__ = [
    "Mil",
    "MilBatch",
    "MilConfig",
    "MilPolicy",
    "Pairs",
    "Support",
    "adapted",
    "inner_loss",
    "outer_gradient",
    "outer_loss",
]


class MilConfig(MethodConfig):
    """Meta imitation learning with a transformer."""

    name: Literal["mil"] = "mil"
    """The method."""
    layers: Size = 3
    """Layers of the encoder, and as many of the decoder (Table 10)."""
    heads: Size = 8
    """Heads of each attention (Table 10)."""
    units: Size = 512
    """Units of each token, d_model (Table 10)."""
    key_units: Size = 64
    """Of each head's keys and queries, d_k (Table 10)."""
    value_units: Size = 64
    """Of each head's values, d_v (Table 10)."""
    feed_forward_units: Size = 2048
    """Hidden units of each layer; the paper names none."""
    positions: Size = 250
    """Places in a demonstration (Table 10); a longer one is thinned out to so many steps."""
    dropout: Probability = 0.1
    """In the outer loss (Table 10)."""
    batch_pairs: Size = 512
    """State-action pairs that each of the two losses asks for at most (Table 10)."""
    shots: Size = 3
    """Most demonstrations in a support set: meta-training draws from one to so many."""
    inner_learning_rate: Positive = 1e-2
    """α; the paper names none, Finn et al. 2017 have 0.001 to 0.01."""
    inner_steps: Size = 1
    """Steps of the inner loop (Finn et al. 2017)."""
    inner_clip: Positive | None = 10.0
    """Clip each number of the inner gradients to ± this (Finn et al. 2017: 10 or 20)."""
    order: Literal["first", "second"] = "second"
    """Of the meta-gradient: exact, or taken at the adapted parameters."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {"evaluation": {"fine_tuning_steps": 1, "learning_rate": 1e-2}},
        "quick": {
            "method": {
                "layers": 2,
                "heads": 4,
                "units": 64,
                "key_units": 16,
                "value_units": 16,
                "feed_forward_units": 256,
                "batch_pairs": 256,
                "order": "first",
            },
            "evaluation": {"fine_tuning_steps": 1, "learning_rate": 1e-2},
        },
        "smoke": {
            "method": {
                "layers": 1,
                "heads": 2,
                "units": 16,
                "key_units": 8,
                "value_units": 8,
                "feed_forward_units": 32,
                "positions": 50,
                "batch_pairs": 64,
            },
            "evaluation": {"fine_tuning_steps": 1, "learning_rate": 1e-2},
        },
    }


@dataclass(frozen=True, eq=False)
class MilBatch:
    """What one task contributes to one outer step: demonstrations to adapt to and to read, and pairs to judge by."""

    support: tuple[Demonstration, ...]
    observations: Float32[np.ndarray, "pairs obs_dim"]
    actions: Float32[np.ndarray, "pairs action_dim"]
    query_ids: tuple[str, ...]
    """Of the demonstrations that the pairs are drawn from."""
    seed: int
    """Of the dropout."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of all demonstrations: the support's, then the query's."""
        return tuple(demonstration.id for demonstration in self.support) + self.query_ids


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
        cls, demonstrations: Sequence[Demonstration], standardise: Standardisation, positions: int, units: int
    ) -> "Support":
        """Copy demonstrations into fresh tensors, at most `positions` evenly spaced steps of each."""
        places = [_evenly(len(demonstration), positions) for demonstration in demonstrations]
        counts = [len(kept) for kept in places]
        observations, actions = (
            np.concatenate([values[kept] for values, kept in zip(arrays, places, strict=True)])
            for arrays in ([one.observations for one in demonstrations], [one.actions for one in demonstrations])
        )
        return cls(
            torch.from_numpy(standardise(observations)),
            torch.from_numpy(actions),
            position_encoding(torch.cat([torch.arange(count) for count in counts]), units),
            torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)),
        )

    def only(self, steps: Int[Tensor, " kept"]) -> "Support":
        """Return some of the steps, each with its own place."""
        return Support(*(values[steps] for values in self))


def inner_loss(parameters: Parameters, support: Support, config: MilConfig) -> Float[Tensor, ""]:
    """Return the mean squared error at the support's steps, each half predicted with the other half in the encoder."""
    steps = torch.arange(len(support.states))
    asked = torch.from_numpy(_evenly(len(steps), config.batch_pairs))
    total = support.states.new_zeros(())
    for half in (0, 1):
        queries = asked[asked % 2 == half]
        if len(queries):
            context = support.only(steps[steps % 2 != half])
            predictions = _predictions(parameters, context, support.states[queries], config, no_dropout)
            total = total + squared_errors(predictions, support.actions[queries]).sum()
    return total / len(asked)


def outer_loss(
    parameters: Parameters, support: Support, query: Pairs, config: MilConfig, drop: Dropout
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
    """Take steps down the inner loss.

    Args:
        parameters: where to begin.
        support: the steps to learn from.
        config: of the method.
        tuning: how many steps, and how long.
        keep: keep the graph from `parameters`, which then must ask for a gradient; else the result is a leaf.
    """
    fast, first, clipped = dict(parameters), None, 0
    for _ in range(tuning.steps):
        if not keep:
            fast = _leaves(fast)
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
    return Adapted(fast if keep else _leaves(fast), first, clipped / numbers)


def outer_gradient(
    parameters: Parameters, support: Support, query: Pairs, config: MilConfig, seed: int
) -> TaskGradient:
    """Return ∇_θ L_outer(θ') of one task, exact or, with ``config.order == "first"``, taken at θ'.

    The metrics tell the outer loss with and without the inner loop, under the same dropout.
    """
    start = _leaves(parameters)
    second = config.order == "second"
    tuning = FineTuning(config.inner_steps, config.inner_learning_rate)
    end = adapted(start, support, config, tuning, keep=second)
    with torch.enable_grad():
        loss = outer_loss(end.parameters, support, query, config, dropout(config.dropout, seed))
    target = start if second else end.parameters
    gradients = torch.autograd.grad(loss, tuple(target.values()))
    with torch.no_grad():
        before = outer_loss(parameters, support, query, config, dropout(config.dropout, seed))
    assert end.loss is not None  # there is an inner step at least
    metrics = {
        "loss": loss.item(),
        "loss_unadapted": before.item(),
        "inner_loss": end.loss,
        "inner_clipped": end.clipped,
    }
    return TaskGradient(flatten(dict(zip(target, gradients, strict=True))), metrics)


@dataclass(frozen=True)
class MilPolicy:
    """The decoder acts, with the adapted encoder's view of the support set at hand: a = f_θ'(s | D)."""

    parameters: Parameters
    cache: transformer.Cache
    standardise: Standardisation

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes 0"]:
        """Return an empty memory: the action depends on the state and the support set alone."""
        return np.zeros((episodes, 0), np.int64)

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action for each episode."""
        actions = decode(self.parameters, torch.from_numpy(self.standardise(observations)), self.cache)
        return Decision(actions.numpy(), np.zeros(len(observations), np.int64), memory)

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return sub-skill 0: there are none."""
        return no_sub_skills(demonstration)


@dataclass(frozen=True)
class Mil(Standardised[MilConfig]):
    """MIL for observations and actions of given sizes."""

    config_type = MilConfig

    def initial_parameters(self, stream: np.random.Generator) -> Parameters:
        """Draw the transformer."""
        config = self.config
        sizes = Sizes(
            self.obs_dim,
            self.action_dim,
            config.layers,
            config.heads,
            config.units,
            config.key_units,
            config.value_units,
            config.feed_forward_units,
            config.shots,
        )
        return transformer.initialise(sizes, stream)

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, stream: np.random.Generator) -> MilBatch:
        """Draw one to `shots` demonstrations as the support set, and query pairs from all others.

        Raises:
            DemonstrationError: if there is no second demonstration to draw query pairs from: asking for what the
                encoder has read would teach to copy.
        """
        total = len(demonstrations)
        if total < 2:
            raise DemonstrationError(
                f"demonstrations: got {total} for this task; wanted at least 2, one to read and one to ask for; "
                "collect more"
            )
        shots = int(stream.integers(1, min(self.config.shots, total - 1) + 1))
        order = [demonstrations[index] for index in stream.permutation(total)]
        support, others = order[:shots], order[shots:]
        ends = np.cumsum([len(demonstration) for demonstration in others])
        pairs = stream.choice(ends[-1], min(self.config.batch_pairs, int(ends[-1])), replace=False)
        owners = np.searchsorted(ends, pairs, side="right")
        steps = pairs - np.concatenate([[0], ends])[owners]
        drawn = [(others[owner], step) for owner, step in zip(owners, steps, strict=True)]
        return MilBatch(
            tuple(support),
            np.stack([demonstration.observations[step] for demonstration, step in drawn]),
            np.stack([demonstration.actions[step] for demonstration, step in drawn]),
            tuple(others[owner].id for owner in np.unique(owners)),
            int(stream.integers(2**63)),
        )

    def task_gradient(self, parameters: Parameters, material: MilBatch) -> TaskGradient:
        """Return the outer gradient of one task."""
        query = Pairs(torch.from_numpy(self.standardise(material.observations)), torch.tensor(material.actions))
        return outer_gradient(parameters, self._support(material.support), query, self.config, material.seed)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> MilPolicy:
        """Take the inner loop's steps on the support set and encode it.

        Raises:
            DemonstrationError: for more demonstrations than there are embeddings to tell them apart.
        """
        if len(support) > self.config.shots:
            raise DemonstrationError(
                f"support: got {len(support)} demonstrations; wanted at most method.shots, {self.config.shots}, which "
                "the model was trained to tell apart; give fewer, or train with more"
            )
        steps = self._support(support)
        end = adapted(parameters, steps, self.config, fine_tuning, keep=False).parameters
        with torch.no_grad():
            fixed = {name: tensor.detach() for name, tensor in end.items()}
            heads = self.config.heads
            cache = cached(fixed, encode(fixed, *steps, heads), heads)
        return MilPolicy(fixed, cache, self.standardise)

    def _support(self, demonstrations: Sequence[Demonstration]) -> Support:
        return Support.of(demonstrations, self.standardise, self.config.positions, self.config.units)


def _predictions(
    parameters: Parameters, context: Support, states: Tensor, config: MilConfig, drop: Dropout
) -> Float[Tensor, "queries action_dim"]:
    """Return f_θ(s | D) at some states."""
    encoded = encode(parameters, *context, config.heads, drop)
    return decode(parameters, states, cached(parameters, encoded, config.heads), drop)


def _leaves(parameters: Parameters) -> dict[str, Tensor]:
    """Return the same numbers, cut off from what they came from, ready to be differentiated by."""
    return {name: tensor.detach().requires_grad_() for name, tensor in parameters.items()}


def _evenly(count: int, most: int) -> Int64[np.ndarray, " kept"]:
    """Return indices of all, or of `most` evenly spaced ones from the first to the last."""
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).round().astype(np.int64)
