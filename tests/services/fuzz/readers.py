"""The readers under test: what is real input to each, how it is mutated, and what a right answer is."""

import copy
import io
import json
import math
import os
import shutil
import struct
import zipfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any, ClassVar, Protocol

import h5py
import numpy as np
import yaml
from mutations import ODD, mutated_bytes, mutated_value
from safetensors.numpy import save

from dmil_core.configs import PRESETS, ExperimentConfig
from dmil_core.demonstrations import Demonstration, digest
from dmil_core.outer_loop import OuterState
from services.checkpoints import Checkpoint, Checkpoints, Manifest
from services.command_line import config_from
from services.demo_store import DemoStore
from services.digests import sha256, write_listing
from services.npz_demonstrations import read_npz
from services.report import read_metrics
from services.results import AdaptationResult, EpisodeResult, read_rows, write_rows
from services.suites.base import Attempt

KITCHEN = Path(__file__).parents[3].parent / "shared" / "data" / "kitchen"
Odd = Callable[[], Any]


class Reader(Protocol):
    """A reader, and the files that it is tried on."""

    named: str
    """What an error must name."""

    def __init__(self, folder: Path) -> None:
        """Make real input in an empty folder."""
        ...

    def mutate(self, draw: Random, odd: Odd) -> None:
        """Put a mutation of the real input in its place."""
        ...

    def read(self) -> Any:
        """Read the input."""
        ...

    def right(self, value: Any) -> bool:
        """Tell whether this is what stands in the input."""
        ...


def settings_yaml(settings: Any) -> bytes:
    return yaml.safe_dump(settings, allow_unicode=True, sort_keys=False).encode()


class ConfigReader:
    """Settings in YAML."""

    TEXTS = (
        "a: &a [x, x]\nb: &b [*a, *a, *a, *a]\nc: &c [*b, *b, *b, *b]\nseed: [*c, *c]", "seed: &s [*s]",
        "seed: 2001-99-99", "seed: 2001-01-01 25:61:61", "seed: 1:1:1" + ":59" * 9000, "seed: " + "9" * 9000,
        "seed: 0x" + "f" * 9000, "seed: !!python/object/apply:os.system ['touch x']", "seed: !!int ''",
        "seed: !!timestamp x", "seed: !!bool x", "seed: !!float ''", "seed: !!binary '===='", "<<: [seed, 1]",
        "<<: {seed: 4}", "? [1, 2]\n: 3", "? {a: b}\n: 3", "[" * 30000, "{a: " * 9000, "- " * 9000, "seed: 1\nseed: 2",
        "seed: \"\\ud800\"", "---\nseed: 1\n---\nseed: 2", "%YAML 9.9\n---\nseed: 1", "\ufeffseed: 5", "seed: 1\0",
        "x: " + "a" * 70000, "training: {iterations: 1e3}", "? " * 3000, "!<tag:yaml.org,2002:python/name:os> x",
    )  # fmt: skip

    def __init__(self, folder: Path) -> None:
        self.path, self.named = folder / "settings.yaml", "settings.yaml"
        self.real = json.loads(PRESETS["ml10-quick"].model_dump_json())

    def mutate(self, draw: Random, odd: Odd) -> None:
        match draw.randrange(4):
            case 0 | 1:
                content = settings_yaml(mutated_value(self.real, draw, odd))
            case 2:
                content = mutated_bytes(settings_yaml(self.real), draw)
            case _:
                content = draw.choice(self.TEXTS).encode("utf-8", "surrogatepass")
        self.path.write_bytes(content)

    def read(self) -> ExperimentConfig:
        return config_from("ml10-smoke", self.path)

    def right(self, value: ExperimentConfig) -> bool:
        def over(settings: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
            merged = {key: over(settings[key], v) if isinstance(v, dict) else v for key, v in given.items()}
            return settings | merged

        given = yaml.safe_load(self.path.read_bytes())
        return value == ExperimentConfig.model_validate(over(PRESETS["ml10-smoke"].model_dump(), given))


class CheckpointReader:
    """A checkpoint: its manifest and its tensors."""

    SHAPES: ClassVar = {"high.0.weight": (3, 2), "high.0.bias": (3,), "low.0.weight": (2, 4, 2)}
    NAMES = ("parameters.safetensors", "optimiser.safetensors", "constants.safetensors")

    def __init__(self, folder: Path) -> None:
        self.named = "iteration-0000004"
        generator = np.random.default_rng(0)
        parameters = {n: generator.normal(size=s).astype(np.float32) for n, s in self.SHAPES.items()}
        size = sum(map(math.prod, self.SHAPES.values()))
        state = OuterState(4, *generator.normal(size=(3, size)).astype(np.float32))
        manifest = Manifest(
            iteration=4, loss=0.5, config=PRESETS["ml10-smoke"], shapes=self.SHAPES, data={"reach": "0" * 64},
            versions={"torch": "2"}, mlflow_run_id="run",
        )  # fmt: skip
        self.path = Checkpoints(folder, kept=1).save(state, parameters, {"mean": np.ones(2, np.float32)}, manifest)
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
            Attempt(
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


class NpzReader:
    """Demonstrations in an npz file."""

    def __init__(self, folder: Path) -> None:
        self.path, self.named = folder / "demonstrations.npz", "demonstrations.npz"
        generator = np.random.default_rng(0)
        self.arrays = {
            "observations": generator.normal(size=(9, 6)).astype(np.float32),
            "actions": generator.normal(size=(9, 2)).astype(np.float32),
            "episode_lengths": np.array([4, 1, 4]),
            "tasks": np.array(["microwave", "kettle"]),
        }
        self.real = [npz(self.arrays, packed=packed) for packed in (False, True)]
        kitchen = [path.read_bytes() for path in sorted(KITCHEN.glob("*.npz"))[:1]]
        self.files = self.real * 10 + kitchen

    def mutate(self, draw: Random, odd: Odd) -> None:
        match draw.randrange(6):
            case 0 | 1:
                content = mutated_bytes(draw.choice(self.files), draw)
            case 2:
                members = {name: npy(array) for name, array in self.arrays.items()}
                name = draw.choice(list(members))
                members[name] = mutated_bytes(members[name], draw)
                content = archive(members)
            case 3:
                content = archive(self._odd_members(draw))
            case 4:
                content = npz(self._odd_arrays(draw), packed=draw.random() < 0.5)
            case _:
                content = self._odd_directory(draw)
        self.path.write_bytes(content)

    def _odd_members(self, draw: Random) -> dict[str, bytes]:
        members = {name: npy(array) for name, array in self.arrays.items()}
        name = draw.choice(list(members))
        match draw.randrange(6):
            case 0:
                members[draw.choice(["../x", "/etc/x", "x", "observations.npy/..", ""])] = members[name]
            case 1:
                members[draw.choice(["../observations", "x", ""])] = members.pop(name)
            case 2:
                sides = draw.choice(
                    ["10000000000000, 1", "1000000000000000000, 10000", "0, 6", "9", "3, 3, 6", "-9, 6"]
                )
                members[name] = npy(self.arrays[name], shape=f"({sides}, )")
            case 3:
                descr = draw.choice(["|O", "<f2", ">f4", "<f3", "<U999999999", "<c8", "|V4", "<M8[s]", "<i1", "<f16"])
                members[name] = npy(self.arrays[name], descr=descr)
            case 4:
                members[name] = npy(self.arrays[name], descr="(1000000000,)<f4")
            case 5:
                members[name] = b"\x93NUMPY" + draw.choice([b"\x02\x00", b"\x03\x00", b"\x09\x00"]) + members[name][8:]
        return members

    def _odd_arrays(self, draw: Random) -> dict[str, np.ndarray]:
        arrays = copy.deepcopy(self.arrays)
        name = draw.choice(list(arrays))
        match draw.randrange(8):
            case 0:
                arrays[draw.choice(["observations", "actions"])][draw.randrange(9), 0] = draw.choice(
                    [math.nan, math.inf, -math.inf]
                )
            case 1:
                lengths = [[9], [4, 5], [4, 0, 5], [10, -1], [4, 4], [], [1] * 9, [2**62, 2**62, 2**62, 2**62 + 9]]
                arrays["episode_lengths"] = np.array(draw.choice(lengths), np.int64)
            case 2:
                arrays[name] = arrays[name][..., None]
            case 3:
                arrays[name] = arrays[name][:0]
            case 4:
                dtype = draw.choice(["f2", "f4", "f8", "i4", "u8", "c8", ">f4", "S4", "?"])
                arrays[draw.choice(["observations", "actions", "episode_lengths"])] = np.ones((9, 6), dtype)
            case 5:
                del arrays[name]
            case 6:
                arrays["observations"] = np.full((9, 6), 1e300)
            case 7:
                arrays["observations"] = np.asfortranarray(arrays["observations"])
        return arrays

    def _odd_directory(self, draw: Random) -> bytes:
        content = bytearray(self.real[1])
        entry = content.index(b"PK\x01\x02")
        match draw.randrange(7):
            case 0:
                content[entry + 8] |= 1  # encrypted
            case 1:
                content[entry + 10] = draw.choice([1, 9, 12, 14, 99])  # packed in another way
            case 2:
                content[entry + 24 : entry + 28] = struct.pack("<I", draw.choice([0, 10, 2**31, 2**32 - 1]))
            case 3:
                content[-10:-6] = struct.pack("<I", draw.choice([0, 10, 2**31, 2**32 - 1]))
            case 4:
                return bomb()
            case 5:
                # The directory says that the bomb is a small array.
                content = bytearray(bomb())
                entry = content.index(b"PK\x01\x02")
                content[entry + 24 : entry + 28] = struct.pack("<I", draw.choice([128, 344, 4096]))
            case 6:
                return b"".join(self.real) + draw.randbytes(draw.randrange(3))
        return bytes(content)

    def read(self) -> list[Demonstration]:
        return read_npz(self.path, "kitchen", 3)

    def right(self, value: list[Demonstration]) -> bool:
        with np.load(self.path, allow_pickle=False) as arrays:
            ends = np.cumsum(arrays["episode_lengths"])
            observations = np.split(arrays["observations"][:, :3].astype(np.float32), ends)[:-1]
            actions = np.split(arrays["actions"].astype(np.float32), ends)[:-1]
        return (
            len(value) == len(ends)
            and ends[-1] == sum(map(len, value))
            and all(map(np.array_equal, [d.observations for d in value], observations))
            and all(map(np.array_equal, [d.actions for d in value], actions))
        )


class RowsReader:
    """Rows of results."""

    def __init__(self, folder: Path) -> None:
        self.path, self.named = folder / "episodes.jsonl", "episodes.jsonl"
        common = {
            "suite": "ml10", "protocol": "p", "method": "dmil", "checkpoint": "0" * 64, "split": "meta-testing",
            "task": "reach", "shots": 1, "draw": 0, "support": ["008"], "data": "1" * 64, "fine_tuning_steps": 5,
            "learning_rate": 0.003, "versions": {"torch": "2.13.0"}, "steps": 30, "sub_skill_steps": [10, 20],
        }  # fmt: skip
        self.kinds: dict[type[EpisodeResult | AdaptationResult], bytes] = {}
        own = {"episode": 0, "seed": 2**62, "goal": [0.1, -0.25], "success": True}
        for kind, row in ((EpisodeResult, common | own), (AdaptationResult, common | {"agreeing": 3})):
            write_rows(self.path, [kind.model_validate(row | {"draw": draw}) for draw in range(3)])
            self.kinds[kind] = self.path.read_bytes()
        self.kind: type[EpisodeResult | AdaptationResult] = EpisodeResult

    def mutate(self, draw: Random, odd: Odd) -> None:
        self.kind = draw.choice(list(self.kinds))
        self.path.write_bytes(mutated_lines(self.kinds[self.kind], draw, odd))

    def read(self) -> Any:
        return read_rows(self.path, self.kind)

    def right(self, value: Any) -> bool:
        return [json.loads(row.model_dump_json()) for row in value] == list(map(json.loads, lines(self.path)))


class MetricsReader:
    """The metrics of a run's iterations."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.named = folder, "tracking.jsonl"
        records: list[Any] = [["parameters", {"seed": "0"}], ["tags", {"suite": "ml10"}]]
        values = {"agreement": 0.5, "gradient_norm": math.nan, "high_loss_after": 1e-30}
        records += [["metrics", {"step": step, "time": 1, "values": values}] for step in (1, 2, 3, 2)]
        records += [["artifact", {"path": "/x", "folder": None}], ["end", "FINISHED"]]
        self.real = b"".join(json.dumps(record).encode() + b"\n" for record in records)

    def mutate(self, draw: Random, odd: Odd) -> None:
        (self.folder / self.named).write_bytes(mutated_lines(self.real, draw, odd))

    def read(self) -> list[dict[str, float]]:
        return read_metrics(self.folder)

    def right(self, value: list[dict[str, float]]) -> bool:
        found: dict[int, dict[str, float]] = {}
        for kind, record in map(json.loads, lines(self.folder / self.named)):
            if kind == "metrics":
                row = found.setdefault(record["step"], {"iteration": record["step"]})
                row.update({name: float(number) for name, number in record["values"].items()})
        return repr(value) == repr([found[step] for step in sorted(found)])


def lines(path: Path) -> list[bytes]:
    """Return a file's lines, and half a line at its end where there is one."""
    whole = path.read_bytes().split(b"\n")
    return whole if whole[-1] else whole[:-1]


def mutated_lines(content: bytes, draw: Random, odd: Odd) -> bytes:
    """Return JSON lines of which one is mutated as JSON, or all as bytes."""
    if draw.random() < 0.4:
        return mutated_bytes(content, draw)
    rows = content.splitlines(keepends=True)
    which = draw.randrange(len(rows))
    rows[which] = json_bytes(mutated_value(json.loads(rows[which]), draw, odd)) + draw.choice(
        [b"\n", b"\n", b"", b"\n\n"]
    )
    return b"".join(rows)


def json_bytes(value: Any) -> bytes:
    return json.dumps(value).encode()


def restore(folder: Path, files: dict[str, bytes]) -> None:
    shutil.rmtree(folder)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def misplace(path: Path, outside: Path, draw: Random) -> None:
    """Put something in a file's place that is no file of its folder, or far too large."""
    content = path.read_bytes()
    path.unlink()
    match draw.randrange(7):
        case 1:
            path.symlink_to(outside)
        case 2:
            path.symlink_to("/dev/zero")
        case 3:
            os.mkfifo(path)
        case 4:
            path.mkdir()
        case 5:
            path.write_bytes(content)
            os.truncate(path, 10**13)
        case 6:
            path.symlink_to(path.name)


def npy(array: np.ndarray, descr: str | None = None, shape: str | None = None) -> bytes:
    """Return an array in numpy's format, with another header if so wanted."""
    said = f"'descr': '{descr or array.dtype.str}', 'fortran_order': False, 'shape': {shape or array.shape}, "
    header = f"{{{said}}}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + array.tobytes()


def archive(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members.items():
            packed.writestr(f"{name}.npy", content)
    return file.getvalue()


def npz(arrays: dict[str, np.ndarray], *, packed: bool) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


@cache
def bomb() -> bytes:
    """Return 300 MB of zeros, as observations, in 300 kB."""
    part = b"\0" * 10**6
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        with packed.open("observations.npy", "w") as member:
            member.write(npy(np.zeros((0, 6), np.float32), shape="(12500000, 6)"))
            for _ in range(300):
                member.write(part)
        packed.writestr("actions.npy", npy(np.zeros((9, 2), np.float32)))
        packed.writestr("episode_lengths.npy", npy(np.array([4, 5])))
    return file.getvalue()


READERS: dict[str, Callable[[Path], Reader]] = {
    "config": ConfigReader,
    "checkpoint": CheckpointReader,
    "dataset": DatasetReader,
    "npz": NpzReader,
    "rows": RowsReader,
    "metrics": MetricsReader,
}


def plain_odd(draw: Random) -> Odd:
    """Return what draws from the fixed list of odd values."""
    return partial(draw.choice, ODD)
