"""Foreign HDF5 files: what lies in them is read, what lies elsewhere or unpacks to too much is not."""

import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from dmil_core.demonstrations import DemonstrationError
from services.demonstrations.hdf5 import open_plain

ROWS = np.arange(12, dtype=np.float32).reshape(4, 3)


def test_arrays_and_names_are_read(tmp_path: Path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["group/packed"] = ROWS
        file.create_dataset("group/zipped", data=ROWS, compression="gzip")
    with open_plain(tmp_path, "a.h5") as plain:
        assert plain.names("group") == ["packed", "zipped"]
        assert plain.names("group/packed") == plain.names("nothing") == []
        assert plain.has("group/zipped")
        assert not plain.has("group/other")
        for name in plain.names("group"):
            assert np.array_equal(plain.array(f"group/{name}", axes=2), ROWS)


def external(file: h5py.File, secret: Path) -> None:
    file.create_dataset("x", (4, 3), "u1", external=[(str(secret), 0, 12)])


def virtual(file: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout((4, 3), "f4")
    layout[:] = h5py.VirtualSource(str(secret.with_suffix(".h5")), "rows", (4, 3))
    file.create_virtual_dataset("x", layout)


def linked_group(file: h5py.File, secret: Path) -> None:
    file["x"] = h5py.ExternalLink(str(secret.with_suffix(".h5")), "/rows")


def soft(file: h5py.File, secret: Path) -> None:
    file["x"] = h5py.SoftLink("/y")
    file["y"] = ROWS


def text(file: h5py.File, secret: Path) -> None:
    file["x"] = [b"rows"]


def bomb(file: h5py.File, secret: Path) -> None:
    file.create_dataset("x", (2**25, 3), "f4", chunks=(2**14, 3), compression="gzip")


def huge(file: h5py.File, secret: Path) -> None:
    file.create_dataset("x", (10**12, 3), "f4", chunks=(2**14, 3))


@pytest.mark.parametrize("make", [external, virtual, linked_group, soft, text, bomb, huge])
def test_what_is_not_plain_data_of_the_file_is_refused(tmp_path: Path, make: Callable[[h5py.File, Path], None]):
    secret = tmp_path / "secret"
    secret.write_bytes(b"PRIVATE KEY!")
    with h5py.File(secret.with_suffix(".h5"), "w") as file:
        file["rows"] = ROWS
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(file, secret)
    with open_plain(tmp_path, "a.h5") as plain, pytest.raises(DemonstrationError, match="x: got"):
        plain.array("x")


def test_many_arrays_together_are_bounded_too(tmp_path: Path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number in range(4):
            file.create_dataset(str(number), (2**21, 4), "f4", chunks=(2**14, 4), compression="gzip")
    with open_plain(tmp_path, "a.h5") as plain:
        assert plain.array("0").nbytes == 2**25
        assert plain.array("1").nbytes == 2**25
        with pytest.raises(DemonstrationError, match="split the file"):
            plain.array("2")


def test_a_pipe_is_no_file(tmp_path: Path):
    os.mkfifo(tmp_path / "a.h5")
    with pytest.raises(OSError, match="no regular file"), open_plain(tmp_path, "a.h5"):
        pass
