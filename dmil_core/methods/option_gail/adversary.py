"""A round of OptionGAIL against its discriminator, see `option_gail`: discriminate, then improve by PPO on two levels.

All networks lie in one mapping of parameters, of which each step here changes its own in place.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.demonstrations import Normalisation
from dmil_core.losses import Steps
from dmil_core.methods.option_gail.config import OptionGailConfig
from dmil_core.methods.option_gail.option_model import OptionModel, options_before
from dmil_core.methods.ppo import clipped_surrogate, trajectory_advantages
from dmil_core.networks import Adam, Parameters, descend, mlp, network
from dmil_core.trajectories import Rollout

POLICY = ("high.", "low.", "log_deviations")
"""What the names of the option model's parameters begin with."""


def named(parameters: Parameters, prefixes: str | tuple[str, ...]) -> list[Tensor]:
    """Return the parameters whose names begin with one of the prefixes."""
    return [tensor for name, tensor in parameters.items() if name.startswith(prefixes)]


def orthogonal(prefix: str, sizes: Sequence[int], rng: np.random.Generator) -> Parameters:
    """Draw the parameters of a perceptron: orthogonal weights (Saxe et al. 2014), scaled by √2 before a ReLU."""
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    parameters: dict[str, Tensor] = {}
    for layer, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
        gain = 2**0.5 if layer < len(sizes) - 2 else 1.0
        weight = torch.nn.init.orthogonal_(torch.empty(fan_out, fan_in), gain, generator)
        parameters |= {f"{prefix}.{layer}.weight": weight, f"{prefix}.{layer}.bias": torch.zeros(fan_out)}
    return parameters


class OptionSteps(NamedTuple):
    """The steps of several trajectories, of the policy or demonstrated, and the option before and at each."""

    steps: Steps
    before: Int[Tensor, " steps"]
    options: Int[Tensor, " steps"]

    @classmethod
    def of(cls, steps: Steps, options: Int[Tensor, " steps"], start: int) -> "OptionSteps":
        """Return steps with the option at each; `start` comes before the first of a trajectory."""
        return cls(steps, options_before(options, steps.lengths, start), options)

    @classmethod
    def of_rollouts(cls, rollouts: Sequence[Rollout], normalise: Normalisation, start: int) -> "OptionSteps":
        """Return the steps of rollouts, none of them empty, one after the other."""
        states = np.concatenate([rollout.observations[:-1] for rollout in rollouts])
        actions = np.concatenate([rollout.actions for rollout in rollouts])
        options = np.concatenate([rollout.sub_skills for rollout in rollouts])
        lengths = torch.tensor([len(rollout.actions) for rollout in rollouts])
        steps = Steps(torch.from_numpy(normalise(states)), torch.from_numpy(actions), lengths)
        return cls.of(steps, torch.from_numpy(options), start)

    def at(self, index: Int[Tensor, " chosen"]) -> "OptionSteps":
        """Return some of the steps, each a trajectory of its own."""
        states, actions = self.steps.states[index], self.steps.actions[index]
        return OptionSteps(Steps(states, actions, torch.ones_like(index)), self.before[index], self.options[index])


def discriminator_logits(parameters: Parameters, batch: OptionSteps, options: int) -> Float[Tensor, " steps"]:
    """Return d(s_t, a_t, o_{t−1}, o_t), the logit of a step being the policy's; `options` is K."""
    outputs = mlp(network(parameters, "discriminator"), torch.cat([batch.steps.states, batch.steps.actions], 1))
    return outputs.gather(1, (batch.before * options + batch.options)[:, None])[:, 0]


def discriminator_loss(of_policy: Float[Tensor, " steps"], of_expert: Float[Tensor, " others"]) -> Float[Tensor, ""]:
    """Return the binary cross-entropy: mean −log σ(d) of the policy's plus mean −log(1 − σ(d)) of the expert's."""
    return functional.softplus(-of_policy).mean() + functional.softplus(of_expert).mean()


def imitation_rewards(logits: Float[Tensor, " steps"]) -> Float[Tensor, " steps"]:
    """Return −log σ(d): the higher, the less the discriminator takes a step for the policy's."""
    return functional.softplus(-logits)


def discriminate(
    moved: Parameters, batch: OptionSteps, expert: OptionSteps, config: OptionGailConfig, generator: torch.Generator
) -> dict[str, float]:
    """Train the discriminator in place, each minibatch of the policy's steps against as many demonstrated ones."""
    losses, k = [], config.sub_skills
    descent = Adam(named(moved, "discriminator."), config.learning_rate, config.weight_decay)
    for index in _minibatches(len(batch.options), config.minibatch, config.discriminator_passes, generator):
        others = torch.randint(len(expert.options), (len(index),), generator=generator)
        of_policy, of_expert = (discriminator_logits(moved, side, k) for side in (batch.at(index), expert.at(others)))
        loss = discriminator_loss(of_policy, of_expert)
        losses.append(loss.item())
        descend(descent, loss)
    with torch.no_grad():
        of_policy = (discriminator_logits(moved, batch, k) > 0).float().mean().item()
        of_expert = (discriminator_logits(moved, expert, k) < 0).float().mean().item()
    return {"discriminator_loss": float(np.mean(losses)), "discriminator_accuracy": (of_policy + of_expert) / 2}


def _minibatches(count: int, size: int, passes: int, generator: torch.Generator) -> Iterator[Int[Tensor, " _"]]:
    """Yield the indices of so many shuffled passes, a minibatch at a time."""
    for _ in range(passes):
        yield from torch.randperm(count, generator=generator).split(size)


class Targets(NamedTuple):
    """Targets of PPO: the standardised advantages of both levels, and the returns that V_L is fitted to."""

    high: Float[Tensor, " steps"]
    low: Float[Tensor, " steps"]
    returns: Float[Tensor, " steps"]


def low_values(parameters: Parameters, batch: OptionSteps) -> Float[Tensor, " steps"]:
    """Return the critic's V_L(s_t, o_t)."""
    return mlp(network(parameters, "critic"), batch.steps.states).gather(1, batch.options[:, None])[:, 0]


def high_values(
    parameters: Parameters,
    states: Float[Tensor, "steps obs_dim"],
    before: Int[Tensor, " steps"],
    config: OptionGailConfig,
) -> Float[Tensor, " steps"]:
    """Return V_H(s_t, o_{t−1}) = Σ_o π_H(o | s_t, o_{t−1}) V_L(s_t, o)."""
    log_high = OptionModel.of(parameters, config.least_log_deviation).log_high(states)
    chances = log_high[torch.arange(len(states)), before].exp()
    return (chances * mlp(network(parameters, "critic"), states)).sum(-1)


@torch.no_grad()
def ppo_targets(
    parameters: Parameters,
    batch: OptionSteps,
    rewards: Float[Tensor, " steps"],
    beyond: Float[Tensor, "trajectories obs_dim"],
    config: OptionGailConfig,
) -> Targets:
    """Return the targets of PPO in a round.

    Values are of rewards less the round's mean. `beyond` is each trajectory's state after its last step, where both
    levels are valued by V_H: the next option is not yet drawn.
    """
    lengths, centred = batch.steps.lengths, rewards - rewards.mean()
    last_values = high_values(parameters, beyond, batch.options[lengths.cumsum(0) - 1], config)
    of_low = low_values(parameters, batch)
    of_high = high_values(parameters, batch.steps.states, batch.before, config)
    high, low = (
        trajectory_advantages(centred, values, lengths, config.discount, config.smoothing, last_values)
        for values in (of_high, of_low)
    )
    return Targets(_standard(high), _standard(low), low + of_low)


def _standard(values: Float[Tensor, " steps"]) -> Float[Tensor, " steps"]:
    array = values.numpy()  # its sums round otherwise than torch's
    return torch.from_numpy(((array - array.mean()) / (array.std() + 1e-8)).astype(np.float32))


class Decisions(NamedTuple):
    """How probable what was decided is."""

    high: Float[Tensor, " steps"]
    """log π_H(o_t | s_t, o_{t−1})."""
    low: Float[Tensor, " steps"]
    """log π_L(a_t | s_t, o_t)."""
    entropy: Float[Tensor, ""]
    """Of π_H, in the mean."""


def decisions(parameters: Parameters, batch: OptionSteps, config: OptionGailConfig) -> Decisions:
    """Return how probable each level's decisions are."""
    model, (states, actions, _) = OptionModel.of(parameters, config.least_log_deviation), batch.steps
    log_high = model.log_high(states)[torch.arange(len(states)), batch.before]
    chosen = log_high.gather(1, batch.options[:, None])[:, 0]
    entropy = -(log_high.exp() * log_high).sum(-1).mean()
    return Decisions(chosen, model.log_chosen(states, actions, batch.options), entropy)


def improve(
    moved: Parameters, batch: OptionSteps, targets: Targets, config: OptionGailConfig, generator: torch.Generator
) -> dict[str, float]:
    """Improve both levels and the critic in place, down L = −L_clip of either level − c·entropy + ½(V_L − return)²."""
    with torch.no_grad():
        old = decisions(moved, batch, config)
    descent = Adam(named(moved, (*POLICY, "critic.")), config.learning_rate, config.weight_decay)
    for index in _minibatches(len(batch.options), config.minibatch, config.policy_epochs, generator):
        some = batch.at(index)
        new = decisions(moved, some, config)
        high = clipped_surrogate(new.high - old.high[index], targets.high[index], config.clip)
        low = clipped_surrogate(new.low - old.low[index], targets.low[index], config.clip)
        errors = low_values(moved, some) - targets.returns[index]
        descend(descent, errors.square().mean() / 2 - high - low - config.option_entropy * new.entropy)
    with torch.no_grad():
        new, errors = decisions(moved, batch, config), low_values(moved, batch) - targets.returns
        return {
            "value_error": errors.square().mean().item(),
            "option_entropy": new.entropy.item(),
            "high_divergence": (old.high - new.high).mean().item(),
            "low_divergence": (old.low - new.low).mean().item(),
        }
