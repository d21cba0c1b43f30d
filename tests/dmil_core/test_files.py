"""Files are written whole or not at all, and read only as far as is sane."""

import errno
import os
from pathlib import Path

import pytest

from dmil_core.files import (
    DiskFullError,
    ForeignFileError,
    append_to,
    copy_plain,
    inside,
    making_folder,
    named,
    read_file,
    remove_abandoned,
    remove_file,
    remove_folder,
    room_for,
    write_file,
)


def test_a_file_is_written_whole_and_in_place_of_another(tmp_path: Path):
    path = tmp_path / "file"
    for content in (b"one", b"another"):
        write_file(tmp_path, "file", content)
        assert read_file(tmp_path, "file", 10) == content
    write_file(tmp_path, "file", "wörter")
    assert path.read_text("utf-8") == "wörter"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "words", ["No space left on device", "I/O error: os error 28", "Can't write (errno = 28)", "(errno = 27, a quota)"]
)
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


def test_a_disk_that_does_not_tell_its_size_is_not_full():
    """Such as a network disk's; here it is that of the kernel's own folder."""
    with room_for(Path("/proc/self/file"), 2**70):
        pass


def test_other_errors_stay_what_they_are(tmp_path: Path):
    with pytest.raises(PermissionError), room_for(tmp_path / "file", 1):
        raise PermissionError(errno.EACCES, "no")


def test_only_regular_files_up_to_a_size_are_read(tmp_path: Path):
    (tmp_path / "large").write_bytes(b"12345")
    os.mkfifo(tmp_path / "pipe")
    for name in ("large", "pipe", ".", "nowhere"):
        with pytest.raises(OSError, match=r".+"):
            read_file(tmp_path, name, 4)
    with pytest.raises(ForeignFileError, match="no regular file"):
        read_file(Path("/dev"), "zero", 4)
    assert read_file(tmp_path, "large", 5) == b"12345"


@pytest.mark.parametrize("name", ["../other", "/etc/passwd", "link/file", "a/../../other", "dangling", "a\0b", ""])
def test_a_path_is_kept_inside_its_root(tmp_path: Path, name: str):
    root = tmp_path / "root"
    root.mkdir()
    (root / "link").symlink_to("/tmp")
    (root / "dangling").symlink_to("nowhere")
    assert inside(root, "a/./b") == root / "a" / "b"
    with pytest.raises(ForeignFileError, match=r"lies outside|got a link"):
        inside(root, name)


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A folder of somebody else's, reached through a link of the user's, with links to the folder ``victim`` in it."""
    for folder in ("victim", "there"):
        (tmp_path / folder).mkdir()
    (tmp_path / "victim" / "file").write_bytes(b"precious")
    (tmp_path / "root").symlink_to("there")
    (tmp_path / "there" / "folder").symlink_to("../victim")
    (tmp_path / "there" / "file").symlink_to("../victim/file")
    (tmp_path / "there" / "dangling").symlink_to("../victim/new")
    os.mkfifo(tmp_path / "there" / "pipe")
    return tmp_path / "root"


def test_a_folder_may_be_a_link_and_nothing_below_it(foreign: Path):
    write_file(foreign, "new/own", b"1")
    assert read_file(foreign, "new/own", 1) == b"1"
    assert read_file(*named(foreign / "file"), 8) == b"precious", "the user names it"
    for name in ("file", "folder/file", "dangling", "pipe"):
        with pytest.raises(ForeignFileError, match=r"got (a link|no regular file)"):
            read_file(foreign, name, 10)
        with pytest.raises(ForeignFileError, match=r"got (a link|no regular file)"):
            append_to(foreign, name)
    with pytest.raises(ForeignFileError, match="folder: got a link"):
        write_file(foreign, "folder/file", b"other")
    with pytest.raises(ForeignFileError, match="folder: got a link"), making_folder(foreign, "folder/made"):
        pytest.fail("made all the same")
    for name in ("file", "dangling", "pipe"):
        write_file(foreign, name, b"own")
        assert read_file(foreign, name, 3) == b"own", "a link is replaced"
    victim = foreign.parent / "victim"
    assert [path.name for path in victim.iterdir()] == ["file"]
    assert (victim / "file").read_bytes() == b"precious"


def test_only_what_is_plain_is_copied(foreign: Path, tmp_path: Path):
    write_file(foreign, "report/pictures/one", b"1")
    (foreign / "report" / "key").symlink_to("../../victim/file")
    (foreign / "report" / "more").symlink_to("../../victim")
    os.mkfifo(foreign / "report" / "pipe")
    left_out = copy_plain(foreign, "report", tmp_path / "copy")
    assert {path.name for path in left_out} == {"key", "more", "pipe"}
    assert [path for path in (tmp_path / "copy").rglob("*") if path.is_file()] == [tmp_path / "copy/pictures/one"]
    copy_plain(foreign, "report/pictures/one", tmp_path / "alone")
    assert (tmp_path / "alone" / "one").read_bytes() == b"1"
    for name in ("file", "folder", "folder/file", "report/more", "pipe"):
        with pytest.raises(ForeignFileError):
            copy_plain(foreign, name, tmp_path / "none")


def test_only_folders_of_our_making_are_removed(foreign: Path):
    (foreign / ".writing-link").symlink_to("../victim")
    (foreign / ".writing-0a").symlink_to("../victim")
    (foreign / ".writing-of-mine").mkdir()
    (foreign / ".writing-0b").write_bytes(b"a file")
    (foreign / ".writing-0c").mkdir()
    remove_abandoned(foreign.parent, "there")
    assert {path.name for path in foreign.glob(".writing-*")} == {
        ".writing-link", ".writing-0a", ".writing-of-mine", ".writing-0b",
    }  # fmt: skip
    remove_file(foreign, "file")
    with pytest.raises(OSError, match="symbolic link"):
        remove_folder(foreign, "folder")
    assert (foreign.parent / "victim" / "file").exists()


def test_a_folder_is_made_whole_or_not_at_all(tmp_path: Path):
    with pytest.raises(IsADirectoryError), making_folder(tmp_path, "made") as made:
        made.read_bytes()
    assert not list(tmp_path.iterdir())
    with making_folder(tmp_path, "made") as made:
        (made / "one").touch()
    with pytest.raises(FileExistsError), making_folder(tmp_path, "made") as made:
        (made / "two").touch()
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["one"]
    with making_folder(tmp_path, "made", instead=True) as made:
        (made / "two").touch()
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["made", "made/two"]
