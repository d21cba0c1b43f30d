"""Demonstrations as other tools lay them out: robomimic's HDF5 files, pairs of .npy files, LeRobot's data sets."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dmil_core.demonstrations import DemonstrationError
from dmil_core.errors import shorten
from dmil_core.files import named, open_file, read_file
from services.demonstrations.hdf5 import PlainFile
from services.demonstrations.npz import MOST_ARRAYS, array_in, episodes_in

if TYPE_CHECKING:
    import pyarrow

Arrays = tuple[np.ndarray, np.ndarray]
"""Observations (steps, numbers) and actions (steps, numbers) of one episode."""
DEMO = re.compile(r"demo_(\d+)")
OBSERVATIONS, ACTIONS = "observation.state", "action"
"""LeRobot's columns of states and actions."""

KINDS = {
    ".pkl .pickle .pt .pth .joblib": "a pickle, which can run any code when it is read",
    ".bag .db3 .mcap": "a recording of ROS",
    ".tfrecord .tfrecords .riegeli": "a TensorFlow or RLDS data set",
    ".zarr": "a Zarr store, as of diffusion policy",
    ".csv .txt .tsv": "a table of text",
    ".mat": "a MATLAB file",
    ".json .jsonl": "JSON",
    ".mp4 .avi .png .jpg": "pictures, and policies here see state vectors only",
}
"""What a file looks like that is not read, by its suffix."""


def read_robomimic(file: PlainFile, keys: Sequence[str]) -> list[Arrays]:
    """Read ``data/demo_*/obs/*`` and ``data/demo_*/actions``, as robomimic and LIBERO have them.

    The observations of these keys are laid one after the other, all in alphabetical order if there are none.

    Raises:
        DemonstrationError: for a key that is not there or no vector, as pictures are, with those that are.
    """
    demos = sorted(filter(DEMO.fullmatch, file.names("data")), key=lambda name: int(name.removeprefix("demo_")))
    return [_robomimic_demo(file, f"data/{demo}", keys) for demo in demos]


def _robomimic_demo(file: PlainFile, demo: str, keys: Sequence[str]) -> Arrays:
    there = file.names(f"{demo}/obs")
    axes = {key: len(file.shape(f"{demo}/obs/{key}")) for key in there}
    vectors = [key for key in there if axes[key] in (1, 2)]
    if odd := [key for key in keys or there if key not in vectors]:
        got = ", ".join(f"{key}{' (pictures)' if axes.get(key, 0) > 2 else ''}" for key in odd)
        raise DemonstrationError(
            f"{demo}/obs: got {got or 'nothing'}; wanted keys of vectors, chosen and ordered as "
            f"hdf5:PATH#{'+'.join(vectors)}"
        )
    parts = [file.array(f"{demo}/obs/{key}") for key in keys or there]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1), file.array(
        f"{demo}/actions", axes=2
    )


def read_pair(paths: str) -> list[Arrays]:
    """Read ``OBSERVATIONS.npy+ACTIONS.npy``: (steps, numbers) each, or stacked, (episodes, steps, numbers).

    Raises:
        DemonstrationError: names the file that cannot be used.
    """
    names = paths.split("+")
    if len(names) != 2:
        raise DemonstrationError(f"got {len(names)} files; wanted two: npy:OBSERVATIONS.npy+ACTIONS.npy")
    observations, actions = (
        array_in(read_file(*named(Path(name)), MOST_ARRAYS), name, "fiu", (2, 3)) for name in names
    )
    return episodes_in(observations, actions, None)


def read_lerobot(folder: Path) -> list[Arrays]:
    """Read a LeRobot data set on disk, ``data/**/*.parquet``: its states and actions, and no pictures.

    Raises:
        DemonstrationError: if there is no such file, or a column is not as LeRobot has it.
    """
    from pyarrow.parquet import ParquetFile  # takes a while to import: not for other data

    paths = sorted(folder.glob("data/**/*.parquet"))
    if not paths:
        raise DemonstrationError(f"got no data/**/*.parquet in {folder}; wanted the folder of a LeRobot data set")
    episodes: dict[int, list[Arrays]] = {}
    left = MOST_ARRAYS
    for path in paths:
        with open_file(folder, path.relative_to(folder), MOST_ARRAYS) as content:
            file = ParquetFile(content)
            left -= sum(file.metadata.row_group(index).total_byte_size for index in range(file.metadata.num_row_groups))
            wanted = (OBSERVATIONS, ACTIONS, "episode_index")
            if missing := [name for name in wanted if name not in file.schema_arrow.names]:
                raise DemonstrationError(
                    f"{path}: got the columns {shorten(file.schema_arrow.names)}; wanted {', '.join(missing)} too"
                )
            if left < 0:
                raise DemonstrationError(
                    f"{path}: got over {MOST_ARRAYS} bytes by then; wanted less; split the data set"
                )
            table = file.read(list(wanted))
        observations, actions = (_rows(table[name], f"{path}: {name}") for name in wanted[:2])
        numbers = table["episode_index"].to_numpy()
        for number in dict.fromkeys(numbers.tolist()):
            steps = numbers == number
            episodes.setdefault(number, []).append((observations[steps], actions[steps]))
    return [
        (np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts]))
        for _, parts in sorted(episodes.items())
    ]


def _rows(column: "pyarrow.ChunkedArray", name: str) -> np.ndarray:
    """Return a column of lists as a matrix."""
    try:
        return np.stack(column.to_numpy()).astype(np.float32)
    except (ValueError, TypeError) as error:
        raise DemonstrationError(f"{name}: got {column.type}; wanted a list of as many numbers in each row") from error


def looks_like(path: Path) -> str:
    """Return in words what a file or folder looks like that is in none of the forms that are read."""
    if path.is_dir() and (path / "meta").is_dir():
        return f"a LeRobot data set: lerobot:{path}"
    if path.suffix == ".parquet":
        return "a part of a LeRobot data set: lerobot:FOLDER"
    for suffixes, kind in KINDS.items():
        if path.suffix and path.suffix in suffixes.split():
            return f"{kind}; save its arrays by numpy.savez, see docs/data.md"
    return f"a file of the kind {path.suffix or 'without a suffix'}"
