"""A checkpoint's folder, read: safetensors and a JSON manifest with a digest of every file, whole or not there at all.

A run has several, ``checkpoints/iteration-0000500`` and the like; what writes and keeps them is the services'.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, field_validator, model_validator
from safetensors import SafetensorError
from safetensors.numpy import load, save

from dmil_core.checksums import checked_file, listing, sha256
from dmil_core.configs import ExperimentConfig
from dmil_core.errors import UserError, describe_errors, shorten
from dmil_core.files import inside, read_file
from dmil_core.methods.base import Method
from dmil_core.methods.registry import method_type
from dmil_core.networks import Parameters, flatten, unflatten
from dmil_core.outer_loop import OuterState

FOLDER = "checkpoints"
"""In a run's folder."""
NAMED = r"iteration-\d{7,}"
"""Folders of checkpoints."""
MANIFEST, MARKER = "manifest.json", "manifest.sha256"
PARAMETERS, OPTIMISER, CONSTANTS = "parameters.safetensors", "optimiser.safetensors", "constants.safetensors"
MOST_MANIFEST = 2**22
"""Bytes of a manifest."""
MOST_MARKER = 200
MOST_TENSORS = 2**32
"""Bytes of all parameters together: a hundred times those of the paper's networks."""
MOST_CONSTANTS = 2**26
"""Bytes of what a method learned once."""
MOST_HEADER = 2**20
"""Bytes of a file of tensors besides the tensors."""
FILES = {
    PARAMETERS: MOST_TENSORS + MOST_HEADER,
    OPTIMISER: 2 * MOST_TENSORS + MOST_HEADER,
    CONSTANTS: MOST_CONSTANTS,
    MANIFEST: MOST_MANIFEST,
}
"""What a checkpoint has besides its marker, and the most bytes of each."""

Model = TypeVar("Model", bound=BaseModel)
ADDED = {
    "suite": {"points"},
    "method": {"features", "absolute_position", "context", "context_share", "balance", "labels_until"},
    "training": {"schedule"},
    "evaluation": {"optimiser", "displaced", "controls"},
}
"""Settings that version 0.1 did not have: where they have their defaults, a digest is as it was without them."""

Side = Annotated[int, Field(ge=1, le=MOST_TENSORS, strict=True)]
Finite = Annotated[FiniteFloat, Field(strict=True)]
Shape = Annotated[tuple[Side, ...], Field(min_length=1, max_length=8)]


class CheckpointError(UserError):
    """A checkpoint that is missing or damaged."""


class Range(BaseModel):
    """The least and the greatest value of each number of an observation or an action."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    low: Annotated[tuple[Finite, ...], Field(min_length=1)]
    high: Annotated[tuple[Finite, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _goes_upwards(self) -> "Range":
        if len(self.low) != len(self.high) or any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low: got {shorten(self.low)}; wanted as many numbers as high, none of them above it")
        return self

    @classmethod
    def of(cls, low: Float[np.ndarray, " numbers"], high: Float[np.ndarray, " numbers"]) -> "Range":
        """Return a range; what is infinite becomes the greatest float32."""
        most = float(np.finfo(np.float32).max)
        return cls(low=tuple(low.clip(-most, most).tolist()), high=tuple(high.clip(-most, most).tolist()))

    def __len__(self) -> int:
        return len(self.low)


class Manifest(BaseModel):
    """What a checkpoint says of itself, ``manifest.json``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    iteration: Annotated[int, Field(ge=0, lt=2**63, strict=True)]
    """Outer steps done; the one unit of progress everywhere."""
    loss: Annotated[float, Field(strict=True)] | None
    """Mean loss after adaptation since the checkpoint before, by which the best is chosen."""
    config: ExperimentConfig
    shapes: dict[str, Shape]
    """Names and shapes of the parameters, in the order in which they are laid out flat; none of a method that learns
    nothing."""
    environment_steps: Annotated[int, Field(ge=0, lt=2**63, strict=True)] = 0
    """Steps that an online method took in the environments of meta-training tasks."""
    actions: Range | None = None
    """The bounds of the action space; none in checkpoints of version 0.1."""
    observed: Range | None = None
    """What the observations of the meta-training demonstrations lie between; none in checkpoints of version 0.1."""
    data: dict[str, str]
    """The SHA-256 of each task's demonstrations."""
    versions: dict[str, str]
    mlflow_run_id: str | None
    files: dict[str, str] = {}
    """The SHA-256 of every file of tensors; a model that is there to be adapted has no optimiser's."""

    @field_validator("shapes")
    @classmethod
    def _can_be_held(cls, shapes: dict[str, Shape]) -> dict[str, Shape]:
        if odd := [name for name, shape in shapes.items() if name.endswith(".weight") and len(shape) < 2]:
            raise ValueError(f"shapes: got {shapes[odd[0]]} for {shorten(odd[0])}; wanted a matrix")
        if (total := 4 * sum(map(math.prod, shapes.values()))) > MOST_TENSORS:
            raise ValueError(f"shapes: got {total} bytes of parameters; wanted at most {MOST_TENSORS}")
        return shapes

    @property
    def size(self) -> int:
        """The number of all parameters together."""
        return sum(map(math.prod, self.shapes.values()))

    @property
    def torch_shapes(self) -> dict[str, torch.Size]:
        """The same as `shapes`, as torch has them."""
        return {name: torch.Size(shape) for name, shape in self.shapes.items()}

    @property
    def digest(self) -> str:
        """What a result row names the checkpoint by.

        The SHA-256 of the manifest as canonical JSON, and so of all tensors, settings and data, but without `loss` and
        `mlflow_run_id`: they differ between a run that was disturbed and one that was not, which end alike otherwise.
        `actions` and `observed` follow from suite and data, and are left out too, and so are settings that came later
        and have their defaults.
        """
        identity = self.model_dump(mode="json", exclude={"loss", "mlflow_run_id", "actions", "observed"})
        for section, names in ADDED.items():
            settings = getattr(self.config, section)
            for name in names & type(settings).model_fields.keys():
                if getattr(settings, name) == type(settings).model_fields[name].default:
                    del identity["config"][section][name]
        identity["shapes"] = list(identity["shapes"].items())  # their order is the parameters' order
        return sha256(json.dumps(identity, sort_keys=True, separators=(",", ":")).encode())


class Checkpoint:
    """One checkpoint, read and found whole."""

    def __init__(self, path: Path) -> None:
        """Read a checkpoint's folder.

        Raises:
            CheckpointError: names the file that is missing, not as its digest says or not as the manifest describes.
        """
        self.path = path
        self.manifest = read_manifest(path)
        self.digest = self.manifest.digest
        """What result rows name the checkpoint by."""
        self.parameters: Mapping[str, np.ndarray] = self._read(PARAMETERS, self.manifest.shapes)
        """The parameters by name, in their flat order."""
        flat = (self.manifest.size,)
        self._moments = (
            self._read(OPTIMISER, {"first_moment": flat, "second_moment": flat})
            if OPTIMISER in self.manifest.files
            else None
        )
        self.constants: Mapping[str, np.ndarray] = self._read(CONSTANTS, None)
        """What the method learned once from the data."""

    def _read(self, name: str, shapes: Mapping[str, Sequence[int]] | None) -> dict[str, np.ndarray]:
        """Return the tensors of a file, which have these names and shapes, in this order."""
        most = MOST_CONSTANTS if shapes is None else 4 * sum(map(math.prod, shapes.values())) + MOST_HEADER
        tensors = read_tensors(self.path, name, self.manifest.files.get(name), most)
        if odd := [key for key, tensor in tensors.items() if tensor.dtype != np.float32]:
            raise damaged(self.path / name, f"{tensors[odd[0]].dtype} in {shorten(odd[0])}", "float32 only")
        if shapes is None:
            return tensors
        found_shapes = {key: tensor.shape for key, tensor in tensors.items()}
        if found_shapes != {key: tuple(shape) for key, shape in shapes.items()}:
            got, wanted = f"tensors {shorten(found_shapes)}", f"the manifest's {shorten(dict(shapes))}"
            raise damaged(self.path / name, got, wanted)
        return {key: tensors[key] for key in shapes}

    @property
    def flat(self) -> Float[np.ndarray, " parameters"]:
        """All parameters as one vector, a new copy each time."""
        return flatten({name: torch.from_numpy(array) for name, array in self.parameters.items()}).numpy()

    @property
    def state(self) -> OuterState:
        """The learner's state, a new copy each time.

        Raises:
            CheckpointError: of a model that was exported without it.
        """
        if self._moments is None:
            raise damaged(self.path / OPTIMISER, "none, as of a model to adapt", "a run's, to train on")
        moments = {name: array.copy() for name, array in self._moments.items()}
        return OuterState(self.manifest.iteration, self.flat, **moments)

    def tensors(self) -> Parameters:
        """Return the parameters, a new copy each time, laid out as in meta-training: the last bits depend on it."""
        return unflatten(torch.from_numpy(self.flat), self.manifest.torch_shapes)

    def method(self, action_dim: int) -> Method[Any]:
        """Return the method that the parameters are of, for actions of so many numbers."""
        config = self.manifest.config
        return method_type(config.method.name).restored(config.method, action_dim, self.constants, config.suite.points)

    @cached_property
    def actions(self) -> Range:
        """The bounds of actions.

        Those of checkpoints of version 0.1 were -1 and 1 in all suites. How many numbers an action had the parameters
        tell, whose count grows by as much with each.

        Raises:
            CheckpointError: of such a checkpoint, if its method learns nothing.
        """
        if self.manifest.actions is not None:
            return self.manifest.actions
        if not self.parameters:
            raise damaged(self.path / MANIFEST, "no actions", "their bounds, which version 0.1 did not write")
        rng = np.random.default_rng(0)
        one, two = (flatten(self.method(count).initial_parameters(rng)).numel() for count in (1, 2))
        count = 1 + (self.manifest.size - one) // (two - one)
        return Range.of(np.full(count, -1.0), np.full(count, 1.0))


def read_tensors(folder: Path, name: str, digest: str | None, most: int) -> dict[str, np.ndarray]:
    """Return the tensors of a file of safetensors in `folder`, of at most so many bytes.

    Raises:
        CheckpointError: if it is missing, has another digest, or cannot be read.
    """
    try:
        return load(checked_file(folder, name, digest, most))
    except OSError as error:
        raise damaged(folder / name, _describe(error), "what its digest in the manifest says") from error
    except (SafetensorError, KeyError, ValueError, TypeError, OverflowError) as error:  # KeyError: an odd dtype
        raise damaged(folder / name, f"{type(error).__name__}, {str(error)[:200]}", "safetensors") from error


def damaged(path: Path, got: str, wanted: str) -> CheckpointError:
    """Return the error that says what is wrong with a file."""
    return CheckpointError(f"{path}: got {got}; wanted {wanted}; use another checkpoint")


def read_sealed(folder: Path, name: str, marker: str, most: int, model: type[Model]) -> Model:
    """Read a JSON file whose digest is in a file beside it, the `marker`.

    Raises:
        CheckpointError: if either is missing or damaged.
    """
    try:
        text = read_file(folder, name, most)
        if read_file(folder, marker, MOST_MARKER).decode("ascii", "replace") != listing({name: sha256(text)}):
            raise OSError(f"a file whose SHA-256 is not the one in {marker}")
        return model.model_validate_json(text)
    except (OSError, ValidationError) as error:
        got = _describe(error) if isinstance(error, OSError) else describe_errors(error, "manifest", "; ")
        raise damaged(folder / name, got, "a checkpoint's manifest") from error


def packed(tensors: Mapping[str, np.ndarray]) -> bytes:
    """Return tensors as the content of a file of safetensors."""
    return save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()})


def sealed(files: Mapping[str, bytes], description: BaseModel, name: str, marker: str) -> dict[str, bytes]:
    """Return files of tensors, with the JSON file `name` that has their digests, and the `marker` that has its own.

    `read_sealed` reads it: a description with a field ``files``.
    """
    digests = {file: sha256(content) for file, content in files.items()}
    text = json.dumps({**description.model_dump(mode="json"), "files": digests}, indent=1).encode()
    return {**files, name: text, marker: listing({name: sha256(text)}).encode()}


def checkpoints_in(folder: Path) -> list[Path]:
    """Return the checkpoints' folders in `folder`, oldest first; what has another name is none."""
    found = (path for path in folder.glob("iteration-*") if re.fullmatch(NAMED, path.name))
    return sorted((path for path in found if path.is_dir()), key=iteration_of)


def iteration_of(path: Path) -> int:
    """Return the iteration that the folder of a checkpoint is named by."""
    return int(path.name.partition("-")[2])


def inside_run(folder: Path, path: Path) -> Path:
    """Return the folder of a checkpoint in `folder`, the folder ``checkpoints`` of a run.

    Raises:
        CheckpointError: if a link leads there.
    """
    try:
        return inside(folder.parent, f"{folder.name}/{path.name}")
    except OSError as error:
        raise CheckpointError(str(error)) from error


def newest(folder: Path, warn: Callable[[str], object]) -> Checkpoint:
    """Read the newest checkpoint that is whole in `folder`, the folder ``checkpoints`` of a run.

    `warn` receives in words which newer ones are damaged, if there are any.

    Raises:
        CheckpointError: if there is none.
    """
    checkpoint, complaints = newest_whole(folder)
    if checkpoint is None:
        got = f"{len(complaints)} checkpoints, none of them whole" if complaints else "no checkpoint"
        advice = "put a whole one there, or remove them and begin anew" if complaints else "train first"
        raise CheckpointError("\n".join([f"{folder}: got {got}; wanted one; {advice}", *complaints]))
    if complaints:
        warn(f"{' | '.join(complaints)}; taking {checkpoint.path} instead")
    return checkpoint


def newest_whole(folder: Path) -> tuple[Checkpoint | None, list[str]]:
    """Read the newest checkpoint in `folder` that is whole, if any is; return also what is wrong with newer ones."""
    complaints: list[str] = []
    for path in reversed(checkpoints_in(folder)):
        try:
            return Checkpoint(inside_run(folder, path)), complaints
        except CheckpointError as error:
            complaints.append(" ".join(str(error).splitlines()))
    return None, complaints


def opened(path: Path, warn: Callable[[str], object]) -> Checkpoint:
    """Read a checkpoint's folder, or the newest checkpoint in a run's.

    Raises:
        CheckpointError: if there is none, or it is damaged.
    """
    return newest(path / FOLDER, warn) if (path / FOLDER).is_dir() else Checkpoint(path)


def read_manifest(path: Path) -> Manifest:
    """Read the manifest of the checkpoint `path`, and see whether the files it speaks of are there.

    Raises:
        CheckpointError: if not.
    """
    manifest = read_sealed(path, MANIFEST, MARKER, MOST_MANIFEST, Manifest)
    for name, least in {PARAMETERS: 4 * manifest.size, OPTIMISER: 8 * manifest.size, CONSTANTS: 1}.items():
        if name == OPTIMISER and name not in manifest.files:
            continue  # a model to adapt
        size = (path / name).stat().st_size if (path / name).is_file() else 0
        if size < least:
            raise damaged(path / name, f"{size} bytes", f"at least {least}")
    return manifest


def _describe(error: OSError) -> str:
    return f"{error.strerror} ({error.filename})" if error.filename else str(error)
