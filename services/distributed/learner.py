"""The actor that takes the outer step: the only one with state."""

import math
import time
from typing import NamedTuple

import torch

from dmil_core.configs import TrainingConfig
from dmil_core.devices import device_of
from dmil_core.outer_loop import OuterState, OuterStep
from services.distributed.chunking import Chunks, from_chunks, to_chunks
from services.distributed.gpus import granted_gpu
from services.distributed.timing import Span


class StepReport(NamedTuple):
    """What an outer step yields beside the new parameters."""

    gradient_norm: float
    """Before clipping; where it is not finite, the step was not taken."""
    span: Span


class Learner:
    """Holds the parameters and what else its steps depend on."""

    def __init__(
        self, state: OuterState, training: TrainingConfig, *, skip_nonfinite: bool = False, device: str = "cpu"
    ) -> None:
        """Continue from `state` on a device; `skip_nonfinite` counts an iteration whose gradient is not finite."""
        torch.set_num_threads(1)
        self._skip_nonfinite = skip_nonfinite
        self._step = OuterStep(state, training, device_of(device, granted=granted_gpu()))

    def parameters(self) -> tuple[float, Chunks]:
        """Return the time on this machine's clock, and the current parameters, flat."""
        return time.perf_counter(), to_chunks(self._step.parameters.cpu().numpy().copy())

    def step(self, gradient: Chunks) -> tuple[StepReport, Chunks]:
        """Step by the sum of all gradients; return the report and the new parameters."""
        started = time.perf_counter()
        norm = self._step(from_chunks(gradient))
        if self._skip_nonfinite and not math.isfinite(norm):
            self._step.skip()
        ended, parameters = self.parameters()
        return StepReport(norm, Span(started, ended)), parameters

    def state(self) -> OuterState:
        """Return everything a checkpoint needs."""
        return self._step.state
