"""The actor that adapts to tasks and returns their outer gradients."""

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import MetaLearner
from dmil_core.networks import unflatten
from dmil_core.outer_loop import NonfiniteSlot, add, group_gradient
from services.distributed.chunking import Chunks, from_chunks, to_chunks
from services.distributed.simulation_worker import SimulationWorker
from services.distributed.timing import Span
from services.suites.base import TaskSuite


class BlockReport(NamedTuple):
    """What is told of a block beside its gradient."""

    metrics: list[Mapping[str, float]]
    """Of each of its slots."""
    nonfinite: list[NonfiniteSlot]
    span: Span


class AdaptationWorker:
    """Computes blocks of slots and adds gradients; keeps nothing but what every call needs."""

    def __init__(
        self,
        method: MetaLearner[Any],
        shapes: Mapping[str, torch.Size],
        demonstrations: Mapping[str, Sequence[Demonstration]],
        seed: int,
        suite: TaskSuite | None,
    ) -> None:
        """Take what does not change during the run; demonstrations stay in shared memory.

        A method that practises does so here, in environments of the suite: a slot stays one piece of pure work.
        """
        torch.set_num_threads(1)
        self._practise = SimulationWorker(suite).practise if suite is not None else None
        self._method, self._shapes, self._demonstrations, self._seed = method, shapes, demonstrations, seed

    def gradient(
        self,
        parameters: Chunks,
        iteration: int,
        tasks: Sequence[str],
        block: Sequence[Sequence[int]],
        before: Sequence[Any] = (),
    ) -> tuple[BlockReport, Chunks]:
        """Return the sum of a block's gradients, which is all that need travel, and its report.

        Args:
            parameters: flat; they are copied first.
            iteration: counts from 0.
            tasks: of every slot of the iteration.
            block: the slots of each of its groups.
            before: Ray's references to the gradients of the blocks just before, which are then added.

        Raises:
            WorkError: for a Python error in one of the slots.
        """
        began = time.perf_counter()
        own = unflatten(torch.from_numpy(from_chunks(parameters)), self._shapes)
        results = [
            group_gradient(self._method, self._demonstrations, own, self._seed, iteration, tasks, slots, self._practise)
            for slots in block
        ]
        gradient = add([result.gradient for result in results])
        metrics = [slot for result in results for slot in result.metrics]
        nonfinite = [slot for result in results for slot in result.nonfinite]
        report = BlockReport(metrics, nonfinite, Span(began, time.perf_counter()))
        if not before:
            return report, to_chunks(gradient)
        import ray  # the local runner, which never comes here, does without

        _, total = self.add(*ray.get(list(before)), to_chunks(gradient))
        return report, total

    def add(self, *gradients: Chunks) -> tuple[Span, Chunks]:
        """Return the sum of neighbouring gradients of the tree, and when it was made."""
        began = time.perf_counter()
        total = [add(pieces) for pieces in zip(*gradients, strict=True)]
        return Span(began, time.perf_counter()), total
