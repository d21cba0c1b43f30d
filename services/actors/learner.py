"""The actor that adds the outer gradients and takes the outer step: the only one with state."""

import numpy as np
import torch
from jaxtyping import Float32

from dmil_core.configs import TrainingConfig
from dmil_core.outer_loop import OuterState, OuterStep

__all__ = ["Learner"]


class Learner:
    """Holds the parameters and Adam's moments."""

    def __init__(self, state: OuterState, training: TrainingConfig) -> None:
        """Continue from `state`."""
        torch.set_num_threads(1)
        self._step = OuterStep(state, training.learning_rate, training.gradient_clip)

    def parameters(self) -> Float32[np.ndarray, " size"]:
        """Return the current parameters, flat."""
        return self._step.parameters.numpy().copy()

    def step(self, *gradients: Float32[np.ndarray, " size"]) -> tuple[float, Float32[np.ndarray, " size"]]:
        """Add the groups' gradients, step, and return the gradient's norm and the new parameters."""
        return self._step(gradients), self.parameters()

    def state(self) -> OuterState:
        """Return everything a checkpoint needs."""
        return self._step.state
