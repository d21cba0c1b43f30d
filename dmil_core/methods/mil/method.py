"""MIL: model-agnostic meta-learning over a policy that reads the demonstrations (Finn et al. 2017; F.2, Table 10).

The policy f_θ(s | D) is a transformer (Vaswani et al. 2017): the steps [s, a] of the support demonstrations D go into
its encoder, the current state is the decoder's query, its output the action. Per task, with support steps (s_t, a_t),
    L_inner(θ) = mean over t of ‖f_θ(s_t | D without t) − a_t‖²,    θ' = θ − α clip(∇ L_inner(θ)),
    L_outer(θ) = mean over query pairs (s, a) of ‖f_θ'(s | D) − a‖²,
and the outer Adam descends Σ over tasks of L_outer (Finn et al. 2017, "One-shot visual imitation learning via
meta-learning"). At test the same inner steps are taken on the support set, and f_θ'(s | D) acts.

What the appendix leaves open, and what is done here:

- **Copying.** The support states are asked for with the support itself in the encoder, where each answer could be read
  off. Hiding step t from the decoder alone is no help: self-attention has carried a_t into all other tokens. So every
  other step is predicted from the remaining ones, and the other way round: what is asked for never enters the encoder,
  and no path leads from a_t to its prediction. It is two passes of half the size. A learned first token is always
  there, so that a support of one step can be learned from: it is asked for with nothing else to go by.
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
- **Inner loop.** One step, inner gradients clipped number by number at ±10, and second order, as in MIL. α is 0.001,
  the lower end of MIL's 0.001 to 0.01: with 512 units, 0.01 takes an untrained model's loss up. The size quick is of
  first order with α 0.003; with 0.01, on demonstrations of the kitchen, the loss without the inner step rose to over
  100, which a gradient taken after that step does not see. MIL's temporal loss is for videos without actions: here
  they are given.
- **Outer learning rate.** MIL's 1e-3 was for convolutions of 4 layers; with 512 units and no warm-up it is Table 9's
  1e-4 here, and 1e-3 for the small model of the size quick.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, DemonstrationError, Normalisation
from dmil_core.methods.base import Decision, FineTuning, Flat, MetaLearner, TaskGradient
from dmil_core.methods.mil import transformer
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mil.losses import Pairs, Support, adapted, outer_gradient
from dmil_core.methods.mil.transformer import Cache, Sizes, cached, decode, encode
from dmil_core.networks import Parameters


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


@dataclass(frozen=True)
class MilPolicy(Flat):
    """The decoder acts, with the adapted encoder's view of the support set at hand: a = f_θ'(s | D)."""

    parameters: Parameters
    cache: Cache
    normalise: Normalisation

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action for each episode."""
        actions = decode(self.parameters, torch.from_numpy(self.normalise(observations)), self.cache)
        return Decision(actions.numpy(), np.zeros(len(observations), np.int64), memory)


@dataclass(frozen=True)
class Mil(MetaLearner[MilConfig, MilBatch]):
    """MIL for observations and actions of given sizes."""

    config_type = MilConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
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
        return transformer.initialise(sizes, rng, config.output_scale)

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> MilBatch:
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
        shots = int(rng.integers(1, min(self.config.shots, total - 1) + 1))
        order = [demonstrations[index] for index in rng.permutation(total)]
        support, others = order[:shots], order[shots:]
        ends = np.cumsum([len(demonstration) for demonstration in others])
        pairs = rng.choice(ends[-1], min(self.config.batch_pairs, int(ends[-1])), replace=False)
        owners = np.searchsorted(ends, pairs, side="right")
        steps = pairs - np.concatenate([[0], ends])[owners]
        drawn = [(others[owner], step) for owner, step in zip(owners, steps, strict=True)]
        return MilBatch(
            tuple(support),
            np.stack([demonstration.observations[step] for demonstration, step in drawn]),
            np.stack([demonstration.actions[step] for demonstration, step in drawn]),
            tuple(others[owner].id for owner in np.unique(owners)),
            int(rng.integers(2**63)),
        )

    def task_gradient(self, parameters: Parameters, batch: MilBatch) -> TaskGradient:
        """Return the outer gradient of one task."""
        query = Pairs(torch.from_numpy(self.normalise(batch.observations)), torch.tensor(batch.actions))
        return outer_gradient(parameters, self._support(batch.support), query, self.config, batch.seed)

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
            views = cached(fixed, encode(fixed, *steps, heads), heads)
        # In one piece, or each action would copy them.
        cache = tuple((keys.contiguous(), values.contiguous()) for keys, values in views)
        return MilPolicy(fixed, cache, self.normalise)

    def _support(self, demonstrations: Sequence[Demonstration]) -> Support:
        return Support.of(demonstrations, self.normalise, self.config.positions, self.config.units)
