"""Whatever the input, a reader reads it rightly or refuses it with an error of ours that names the file.

500 mutated inputs in `make test`, 10,000 in `make test-all`.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PROJECT = HERE.parents[2]
SHARES = {"config": 90, "checkpoint": 120, "dataset": 90, "npz": 100, "rows": 60, "metrics": 40}
"""The number of inputs for each reader, of 500 in all."""
THOROUGH = [pytest.mark.thorough, pytest.mark.timeout(3600)]


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python where it finds the guards and the readers."""
    environment = {**os.environ, "PYTHONPATH": f"{HERE}{os.pathsep}{PROJECT}", "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("times", [1, pytest.param(20, marks=THOROUGH)])
def test_an_input_is_read_rightly_or_refused_by_name(times: int, tmp_path: Path):
    folder = tmp_path / "fuzz"
    folder.mkdir()
    ran = python(str(HERE / "trials.py"), str(folder), *(f"{name}={times * share}" for name, share in SHARES.items()))
    faults = [path.read_text() for path in sorted(folder.glob("*.fault"))]
    assert not faults, f"the inputs are in {folder}\n" + "\n".join(faults)
    assert ran.returncode == 0, ran.stderr
    reports = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    print(json.dumps(reports))
    for name, share in SHARES.items():
        assert reports[name]["inputs"] >= times * share
        assert reports[name]["refused"] > 0
        assert reports[name]["read"] > 0, "no input was sound: nothing shows that sound ones are read"


READING = "from guards import *; set_up(2**28)\nwith guarded(0.5): {}\nprint('read')"


@pytest.mark.parametrize(
    ("deed", "complaint"),
    [
        ("\n while True: pass", "took too long"),
        ("bytearray(2**29)", "MemoryError"),
        ("open('new', 'w')", "opened new to write"),
        ("os.open('new', os.O_CREAT | os.O_RDWR)", "opened new to write"),
        ("os.mkdir('new')", "os.mkdir"),
        ("os.system('true')", "os.system"),
        ("__import__('pickle').loads(b'cposix\\nsystem\\n.')", "pickle.find_class"),
    ],
)
def test_a_guard_stops_a_reader_that_does_other_things(tmp_path: Path, monkeypatch, deed: str, complaint: str):
    monkeypatch.chdir(tmp_path)
    ran = python("-c", READING.format(deed))
    assert ran.returncode != 0
    assert complaint in ran.stderr


def test_a_guard_lets_a_reader_read():
    ran = python("-c", READING.format("open('/etc/hostname').read(); bytearray(2**20)"))
    assert (ran.returncode, ran.stdout) == (0, "read\n"), ran.stderr
