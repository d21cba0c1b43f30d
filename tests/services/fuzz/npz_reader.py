"""The reader of npz files, and archives that numpy would not write."""

import copy
import io
import math
import struct
import zipfile
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
from mutations import Odd, mutated_bytes

from dmil_core.demonstrations import Demonstration, DemonstrationError
from services.demonstrations.npz import read_arrays

KITCHEN = Path(__file__).parents[3].parent / "shared" / "data" / "kitchen"


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
        try:
            return [Demonstration(str(index), "kitchen", *one) for index, one in enumerate(read_arrays(self.path))]
        except DemonstrationError as error:
            raise DemonstrationError(f"{self.path}: {error}") from error

    def right(self, value: list[Demonstration]) -> bool:
        with np.load(self.path, allow_pickle=False) as arrays:
            if "episode_lengths" not in arrays.files:  # one episode
                (one,) = value
                return np.array_equal(one.observations, arrays["observations"].astype(np.float32))
            ends = np.cumsum(arrays["episode_lengths"])
            observations = np.split(arrays["observations"].astype(np.float32), ends)[:-1]
            actions = np.split(arrays["actions"].astype(np.float32), ends)[:-1]
        return (
            len(value) == len(ends)
            and ends[-1] == sum(map(len, value))
            and all(map(np.array_equal, [d.observations for d in value], observations))
            and all(map(np.array_equal, [d.actions for d in value], actions))
        )


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
