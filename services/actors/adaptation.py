"""The actor that adapts to tasks and returns their outer gradients."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import MetaLearner
from dmil_core.networks import unflatten
from dmil_core.outer_loop import group_gradient

__all__ = ["AdaptationWorker"]


class AdaptationWorker:
    """Computes groups of slots; keeps nothing but what every group needs."""

    def __init__(
        self,
        method: MetaLearner[Any],
        shapes: Mapping[str, torch.Size],
        demonstrations: Mapping[str, Sequence[Demonstration]],
        seed: int,
    ) -> None:
        """Take what does not change during the run; demonstrations stay in shared memory."""
        torch.set_num_threads(1)
        self._method, self._shapes, self._demonstrations, self._seed = method, shapes, demonstrations, seed

    def gradient(
        self, parameters: Float32[np.ndarray, " size"], iteration: int, tasks: Sequence[str], slots: Sequence[int]
    ) -> tuple[list[Mapping[str, float]], Float32[np.ndarray, " size"]]:
        """Return each slot's metrics, and the group's gradient.

        The parameters may lie in memory that other processes read: they are copied first.
        """
        own = unflatten(torch.tensor(parameters), self._shapes)
        result = group_gradient(self._method, self._demonstrations, own, self._seed, iteration, tasks, slots)
        return result.metrics, result.gradient
