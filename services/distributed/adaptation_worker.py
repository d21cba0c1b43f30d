"""The actor that adapts to tasks and returns their outer gradients."""

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.devices import USUAL, Compute, computing_on, describe
from dmil_core.methods.base import MetaLearner
from dmil_core.networks import unflatten
from dmil_core.outer_loop import NonfiniteSlot, add, group_gradient
from services.distributed.chunking import Chunks, from_chunks, to_chunks
from services.distributed.gpus import granted_gpu
from services.distributed.simulation_worker import SimulationWorker
from services.distributed.timing import Span
from services.suites.base import TaskSuite


class Block(NamedTuple):
    """Slots of an iteration whose gradients one worker computes and adds in one call."""

    iteration: int
    """Counts from 0."""
    tasks: Sequence[str]
    """The task of every slot of the iteration."""
    groups: Sequence[Sequence[int]]
    """Its slots, group by group."""

    @property
    def slots(self) -> list[int]:
        """Its slots."""
        return [slot for group in self.groups for slot in group]


class BlockReport(NamedTuple):
    """What a block yields beside its gradient."""

    metrics: list[Mapping[str, float]]
    """Of each of its slots."""
    nonfinite: list[NonfiniteSlot]
    span: Span
    device: str = "cpu"
    """What computed it, as rows name it."""


class AdaptationWorker:
    """Computes gradients of blocks and adds them; holds nothing but what every call needs."""

    def __init__(
        self,
        method: MetaLearner[Any, Any],
        shapes: Mapping[str, torch.Size],
        demonstrations: Mapping[str, Sequence[Demonstration]],
        seed: int,
        suite: TaskSuite | None,
        compute: Compute = USUAL,
    ) -> None:
        """Hold what does not change during the run; demonstrations stay in shared memory.

        A method that learns from rollouts in meta-training has them here, in environments of the suite, so that a slot
        stays pure work.

        Raises:
            UserError: for a device that there is not.
        """
        torch.set_num_threads(1)
        self._collect_rollouts = SimulationWorker(suite).collect_rollouts if suite is not None else None
        self._method, self._shapes, self._demonstrations, self._seed = method, shapes, demonstrations, seed
        self._device = compute.device_for(method, granted=granted_gpu())
        self._batched, self._device_name = compute.is_batched(method, self._device), describe(self._device)

    def gradient(self, parameters: Chunks, block: Block, previous: Sequence[Any] = ()) -> tuple[BlockReport, Chunks]:
        """Return a block's report, and the sum of its gradients, which is all that must travel.

        Added to it are those of the blocks just before it, to which `previous` has Ray's references.

        Raises:
            WorkError: for a Python error in one of the slots.
        """
        started = time.perf_counter()
        with computing_on(self._device):
            unflattened = unflatten(torch.from_numpy(from_chunks(parameters)).to(self._device), self._shapes)
        results = [
            group_gradient(
                self._method,
                self._demonstrations,
                unflattened,
                self._seed,
                block.iteration,
                block.tasks,
                slots,
                self._collect_rollouts,
                batched=self._batched,
            )
            for slots in block.groups
        ]
        gradient = to_chunks(add([result.gradient for result in results]))
        metrics = [slot for result in results for slot in result.metrics]
        nonfinite = [slot for result in results for slot in result.nonfinite]
        report = BlockReport(metrics, nonfinite, Span(started, time.perf_counter()), self._device_name)
        if not previous:
            return report, gradient
        import ray  # the local runner, which never comes here, does without

        _, total = self.add(*ray.get(list(previous)), gradient)
        return report, total

    def add(self, *gradients: Chunks) -> tuple[Span, Chunks]:
        """Return when neighbouring gradients of the tree were added, and their sum."""
        started = time.perf_counter()
        total = [add(chunks) for chunks in zip(*gradients, strict=True)]
        return Span(started, time.perf_counter()), total
