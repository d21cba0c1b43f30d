"""Demonstrations on disk: one Minari data set a task, under a data root that Minari's own tools can read.

``MINARI_DATASETS_PATH=data minari list local`` shows what is there.
"""

import errno
import hashlib
import json
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import h5py
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from pydantic import BaseModel, Field, ValidationError

from dmil_core.checksums import MOST_LISTED, check_listing, write_listing
from dmil_core.configs import DemonstrationConfig
from dmil_core.demonstrations import Demonstration, DemonstrationError, digest
from dmil_core.errors import describe_errors
from dmil_core.files import ForeignFileError, at_home, inside, making_folder, open_file, read_file, reserve, room_for
from dmil_core.trajectories import Episode
from services.storage.redaction import error_line
from services.storage.remote import Storage, given_storage
from services.suites.base import TaskSuite

logger = logging.getLogger(__name__)

DATA = "DMIL_DATA"
"""The environment variable that names the data root."""
LIBRARIES = ("gymnasium", "gymnasium-robotics", "metaworld", "minari", "mujoco", "numpy")
DIGESTS, ARRAYS, METADATA = "SHA256SUMS", "data/main_data.hdf5", "data/metadata.json"
MOST_ARRAYS = 2**32
"""Bytes of a data set's file of arrays."""
MOST_METADATA = 2**20
UNREADABLE = {errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.ENOMEM}
"""Why good data may not be read."""
FILES = {ARRAYS: MOST_ARRAYS, METADATA: MOST_METADATA}


@dataclass(frozen=True)
class TaskDemonstrations:
    """One task's data set: its demonstrations, how many attempts failed, and the SHA-256 of its arrays."""

    id: str
    demonstrations: tuple[Demonstration, ...]
    failed: int
    digest: str


class _Metadata(BaseModel):
    """What we read of Minari's ``metadata.json``."""

    total_episodes: Annotated[int, Field(ge=1, le=10**6)]
    failed: Annotated[int, Field(ge=0)]
    digest: str


def data_root() -> Path:
    """Return ``DMIL_DATA``, or ``data`` in the working directory."""
    return at_home(os.environ.get(DATA) or "data")


class DemoStore:
    """The data sets under one data root."""

    def __init__(self, root: Path, storage: Storage | None = None) -> None:
        """Use the data sets under `root`, which is made with the first of them.

        Those that are not there are fetched from the storage, and new ones are copied to it.
        """
        self.root = root.resolve()
        self._storage = storage

    @staticmethod
    def dataset_id(task: str, suite: TaskSuite, config: DemonstrationConfig) -> str:
        """Return the Minari id of a task's demonstrations: other settings, other id."""
        settings = {"protocol": suite.protocol, **config.model_dump(exclude={"held_out", "source"})}
        key = hashlib.sha256(json.dumps([task, settings], sort_keys=True).encode()).hexdigest()[:10]
        return f"{suite.family}/{task}/scripted-{key}-v2"

    def load(self, dataset_id: str, task: str) -> TaskDemonstrations | None:
        """Read a task's demonstrations, or `None` if they are not collected yet.

        What its digests do not vouch for never reaches the HDF5 library, which does not withstand every file.

        Raises:
            DemonstrationError: if the data set is damaged, lies outside the root or holds what cannot be learned from.
        """
        path = self.root / dataset_id
        try:
            if not inside(self.root, dataset_id).exists() and not self._fetched(dataset_id):
                return None
            check_listing(path, DIGESTS, FILES)
            metadata = _Metadata.model_validate_json(read_file(path, METADATA, MOST_METADATA))
            demonstrations = tuple(
                Demonstration(f"{index:03d}", task, observations[:-1], actions)
                for index, (observations, actions) in enumerate(_read_episodes(path, metadata.total_episodes))
            )
        except ForeignFileError as error:
            if error.errno != errno.ELOOP:
                raise self._damaged(error.filename, str(error.strerror)) from error
            raise DemonstrationError(
                f"{error.filename}: got {error.strerror}; wanted a folder of {self.root} itself, which alone may be a "
                f"link; put what is meant in its place, or set {DATA} to where all data sets are"
            ) from error
        except ValidationError as error:
            raise self._damaged(path / METADATA, describe_errors(error, "metadata", "; ")) from error
        except DemonstrationError as error:
            raise DemonstrationError(f"{path / ARRAYS}: {error}") from error
        except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:  # the last four are h5py's
            if isinstance(error, OSError) and error.errno in UNREADABLE:
                raise DemonstrationError(
                    f"{path}: got {error}; wanted a data set that can be read; mend that"
                ) from error
            raise self._damaged(path, f"{type(error).__name__}: {error}") from error
        found = digest(demonstrations)
        if metadata.digest != found:
            raise self._damaged(path, f"arrays with the SHA-256 {found[:12]}, not the one in its metadata")
        return TaskDemonstrations(dataset_id, demonstrations, metadata.failed, found)

    def seed_of(self, dataset_id: str, number: int) -> int:
        """Return the seed of the attempt that a scripted expert's demonstration is, by its number in the data set.

        Raises:
            DemonstrationError: if the data set is damaged, or lies outside the root.
        """
        path = self.root / dataset_id
        try:
            check_listing(inside(self.root, dataset_id), DIGESTS, FILES)
            with open_file(path, ARRAYS) as content, h5py.File(content, "r") as file:
                return int(np.asarray(file[f"episode_{number}"].attrs["seed"]).item())
        except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
            raise self._damaged(path, f"{type(error).__name__}: {error}") from error

    @staticmethod
    def _damaged(path: Path | str, got: str) -> DemonstrationError:
        return DemonstrationError(
            f"{path}: got {got}; wanted a whole data set as collect_demos writes it; remove it and collect again"
        )

    def save(
        self,
        dataset_id: str,
        task: str,
        successes: Sequence[Episode],
        failed: int,
        settings: dict[str, Any],
        algorithm: str = "scripted expert",
    ) -> TaskDemonstrations:
        """Write a task's demonstrations beside, then rename: a data set is there whole, or not at all.

        Where another program was faster, its data set is taken: whoever collects makes the same one.

        Raises:
            DemonstrationError: for an attempt that cannot be learned from. One step is enough for a demonstration.
            DiskFullError: for want of space; nothing is kept then.
        """
        path = self.root / dataset_id
        demonstrations = tuple(
            Demonstration(f"{index:03d}", task, attempt.observations[:-1], attempt.actions)
            for index, attempt in enumerate(successes)
        )
        metadata = {
            "dataset_id": dataset_id,
            "minari_version": minari.__version__,
            "algorithm_name": algorithm,
            "description": "reward 1 at the step that solves the task for the first time, 0 elsewhere",
            "failed": failed,
            "digest": digest(demonstrations),
            "settings": json.dumps(settings),
            "versions": json.dumps({library: version(library) for library in LIBRARIES}),
        }
        needed = _bytes_on_disk(successes)
        with room_for(path, needed):
            try:
                with making_folder(self.root, dataset_id) as made:
                    reserve(made, needed)  # HDF5 ends the process where a write fails
                    _write(made, successes, metadata)
            except FileExistsError:
                if not (there := self.load(dataset_id, task)):
                    raise
                return there
        self._copy(dataset_id)
        return TaskDemonstrations(dataset_id, demonstrations, failed, metadata["digest"])

    def _fetched(self, dataset_id: str) -> bool:
        """Fetch a data set from the storage, if it is there, and return whether it was."""
        if self._storage is None:
            return False
        try:
            return self._storage.get_folder(f"data/{dataset_id}", self.root, dataset_id, FILES, DIGESTS)
        except Exception as error:  # noqa: BLE001  whatever a storage raises, demonstrations can be made again
            logger.warning(f"{self._storage.url} gives no {dataset_id}: {error_line(error)}")
            return False

    def _copy(self, dataset_id: str) -> None:
        """Copy a new data set to the storage."""
        if self._storage is None:
            return
        sizes = {**FILES, DIGESTS: MOST_LISTED}
        contents = {file: read_file(self.root, f"{dataset_id}/{file}", most) for file, most in sizes.items()}
        try:
            self._storage.put_folder(f"data/{dataset_id}", contents, DIGESTS)
        except Exception as error:  # noqa: BLE001  whatever a storage raises, they are here
            logger.warning(f"{self._storage.url} does not take {dataset_id}: {error_line(error)}")


def open_store() -> DemoStore:
    """Return the store under the data root, with the storage that ``DMIL_STORAGE`` names behind it.

    Raises:
        UserError: if it names none.
    """
    return DemoStore(data_root(), given_storage())


def _write(folder: Path, successes: Sequence[Episode], metadata: dict[str, Any]) -> None:
    """Write a Minari data set and the digests of its files."""
    storage = MinariStorage.new(
        folder / "data",
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, successes[0].observations.shape[1:], np.float32),
        action_space=gymnasium.spaces.Box(-1, 1, successes[0].actions.shape[1:], np.float32),
    )
    storage.update_metadata(metadata)
    storage.update_episodes([_episode(attempt) for attempt in successes])
    write_listing(folder, DIGESTS, (ARRAYS, METADATA))


def _bytes_on_disk(successes: Sequence[Episode]) -> int:
    """Return about what a data set takes: rewards and ends of episodes are 10 bytes a step."""
    states = sum(attempt.observations.nbytes + attempt.actions.nbytes for attempt in successes)
    steps = sum(len(attempt.actions) for attempt in successes)
    return states + 10 * steps + 2**13 * len(successes) + 2**16


def _read_episodes(folder: Path, number: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the observations and the actions of each episode, one observation more than actions.

    Raises:
        ValueError: names what is not as it was written, before any array is read.
    """
    with open_file(folder, ARRAYS) as content, h5py.File(content, "r") as file:
        found = [_find_episode(file, f"episode_{index}", index) for index in range(number)]
        size = sum(array.nbytes for arrays in found for array in arrays)
        if size > (held := os.fstat(content.fileno()).st_size):  # as where they are compressed, or have two names
            raise ValueError(f"got arrays of {size} bytes in a file of {held}; wanted them all in it")
        return [(observations[()], actions[()]) for observations, actions in found]


def _find_episode(file: h5py.File, name: str, index: int) -> tuple[h5py.Dataset, h5py.Dataset]:
    if (found := file[name].attrs["id"]) != index:
        raise ValueError(f"{name}: got the id {found}; wanted {index}, as no other has")
    observations, actions = _find_array(file, f"{name}/observations"), _find_array(file, f"{name}/actions")
    if len(observations) != len(actions) + 1:
        raise ValueError(f"{name}: got {len(observations)} observations of {len(actions)} actions; wanted one more")
    return observations, actions


def _find_array(file: h5py.File, name: str) -> h5py.Dataset:
    array = file[name]
    if not isinstance(array, h5py.Dataset) or array.file != file or array.is_virtual or array.external:
        raise ValueError(f"{name}: got no array of this file; wanted one")
    if array.dtype != np.float32 or array.ndim != 2:
        raise ValueError(f"{name}: got {array.dtype} of the shape {array.shape}; wanted float32, (steps, dimensions)")
    return array


def _episode(attempt: Episode) -> EpisodeBuffer:
    steps = len(attempt.actions)
    return EpisodeBuffer(
        seed=attempt.seed,
        options={"goal": attempt.goal} if attempt.goal else None,
        observations=attempt.observations,  # type: ignore[arg-type]
        actions=attempt.actions,  # type: ignore[arg-type]
        rewards=[float(step == attempt.solved_at) for step in range(steps)],
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
    )
