import os
from pathlib import Path

import pytest

from services import doctor
from services.cli.arguments import exit_code
from services.distributed.node_info import NodeFacts, facts
from services.doctor import Finding, examine

GOOD = NodeFacts(
    name="one", versions={"python": "3.11.7", "torch": "2.13.0"}, packages="torch==2.13.0", cores=4, cpus=4.0,
    memory=10**11, shared_memory=10**10, disk=10**12, threads="1", drawing="egl", draws=True, sees_mark=True,
)  # fmt: skip


def of(findings: list[Finding], what: str) -> Finding:
    (found,) = (finding for finding in findings if finding.what == what)
    return found


def test_two_equal_nodes_are_good():
    findings = list(examine([GOOD, GOOD._replace(name="two")]))
    assert {finding.verdict for finding in findings} == {"good"}
    assert not any(finding.remedy for finding in findings)
    assert {"versions", "one: disk", "two: clock", "two: shared storage"} <= {finding.what for finding in findings}


@pytest.mark.parametrize(
    ("changed", "what", "verdict", "got", "remedy"),
    [
        ({"versions": {"python": "3.11.7", "torch": "2.13.1"}}, "versions", "bad",
         "torch 2.13.0 on one, 2.13.1 on two", "constraints.txt"),
        ({"packages": "torch==2.13.0 zlib==1"}, "versions", "warning", "other packages differ", "constraints.txt"),
        ({"disk": 10**9}, "two: disk", "bad", "1.0 GB, wanted 2.0", "--runs"),
        ({"memory": 10**9}, "two: memory for 4 workers", "bad", "1.0 GB, wanted 2.8", "fewer CPUs"),
        ({"shared_memory": 64 * 10**6}, "two: /dev/shm", "bad", "0.1 GB, wanted 0.5", "--shm-size"),
        ({"cpus": 8.0}, "two: CPUs", "warning", "Ray counts 8, there are 4 cores", "--num-cpus"),
        ({"threads": "4"}, "two: CPUs", "warning", "OMP_NUM_THREADS=4", "set it to 1"),
        ({"draws": False, "drawing": "no GL"}, "two: drawing", "warning", "no GL", "libegl1"),
        ({"skew": -2.5}, "two: clock", "warning", "-2.50 s", "NTP"),
        ({"sees_mark": False}, "two: shared storage", "bad", "does not see", "mount the same folder"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_node_is_reported_with_a_remedy(changed, what: str, verdict: str, got: str, remedy: str):
    findings = list(examine([GOOD, GOOD._replace(name="two", **changed)]))
    found = of(findings, what)
    assert (found.verdict, [f.what for f in findings if f.verdict != "good"]) == (verdict, [what])
    assert got in found.got
    assert remedy in found.remedy


def test_the_facts_of_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "mark").touch()
    found = facts(str(tmp_path / "runs" / "not" / "there"), "mark")
    assert found.cores == found.cpus == len(os.sched_getaffinity(0))
    assert not found.sees_mark
    assert facts(str(tmp_path), "mark").sees_mark
    monkeypatch.setenv("MUJOCO_GL", "none")
    assert not facts(str(tmp_path), "mark").draws


@pytest.fixture
def short_mlflow(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the program sets in this process is undone."""
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", doctor.SECONDS_FOR_MLFLOW)


@pytest.mark.usefixtures("short_mlflow")
def test_a_machine_is_examined_and_left_as_it_was(programs, workplace: Path, capfd, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS")
    code, printed = programs("doctor")
    assert code == 0, printed
    assert "all that a run needs is there" in printed
    assert list(workplace.iterdir()) == []

    (workplace / "file").touch()
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://user:secret@127.0.0.1:1")
    assert exit_code(doctor.run, ["--runs", "file"]) == 1
    printed = "".join(capfd.readouterr())
    assert "2 of 9 checks are bad: storage of runs, MLflow" in printed
    assert "secret" not in printed


@pytest.mark.thorough
@pytest.mark.usefixtures("joined", "short_mlflow")
def test_a_cluster_is_examined_by_node(workplace: Path, capfd):
    doctor.run([])
    printed = "".join(capfd.readouterr())
    assert "shared storage" not in printed  # one node shares with nobody
    assert "Ray counts 3" in printed or len(os.sched_getaffinity(0)) >= 3
    assert list((workplace / "runs").iterdir()) == []
