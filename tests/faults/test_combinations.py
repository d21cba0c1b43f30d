"""A minute of `make fuzz`."""

import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]


@pytest.mark.thorough
def test_the_promises_hold_in_combinations():
    command = [sys.executable, "-m", "tests.faults.combinations", "--first", "3", "--count", "7"]
    tried = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True)
    print(tried.stdout)
    assert tried.returncode == 0, tried.stderr
