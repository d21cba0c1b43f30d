"""Checkpoints: safetensors and a JSON manifest with a digest of every file, whole or not there at all."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from dmil_core.configs import ExperimentConfig
from dmil_core.errors import UserError
from dmil_core.networks import flatten
from dmil_core.outer_loop import OuterState

__all__ = ["Checkpoint", "CheckpointError", "Checkpoints", "Manifest"]


class CheckpointError(UserError):
    """A checkpoint that is missing or damaged."""


class Manifest(BaseModel):
    """What a checkpoint says of itself, ``manifest.json``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    iteration: int
    """Outer steps done; the one unit of progress everywhere."""
    loss: float | None
    """Mean loss after adaptation since the checkpoint before, by which the best is chosen."""
    config: ExperimentConfig
    shapes: dict[str, tuple[int, ...]]
    """Names and shapes of the parameters, in the order in which they are laid out flat."""
    data: dict[str, str]
    """The SHA-256 of each task's demonstrations."""
    versions: dict[str, str]
    mlflow_run_id: str | None
    files: dict[str, str] = {}
    """The SHA-256 of every other file of the checkpoint."""


class Checkpoint:
    """One checkpoint, read and found whole."""

    def __init__(self, path: Path) -> None:
        """Read a checkpoint's folder.

        Raises:
            CheckpointError: names the file that is missing or not as its digest says.
        """
        self.path = path
        try:
            text = (path / "manifest.json").read_bytes()
            self.manifest = Manifest.model_validate_json(text)
        except (OSError, ValidationError) as error:
            raise CheckpointError(f"{path / 'manifest.json'}: got {error}; wanted a checkpoint's manifest") from error
        self.digest = hashlib.sha256(text).hexdigest()
        """Of the manifest, and so of the whole checkpoint."""
        for name in ("parameters.safetensors", "optimiser.safetensors", "constants.safetensors"):
            found = _sha256(path / name)
            if found != self.manifest.files.get(name):
                raise CheckpointError(
                    f"{path / name}: got {'nothing' if found is None else 'SHA-256 ' + found[:12]}; wanted "
                    f"{(self.manifest.files.get(name) or 'its digest in the manifest')[:12]}; use another checkpoint"
                )

    def _load(self, name: str) -> dict[str, np.ndarray]:
        try:
            return load_file(self.path / name)
        except (SafetensorError, OSError) as error:
            raise CheckpointError(f"{self.path / name}: got {error}; wanted safetensors") from error

    @property
    def state(self) -> OuterState:
        """The learner's state."""
        flat = flatten({name: torch.from_numpy(array) for name, array in self.parameters.items()}).numpy()
        return OuterState(self.manifest.iteration, flat, **self._load("optimiser.safetensors"))

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """The parameters by name, in their flat order."""
        tensors = self._load("parameters.safetensors")
        return {name: tensors[name] for name in self.manifest.shapes}

    @property
    def constants(self) -> dict[str, np.ndarray]:
        """What the method learned once from the data."""
        return self._load("constants.safetensors")


class Checkpoints:
    """The checkpoints of one run, in its folder ``checkpoints``."""

    def __init__(self, folder: Path, kept: int) -> None:
        """Keep the newest `kept` checkpoints, and the best besides."""
        self.folder = folder
        self.kept = kept
        self.spares: Callable[[int], bool] = lambda iteration: False
        """Tells by its iteration whether a checkpoint is still needed, and so not let go."""

    def all(self) -> list[Path]:
        """Return the checkpoints' folders, oldest first."""
        return sorted(self.folder.glob("iteration-*"))

    def newest(self) -> Checkpoint:
        """Read the newest checkpoint.

        Raises:
            CheckpointError: if there is none, or it is damaged.
        """
        if not (paths := self.all()):
            raise CheckpointError(f"{self.folder}: got no checkpoint; wanted at least one; start the run anew")
        return Checkpoint(paths[-1])

    def save(
        self,
        state: OuterState,
        parameters: Mapping[str, np.ndarray],
        constants: Mapping[str, np.ndarray],
        manifest: Manifest,
    ) -> Path:
        """Write a checkpoint beside, sync it, rename it, and let go of those that are no longer kept."""
        path = self.folder / f"iteration-{state.iteration:07d}"
        writing = self.folder / f".writing-{os.getpid()}"
        shutil.rmtree(writing, ignore_errors=True)
        writing.mkdir(parents=True)
        moments = {"first_moment": state.first_moment, "second_moment": state.second_moment}
        contents: dict[str, Mapping[str, np.ndarray]] = {
            "parameters.safetensors": parameters,
            "optimiser.safetensors": moments,
            "constants.safetensors": constants,
        }
        for name, tensors in contents.items():
            save_file({key: np.ascontiguousarray(value) for key, value in tensors.items()}, writing / name)
        files = {name: _sha256(writing / name) for name in contents}
        text = json.dumps({**manifest.model_dump(mode="json"), "files": files}, indent=1)
        (writing / "manifest.json").write_text(text)
        for name in (*contents, "manifest.json", "."):
            _sync(writing / name)
        shutil.rmtree(path, ignore_errors=True)
        writing.replace(path)
        _sync(self.folder)
        self._let_go()
        return path

    def best(self) -> Path | None:
        """Return the checkpoint with the least loss."""
        losses = {path: self._loss(path) for path in self.all()}
        scored = {path: loss for path, loss in losses.items() if loss is not None}
        return min(scored, key=lambda path: scored[path]) if scored else None

    @staticmethod
    def _loss(path: Path) -> float | None:
        loss: Any = json.loads((path / "manifest.json").read_text())["loss"]
        return loss

    def _let_go(self) -> None:
        keep = {*self.all()[-self.kept :], self.best()}
        for path in self.all():
            if path not in keep and not self.spares(int(path.name.partition("-")[2])):
                shutil.rmtree(path)


def _sha256(path: Path) -> str | None:
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
