"""Readers of what a run stores: checkpoints and data sets, both with digests."""

import json
import math
import struct
from pathlib import Path
from random import Random
from typing import Any, ClassVar

import h5py
import numpy as np
from misplaced import misplace, restore
from mutations import Odd, json_bytes, mutated_bytes, mutated_value
from safetensors.numpy import save

from dmil_core.checkpoint import Checkpoint, Manifest
from dmil_core.checksums import sha256, write_listing
from dmil_core.configs import PRESETS
from dmil_core.demonstrations import digest
from dmil_core.outer_loop import OuterState
from dmil_core.trajectories import Episode
from services.demonstrations.store import DemoStore
from services.storage.checkpoints import Checkpoints


class CheckpointReader:
    """A checkpoint: its manifest and its tensors."""

    SHAPES: ClassVar = {"high.0.weight": (3, 2), "high.0.bias": (3,), "low.0.weight": (2, 4, 2)}
    NAMES = ("parameters.safetensors", "optimiser.safetensors", "constants.safetensors")

    def __init__(self, folder: Path) -> None:
        self.named = "iteration-0000004"
        generator = np.random.default_rng(0)
        size = sum(map(math.prod, self.SHAPES.values()))
        state = OuterState(4, *generator.normal(size=(3, size)).astype(np.float32))
        manifest = Manifest(
            iteration=4, loss=0.5, config=PRESETS["ml10-smoke"], shapes=self.SHAPES, data={"reach": "0" * 64},
            versions={"torch": "2"}, mlflow_run_id="run",
        )  # fmt: skip
        self.path = Checkpoints(folder, kept=1).save(state, {"mean": np.ones(2, np.float32)}, manifest)
        self.files = {path.name: path.read_bytes() for path in self.path.iterdir()}
        self.real = Checkpoint(self.path)
        self.outside = folder / "outside"
        self.outside.write_bytes(self.files["manifest.json"])
        self.sealed = False

    def _seal(self) -> None:
        """Have the digests say that all is as it was written, so that what lies behind them is reached."""
        self.sealed = True
        write_listing(self.path, "manifest.sha256", ["manifest.json"])

    def _replace(self, name: str, content: bytes) -> None:
        (self.path / name).write_bytes(content)
        manifest = json.loads(self.files["manifest.json"])
        manifest["files"][name] = sha256(content)
        (self.path / "manifest.json").write_text(json.dumps(manifest))
        self._seal()

    def mutate(self, draw: Random, odd: Odd) -> None:
        self.sealed = False
        restore(self.path, self.files)
        match draw.randrange(8):
            case 0 | 1:
                name = draw.choice(list(self.files))
                (self.path / name).write_bytes(mutated_bytes(self.files[name], draw))
            case 2:
                misplace(self.path / draw.choice(list(self.files)), self.outside, draw)
            case 3 | 4:
                changed = mutated_value(json.loads(self.files["manifest.json"]), draw, odd)
                (self.path / "manifest.json").write_bytes(json_bytes(changed))
                self._seal()
            case 5:
                (self.path / "manifest.json").write_bytes(mutated_bytes(self.files["manifest.json"], draw))
                self._seal()
            case 6:
                name = draw.choice(self.NAMES)
                self._replace(name, mutated_bytes(self.files[name], draw))
            case _:
                name = draw.choice(self.NAMES)
                self._replace(name, self._odd_tensors(self.files[name], draw, odd))

    @staticmethod
    def _odd_tensors(content: bytes, draw: Random, odd: Odd) -> bytes:
        if draw.random() < 0.5:
            size = int.from_bytes(content[:8], "little")
            described = json.loads(content[8 : 8 + size])
            if draw.random() < 0.3:  # a type of one byte, of which there is a vector in the place of the tensor
                tensor = described[draw.choice(list(described))]
                start, end = tensor["data_offsets"]
                tensor.update(dtype=draw.choice(["F8_E4M3", "F8_E5M2", "F8_E8M0", "U8"]), shape=[end - start])
            else:
                described = mutated_value(described, draw, odd)
            header = json_bytes(described)
            return struct.pack("<Q", draw.choice([len(header), len(header), 2**63])) + header + content[8 + size :]
        names = draw.sample(["first_moment", "second_moment", "mean", *CheckpointReader.SHAPES], 3)
        dtypes = [np.float16, np.float32, np.float64, np.int32, np.bool_]
        shapes = [(), (0,), (3,), (25,), (3, 2), (1, 25)]
        return save({name: np.ones(draw.choice(shapes), draw.choice(dtypes)) for name in names})

    def read(self) -> tuple[Checkpoint, OuterState]:
        checkpoint = Checkpoint(self.path)
        return checkpoint, checkpoint.state

    def right(self, value: tuple[Checkpoint, OuterState]) -> bool:
        checkpoint, state = value
        shapes = {name: array.shape for name, array in checkpoint.parameters.items()}
        arrays = [*checkpoint.parameters.values(), *checkpoint.constants.values(), *state[1:]]
        consistent = (
            shapes == checkpoint.manifest.shapes
            and all(array.dtype == np.float32 for array in arrays)
            and len({len(array) for array in state[1:]}) == 1
        )
        real = all(map(np.array_equal, state, self.real.state)) and checkpoint.manifest == self.real.manifest
        return consistent and (self.sealed or real)


class DatasetReader:
    """A data set of demonstrations, as the store keeps them."""

    ID = "reach/scripted-test-v2"

    def __init__(self, folder: Path) -> None:
        self.store, self.path, self.named = DemoStore(folder), folder / self.ID, self.ID
        generator = np.random.default_rng(0)
        attempts = [
            Episode(
                seed=length, goal=[0.5], solved_at=0,
                observations=generator.normal(size=(length + 1, 5)).astype(np.float32),
                actions=generator.normal(size=(length, 2)).astype(np.float32),
            )
            for length in (4, 1, 6)
        ]  # fmt: skip
        self.real = self.store.save(self.ID, "reach", attempts, failed=2, settings={})
        names = ("SHA256SUMS", "data/main_data.hdf5", "data/metadata.json")
        self.files = {name: (self.path / name).read_bytes() for name in names}
        self.outside = folder / "outside"
        self.outside.write_bytes(self.files["data/main_data.hdf5"])

    def _seal(self) -> None:
        write_listing(self.path, "SHA256SUMS", ["data/main_data.hdf5", "data/metadata.json"])

    def mutate(self, draw: Random, odd: Odd) -> None:
        restore(self.path, self.files)
        metadata = self.path / "data" / "metadata.json"
        match draw.randrange(8):
            case 0 | 1 | 2:
                name = draw.choice(list(self.files))
                (self.path / name).write_bytes(mutated_bytes(self.files[name], draw))
            case 3:
                misplace(self.path / draw.choice(list(self.files)), self.outside, draw)
            case 4:
                metadata.write_bytes(json_bytes(mutated_value(json.loads(metadata.read_text()), draw, odd)))
                self._seal()
            case 5:
                metadata.write_bytes(mutated_bytes(metadata.read_bytes(), draw))
                self._seal()
            case _:
                with h5py.File(self.path / "data" / "main_data.hdf5", "r+") as file:
                    self._edit(file, draw)
                self._seal()

    @staticmethod
    def _edit(file: h5py.File, draw: Random) -> None:
        """Change the arrays with HDF5's own means: its library must not be given what it did not write."""
        episode = file[f"episode_{draw.randrange(3)}"]
        assert isinstance(episode, h5py.Group)
        name = draw.choice(["observations", "actions"])
        match draw.randrange(9):
            case 0:
                array = episode[name]
                assert isinstance(array, h5py.Dataset)
                array[0, 0] = draw.choice([math.nan, math.inf, -math.inf, 7.0])
                return
            case 1:
                episode.attrs["id"] = draw.choice([0, 1, 2, -1, "0", [0, 1], 0.5])
                return
            case 2:
                del file[f"episode_{draw.randrange(3)}"]
                return
        del episode[name]
        match draw.randrange(6):
            case 0:
                shape = draw.choice([(), (0,), (0, 5), (1, 2), (5, 0), (5, 5, 1), (4, 2), (5, 5)])
                episode.create_dataset(name, shape, draw.choice(["f2", "f4", "f8", "i4", "?", "S4", ">f4"]))
            case 1:
                del episode["actions" if name == "observations" else "observations"]
                for each, steps in (("observations", 10**6 + 1), ("actions", 10**6)):
                    episode.create_dataset(each, (steps, 10**6), "f4", chunks=(1000, 1000), compression="gzip")
            case 2:
                episode[name] = h5py.ExternalLink("../../../outside", f"/episode_0/{name}")
            case 3:
                episode[name] = h5py.SoftLink(draw.choice([f"/episode_0/{name}", "/nowhere", f"{episode.name}/{name}"]))
            case 4:
                layout = h5py.VirtualLayout((5, 5), "f4")
                layout[:] = h5py.VirtualSource("../../../outside", "/episode_0/observations", (5, 5))
                episode.create_virtual_dataset(name, layout)
            case 5:
                episode.create_group(name)

    def read(self) -> Any:
        return self.store.load(self.ID, "reach")

    def right(self, value: Any) -> bool:
        if value is None:
            return not self.path.exists()
        return digest(value.demonstrations) == value.digest == self.real.digest
