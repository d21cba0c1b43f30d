"""How an option model acts: at test by its most probable option and its mean action, in meta-training at random."""

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.losses import Steps
from dmil_core.methods.base import Decision, Policy, SubSkillUse
from dmil_core.methods.option_gail.option_model import OptionModel


@dataclass(frozen=True)
class OptionPolicy(Policy):
    """The most probable option after the last one acts, by its mean: a = μ_o(s), o = argmax π_H(o | s, o').

    An episode's memory is its last option, K at the start.
    """

    model: OptionModel
    normalise: Normalisation

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes 1"]:
        """Return the start symbol for each episode."""
        return np.full((episodes, 1), self.model.options)

    @torch.no_grad()
    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 1"]
    ) -> Decision:
        """Choose an option and its mean action for each episode."""
        states = torch.from_numpy(self.normalise(observations))
        log_high = self.model.log_high(states)[torch.arange(len(states)), torch.from_numpy(memory[:, 0])]
        options = log_high.argmax(-1)
        return Decision(self.model.means(states, options).numpy(), options.numpy(), options.numpy()[:, None])

    @torch.no_grad()
    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return the options that the policy itself would take along a demonstration, each after its own last one.

        The best fit is the option under which the action has the highest density, whatever came before.
        """
        steps = Steps.of([demonstration], self.normalise)
        chosen, last = [], self.model.options
        for choice in self.model.log_high(steps.states).argmax(-1).tolist():
            last = choice[last]
            chosen.append(last)
        return SubSkillUse(np.array(chosen), self.model.log_low(steps.states, steps.actions).argmax(-1).numpy())


@dataclass(frozen=True)
class OptionExplorationPolicy(OptionPolicy):
    """Options and actions drawn from the model.

    An episode's memory is its last option, how many steps it has gone, and its key. Its key is made of its number and
    its first observation, for episodes that are begun one by one all have the number 0. What is drawn at a step is
    named by the policy's seed, the key and the step alone: it does not depend on which other episodes still run.
    """

    seed: int

    def start(self, episodes: int) -> Int64[np.ndarray, "episodes 3"]:
        """Return the start symbol, no step and a number for each episode."""
        numbers = np.arange(episodes)
        return np.stack([np.full(episodes, self.model.options), np.zeros_like(numbers), numbers], 1)

    @torch.no_grad()
    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 3"]
    ) -> Decision:
        """Draw an option and an action for each episode."""
        last, step, key = memory.T
        begun = zip(key.tolist(), step.tolist(), observations, strict=True)
        key = np.array([number if gone else _key(number, first) for number, gone, first in begun], np.int64)
        draws = [self._draw(*at) for at in zip(key.tolist(), step.tolist(), strict=True)]
        uniform = torch.tensor([number for number, _ in draws])
        noise = torch.from_numpy(np.array([numbers for _, numbers in draws], np.float32).reshape(len(draws), -1))

        states = torch.from_numpy(self.normalise(observations))
        high = self.model.log_high(states)[torch.arange(len(states)), torch.from_numpy(last)].exp()
        # How many options lie wholly below the draw; rounding may leave the sum below 1.
        options = (high.cumsum(-1) < uniform[:, None]).sum(-1).clamp(max=self.model.options - 1)
        actions = self.model.means(states, options) + self.model.log_deviations[options].exp() * noise
        return Decision(actions.numpy(), options.numpy(), np.stack([options.numpy(), step + 1, key], 1))

    def _draw(self, key: int, step: int) -> tuple[float, Float32[np.ndarray, " action_dim"]]:
        """Return a uniform number for the option and normal ones for the action."""
        philox = np.random.Generator(np.random.Philox(key=[self.seed, key], counter=[0, step, 0, 0]))
        return philox.random(), philox.standard_normal(self.model.log_deviations.shape[-1], np.float32)


def _key(number: int, observation: Float32[np.ndarray, " obs_dim"]) -> int:
    """Name an episode by its number and first observation."""
    digest = hashlib.sha256(number.to_bytes(8) + observation.tobytes()).digest()
    return int.from_bytes(digest[:8]) >> 1
