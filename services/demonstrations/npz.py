"""Demonstrations in npz files: numpy's own form, read without trust in it.

A file holds ``observations`` (steps, dimensions) and ``actions`` (steps, dimensions) of all demonstrations, one after
the other, and ``episode_lengths`` (demonstrations); it may hold ``tasks``, names of what is done in them. Without
lengths it is one demonstration, or, with an axis more in front, a stack of demonstrations that are equally long.
"""

import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dmil_core.demonstrations import DemonstrationError
from dmil_core.errors import shorten
from dmil_core.files import named, read_file

FORMS = {
    "observations": ("f", (2, 3)),
    "actions": ("f", (2, 3)),
    "episode_lengths": ("iu", (1,)),
    "tasks": ("U", (1,)),
}
"""Of each array, the kinds of numbers and the numbers of axes."""
IN_WORDS = {"f": "floating-point numbers", "fiu": "numbers", "iu": "whole numbers", "U": "text"}
OPTIONAL = {"episode_lengths", "tasks"}
MOST_ARCHIVE = 2**28
"""Bytes of a file."""
MOST_ARRAYS = 2**29
"""Bytes of its arrays together."""
MOST_DEMONSTRATIONS = 10**5
MOST_PACKED = 200
"""Bytes of an array for each byte in the file; demonstrations have some 2."""
MOST_DIRECTORY = 2**12
"""Bytes of an archive's directory; a member takes some 60."""

SYNONYMS = {
    "observations": ("obs", "observation", "states", "state", "qpos", "s"),
    "actions": ("acts", "action", "act", "a"),
    "episode_lengths": ("lengths", "episode_length", "traj_lengths"),
}
"""Other names of arrays."""

END = b"PK\x05\x06"
"""Begins the 22 bytes that end an archive without a comment."""
END_64 = b"PK\x06\x07"
"""Begins the 20 bytes before, in an archive of over 4 GB or 65535 members."""
MOST_HEADER = 2**10
"""Bytes of an array's header; those that numpy writes for these arrays have 128."""


def read_arrays(path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Read observations and actions of each demonstration, whatever numbers are in them.

    Archives that unpack to more than is sane are refused before they are unpacked.

    Raises:
        DemonstrationError: names the file, and the array that cannot be used.
    """
    try:
        return arrays_in(read_file(*named(path), MOST_ARCHIVE))
    except (OSError, DemonstrationError) as error:
        got = str(error) if isinstance(error, DemonstrationError) else _unreadable(error)
        raise DemonstrationError(f"{path}: {got}") from error


def arrays_in(content: bytes, most: int = MOST_ARRAYS) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return observations and actions of each demonstration in the content of a file, whose arrays have `most` bytes.

    Raises:
        DemonstrationError: names the array that cannot be used.
    """
    try:
        arrays = _read_arrays(content, most)
        episodes = episodes_in(arrays["observations"], arrays["actions"], arrays.get("episode_lengths"))
        with np.errstate(over="ignore"):  # what does not fit becomes infinite, and is refused
            return [
                (np.ascontiguousarray(observations, np.float32), np.ascontiguousarray(actions, np.float32))
                for observations, actions in episodes
            ]
    except DemonstrationError:
        raise
    # What zipfile and numpy raise of damaged files; NotImplementedError and RuntimeError for what they do not read.
    except (
        OSError, ValueError, TypeError, EOFError, SyntaxError, MemoryError, RuntimeError,
        zipfile.BadZipFile, zlib.error, tokenize.TokenError,
    ) as error:  # fmt: skip
        raise DemonstrationError(_unreadable(error)) from error


def _unreadable(error: Exception) -> str:
    return f"got {type(error).__name__}, {error}; wanted an npz file as numpy writes it"


def episodes_in(
    observations: np.ndarray, actions: np.ndarray, lengths: np.ndarray | None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the observations and actions of each episode.

    Both are (steps, numbers) of all episodes, or stacked, (episodes, steps, numbers). Episodes that lie one after the
    other have `lengths`, unless there is but one.

    Raises:
        DemonstrationError: if they do not belong together.
    """
    if observations.ndim != actions.ndim:
        raise DemonstrationError(
            f"got observations of the shape {observations.shape} and actions of {actions.shape}; wanted as many axes"
        )
    if observations.ndim == 3:
        if lengths is not None or not 0 < len(observations) == len(actions) <= MOST_DEMONSTRATIONS:
            raise DemonstrationError(
                f"got {len(observations)} stacked episodes of observations and {len(actions)} of actions"
                f"{', and episode_lengths' * (lengths is not None)}; wanted as many of both and no lengths: lay "
                "episodes that are not equally long one after the other"
            )
        return [_paired(*both) for both in zip(observations, actions, strict=True)]
    if lengths is None:
        return [_paired(observations, actions)]
    more = int(len(observations) == len(actions) + len(lengths))  # after the last action of each
    _check_lengths(lengths, len(observations) - more * len(lengths), len(actions))
    cuts = np.cumsum(lengths.astype(np.int64))[:-1]
    observed = np.split(observations, cuts + more * np.arange(1, len(lengths)))
    return [_paired(*both) for both in zip(observed, np.split(actions, cuts), strict=True)]


def _paired(observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out an observation after the last action."""
    if len(observations) not in (len(actions), len(actions) + 1):
        raise DemonstrationError(
            f"got {len(observations)} observations for {len(actions)} actions; wanted as many of both, or, of several "
            "episodes one after the other, episode_lengths too"
        )
    return observations[: len(actions)], actions


def _check_lengths(lengths: np.ndarray, observations: int, actions: int) -> None:
    few = 1 <= len(lengths) <= MOST_DEMONSTRATIONS
    if not few or (lengths < 1).any() or (lengths > observations).any() or not lengths.sum() == observations == actions:
        raise DemonstrationError(
            f"episode_lengths: got {shorten(lengths[:10].tolist())} for {observations} observations and {actions} "
            f"actions; wanted as many of both as the lengths together, each at least 1, of 1 to {MOST_DEMONSTRATIONS} "
            "demonstrations"
        )


def _read_arrays(content: bytes, most: int) -> dict[str, np.ndarray]:
    _check_end(content)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        _check_members(members, most)
        return {_name(member): _read_array(archive, member) for member in members}


def _check_end(content: bytes) -> None:
    """Look at the size of the directory before `zipfile` makes an object of each of its entries."""
    end = content[-22:]
    directory = int.from_bytes(end[12:16], "little")
    if end[:4] != END or end[20:] != b"\0\0" or content[-42:-38] == END_64 or directory > MOST_DIRECTORY:
        raise DemonstrationError(
            f"got no archive of a few arrays, with a directory of at most {MOST_DIRECTORY} bytes at its end"
        )


def _check_members(members: list[zipfile.ZipInfo], most: int) -> None:
    names = [member.filename for member in members]
    wanted = {f"{name}.npy" for name in FORMS}
    if len(set(names)) != len(names) or not {f"{name}.npy" for name in FORMS.keys() - OPTIONAL} <= set(names) <= wanted:
        raise DemonstrationError(
            f"got the members {shorten(names)}; wanted {', '.join(sorted(wanted))}, each once"
            f"{renaming([*map(_name, members)])}"
        )
    for member in members:
        if member.flag_bits & 1 or member.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise DemonstrationError(
                f"{_name(member)}: got it encrypted or packed in an odd way; wanted what numpy.savez writes"
            )
        if member.file_size > MOST_PACKED * member.compress_size + 2**16:
            raise DemonstrationError(
                f"{_name(member)}: got {member.file_size} bytes packed into {member.compress_size}; wanted at most "
                f"{MOST_PACKED} for one"
            )
    if (total := sum(member.file_size for member in members)) > most:
        raise DemonstrationError(f"got arrays of {total} bytes; wanted at most {most}; split the file")


def _name(member: zipfile.ZipInfo) -> str:
    return member.filename.removesuffix(".npy")


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(member) as file:
        content = file.read(member.file_size)  # without a number it would unpack more, and only then cut off
    return array_in(content, _name(member), *FORMS[_name(member)])


def array_in(content: bytes, name: str, kinds: str, axes: tuple[int, ...]) -> np.ndarray:
    """Return the array of a .npy file, whose header is checked before memory is taken for it.

    It may have these `kinds` of numbers, as `numpy.dtype.kind` names them, and one of these numbers of `axes`.

    Raises:
        ValueError: if the header is not one of numpy's, or the array would have another size than there is.
    """
    stream = io.BytesIO(content)
    if (version := np.lib.format.read_magic(stream)) != (1, 0):
        raise DemonstrationError(f"{name}: got numpy's format {version}; wanted numbers or text in its format 1.0")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream, max_header_size=MOST_HEADER)
    if not dtype.isnative:
        raise DemonstrationError(f"{name}: got the byte order of {dtype.str}; wanted this machine's")
    if dtype.kind not in kinds or len(shape) not in axes:
        raise DemonstrationError(
            f"{name}: got {dtype} of the shape {shape}; wanted {IN_WORDS[kinds]} along {' or '.join(map(str, axes))} "
            f"ax{'i' if axes == (1,) else 'e'}s"
        )
    wanted = math.prod(shape) * dtype.itemsize
    if (there := len(content) - stream.tell()) != wanted or min(shape) < 0:
        raise DemonstrationError(f"{name}: got {there} bytes for {dtype} of the shape {shape}; wanted {wanted}")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def renaming(names: Sequence[str]) -> str:
    """Return the line that renames arrays to what is wanted, as far as their names can be guessed; else nothing."""
    found = {
        wanted: next((name for name in names if name.lower() in (wanted, *others)), None)
        for wanted, others in SYNONYMS.items()
    }
    if found["observations"] is None or found["actions"] is None:
        return ""
    arrays = ", ".join(f'{wanted}=a["{name}"]' for wanted, name in found.items() if name is not None)
    return f'; a = numpy.load("PATH"); numpy.savez("NEW.npz", {arrays})'
