"""MIL as a method: what it draws, its gradient and its adaptation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32

from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.methods.base import FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.mil import transformer
from dmil_core.methods.mil.config import MilConfig
from dmil_core.methods.mil.losses import Pairs, Support, adapted, outer_gradient
from dmil_core.methods.mil.policy import MilPolicy
from dmil_core.methods.mil.transformer import cached, encode
from dmil_core.networks import Parameters, without_graph


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
class Mil(MetaLearner[MilConfig, MilBatch]):
    """MIL for observations and actions of given sizes."""

    config_type = MilConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the transformer."""
        return transformer.initialise(self.config, self.input_dim, self.action_dim, rng)

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
        query = [(others[owner], step) for owner, step in zip(owners, steps, strict=True)]
        return MilBatch(
            tuple(support),
            np.stack([demonstration.observations[step] for demonstration, step in query]),
            np.stack([demonstration.actions[step] for demonstration, step in query]),
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
            fixed = without_graph(end)
            heads = self.config.heads
            views = cached(fixed, encode(fixed, *steps, heads), heads)
        # In one piece, or each action would copy them.
        cache = tuple((keys.contiguous(), values.contiguous()) for keys, values in views)
        return MilPolicy(fixed, cache, self.normalise)

    def _support(self, demonstrations: Sequence[Demonstration]) -> Support:
        return Support.of(demonstrations, self.normalise, self.config.positions, self.config.units)
