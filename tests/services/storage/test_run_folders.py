"""A new run's name is taken by one of those that want it, and what is no run of ours is not gone on with."""

import os
from pathlib import Path

import pytest

from dmil_core.errors import UserError
from services.storage.run_folders import find_folder, make_folder, new_name


@pytest.mark.parametrize("make", [Path.mkdir, Path.touch, os.mkfifo, lambda path: path.symlink_to("nowhere")])
def test_a_name_that_is_taken_meanwhile_is_refused(tmp_path: Path, make):
    folder = new_name("run", tmp_path / "runs")
    make_folder(new_name("other", tmp_path / "runs"))
    make(folder)
    with pytest.raises(UserError, match="runs/run, which is taken; wanted a new name, or --resume"):
        make_folder(folder)
    with pytest.raises(UserError, match=r"got .*runs/run, "):
        new_name("run", tmp_path / "runs")


def test_a_pipe_marks_no_run(tmp_path: Path):
    (tmp_path / "run").mkdir()
    os.mkfifo(tmp_path / "run" / "config.json")
    with pytest.raises(UserError, match=r"--resume: got 'run'; wanted a folder with a config\.json"):
        find_folder("run", tmp_path, "config.json")
