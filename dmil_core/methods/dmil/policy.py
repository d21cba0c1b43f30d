"""The policy of DMIL."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Int64

from dmil_core.demonstrations import Demonstration, Normalisation
from dmil_core.losses import Steps, bank_errors, sub_skill_labels
from dmil_core.methods.base import Decision, Policy, SubSkillUse
from dmil_core.methods.dmil import adaptation
from dmil_core.methods.dmil.adaptation import Hierarchy
from dmil_core.methods.path_context import PathGuide


@dataclass(frozen=True)
class DmilPolicy(Policy):
    """The most probable sub-skill acts: a = π_k(s), k = argmax π_h(s)."""

    hierarchy: Hierarchy
    normalise: Normalisation
    guide: PathGuide | None = None
    """What sees the demonstrations while the policy acts, if anything does."""

    def act(
        self, observations: Float32[np.ndarray, "episodes obs_dim"], memory: Int64[np.ndarray, "episodes 0"]
    ) -> Decision:
        """Choose one action and its sub-skill for each episode."""
        actions, chosen = adaptation.act(self.hierarchy, torch.from_numpy(self.normalise(observations)))
        if self.guide is not None:
            actions = self.guide.blend(actions, observations)
        return Decision(actions.numpy(), chosen.numpy(), memory)

    def sub_skill_use(self, demonstration: Demonstration) -> SubSkillUse:
        """Return the high level's choice and the argmin label (equation 3) at each step."""
        steps = Steps.of([demonstration], self.normalise)
        chosen = adaptation.choose(self.hierarchy.high, steps.states)
        return SubSkillUse(chosen.numpy(), sub_skill_labels(bank_errors(self.hierarchy.low, steps)).numpy())
