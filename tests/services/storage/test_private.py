"""What lies between the processes of one user: a folder of their own, and no proxy."""

import os
import tempfile
from pathlib import Path

import pytest

from services.storage.private import bypass_proxies, private_folder

SESSION = "ray/session_2026-11-30_07-13-40_123456_4194304/sockets/dash_UsageStatsHead"
"""As deep as Ray goes, with the largest number of a process."""
LONGEST_SOCKET = 107


@pytest.fixture
def base(monkeypatch: pytest.MonkeyPatch):
    """Sets where temporary files go."""

    def set_base(folder: Path) -> None:
        monkeypatch.setenv("TMPDIR", str(folder))
        monkeypatch.setattr(tempfile, "tempdir", None)

    return set_base


def test_a_private_folder_is_closed_and_goes_with_all_that_is_in_it():
    with private_folder() as folder:
        assert folder.stat().st_mode & 0o777 == 0o700
        assert folder.stat().st_uid == os.geteuid()
        (folder / "open").mkdir(mode=0o777)
        (folder / "open" / "file").touch()
    assert not folder.exists()


def test_a_long_or_missing_folder_for_temporary_files_is_not_used(tmp_path: Path, base):
    base(tmp_path)
    assert len(str(tmp_path)) > 30
    with private_folder() as folder:
        assert len(os.fsencode(folder / SESSION)) <= LONGEST_SOCKET
        assert not folder.is_relative_to(tmp_path)


def test_a_short_folder_for_temporary_files_is_used(base):
    with tempfile.TemporaryDirectory(prefix="s", dir="/tmp") as short:
        base(Path(short))
        with private_folder() as folder:
            assert folder.parent == Path(short)
            assert len(os.fsencode(folder / SESSION)) <= LONGEST_SOCKET


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({}, "localhost,127.0.0.1,::1"),
        ({"no_proxy": "intern"}, "intern,localhost,127.0.0.1,::1"),
        ({"NO_PROXY": "intern"}, "intern,localhost,127.0.0.1,::1"),
        ({"no_proxy": "*"}, "*"),
    ],
)
def test_proxies_are_bypassed_on_this_machine_alone(given: dict[str, str], wanted: str):
    environment = dict(given)
    for _ in range(2):
        bypass_proxies(environment)
        assert environment == {"no_proxy": wanted, "NO_PROXY": wanted}
