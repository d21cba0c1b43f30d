"""How MLSH learns one task: PPO on both levels along the demonstrations."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmil_core.losses import Steps, squared_errors
from dmil_core.methods.mlsh.config import MlshConfig
from dmil_core.methods.mlsh.macro_steps import MacroSteps, draw_batch, macro_steps
from dmil_core.methods.ppo import clipped_surrogate, normalised, scaled, trajectory_advantages
from dmil_core.networks import Adam, Parameters, bank, descend, leaves, mlp, network, routed, without_graph

FRESH_SCALE = 0.01
"""Scale of a fresh high level's last layer, against He's."""


class Learner:
    """Parameters as they are learned: copies, and an Adam of their own."""

    def __init__(self, parameters: Parameters, learning_rate: float) -> None:
        self.parameters = leaves(parameters, copy=True)
        self._adam = Adam(self.parameters.values(), learning_rate)

    def descend(self, loss: Tensor) -> None:
        """Take a step of Adam down a loss."""
        descend(self._adam, loss)

    @property
    def learned(self) -> Parameters:
        """The current parameters, without graph."""
        return without_graph(self.parameters)


class Picks(NamedTuple):
    """What the high level drew along some trajectories: a sub-skill for each macro-step."""

    macro: MacroSteps
    states: Float[Tensor, "macro_steps obs_dim"]
    chosen: Int[Tensor, " macro_steps"]
    log_probabilities: Float[Tensor, " macro_steps"]
    values: Float[Tensor, " macro_steps"]

    @property
    def of_step(self) -> Int[Tensor, " steps"]:
        """The sub-skill at each step."""
        return self.chosen[self.macro.of_step]


class Outcome(NamedTuple):
    """What came of what was drawn."""

    advantages: Float[Tensor, " draws"]
    targets: Float[Tensor, " draws"]
    """What the values should have been."""


@dataclass(frozen=True)
class TaskLearning:
    """One task's trajectories and what is drawn in learning from them: not pure, its generator moves on."""

    steps: Steps
    config: MlshConfig
    generator: torch.Generator

    def warm_up(self, high: Learner, errors: Float[Tensor, "sub_skills steps"], updates: int) -> None:
        """Take updates of the high level alone, given the sub-skills' squared errors at all steps."""
        for passes in self._batches(updates):
            index, lengths = self._draw_batch()
            picks = self._pick(high, self.steps.states[index], lengths)
            outcome = self._outcome_of_picks(picks, errors[picks.of_step, index])
            for _ in range(passes):
                high.descend(self._high_loss(high, picks, outcome))

    def learn(self, high: Learner, low: Learner, updates: int) -> None:
        """Take updates of both levels."""
        for passes in self._batches(updates):
            index, lengths = self._draw_batch()
            states, demonstrated = self.steps.states[index], self.steps.actions[index]
            picks = self._pick(high, states, lengths)
            chosen = picks.of_step
            with torch.no_grad():
                outputs = routed(bank(low.parameters, "low"), states, chosen)
            means, values = outputs[:, :-1], outputs[:, -1]
            noise = torch.randn(means.shape, generator=self.generator, dtype=means.dtype)
            actions = means + self.config.deviation * noise
            log_densities = self._log_densities(means, actions)
            outcome_of_picks = self._outcome_of_picks(picks, squared_errors(means, demonstrated))
            outcome = self._outcome(-squared_errors(actions, demonstrated), values, lengths)
            for _ in range(passes):
                high.descend(self._high_loss(high, picks, outcome_of_picks))
                outputs = routed(bank(low.parameters, "low"), states, chosen)
                log_ratio = self._log_densities(outputs[:, :-1], actions) - log_densities
                low.descend(self._loss(log_ratio, outputs[:, -1], outcome))

    def _batches(self, updates: int) -> Iterator[int]:
        """Yield how many updates each batch serves for."""
        for done in range(0, updates, self.config.passes):
            yield min(self.config.passes, updates - done)

    def _draw_batch(self) -> tuple[Int[Tensor, " size"], Int[Tensor, " drawn"]]:
        return draw_batch(self.steps.lengths, self.config.batch_size, self.generator)

    def _pick(
        self, high: Learner, states: Float[Tensor, "steps obs_dim"], lengths: Int[Tensor, " trajectories"]
    ) -> Picks:
        macro = macro_steps(lengths, self.config.macro_step)
        with torch.no_grad():
            outputs = mlp(network(high.parameters, "high"), states[macro.first])
        log_probabilities = outputs[:, :-1].log_softmax(-1)
        # argmax log p − log e, e ~ Exp(1), draws from p (Gumbel-max), and raises nothing where learning has diverged:
        # what is not finite is then reported by the outer loop, with the slot's name.
        waiting = torch.empty_like(log_probabilities).exponential_(generator=self.generator)
        chosen = (log_probabilities - waiting.log()).argmax(-1)
        return Picks(macro, states[macro.first], chosen, at_columns(log_probabilities, chosen), outputs[:, -1])

    def _outcome_of_picks(self, picks: Picks, errors: Float[Tensor, " steps"]) -> Outcome:
        """Return what came of the picks where `errors` are of the picked sub-skills."""
        returns = torch.zeros_like(picks.values).index_add(0, picks.macro.of_step, -errors)
        return self._outcome(returns, picks.values, picks.macro.lengths)

    def _outcome(
        self, rewards: Float[Tensor, " draws"], values: Float[Tensor, " draws"], lengths: Int[Tensor, " trajectories"]
    ) -> Outcome:
        config = self.config
        advantages = trajectory_advantages(scaled(rewards), values, lengths, config.discount, config.trace)
        return Outcome(normalised(advantages), advantages + values)

    def _log_densities(
        self, means: Float[Tensor, "steps action_dim"], actions: Float[Tensor, "steps action_dim"]
    ) -> Float[Tensor, " steps"]:
        """Return log N(ã; μ, σ²), without the constant."""
        return squared_errors(means, actions) / (-2 * self.config.deviation**2)

    def _high_loss(self, high: Learner, picks: Picks, outcome: Outcome) -> Float[Tensor, ""]:
        outputs = mlp(network(high.parameters, "high"), picks.states)
        log_probabilities = at_columns(outputs[:, :-1].log_softmax(-1), picks.chosen)
        return self._loss(log_probabilities - picks.log_probabilities, outputs[:, -1], outcome)

    def _loss(
        self, log_ratio: Float[Tensor, " draws"], values: Float[Tensor, " draws"], outcome: Outcome
    ) -> Float[Tensor, ""]:
        surrogate = clipped_surrogate(log_ratio, outcome.advantages, self.config.clip)
        return self.config.value_weight * (values - outcome.targets).square().mean() - surrogate


def at_columns(rows: Float[Tensor, "rows columns"], columns: Int[Tensor, " rows"]) -> Float[Tensor, " rows"]:
    """Return the value of each row at its column."""
    return rows.gather(1, columns[:, None]).squeeze(1)
