"""Meta Learning Shared Hierarchies (Frans et al. 2018), its behaviour-cloning variant (F.2 and Table 11).

All tasks share a bank of K sub-skills, which is what meta-training learns. The high level belongs to one task: for
each sampled task, and again for a new one, it starts from fresh weights with a fresh Adam. It picks a sub-skill z for
every macro-step m of 3 steps, counted from a trajectory's start and cut off at its end; the states are those of the
demonstrations whatever is picked, so nothing corrects for who chose the actions there (F.2). Per sampled task:

    500 updates of the high level alone (the warm-up), then 1000 of both levels, each a step of Adam down
    L_h = −mean min(ρA, clip(ρ)A) + c mean (V_h(s_m) − R_m)²,     R_m = −Σ_{t ∈ m} ‖μ_z(s_t) − a_t‖²,
    L_l = −mean min(ρA, clip(ρ)A) + c mean (V_z(s_t) − r_t)²,     r_t = −‖ã_t − a_t‖², ã_t ~ N(μ_z(s_t), σ²),

with PPO's clip(ρ) in 1 ± 0.02 (Schulman et al. 2017). The slot returns the bank before minus after, and the outer step
goes to the slots' mean. At test the high level is learned anew on the support set while the sub-skills stay as they
are; then both levels take their modes.

What the appendix leaves open, and what is chosen here:

- What an update is. A batch of 900 state-action pairs is drawn together with sub-skills and actions by the policy of
  that moment, and serves for `passes` updates. So ρ is the policy of now over the one that drew: 1 at the batch's first
  update, and the clip bounds how far the others go. The authors' RL code passes 10 times with a clip of 0.2. With 0.02,
  10 passes missed the two skills of the tests' toy (in four new tasks 0.83 to 0.98 of the states after 40 iterations),
  and 3 passes found them (0.97 to 0.98 after 20).
- What a batch is made of: whole trajectories in random order, the last one cut off where the batch is full. A support
  set that is smaller comes more than once, each time with other sub-skills drawn.
- Values: each network has one more output, where the RL code has networks of their own. So the trunk is shared, and
  rewards are scaled to a root mean square of 1 first. Advantages are standardised over the batch; there, over each
  sub-skill's part of it.
- γ. Transitions follow the demonstration, so what is drawn at one state has no consequence at the next, and γ = 0
  loses nothing; the RL code has γ = 0.99 and λ = 0.98. Nor has a high level to explore beyond its own draws, where the
  RL code picks a tenth of the sub-skills at random.
- σ is a setting. The reward is best at σ = 0, where any step takes the ratio out of the clip and learning ends.
- The high level's return takes the error of the mean action, which acts at test: that of ã only adds noise to it.
- A fresh high level starts near uniform: its last layer begins small (Andrychowicz et al. 2021).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int64
from torch import Tensor

from dmil_core.demonstrations import Demonstration, DemonstrationError, Normalisation
from dmil_core.losses import Steps, squared_errors, sub_skill_labels
from dmil_core.methods.base import Decision, FineTuning, MetaLearner, SubSkillUse, TaskGradient
from dmil_core.methods.mlsh.config import MlshConfig
from dmil_core.methods.mlsh.macro_steps import MacroSteps, draw_batch, macro_steps
from dmil_core.methods.ppo import clipped_surrogate, normalised, scaled, trajectory_advantages
from dmil_core.networks import Layer, Network, Parameters, bank, flatten, initialise, mlp, network, own_states
from dmil_core.seeding import named_rng

FRESH_SCALE = 0.01
"""Scale of a fresh high level's last layer, against He's."""


@dataclass(frozen=True)
class MlshBatch:
    """What a sampled task is learned from."""

    demonstrations: tuple[Demonstration, ...]
    seed: int
    """Names the fresh high level and all that is drawn in learning."""

    @property
    def ids(self) -> tuple[str, ...]:
        """The ids of the demonstrations."""
        return tuple(demonstration.id for demonstration in self.demonstrations)


class _Learning:
    """Parameters as they are learned: copies, and an Adam of their own."""

    def __init__(self, parameters: Parameters, learning_rate: float) -> None:
        self.parameters = {name: tensor.detach().clone().requires_grad_() for name, tensor in parameters.items()}
        self._adam = torch.optim.Adam(self.parameters.values(), lr=learning_rate, fused=True)

    def descend(self, loss: Tensor) -> None:
        self._adam.zero_grad()
        loss.backward()
        self._adam.step()

    @property
    def learned(self) -> Parameters:
        return {name: tensor.detach() for name, tensor in self.parameters.items()}


@dataclass(frozen=True)
class MlshPolicy:
    """The high level picks the most probable sub-skill every few steps; its mean acts: a = μ_z(s)."""

    high: Network
    low: tuple[Network, ...]
    """Sub-skills without their values."""
    macro_step: int
    normalise: Normalisation

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes 2"]:
        """Return that no step of a macro-step is done, and so no sub-skill is picked yet."""
        return np.zeros((episodes, 2), np.int64)

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 2"]
    ) -> Decision:
        """Choose one action and its sub-skill for each episode; the memory is the steps done and the sub-skill."""
        states = torch.from_numpy(self.normalise(observations))
        done, chosen = torch.from_numpy(memory).unbind(1)
        if (done == 0).any():
            chosen = torch.where(done == 0, mlp(self.high, states).argmax(-1), chosen)
        actions = torch.empty(len(states), len(self.low[0][-1].bias))
        for sub_skill, own in zip(self.low, own_states(chosen, len(self.low)), strict=True):
            if len(own):
                actions[own] = mlp(sub_skill, states[own])
        after = torch.stack([(done + 1) % self.macro_step, chosen], 1)
        return Decision(actions.numpy(), chosen.numpy(), after.numpy())

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return the high level's choice, held for each macro-step, and the argmin of the error at each step."""
        steps = Steps.of([demonstration], self.normalise)
        macro = macro_steps(steps.lengths, self.macro_step)
        chosen = mlp(self.high, steps.states[macro.first]).argmax(-1)[macro.of_step]
        errors = torch.stack([squared_errors(mlp(sub_skill, steps.states), steps.actions) for sub_skill in self.low])
        return SubSkillUse(chosen.numpy(), sub_skill_labels(errors).numpy())


class _Picks(NamedTuple):
    """What the high level drew along some trajectories: a sub-skill for each macro-step."""

    macro: MacroSteps
    states: Float[Tensor, "macro_steps obs_dim"]
    chosen: Int[Tensor, " macro_steps"]
    log_probabilities: Float[Tensor, " macro_steps"]
    values: Float[Tensor, " macro_steps"]

    @property
    def of_step(self) -> Int[Tensor, " steps"]:
        return self.chosen[self.macro.of_step]


class _Outcome(NamedTuple):
    """What came of what was drawn."""

    advantages: Float[Tensor, " draws"]
    targets: Float[Tensor, " draws"]
    """What the values should have been."""


@dataclass(frozen=True)
class _Task:
    """One task's trajectories and what is drawn in learning from them: not pure, its generator moves on."""

    steps: Steps
    config: MlshConfig
    generator: torch.Generator

    def warm_up(self, high: _Learning, errors: Float[Tensor, "sub_skills steps"], updates: int) -> None:
        """Take updates of the high level alone, given the sub-skills' squared errors at all steps."""
        for passes in self._batches(updates):
            index, lengths = self._draw_batch()
            picks = self._pick(high, self.steps.states[index], lengths)
            outcome = self._outcome_of_picks(picks, errors[picks.of_step, index])
            for _ in range(passes):
                high.descend(self._high_loss(high, picks, outcome))

    def learn(self, high: _Learning, low: _Learning, updates: int) -> None:
        """Take updates of both levels."""
        for passes in self._batches(updates):
            index, lengths = self._draw_batch()
            states, demonstrated = self.steps.states[index], self.steps.actions[index]
            picks = self._pick(high, states, lengths)
            own = own_states(picks.of_step, self.config.sub_skills)
            with torch.no_grad():
                outputs = _outputs(low.parameters, states, own)
            means, values = outputs[:, :-1], outputs[:, -1]
            noise = torch.randn(means.shape, generator=self.generator, dtype=means.dtype)
            actions = means + self.config.deviation * noise
            log_densities = self._log_densities(means, actions)
            outcome_of_picks = self._outcome_of_picks(picks, squared_errors(means, demonstrated))
            outcome = self._outcome(-squared_errors(actions, demonstrated), values, lengths)
            for _ in range(passes):
                high.descend(self._high_loss(high, picks, outcome_of_picks))
                outputs = _outputs(low.parameters, states, own)
                log_ratio = self._log_densities(outputs[:, :-1], actions) - log_densities
                low.descend(self._loss(log_ratio, outputs[:, -1], outcome))

    def _batches(self, updates: int) -> Iterator[int]:
        """Yield how many updates each batch serves for."""
        for done in range(0, updates, self.config.passes):
            yield min(self.config.passes, updates - done)

    def _draw_batch(self) -> tuple[Int[Tensor, " size"], Int[Tensor, " drawn"]]:
        return draw_batch(self.steps.lengths, self.config.batch_size, self.generator)

    def _pick(
        self, high: _Learning, states: Float[Tensor, "steps obs_dim"], lengths: Int[Tensor, " trajectories"]
    ) -> _Picks:
        macro = macro_steps(lengths, self.config.macro_step)
        with torch.no_grad():
            outputs = mlp(network(high.parameters, "high"), states[macro.first])
        log_probabilities = outputs[:, :-1].log_softmax(-1)
        # argmax log p − log e, e ~ Exp(1), draws from p (Gumbel-max), and raises nothing where learning has diverged:
        # what is not finite is then reported by the outer loop, with the slot's name.
        waiting = torch.empty_like(log_probabilities).exponential_(generator=self.generator)
        chosen = (log_probabilities - waiting.log()).argmax(-1)
        return _Picks(macro, states[macro.first], chosen, _at(log_probabilities, chosen), outputs[:, -1])

    def _outcome_of_picks(self, picks: _Picks, errors: Float[Tensor, " steps"]) -> _Outcome:
        """Return what came of the picks where `errors` are of the picked sub-skills."""
        returns = torch.zeros_like(picks.values).index_add(0, picks.macro.of_step, -errors)
        return self._outcome(returns, picks.values, picks.macro.lengths)

    def _outcome(
        self, rewards: Float[Tensor, " draws"], values: Float[Tensor, " draws"], lengths: Int[Tensor, " trajectories"]
    ) -> _Outcome:
        config = self.config
        advantages = trajectory_advantages(scaled(rewards), values, lengths, config.discount, config.trace)
        return _Outcome(normalised(advantages), advantages + values)

    def _log_densities(
        self, means: Float[Tensor, "steps action_dim"], actions: Float[Tensor, "steps action_dim"]
    ) -> Float[Tensor, " steps"]:
        """Return log N(ã; μ, σ²), without the constant."""
        return squared_errors(means, actions) / (-2 * self.config.deviation**2)

    def _high_loss(self, high: _Learning, picks: _Picks, outcome: _Outcome) -> Float[Tensor, ""]:
        outputs = mlp(network(high.parameters, "high"), picks.states)
        log_probabilities = _at(outputs[:, :-1].log_softmax(-1), picks.chosen)
        return self._loss(log_probabilities - picks.log_probabilities, outputs[:, -1], outcome)

    def _loss(
        self, log_ratio: Float[Tensor, " draws"], values: Float[Tensor, " draws"], outcome: _Outcome
    ) -> Float[Tensor, ""]:
        surrogate = clipped_surrogate(log_ratio, outcome.advantages, self.config.clip)
        return self.config.value_weight * (values - outcome.targets).square().mean() - surrogate


def _at(rows: Float[Tensor, "rows columns"], columns: Int[Tensor, " rows"]) -> Float[Tensor, " rows"]:
    return rows.gather(1, columns[:, None]).squeeze(1)


def _outputs(
    low: Parameters, states: Float[Tensor, "steps obs_dim"], own: Sequence[Int[Tensor, " _"]]
) -> Float[Tensor, "steps outputs"]:
    """Run each sub-skill on its own states."""
    parts = [mlp(sub_skill, states[index]) for sub_skill, index in zip(bank(low, "low"), own, strict=True)]
    return torch.cat(parts)[torch.cat(list(own)).argsort()]


def _actors(parameters: Parameters) -> tuple[Network, ...]:
    """Return the sub-skills of a bank without their values."""

    def of(sub_skill: Network) -> Network:
        *hidden, output = sub_skill
        return (*hidden, Layer(output.weight[:-1], output.bias[:-1]))

    return tuple(map(of, bank({name: tensor.detach() for name, tensor in parameters.items()}, "low")))


def _errors(low: Sequence[Network], steps: Steps) -> Float[Tensor, "sub_skills steps"]:
    """Return ‖μ_k(s_t) − a_t‖² of every sub-skill at every step."""
    return torch.stack([squared_errors(mlp(sub_skill, steps.states), steps.actions) for sub_skill in low])


@dataclass(frozen=True)
class Mlsh(MetaLearner[MlshConfig, MlshBatch]):
    """MLSH for observations and actions of given sizes."""

    config_type = MlshConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the bank of sub-skills; each one's last output is its value."""
        config = self.config
        sizes = [self.obs_dim, *[config.hidden_units] * config.hidden_layers, self.action_dim + 1]
        return initialise("low", sizes, rng, copies=config.sub_skills, output_scale=config.output_scale)

    def sample(self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator) -> MlshBatch:
        """Draw whole demonstrations, without replacement.

        Raises:
            DemonstrationError: if there is no demonstration.
        """
        if not demonstrations:
            raise DemonstrationError("demonstrations: got none for this task; wanted at least one; collect some first")
        drawn = rng.permutation(len(demonstrations))[: self.config.trajectories]
        return MlshBatch(tuple(demonstrations[index] for index in drawn), int(rng.integers(2**63)))

    def task_gradient(self, parameters: Parameters, batch: MlshBatch) -> TaskGradient:
        """Learn one task from its demonstrations and return how far the bank went, the other way round."""
        config, steps = self.config, Steps.of(batch.demonstrations, self.normalise)
        high = self._fresh_high(np.random.default_rng(batch.seed), config.high_learning_rate)
        low = _Learning(parameters, config.sub_skill_learning_rate)
        task = _Task(steps, config, torch.Generator().manual_seed(batch.seed))
        before = _errors(_actors(parameters), steps)
        task.warm_up(high, before, config.warm_up_updates)
        chosen_before = self._mode(high, steps)
        task.learn(high, low, config.joint_updates)
        after, chosen = _errors(_actors(low.learned), steps), self._mode(high, steps)
        shares = torch.bincount(chosen, minlength=config.sub_skills) / len(chosen)
        metrics = {
            "loss": _at(after.T, chosen).mean().item(),
            "loss_after_warm_up": _at(before.T, chosen_before).mean().item(),
            "loss_of_best": after.min(0).values.mean().item(),
            "agreement": (chosen == sub_skill_labels(after)).float().mean().item(),
            **{f"sub_skill_share/{k}": share for k, share in enumerate(shares.tolist())},
        }
        return TaskGradient(flatten(parameters) - flatten(low.learned), metrics)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> MlshPolicy:
        """Learn a fresh high level on the support set, its steps being updates; the sub-skills stay as they are."""
        steps, low, random = (
            Steps.of(support, self.normalise),
            _actors(parameters),
            named_rng(0, "mlsh", "adapt"),
        )
        high = self._fresh_high(random, fine_tuning.learning_rate)
        task = _Task(steps, self.config, torch.Generator().manual_seed(int(random.integers(2**63))))
        task.warm_up(high, _errors(low, steps), fine_tuning.steps)
        *hidden, output = network(high.learned, "high")
        logits = Layer(output.weight[:-1], output.bias[:-1])
        return MlshPolicy((*hidden, logits), low, self.config.macro_step, self.normalise)

    def _fresh_high(self, random: np.random.Generator, learning_rate: float) -> _Learning:
        """Draw a high level; its last output is its value."""
        config = self.config
        sizes = [self.obs_dim, *[config.hidden_units] * config.hidden_layers, config.sub_skills + 1]
        return _Learning(initialise("high", sizes, random, output_scale=FRESH_SCALE), learning_rate)

    def _mode(self, high: _Learning, steps: Steps) -> Int[Tensor, " steps"]:
        """Return the most probable sub-skill of each step's macro-step."""
        macro = macro_steps(steps.lengths, self.config.macro_step)
        outputs = mlp(network(high.learned, "high"), steps.states[macro.first])
        return outputs[:, :-1].argmax(-1)[macro.of_step]
