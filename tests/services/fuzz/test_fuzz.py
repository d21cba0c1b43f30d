"""Whatever the input, a reader reads it rightly or refuses it with an error of ours that names the file.

500 mutated inputs in an ordinary run, 10,000 with ``pytest -m fuzz``.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PROJECT = HERE.parents[2]
READERS = ("config", "checkpoint", "dataset", "npz", "rows", "metrics")

pytestmark = pytest.mark.fuzz


def python(*arguments: str, seconds: float) -> subprocess.CompletedProcess[str]:
    """Run Python where it finds the guards and the readers."""
    environment = {**os.environ, "PYTHONPATH": f"{HERE}{os.pathsep}{PROJECT}", "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=seconds
    )


@pytest.fixture(scope="session")
def reports(shares: Mapping[str, int], tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, float]]:
    """What came of each reader's inputs; a reader that met with a fault has no report."""
    folder = tmp_path_factory.mktemp("fuzz")
    wanted = [f"{name}={share}" for name, share in shares.items()]
    ran = python(str(HERE / "trials.py"), str(folder), *wanted, seconds=120 + sum(shares.values()) / 4)
    faults = [path.read_text() for path in sorted(folder.glob("*.fault"))]
    assert not faults, f"the inputs are in {folder}\n" + "\n".join(faults)
    assert ran.returncode == 0, ran.stderr
    found = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    print(json.dumps(found))
    return found


@pytest.mark.parametrize("name", READERS)
def test_an_input_is_read_rightly_or_refused_by_name(reports, shares: Mapping[str, int], name: str):
    assert reports[name]["inputs"] >= shares[name]
    assert reports[name]["refused"] > 0
    assert reports[name]["read"] > 0, "no input was sound: nothing shows that sound ones are read"


def test_there_are_as_many_inputs_as_promised(reports, request: pytest.FixtureRequest):
    inputs = sum(report["inputs"] for report in reports.values())
    assert inputs >= (10_000 if request.config.option.markexpr == "fuzz" else 500)
    assert set(reports) == set(READERS)


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
    ran = python("-c", READING.format(deed), seconds=30)
    assert ran.returncode != 0
    assert complaint in ran.stderr


def test_a_guard_lets_a_reader_read():
    ran = python("-c", READING.format("open('/etc/hostname').read(); bytearray(2**20)"), seconds=30)
    assert (ran.returncode, ran.stdout) == (0, "read\n"), ran.stderr
