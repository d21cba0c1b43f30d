"""The checkpoints of a run: written whole or not at all, the newest and the best of them kept."""

import logging
import math
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
import torch

from dmil_core.checkpoint import (
    CONSTANTS,
    MANIFEST,
    MARKER,
    OPTIMISER,
    PARAMETERS,
    Checkpoint,
    CheckpointError,
    Manifest,
    checkpoints_in,
    inside_run,
    iteration_of,
    newest,
    newest_whole,
    packed,
    read_manifest,
    sealed,
)
from dmil_core.files import create_file, making_folder, remove_abandoned, remove_folder, room_for
from dmil_core.networks import unflatten
from dmil_core.outer_loop import OuterState

logger = logging.getLogger(__name__)


class Checkpoints:
    """The checkpoints of one run, in its folder ``checkpoints``."""

    def __init__(self, folder: Path, kept: int) -> None:
        """Keep the newest `kept` checkpoints, and the best besides."""
        self.folder = folder
        self.kept = kept

    def all(self) -> list[Path]:
        """Return the checkpoints' folders, oldest first."""
        return checkpoints_in(self.folder)

    def newest(self) -> Checkpoint:
        """Read the newest checkpoint that is whole, and name damaged ones that are newer in a warning.

        Raises:
            CheckpointError: if there is none.
        """
        return newest(self.folder, logger.warning)

    def newest_whole(self) -> Checkpoint | None:
        """Read the newest checkpoint that is whole, if there is one."""
        return newest_whole(self.folder)[0]

    def save(
        self,
        state: OuterState,
        constants: Mapping[str, np.ndarray],
        manifest: Manifest,
        needed: Collection[Path] = (),
    ) -> Path:
        """Write a checkpoint beside, sync it, rename it, and remove those no longer kept or `needed`.

        Raises:
            DiskFullError: for want of space; what was written by then is removed.
            RunError: if the run's folder is gone that this process works in.
        """
        path = self.folder / f"iteration-{state.iteration:07d}"
        parameters = unflatten(torch.tensor(state.parameters), manifest.torch_shapes)
        contents: dict[str, Mapping[str, np.ndarray]] = {
            PARAMETERS: {name: tensor.numpy() for name, tensor in parameters.items()},
            OPTIMISER: {"first_moment": state.first_moment, "second_moment": state.second_moment},
            CONSTANTS: constants,
        }
        files = sealed({name: packed(of) for name, of in contents.items()}, manifest, MANIFEST, MARKER)
        run, place = self.folder.parent, self.folder.name
        remove_abandoned(run, place)
        with (
            room_for(path, sum(map(len, files.values()))),
            making_folder(run, f"{place}/{path.name}", instead=True) as made,
        ):
            for name, content in files.items():
                create_file(made, name, content)
        self._prune(state.iteration, needed)
        return path

    def _sound(self) -> dict[Path, float | None]:
        """Return the loss of each checkpoint, oldest first, without those that a look at their files finds damaged."""
        losses: dict[Path, float | None] = {}
        for path in self.all():
            try:
                losses[path] = read_manifest(inside_run(self.folder, path)).loss
            except CheckpointError:
                continue
        return losses

    def _prune(self, newest: int, needed: Collection[Path]) -> None:
        """Remove what is older than the newest `kept` whole checkpoints, damaged ones too, but not the best.

        Those after the iteration `newest` do not count: a resume has passed them over as damaged.
        """
        losses = {path: loss for path, loss in self._sound().items() if iteration_of(path) <= newest}
        scored = {path: loss for path, loss in losses.items() if loss is not None and math.isfinite(loss)}
        whole, best = list(losses), min(scored, key=lambda path: scored[path], default=None)
        for path in self.all() if len(whole) > self.kept else []:
            is_older = iteration_of(path) < iteration_of(whole[-self.kept])
            if is_older and path != best and path not in needed and not path.is_symlink():
                remove_folder(self.folder.parent, f"{self.folder.name}/{path.name}")
