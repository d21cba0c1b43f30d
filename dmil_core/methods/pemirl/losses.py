"""PEMIRL's four models and its losses, each loss with gradients for the models that it should train alone.

Parameters are named by model: ``encoder`` is q_ψ(m|τ), ``policy`` with ``log_deviation`` is π_ω(a|s,m), ``reward`` is
r_θ(s,m), ``potential`` is h_φ(s,m). How they fit together stands in `pemirl`.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.losses import Steps
from dmil_core.networks import Parameters, mlp, network

BOUND = 5.0
"""No |log σ| is larger: e⁻⁵ is far below any action's noise."""


class Gaussian(NamedTuple):
    """Independent normal numbers, one vector of them a row."""

    mean: Float[Tensor, "rows size"]
    log_deviation: Float[Tensor, "#rows size"]

    @classmethod
    def bounded(cls, mean: Float[Tensor, "rows size"], raw: Float[Tensor, "#rows size"]) -> "Gaussian":
        """Return the one with log σ = 5 tanh(raw / 5), which is raw where that is small, and never without gradient."""
        return cls(mean, BOUND * torch.tanh(raw / BOUND))

    def log_density(self, values: Float[Tensor, "rows size"]) -> Float[Tensor, " rows"]:
        """Return log N(values; mean, σ²), summed over each row."""
        standard = (values - self.mean) * torch.exp(-self.log_deviation)
        log_normaliser = self.log_deviation + 0.5 * math.log(2 * math.pi)
        return -(0.5 * standard.square() + log_normaliser).sum(-1)

    def divergence(self) -> Float[Tensor, " rows"]:
        """Return KL(N(mean, σ²) ‖ N(0, 1)) = Σ (σ² + mean² − 1) / 2 − log σ (Kingma & Welling 2014)."""
        variance = torch.exp(2 * self.log_deviation)
        return (0.5 * (variance + self.mean.square() - 1) - self.log_deviation).sum(-1)

    def draw(self, generator: torch.Generator) -> Float[Tensor, "rows size"]:
        """Return mean + σε, with gradients for both."""
        noise = torch.randn(self.mean.shape, generator=generator, dtype=self.mean.dtype)
        return self.mean + torch.exp(self.log_deviation) * noise


class Transitions(NamedTuple):
    """The steps of several trajectories, each with the state after it; the last state of each is its own successor."""

    states: Float[Tensor, "steps obs_dim"]
    actions: Float[Tensor, "steps action_dim"]
    successors: Float[Tensor, "steps obs_dim"]
    lengths: Int[Tensor, " trajectories"]

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration], normalise: Normalisation) -> "Transitions":
        """Copy demonstrations into fresh tensors."""
        states, actions, lengths = Steps.of(demonstrations, normalise)
        following, ends = torch.arange(len(states)) + 1, lengths.cumsum(0) - 1
        following[ends] = ends
        return cls(states, actions, states[following], lengths)

    def thinned(self, most: int | None, generator: torch.Generator) -> "Transitions":
        """Return `most` steps of each trajectory that has more, drawn without replacement and left in order."""
        if most is None:
            return self
        starts, kept = (self.lengths.cumsum(0) - self.lengths).tolist(), []
        for start, length in zip(starts, self.lengths.tolist(), strict=True):
            kept.append(start + torch.randperm(length, generator=generator)[:most].sort().values)
        chosen = torch.cat(kept)
        lengths = self.lengths.clamp(max=most)
        return Transitions(self.states[chosen], self.actions[chosen], self.successors[chosen], lengths)

    def spread(self, rows: Float[Tensor, "trajectories size"]) -> Float[Tensor, "steps size"]:
        """Return each trajectory's row at each of its steps."""
        return rows.repeat_interleave(self.lengths, 0)

    def averaged(self, values: Float[Tensor, "steps size"]) -> Float[Tensor, "trajectories size"]:
        """Return the mean over each trajectory's steps."""
        return torch.stack([part.mean(0) for part in values.split(self.lengths.tolist())])


def infer(parameters: Parameters, trajectories: Transitions) -> Gaussian:
    """Return q_ψ(m|τ) of each trajectory: the mean over its steps of what a network makes of each (s, a)."""
    pairs = torch.cat([trajectories.states, trajectories.actions], -1)
    mean, raw = trajectories.averaged(mlp(network(parameters, "encoder"), pairs)).chunk(2, -1)
    return Gaussian.bounded(mean, raw)


def action_distribution(
    parameters: Parameters, states: Float[Tensor, "steps obs_dim"], contexts: Float[Tensor, "steps context_dim"]
) -> Gaussian:
    """Return π_ω(a|s,m) at each step, whose σ is the same in every state."""
    mean = mlp(network(parameters, "policy"), torch.cat([states, contexts], -1))
    return Gaussian.bounded(mean, parameters["log_deviation"][None])


def _estimates(
    parameters: Parameters,
    model: Literal["reward", "potential"],
    states: Float[Tensor, "steps obs_dim"],
    contexts: Float[Tensor, "steps context_dim"],
) -> Float[Tensor, " steps"]:
    return mlp(network(parameters, model), torch.cat([states, contexts], -1)).squeeze(-1)


class LogReward(NamedTuple):
    """f and the reward in it, at each step."""

    f: Float[Tensor, " steps"]
    reward: Float[Tensor, " steps"]


def log_reward(
    parameters: Parameters, trajectories: Transitions, contexts: Float[Tensor, "steps context_dim"], discount: float
) -> LogReward:
    """Return f = r_θ(s,m) + γ h_φ(s′,m) − h_φ(s,m), which at the optimum is the expert's advantage (Fu et al. 2018)."""
    reward = _estimates(parameters, "reward", trajectories.states, contexts)
    before, after = (
        _estimates(parameters, "potential", states, contexts)
        for states in (trajectories.states, trajectories.successors)
    )
    return LogReward(reward + discount * after - before, reward)


def discriminator_loss(
    expert: Float[Tensor, " expert_steps"], pseudo: Float[Tensor, " pseudo_steps"]
) -> Float[Tensor, ""]:
    """Return −E_expert log D − E_pseudo log(1 − D) from the logits f − log π of D = eᶠ / (eᶠ + π)."""
    return functional.softplus(-expert).mean() + functional.softplus(pseudo).mean()


def policy_surrogate(log_probabilities: Float[Tensor, " steps"], rewards: Float[Tensor, " steps"]) -> Float[Tensor, ""]:
    """Return −E[A log π], with the rewards standardised over the batch as the advantages A, and no gradient in them."""
    deviation, mean = torch.std_mean(rewards.detach(), correction=0)
    return -((rewards.detach() - mean) / (deviation + 1e-8) * log_probabilities).mean()


def information_surrogate(
    log_posteriors: Float[Tensor, " trajectories"],
    returns: Float[Tensor, " trajectories"],
    groups: Int[Tensor, " trajectories"],
) -> Float[Tensor, ""]:
    """Return −Cov(log q_ψ(m|τ), R_θ(τ)) over the trajectories of each m, by `groups`; only R_θ has a gradient.

    If trajectories come from p_θ(τ|m) ∝ p(τ) exp R_θ(τ), then ∇_θ E[log q] = E[log q ∇R] − E[log q] E[∇R], and so this
    has the gradient of −E[log q].
    """
    members = functional.one_hot(groups).to(returns.dtype)
    members = members[:, members.any(0)]
    centred = log_posteriors.detach() - members @ ((log_posteriors.detach() @ members) / members.sum(0))
    return -(centred * returns).mean()


class Losses(NamedTuple):
    """All losses without their weights, and what else to show of a batch."""

    likelihood: Float[Tensor, ""]
    """−E log π_ω(a|s,m), m ~ q_ψ(·|τ): trains ψ and ω."""
    divergence: Float[Tensor, ""]
    """KL(q_ψ(m|τ) ‖ N(0, 1)): trains ψ."""
    information: Float[Tensor, ""]
    """−E log q_ψ(m|τ̃) on the policy's own trajectories τ̃: trains ψ."""
    information_surrogate: Float[Tensor, ""]
    """The same as a function of the reward: trains θ."""
    discriminator: Float[Tensor, ""]
    """Trains θ and φ."""
    policy: Float[Tensor, ""]
    """Of the reward f − log π: trains ω."""
    metrics: dict[str, float]


def losses_of(
    parameters: Parameters,
    contexts: Transitions,
    explained: Transitions,
    discount: float,
    negatives: Literal["same", "mismatched"],
    generator: torch.Generator,
) -> Losses:
    """Return the losses of one task.

    From each of C trajectories, the `contexts`, one m is inferred; number j of the `explained` ones belongs to m number
    j mod C. The discriminator's `negatives` have the same m or one of N(0, 1); `discount` is γ in f.
    """
    posterior = infer(parameters, contexts)
    draws = posterior.draw(generator)
    groups = torch.arange(len(explained.lengths)) % len(draws)
    attached = explained.spread(draws[groups])
    imitating = action_distribution(parameters, explained.states, attached)

    # Without a gradient for m from here on: only likelihood and divergence shape what m means.
    context = attached.detach()
    acting = action_distribution(parameters, explained.states, context)
    actions = acting.draw(generator).detach()
    log_probabilities = acting.log_density(actions)
    f, reward = log_reward(parameters, explained, context, discount)
    expert_logits = f - acting.log_density(explained.actions).detach()
    pseudo_logits = f - log_probabilities.detach()

    if negatives == "mismatched":
        shape = len(explained.lengths), draws.shape[1]
        other = explained.spread(torch.randn(shape, generator=generator, dtype=draws.dtype))
        with torch.no_grad():
            mismatched = action_distribution(parameters, explained.states, other)
            log_mismatched = mismatched.log_density(mismatched.draw(generator))
        negative_logits = log_reward(parameters, explained, other, discount).f - log_mismatched
    else:
        negative_logits = pseudo_logits

    log_posteriors = infer(parameters, explained._replace(actions=actions)).log_density(draws.detach()[groups])
    returns = explained.averaged(reward[:, None]).squeeze(-1)
    with torch.no_grad():
        metrics = {
            "action_error": (acting.mean - explained.actions).square().sum(-1).mean().item(),
            "policy_deviation": acting.log_deviation.exp().mean().item(),
            "context_deviation": posterior.log_deviation.exp().mean().item(),
            "discriminator_expert": expert_logits.sigmoid().mean().item(),
            "discriminator_pseudo": negative_logits.sigmoid().mean().item(),
        }
    return Losses(
        likelihood=-imitating.log_density(explained.actions).mean(),
        divergence=posterior.divergence().mean(),
        information=-log_posteriors.mean(),
        information_surrogate=information_surrogate(log_posteriors, returns, groups),
        discriminator=discriminator_loss(expert_logits, negative_logits),
        policy=policy_surrogate(log_probabilities, pseudo_logits),
        metrics=metrics,
    )
