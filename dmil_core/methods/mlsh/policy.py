"""The policy of MLSH."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.losses import Steps, bank_errors, sub_skill_labels
from dmil_core.methods.base import Decision, Policy, SubSkillUse
from dmil_core.methods.mlsh.macro_steps import macro_steps
from dmil_core.networks import Network, mlp, routed


@dataclass(frozen=True)
class MlshPolicy(Policy):
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
        actions = routed(self.low, states, chosen)
        after = torch.stack([(done + 1) % self.macro_step, chosen], 1)
        return Decision(actions.numpy(), chosen.numpy(), after.numpy())

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return the high level's choice, held for each macro-step, and the argmin of the error at each step."""
        steps = Steps.of([demonstration], self.normalise)
        macro = macro_steps(steps.lengths, self.macro_step)
        chosen = mlp(self.high, steps.states[macro.first]).argmax(-1)[macro.of_step]
        return SubSkillUse(chosen.numpy(), sub_skill_labels(bank_errors(self.low, steps)).numpy())
