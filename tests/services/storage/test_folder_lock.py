"""A folder has one process at work in it, and is free when that ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from dmil_core.files import ForeignFileError
from services.storage.folder_lock import LOCK, held

HOLDS = """
import sys
from pathlib import Path
from services.storage.folder_lock import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_is_told_which_holds_a_folder_and_a_killed_one_frees_it(tmp_path: Path):
    command = [sys.executable, "-c", HOLDS, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=rf"{tmp_path}: got process {other.pid} of \S+, since 2"), held(tmp_path):
            pytest.fail("held twice")
        with held(tmp_path, "another.lock"):
            other.send_signal(signal.SIGKILL)
            other.wait()
        with held(tmp_path), pytest.raises(UserError, match=f"process {os.getpid()} of"), held(tmp_path):
            pytest.fail("held twice")


def test_a_lock_that_is_a_link_is_refused(tmp_path: Path):
    (tmp_path / LOCK).symlink_to("victim")
    with pytest.raises(ForeignFileError, match="got a link"), held(tmp_path):
        pytest.fail("held all the same")
    assert not (tmp_path / "victim").exists()


def test_what_stands_in_a_lock_is_not_believed(tmp_path: Path):
    (tmp_path / LOCK).write_bytes(b"\xff" * 10**6)
    with held(tmp_path):
        assert len((tmp_path / LOCK).read_bytes()) < 200
        (tmp_path / LOCK).write_bytes(b"{}")
        with pytest.raises(UserError, match="got another process at work"), held(tmp_path):
            pytest.fail("held twice")
