"""PEMIRL, behaviour-cloning variant: one policy of all tasks, told which it is by what a demonstration says of it.

Yu et al., "Meta-inverse reinforcement learning with probabilistic context variables" (2019), infer a context m from a
trajectory and learn for it a policy and a reward, by adversarial inverse reinforcement learning (Fu et al. 2018) with
an information term between m and τ. The appendix (F.2, Table 12) trains its models on demonstrations only. Per task,
m_c ~ q_ψ(·|τ_c) from C trajectories; of 16 others, with s along the demonstration, a the expert's action and
ã ~ π_ω(·|s,m),

- imitation: E[−log π_ω(a|s,m)] + 0.1 KL(q_ψ(m|τ_c) ‖ N(0, 1)), m reparametrised, trains ψ and ω;
- discriminator: −E log D(s,a,s′,m) − E log(1 − D(s,ã,s′,m)), D = eᶠ / (eᶠ + π_ω),
  f = r_θ(s,m) + γ h_φ(s′,m) − h_φ(s,m), trains θ and φ;
- information: −β E log q_ψ(m|τ̃), with τ̃ the states and the policy's actions, trains ψ; θ gets the gradient of
  −β Cov(log q_ψ(m|τ̃), R_θ) over the trajectories of one m (see `information_surrogate`);
- policy: −E[A log π_ω(ã|s,m)], A the reward f − log π_ω(ã|s,m), standardised over the batch, trains ω.

At test m is the mean of q_ψ's means over the shots, and π_ω's mean acts; there is no gradient step.

What this variant can teach. On demonstrated transitions the expert and the policy share s and s′, and f does not depend
on the action. So f tends to the middle of the two log π, and the policy's expected gradient is that of its entropy,
for any f: it widens σ and says nothing of the mean. All that the mean action learns comes from the imitation term;
reward and potential stand beside. Negatives with a mismatched m, one of N(0, 1), at least ask the reward which states
go with m, but the policy's expected gradient stays the entropy's, and q_ψ gets none from the discriminator.

What the appendix leaves open, and what we chose:

- One step on all losses together, by the outer Adam. PPO's clip of 0.02 (Table 12) bounds the later ones of several
  steps on the same actions; the first has the ratio 1, where the clipped surrogate has the gradient above. So there is
  no setting for it.
- Imitation has the weight 1, as in the original's pre-training (−log π + 0.1 KL), not the 0.01 of its second phase,
  which would leave the actions to a policy term that has nothing to teach here. That one has 0.1: it pulls each log σ
  up by its weight over the deviation of the rewards (at least √(d/2) for d actions), imitation holds it down by at
  most 1. With the weight 1, on the tests' toy, σ grew from 1 to 1.6, m came to mean nothing (KL 0.004), and
  the actions' error was that of m = 0; without the term it was about as with 0.1.
- m is inferred from one trajectory and explains others of the task, so it cannot hold what is particular to one; the
  original has it explain its own. Of the 16 trajectories each m explains 16 / C; with C = 1 there is one m a task, as
  in the original.
- q_ψ is one network on (s, a), averaged over the steps, as trajectories are ragged; the original reads a whole
  trajectory of fixed length. m has the original's 3 dimensions.
- R_θ is the mean of r_θ over the steps, where the original takes the sum. Replayed trajectories do not answer to the
  reward, so nothing but the discriminator, which is a mean over steps too, holds it.
- The discriminator does not train ψ, as in the text of the original; its code does it.
- σ of the policy does not depend on the state and starts at 0.3, where the original's starts at 1: Adam moves log σ by
  at most its learning rate a step, and from 1 the paper's 1e-4 would leave it above 0.8 for 2000 iterations, with
  likelihoods so flat that the divergence outweighs what m could tell.
- The last state of a demonstration is its own successor. Hidden layers of reward and potential are as wide as the
  others.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field

from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.methods.base import FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.behaviour_cloning.method import NetworkPolicy
from dmil_core.methods.pemirl.losses import BOUND, Transitions, infer, losses_of
from dmil_core.networks import Layer, Parameters, flatten, initialise, network
from dmil_core.settings import Count, MethodConfig, NotNegative, Positive, Size


class PemirlConfig(MethodConfig):
    """PEMIRL, behaviour-cloning variant."""

    name: Literal["pemirl"] = "pemirl"
    """The method."""
    hidden_layers: Size = 4
    """Layers of ReLU units in policy and inference model, as in DMIL's high level (F.2)."""
    reward_layers: Size = 3
    """Layers of ReLU units in reward and potential (F.2)."""
    hidden_units: Size = 512
    """Units in each hidden layer (F.2)."""
    output_scale: Positive = 1.0
    """Scale of the output layers' first weights, against He's."""
    context_dim: Size = 3
    """Numbers in m; the original's."""
    initial_deviation: Annotated[float, Field(ge=0.01, le=10)] = 0.3
    """The policy's σ at first, in the environment's units."""
    trajectories: Size = 16
    """Trajectories that are explained in each task (Table 12)."""
    contexts: Size = 4
    """C, how many other trajectories m is inferred from, each for its share of the explained ones."""
    steps_per_trajectory: Count | None = None
    """Use at most so many steps of each trajectory, drawn at random; none uses all. All losses are means over steps."""
    discount: NotNegative = 1.0
    """γ, the coefficient of h_φ (Table 12)."""
    information_weight: NotNegative = 0.1
    """β (Table 12)."""
    divergence_weight: NotNegative = 0.1
    """Weight of KL(q ‖ N(0, 1)) against the mean log-likelihood of a step; the original's."""
    policy_weight: NotNegative = 0.1
    """Weight of the policy's surrogate against the same."""
    negatives: Literal["same", "mismatched"] = "same"
    """The m of the discriminator's negatives: same as the expert's, as in the original; mismatched: of N(0, 1)."""

    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {
            "method": {
                "hidden_layers": 3,
                "hidden_units": 256,
                "output_scale": 0.07,
                "trajectories": 8,
                "steps_per_trajectory": 32,
            },
        },
        "smoke": {
            "method": {
                "hidden_layers": 2,
                "reward_layers": 2,
                "hidden_units": 32,
                "trajectories": 4,
                "contexts": 2,
                "steps_per_trajectory": 24,
            },
        },
    }


@dataclass(frozen=True)
class ContextBatch:
    """What one slot of an iteration learns from."""

    contexts: tuple[Demonstration, ...]
    """Those that m is inferred from."""
    explained: tuple[Demonstration, ...]
    """Those that the policy should explain with it."""
    seed: int
    """Of all that is drawn later."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of the demonstrations in it."""
        return tuple(demonstration.id for demonstration in (*self.contexts, *self.explained))


class Pemirl(MetaLearner[PemirlConfig, ContextBatch]):
    """PEMIRL for observations and actions of given sizes."""

    config_type = PemirlConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the four models; only σ is set."""
        config = self.config
        of_policy, of_reward = (
            [config.hidden_units] * layers for layers in (config.hidden_layers, config.reward_layers)
        )
        with_action, with_context = self.obs_dim + self.action_dim, self.obs_dim + config.context_dim
        sizes = {
            "encoder": [with_action, *of_policy, 2 * config.context_dim],
            "policy": [with_context, *of_policy, self.action_dim],
            "reward": [with_context, *of_reward, 1],
            "potential": [with_context, *of_reward, 1],
        }
        drawn: dict[str, torch.Tensor] = {}
        for prefix, units in sizes.items():
            drawn |= initialise(prefix, units, rng, output_scale=config.output_scale)
        raw = BOUND * math.atanh(math.log(config.initial_deviation) / BOUND)
        return {**drawn, "log_deviation": torch.full((self.action_dim,), raw)}

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> ContextBatch:
        """Draw the trajectories, all different where the task has as many, and name what is drawn later by a seed.

        Raises:
            DemonstrationError: if there is no demonstration.
        """
        if not demonstrations:
            raise DemonstrationError("demonstrations: got none for this task; wanted at least one; collect some first")
        contexts, wanted = self.config.contexts, self.config.contexts + self.config.trajectories
        order = [rng.permutation(len(demonstrations)) for _ in range(-(-wanted // len(demonstrations)))]
        drawn = [demonstrations[index] for index in np.concatenate(order)[:wanted]]
        return ContextBatch(tuple(drawn[:contexts]), tuple(drawn[contexts:]), int(rng.integers(2**63)))

    def task_gradient(self, parameters: Parameters, batch: ContextBatch) -> TaskGradient:
        """Return the gradient of the weighted sum of all losses."""
        config, generator = self.config, torch.Generator().manual_seed(batch.seed)
        contexts, explained = (
            Transitions.of(demonstrations, self.normalise).thinned(config.steps_per_trajectory, generator)
            for demonstrations in (batch.contexts, batch.explained)
        )
        leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in parameters.items()}
        losses = losses_of(leaves, contexts, explained, config.discount, config.negatives, generator)
        total = (
            losses.likelihood
            + config.divergence_weight * losses.divergence
            + config.information_weight * (losses.information + losses.information_surrogate)
            + losses.discriminator
            + config.policy_weight * losses.policy
        )
        gradients = torch.autograd.grad(total, list(leaves.values()))
        metrics = {
            "loss": total.item(),
            "likelihood_loss": losses.likelihood.item(),
            "context_divergence": losses.divergence.item(),
            "information_loss": losses.information.item(),
            "discriminator_loss": losses.discriminator.item(),
            **losses.shown,
        }
        return TaskGradient(flatten(dict(zip(leaves, gradients, strict=True))), metrics)

    def context(self, parameters: Parameters, support: Sequence[Demonstration]) -> torch.Tensor:
        """Return m of a support set: the mean of q_ψ's means over its demonstrations."""
        return infer(parameters, Transitions.of(support, self.normalise)).mean.mean(0)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> NetworkPolicy:
        """Infer m; its part of the first layer's input is the same in every state, and so goes into the bias."""
        first, *others = network(parameters, "policy")
        of_states, of_context = first.weight.split([self.obs_dim, self.config.context_dim], 1)
        told = Layer(of_states, first.bias + of_context @ self.context(parameters, support))
        return NetworkPolicy((told, *others), self.normalise)
