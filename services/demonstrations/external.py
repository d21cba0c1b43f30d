"""Demonstrations that somebody else has recorded: Minari data sets, D4RL's HDF5 files, npz files (docs/data.md)."""

import logging
import os
import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float32
from pydantic import BaseModel, Field

from dmil_core.demonstrations import Demonstration, DemonstrationError, digest
from dmil_core.errors import shorten
from dmil_core.files import ForeignFileError, at_home, inside, named, read_file
from services.demonstrations.hdf5 import PlainFile, open_plain
from services.demonstrations.layouts import looks_like, read_lerobot, read_pair, read_robomimic
from services.demonstrations.npz import read_arrays
from services.demonstrations.store import TaskDemonstrations, data_root
from services.suites.base import TaskSuite
from services.suites.registry import NAME

logger = logging.getLogger(__name__)

FORMS = ("minari", "hdf5", "npz", "npy", "lerobot")
"""What data sets may be: an id of Minari's, a file as D4RL or robomimic has them, a file of arrays or a folder of such,
two files of one array each, the folder of a LeRobot data set."""
SUFFIXES = {".npz": "npz", ".hdf5": "hdf5", ".h5": "hdf5"}
"""The form that a file's name stands for."""
MOST_NUMBER = 1e6
"""In a demonstration: what is larger is damage, or another unit."""
MAX_METADATA = 2**20
"""Bytes of a Minari data set's metadata."""
VERSION = re.compile(r"-v\d+$")
"""What a Minari id ends with."""


class _Metadata(BaseModel):
    """What is read of Minari's ``metadata.json``."""

    total_episodes: Annotated[int, Field(ge=1, le=10**6)]
    data_format: str = "hdf5"


class ExternalEpisode(NamedTuple):
    """One episode, as recorded."""

    observations: Float32[np.ndarray, "steps obs_dim"]
    """Of dictionaries: all parts one after the other, by their names in alphabetical order, inner ones likewise."""
    actions: Float32[np.ndarray, "steps action_dim"]
    reward: float | None
    """The sum over the episode, where rewards are recorded."""
    success: bool | None
    """Whether some step was a success by its info, where that is recorded."""
    problem: str | None = None
    """In words, why it cannot have been meant as it reads."""
    whole: bool = True
    """Whether its end is marked; else it is left out."""


def places_of(source: str) -> dict[str, str]:
    r"""Return where the demonstrations of each task are, from ``minari:ID,TASK=ID,npz:TASK=PATH`` and the like.

    The task is what stands before the first ``=``, if that can be a task's name; ``\,`` is a comma in a path.

    Raises:
        DemonstrationError: for another form, or a task named twice.
    """
    if ":" not in source and (there := at_home(source)).exists():
        form = SUFFIXES.get(there.suffix, "npz" if there.is_dir() else "")
        proposal = f"{form}:{source}" if form else f"a form that is read: it looks like {looks_like(there)}"
        raise DemonstrationError(f"demonstrations.source: got {source}; wanted {proposal}")
    form, places = "", dict[str, str]()
    for part in (part.replace(r"\,", ",") for part in re.split(r"(?<!\\),", source)):
        named_form, _, rest = part.partition(":")
        form, part = (named_form, rest) if named_form in FORMS else (form, part)
        task, equals, place = part.partition("=")
        if not equals or not NAME.fullmatch(task):
            task, place = VERSION.sub("", Path(part.partition("#")[0].partition("+")[0]).stem), part
        if not form or not place:
            raise DemonstrationError(
                f"demonstrations.source: got {source}; wanted expert, or one of {', '.join(FORMS)} and a list: "
                "minari:ID,ID, each with TASK= before it where its last part is not the task's name"
            )
        if task in places:
            raise DemonstrationError(
                f"demonstrations.source: got the task {task} twice; wanted one data set for each; a comma in a path is "
                r"written \,"
            )
        places[task] = f"{form}:{place}"
    return places


def read_episodes(place: str) -> list[ExternalEpisode]:
    """Read the episodes of a data set.

    Args:
        place: ``minari:ID``, ``hdf5:PATH``, ``npz:PATH``, ``npy:PATH+PATH`` or ``lerobot:FOLDER``. Of an HDF5 file as
            robomimic has them ``hdf5:PATH#KEY+KEY`` chooses and orders the parts of the observations.

    Raises:
        DemonstrationError: names the data set, and what of it cannot be read.
    """
    form, _, name = place.partition(":")
    path = at_home(name)
    if form == "npz":
        return _plain(_read_npz(path))
    try:
        if form in ("npy", "lerobot"):
            parts = "+".join(str(at_home(part)) for part in name.split("+"))
            return _plain(read_pair(parts) if form == "npy" else read_lerobot(path))
        return _read_minari(name) if form == "minari" else _read_hdf5(str(path))
    except (DemonstrationError, ForeignFileError) as error:
        raise DemonstrationError(f"{place}: {error}") from error
    # What h5py raises of files that are not what they look like.
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        got = f"no {error.filename}" if isinstance(error, FileNotFoundError) else f"{type(error).__name__}, {error}"
        raise DemonstrationError(f"{place}: got {got}; wanted a data set as docs/data.md describes") from error


def demonstrations(task: str, place: str, suite: TaskSuite, most: int) -> TaskDemonstrations:
    """Read the demonstrations of a task of `suite`, at most so many.

    Raises:
        DemonstrationError: names the episode that cannot be learned from, or the dimensions that do not fit.
    """
    state_of = getattr(suite, "state_of", lambda observations: observations)
    kept = []
    episodes = read_episodes(place)
    if tail := sum(len(episode.actions) for episode in episodes if not episode.whole):
        logger.warning(f"{place}: {tail} steps after the last mark of an end are left out")
    odd = dict(oddities(episodes[:most]))
    for index, episode in enumerate(episode for episode in episodes[:most] if episode.whole):
        try:
            if index in odd:
                raise DemonstrationError(f"{odd[index]}; mend it, or leave it out")
            observations = np.ascontiguousarray(state_of(episode.observations), np.float32)
            demonstration = Demonstration(f"{index:03d}", task, observations, episode.actions)
            check_dimensions(demonstration, suite)
        except DemonstrationError as error:
            raise DemonstrationError(f"{place}: episode {index}: {error}") from error
        kept.append(demonstration)
    return TaskDemonstrations(place, tuple(kept), 0, digest(kept))


def oddities(episodes: Sequence[ExternalEpisode]) -> Iterator[tuple[int, str]]:
    """Yield the number of an episode, and in words why it cannot have been meant as it reads."""
    first_with: dict[bytes, int] = {}
    for index, episode in enumerate(episodes):
        if episode.problem is not None:
            yield index, episode.problem
        if len(episode.actions) > 1 and (episode.observations == episode.observations[0]).all():
            yield index, "the same state at every step, as of a simulator's own array that was not copied"
        for field in ("observations", "actions"):
            far = np.abs(np.nan_to_num(getattr(episode, field), posinf=np.inf)).max(initial=0.0)
            if MOST_NUMBER < far < np.inf:  # what is not finite is told as that
                yield index, f"{field}: got {far:.3g}; wanted numbers of at most {MOST_NUMBER:.0e}, in a robot's units"
        before = first_with.setdefault(episode.observations.tobytes() + episode.actions.tobytes(), index)
        if before != index:
            yield index, f"the same as episode {before}"


def check_dimensions(demonstration: Demonstration, suite: TaskSuite) -> None:
    """See whether a demonstration has the suite's dimensions.

    Raises:
        DemonstrationError: if it has not.
    """
    for misfit in misfits(demonstration, suite):
        raise DemonstrationError(misfit)


def misfits(demonstration: Demonstration, suite: TaskSuite) -> Iterator[str]:
    """Yield in words which of a demonstration's dimensions are not the suite's."""
    for field, wanted in (("observations", suite.obs_dim), ("actions", suite.action_dim)):
        if (got := getattr(demonstration, field).shape[1]) != wanted:
            yield f"{field}: got {got} numbers a step; {suite.name} wants {wanted}"


def _read_minari(dataset_id: str) -> list[ExternalEpisode]:
    """Read a Minari data set without Minari, which would make the environment that the metadata name."""
    folder = inside(data_root(), dataset_id) / "data"
    if not folder.exists():
        folder = _minari_root() / dataset_id / "data"
    if not folder.exists():
        raise DemonstrationError(
            f"got nothing at {folder}, nor in {data_root()}; wanted a data set; minari download {dataset_id}"
        )
    metadata = _Metadata.model_validate_json(read_file(folder, "metadata.json", MAX_METADATA))
    if metadata.data_format != "hdf5":
        raise DemonstrationError(f"data_format: got {metadata.data_format}; wanted hdf5; store the data set as that")
    with open_plain(folder, "main_data.hdf5") as file:
        return [_episode(file, f"episode_{index}") for index in range(metadata.total_episodes)]


def _minari_root() -> Path:
    """Return where Minari keeps data sets; its own function would make the folder."""
    return at_home(os.environ.get("MINARI_DATASETS_PATH") or "~/.minari/datasets")


def _episode(file: PlainFile, name: str) -> ExternalEpisode:
    actions = file.array(f"{name}/actions", axes=2)
    observations = _observations(file, f"{name}/observations")
    if len(observations) not in (len(actions), len(actions) + 1):
        raise DemonstrationError(
            f"{name}: got {len(observations)} observations of {len(actions)} actions; wanted one more, or as many"
        )
    noted = [info for key in ("success", "is_success") if file.has(info := f"{name}/infos/{key}")]
    success = file.array(noted[0]) if noted else None
    return ExternalEpisode(
        observations[: len(actions)],
        actions.astype(np.float32),
        float(file.array(f"{name}/rewards", axes=1).sum()),
        None if success is None else bool(success.any()),
    )


def _observations(file: PlainFile, name: str) -> Float32[np.ndarray, "steps obs_dim"]:
    if parts := file.names(name):
        return np.concatenate([_observations(file, f"{name}/{part}") for part in parts], axis=1)
    observations = file.array(name)
    return observations.reshape(len(observations), -1).astype(np.float32)


def _plain(episodes: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[ExternalEpisode]:
    """Return episodes without rewards."""
    with np.errstate(over="ignore"):  # what does not fit becomes infinite, and is refused
        return [
            ExternalEpisode(observations.astype(np.float32), actions.astype(np.float32), None, None)
            for observations, actions in episodes
        ]


def _read_npz(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Read a file, or all files of a folder in the order of their names."""
    files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
    if not files:
        raise DemonstrationError(f"{path}: got no .npz file in it; it looks like {looks_like(path)}")
    return [episode for file in files for episode in read_arrays(file)]


def _read_hdf5(place: str) -> list[ExternalEpisode]:
    path, _, keys = place.partition("#")
    with open_plain(*named(Path(path))) as file:
        if file.names("data"):
            return _plain(read_robomimic(file, keys.split("+") if keys else ()))
        if not (file.has("observations") and file.has("actions")):
            raise DemonstrationError(
                f"got {shorten(file.names())}; wanted observations, actions and terminals as D4RL has them, or "
                "data/demo_0/obs and data/demo_0/actions as robomimic has them"
            )
        observations, actions = (file.array(name, axes=2) for name in ("observations", "actions"))
        if len(observations) != len(actions):
            raise DemonstrationError(
                f"got {len(observations)} observations and {len(actions)} actions; wanted as many of both"
            )
        ends = np.zeros(len(actions), bool)
        for name in filter(file.has, ("terminals", "timeouts")):
            marks = file.array(name, axes=1).astype(bool)
            if len(marks) != len(ends):
                raise DemonstrationError(f"{name}: got {len(marks)} for {len(ends)} actions; wanted one each")
            ends |= marks
        rewards = file.array("rewards", axes=1) if file.has("rewards") else None
    if not ends.any():
        raise DemonstrationError("got neither terminals nor timeouts that mark an episode's last step; wanted either")
    cuts = sorted({0, len(ends), *(np.flatnonzero(ends) + 1).tolist()})
    with np.errstate(over="ignore"):  # what does not fit becomes infinite, and is refused
        observations, actions = observations.astype(np.float32), actions.astype(np.float32)
    stays = "a single step after a marked one: an end that stays marked cuts each step off; mark last steps only"
    return [
        ExternalEpisode(
            observations[start:end],
            actions[start:end],
            None if rewards is None else float(rewards[start:end].sum()),
            None,
            stays if start and end == start + 1 and ends[start] else None,
            bool(ends[end - 1]),
        )
        for start, end in pairwise(cuts)
    ]
