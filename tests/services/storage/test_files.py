"""Files are written whole or not at all, and read only as far as is sane."""

import errno
import os
from pathlib import Path

import pytest

from services.storage.files import DiskFullError, inside, read_file, room_for, write_file


def test_a_file_is_written_whole_and_in_place_of_another(tmp_path: Path):
    path = tmp_path / "file"
    for content in (b"one", b"another"):
        write_file(path, content)
        assert read_file(path, 10) == content
    write_file(path, "wörter")
    assert path.read_text("utf-8") == "wörter"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("words", ["No space left on device", "I/O error: os error 28", "Can't write (errno = 28)"])
def test_a_full_disk_is_reported_with_path_and_bytes(tmp_path: Path, words: str):
    path = tmp_path / "file"
    with (
        pytest.raises(DiskFullError, match=rf"{path}: needs 9 bytes, its disk had \d+ free") as error,
        room_for(path, 9),
    ):
        raise OSError(words)
    assert "--resume" in str(error.value)


def test_space_is_looked_for_before_anything_is_written(tmp_path: Path):
    with pytest.raises(DiskFullError), room_for(tmp_path / "new" / "file", 2**70):
        pytest.fail("written all the same")
    assert not list(tmp_path.iterdir())


def test_other_errors_stay_what_they_are(tmp_path: Path):
    with pytest.raises(PermissionError), room_for(tmp_path / "file", 1):
        raise PermissionError(errno.EACCES, "no")


def test_only_regular_files_up_to_a_size_are_read(tmp_path: Path):
    (tmp_path / "large").write_bytes(b"12345")
    os.mkfifo(tmp_path / "pipe")
    for name in ("large", "pipe", ".", "nowhere"):
        with pytest.raises(OSError, match=r".+"):
            read_file(tmp_path / name, 4)
    with pytest.raises(OSError, match="no regular file"):
        read_file(Path("/dev/zero"), 4)
    assert read_file(tmp_path / "large", 5) == b"12345"


@pytest.mark.parametrize("name", ["../other", "/etc/passwd", "link/file", "a/../../other"])
def test_a_path_is_kept_inside_its_root(tmp_path: Path, name: str):
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to("/tmp")
    assert inside(root, "a/b/../c") == root / "a" / "c"
    with pytest.raises(OSError, match="lies outside"):
        inside(root, name)
