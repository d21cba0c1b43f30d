"""MLSH as a method: what it draws, its gradient and its adaptation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from dmil_core.demonstrations import Demonstration, DemonstrationError
from dmil_core.losses import Steps, bank_errors, sub_skill_labels
from dmil_core.methods.base import DemonstrationBatch, FineTuning, MetaLearner, TaskGradient
from dmil_core.methods.mlsh.config import MlshConfig
from dmil_core.methods.mlsh.learning import FRESH_SCALE, Learner, TaskLearning, at_columns
from dmil_core.methods.mlsh.macro_steps import macro_steps
from dmil_core.methods.mlsh.policy import MlshPolicy
from dmil_core.networks import Layer, Network, Parameters, bank, flatten, initialise, mlp, network, without_graph
from dmil_core.seeding import named_rng


def _actors(parameters: Parameters) -> tuple[Network, ...]:
    """Return the sub-skills of a bank without their values."""
    return tuple(map(_without_value, bank(without_graph(parameters), "low")))


def _without_value(network: Network) -> Network:
    """Return a network without its last output."""
    *hidden, output = network
    return (*hidden, Layer(output.weight[:-1], output.bias[:-1]))


@dataclass(frozen=True)
class Mlsh(MetaLearner[MlshConfig, DemonstrationBatch]):
    """MLSH for observations and actions of given sizes."""

    config_type = MlshConfig

    def initial_parameters(self, rng: np.random.Generator) -> Parameters:
        """Draw the bank of sub-skills; each one's last output is its value."""
        config = self.config
        sizes = [self.input_dim, *config.hidden, self.action_dim + 1]
        return initialise("low", sizes, rng, copies=config.sub_skills, output_scale=config.output_scale)

    def sample(
        self, demonstrations: Sequence[Demonstration], iteration: int, rng: np.random.Generator
    ) -> DemonstrationBatch:
        """Draw whole demonstrations, without replacement.

        Raises:
            DemonstrationError: if there is no demonstration.
        """
        if not demonstrations:
            raise DemonstrationError("demonstrations: got none for this task; wanted at least one; collect some first")
        indices = rng.permutation(len(demonstrations))[: self.config.trajectories]
        return DemonstrationBatch(tuple(demonstrations[index] for index in indices), int(rng.integers(2**63)))

    def task_gradient(self, parameters: Parameters, batch: DemonstrationBatch) -> TaskGradient:
        """Learn one task from its demonstrations and return how far the bank went, the other way round."""
        config, steps = self.config, Steps.of(batch.demonstrations, self.normalise)
        high = self._fresh_high(np.random.default_rng(batch.seed), config.high_learning_rate)
        low = Learner(parameters, config.sub_skill_learning_rate)
        task = TaskLearning(steps, config, torch.Generator().manual_seed(batch.seed))
        before = bank_errors(_actors(parameters), steps)
        task.warm_up(high, before, config.warm_up_updates)
        chosen_before = self._mode(high, steps)
        task.learn(high, low, config.joint_updates)
        after, chosen = bank_errors(_actors(low.learned), steps), self._mode(high, steps)
        shares = torch.bincount(chosen, minlength=config.sub_skills) / len(chosen)
        metrics = {
            "loss": at_columns(after.T, chosen).mean().item(),
            "loss_after_warm_up": at_columns(before.T, chosen_before).mean().item(),
            "loss_of_best": after.min(0).values.mean().item(),
            "agreement": (chosen == sub_skill_labels(after)).float().mean().item(),
            **{f"sub_skill_share/{k}": share for k, share in enumerate(shares.tolist())},
        }
        return TaskGradient(flatten(parameters) - flatten(low.learned), metrics)

    def adapt(self, parameters: Parameters, support: Sequence[Demonstration], fine_tuning: FineTuning) -> MlshPolicy:
        """Learn a fresh high level on the support set, its steps being updates; the sub-skills stay as they are."""
        steps, low = Steps.of(support, self.normalise), _actors(parameters)
        rng = named_rng(0, "mlsh", "adapt")
        high = self._fresh_high(rng, fine_tuning.learning_rate)
        task = TaskLearning(steps, self.config, torch.Generator().manual_seed(int(rng.integers(2**63))))
        task.warm_up(high, bank_errors(low, steps), fine_tuning.steps)
        logits = _without_value(network(high.learned, "high"))
        return MlshPolicy(logits, low, self.config.macro_step, self.normalise)

    def _fresh_high(self, rng: np.random.Generator, learning_rate: float) -> Learner:
        """Draw a high level; its last output is its value."""
        config = self.config
        sizes = [self.input_dim, *config.hidden, config.sub_skills + 1]
        return Learner(initialise("high", sizes, rng, output_scale=FRESH_SCALE), learning_rate)

    def _mode(self, high: Learner, steps: Steps) -> Int[Tensor, " steps"]:
        """Return the most probable sub-skill of each step's macro-step."""
        macro = macro_steps(steps.lengths, self.config.macro_step)
        outputs = mlp(network(high.learned, "high"), steps.states[macro.first])
        return outputs[:, :-1].argmax(-1)[macro.of_step]
