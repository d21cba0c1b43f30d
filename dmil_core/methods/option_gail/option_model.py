"""The option model of OptionGAIL (Jing et al. 2021, "Adversarial option-aware hierarchical imitation learning").

A one-step option model: at every step the high level draws an option given the last one, and the option an action,
    o_t ~ π_H(o | s_t, o_{t−1}),   a_t ~ π_L(a | s_t, o_t) = N(μ_o(s_t), diag σ_o²),
with a start symbol # in place of o_{−1}. Its K + 1 rows are K options and, last, the start. Given states and actions,
the options are a Markov chain: Viterbi finds the most probable ones (the E-step of the paper's EM), the forward
algorithm sums over all of them, and forward-backward gives their posteriors. Steps of ragged trajectories lie one
after the other, as in `Steps`; the recursions run over time for all trajectories together, in float64.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dmil_core.networks import Network, Parameters, bank, mlp, network, routed

LARGEST_LOG_DEVIATION = 0.0
"""Of the original, as its least: −20."""


class OptionModel(NamedTuple):
    """The networks of both levels, and the log σ of each option."""

    high: Network
    """Puts out (K + 1)·K logits: a row for each last option, and last one for the start."""
    low: tuple[Network, ...]
    log_deviations: Float[Tensor, "options action_dim"]

    @classmethod
    def of(cls, parameters: Parameters, least_log_deviation: float) -> "OptionModel":
        """Return views of ``high.*`` and ``low.*``, and ``log_deviations`` within its bounds.

        Its gradient is as if there were no bounds: a plain clamp has none beyond them, so what a single step took
        there would never come back.
        """
        free = parameters["log_deviations"]
        bound = free.clamp(least_log_deviation, LARGEST_LOG_DEVIATION)
        return cls(network(parameters, "high"), bank(parameters, "low"), free + (bound - free).detach())

    @property
    def options(self) -> int:
        """K, and so the row of the start symbol."""
        return len(self.low)

    def log_high(self, states: Float[Tensor, "steps obs_dim"]) -> Float[Tensor, "steps before options"]:
        """Return log π_H(o | s_t, o') for every last option o', the start last, and every option o."""
        return mlp(self.high, states).unflatten(-1, (self.options + 1, self.options)).log_softmax(-1)

    def log_low(
        self, states: Float[Tensor, "steps obs_dim"], actions: Float[Tensor, "steps action_dim"]
    ) -> Float[Tensor, "steps options"]:
        """Return log π_L(a_t | s_t, o) for every option o."""
        means = torch.stack([mlp(sub_skill, states) for sub_skill in self.low], 1)
        return _log_density(actions[:, None] - means, self.log_deviations)

    def log_chosen(
        self,
        states: Float[Tensor, "steps obs_dim"],
        actions: Float[Tensor, "steps action_dim"],
        options: Int[Tensor, " steps"],
    ) -> Float[Tensor, " steps"]:
        """Return log π_L(a_t | s_t, o_t) for one given option at each step, which alone is computed."""
        return _log_density(actions - self.means(states, options), self.log_deviations[options])

    def means(
        self, states: Float[Tensor, "steps obs_dim"], options: Int[Tensor, " steps"]
    ) -> Float[Tensor, "steps action_dim"]:
        """Return μ_o(s_t) for one given option at each step."""
        return routed(self.low, states, options)


def _log_density(errors: Float[Tensor, "*batch action_dim"], log_deviations: Tensor) -> Float[Tensor, "*batch"]:
    """Return log N(error | 0, diag σ²)."""
    scaled = errors * (-log_deviations).exp()
    return -(scaled.square() / 2 + log_deviations + math.log(2 * math.pi) / 2).sum(-1)


class Chain(NamedTuple):
    """The options of several trajectories as Markov chains: unnormalised log-probabilities of each step.

    Trajectories that end early stay in their last option from then on, at no cost: no recursion has to know of it.
    """

    first: Float[Tensor, "trajectories options"]
    """log π_H(o | s_0, #) + log π_L(a_0 | s_0, o)."""
    links: Float[Tensor, "later trajectories options options"]
    """log π_H(o | s_t, o') + log π_L(a_t | s_t, o) at t = 1, 2, and so on: from the row to the column."""
    trajectory: Int[Tensor, " steps"]
    """In which trajectory each step is."""
    time: Int[Tensor, " steps"]
    """The how many'th it is there."""

    @classmethod
    def of(
        cls,
        log_high: Float[Tensor, "steps before options"],
        log_low: Float[Tensor, "steps options"],
        lengths: Int[Tensor, " trajectories"],
    ) -> "Chain":
        """Return the chains of steps that lie one after the other, trajectory by trajectory."""
        joint = (log_high + log_low[:, None]).double()
        options, starts = log_low.shape[-1], _starts(lengths)
        trajectory = torch.repeat_interleave(torch.arange(len(lengths)), lengths)
        time = torch.arange(len(joint)) - starts[trajectory]
        stay = torch.full((options, options), -torch.inf, dtype=joint.dtype).fill_diagonal_(0)
        links = stay.repeat(int(lengths.max()) - 1, len(lengths), 1, 1)
        later = time > 0
        links[time[later] - 1, trajectory[later]] = joint[later, :options]
        return cls(joint[starts, options], links, trajectory, time)


def _starts(lengths: Int[Tensor, " trajectories"]) -> Int[Tensor, " trajectories"]:
    """Return at which step each trajectory begins."""
    return lengths.cumsum(0) - lengths


def _forward(chain: Chain) -> Float[Tensor, "time trajectories options"]:
    """Return α_t(o) = log p(a_0..a_t, o_t = o)."""
    alphas = [chain.first]
    for link in chain.links:
        alphas.append((alphas[-1][:, :, None] + link).logsumexp(1))
    return torch.stack(alphas)


def _backward(chain: Chain) -> Float[Tensor, "time trajectories options"]:
    """Return β_t(o) = log p(a_{t+1}.. | o_t = o)."""
    betas = [torch.zeros_like(chain.first)]
    for link in chain.links.flip(0):
        betas.append((link + betas[-1][:, None]).logsumexp(2))
    return torch.stack(betas[::-1])


@torch.no_grad()
def posterior(chain: Chain) -> tuple[Float[Tensor, " trajectories"], Float[Tensor, "steps before options"]]:
    """Return the log-likelihoods, and p(o_{t−1} = o', o_t = o | all actions) at each step, by forward-backward.

    At a trajectory's first step all of it is in the start's row, which is the last.
    """
    alphas, betas = _forward(chain), _backward(chain)
    log_likelihoods, options = alphas[-1].logsumexp(-1), chain.first.shape[-1]
    pairs = torch.zeros(len(chain.time), options + 1, options, dtype=chain.first.dtype)
    pairs[chain.time == 0, options] = (alphas[0] + betas[0] - log_likelihoods[:, None]).exp()
    later = chain.time > 0
    t, n = chain.time[later], chain.trajectory[later]
    paths = alphas[t - 1, n][:, :, None] + chain.links[t - 1, n] + betas[t, n][:, None]
    pairs[later, :options] = (paths - log_likelihoods[n][:, None, None]).exp()
    return log_likelihoods, pairs


@torch.no_grad()
def viterbi(chain: Chain) -> Int[Tensor, " steps"]:
    """Return the most probable options of each trajectory."""
    best, pointers = chain.first, []
    for link in chain.links:
        best, pointer = (best[:, :, None] + link).max(1)
        pointers.append(pointer)
    path = [best.argmax(-1)]
    for pointer in reversed(pointers):
        path.append(pointer.gather(1, path[-1][:, None])[:, 0])
    return torch.stack(path[::-1])[chain.time, chain.trajectory]


def options_before(
    options: Int[Tensor, " steps"], lengths: Int[Tensor, " trajectories"], start: int
) -> Int[Tensor, " steps"]:
    """Return o_{t−1} at each step, which is `start` at the first of each trajectory."""
    before = options.roll(1)
    before[_starts(lengths)] = start
    return before


def pairs_of(
    options: Int[Tensor, " steps"], lengths: Int[Tensor, " trajectories"], count: int
) -> Float[Tensor, "steps before options"]:
    """Return given options as a `posterior` that is certain of them; `count` is K."""
    before = functional.one_hot(options_before(options, lengths, count), count + 1)
    return (before[:, :, None] * functional.one_hot(options, count)[:, None]).double()


def weighted_log_likelihood(
    log_high: Float[Tensor, "steps before options"],
    log_low: Float[Tensor, "steps options"],
    pairs: Float[Tensor, "steps before options"],
) -> Float[Tensor, ""]:
    """Return Σ_t Σ_{o',o} w_t(o', o) [log π_H(o | s_t, o') + log π_L(a_t | s_t, o)].

    With weights from `pairs_of` it is the complete-data log-likelihood, which hard EM goes up. With those of
    `posterior`, held fixed, its gradient is that of the log-likelihood itself (Fisher's identity).
    """
    weights = pairs.to(log_low.dtype)
    return (weights * (log_high + log_low[:, None])).sum()
