"""HDF5 files of somebody else's, read as data alone: nothing outside the file, and no more than it can hold."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from dmil_core.demonstrations import DemonstrationError
from dmil_core.files import open_file

MAX_ARRAYS = 2**32
"""Bytes of all arrays that are read from one file together."""
MAX_RATIO = 200
"""Bytes that one byte of a compressed file may stand for, beyond `FREE_BYTES`."""
FREE_BYTES = 2**26


class PlainFile:
    """The arrays of an open HDF5 file that lie in the file itself.

    HDF5 can name arrays that lie elsewhere: links to other files, raw external storage, virtual arrays. None of these
    is followed, and an array is refused before memory is taken for it if the arrays read by then would be larger than
    `MAX_ARRAYS` or than `MAX_RATIO` times the file.
    """

    def __init__(self, file: h5py.File, size: int) -> None:
        """Read from `file`, which has `size` bytes on disk."""
        self._file = file
        self._left = min(MAX_ARRAYS, FREE_BYTES + MAX_RATIO * size)

    def names(self, group: str = "/") -> list[str]:
        """Return the names in a group, in alphabetical order; none for an array or where there is nothing."""
        member = self._member(group)
        return sorted(member) if isinstance(member, h5py.Group) else []

    def has(self, name: str) -> bool:
        """Return whether there is something under a path of the file."""
        return self._member(name) is not None

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array; of what is none, no axis."""
        return getattr(self._member(name), "shape", None) or ()

    def array(self, name: str, *, axes: int | None = None) -> np.ndarray:
        """Return the array of numbers under a path of the file, with so many axes, or with any but none at all.

        Raises:
            DemonstrationError: if there is none, it lies outside the file, holds no numbers, or is too large.
        """
        array = self._member(name)
        if not isinstance(array, h5py.Dataset):
            got = "nothing" if array is None else "a group"
            raise DemonstrationError(f"{name}: got {got}; wanted an array of numbers")
        if array.is_virtual or array.external:
            raise DemonstrationError(
                f"{name}: got numbers that lie in another file, which is not read; wanted them copied into this one"
            )
        if array.dtype.kind not in "fiub" or (array.ndim < 1 if axes is None else array.ndim != axes):
            wanted = "numbers with an axis of steps" if axes is None else f"numbers with {axes} axes"
            raise DemonstrationError(f"{name}: got {array.dtype} of the shape {array.shape}; wanted {wanted}")
        if array.nbytes > self._left:
            raise DemonstrationError(
                f"{name}: got {array.nbytes} bytes, where {self._left} are left of what this file may hold; wanted at "
                f"most {MAX_ARRAYS} bytes in all, and {MAX_RATIO} for each byte on disk; split the file"
            )
        self._left -= array.nbytes
        return array[()]

    def _member(self, path: str) -> h5py.Group | h5py.Dataset | None:
        """Return what lies under a path, reached by hard links only; they cannot lead out of the file."""
        node: h5py.Group | h5py.Dataset | None = self._file
        for part in filter(None, path.split("/")):
            if not isinstance(node, h5py.Group) or part not in node:
                return None
            if not isinstance(node.get(part, getlink=True), h5py.HardLink):
                raise DemonstrationError(f"{path}: got a link; wanted the array itself, in this file")
            member = node[part]
            node = member if isinstance(member, h5py.Group | h5py.Dataset) else None
        return node


@contextmanager
def open_plain(root: Path, name: str) -> Iterator[PlainFile]:
    """Open an HDF5 file below a folder for reading.

    Raises:
        OSError: if it is no regular file, such as a pipe, or no HDF5 file.
    """
    with open_file(root, name) as content, h5py.File(content, "r") as file:
        yield PlainFile(file, os.fstat(content.fileno()).st_size)
