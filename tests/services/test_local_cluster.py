"""What ``make cluster`` starts: real servers, found by their processes and ports."""

import ipaddress
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from services import local_cluster

SUBMIT = [sys.executable, "-m", "ray.scripts.scripts", "job", "submit"]


@pytest.fixture
def ports(free_port: Callable[[], int]) -> list[str]:
    ports = [str(free_port()) for _ in range(3)]
    return ["--ray-port", ports[0], "--dashboard-port", ports[1], "--mlflow-port", ports[2], "--cpus", "1",
            "--object-store-megabytes", "100"]  # fmt: skip


@pytest.fixture
def own_token(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' shell has no token, as a newcomer's."""
    monkeypatch.delenv("RAY_AUTH_TOKEN")


@pytest.fixture
def started(programs, own_token: None, ports: list[str], workplace: Path) -> Iterator[tuple[Path, str]]:
    """A cluster of its own, and what it said when it was started."""
    before = set(Path("/dev/shm").iterdir())
    code, printed = programs("local_cluster", "start", *ports)
    assert code == 0, printed
    yield workplace / "cluster", printed
    if (workplace / "cluster" / "cluster.json").exists():
        programs("local_cluster", "stop")
    assert set(Path("/dev/shm").iterdir()) <= before


def processes_of(folder: Path) -> list[psutil.Process]:
    record = local_cluster.Record.read(folder)
    assert record is not None
    parents = [process for started in record.processes if (process := started.process())]
    return [*parents, *(child for process in parents for child in process.children(recursive=True))]


def ended(processes: list[psutil.Process]) -> bool:
    return not any(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in processes)


@pytest.mark.thorough
@pytest.mark.alone
def test_a_cluster_takes_jobs_with_its_token_and_leaves_nothing_behind(started, programs, answers, wait_for):
    folder, printed = started
    dashboard, mlflow = re.findall(r"^(?:Ray dashboard|MLflow): +(\S+)", printed, re.MULTILINE)
    assert answers(dashboard)
    assert answers(f"{mlflow}/health")
    assert (folder / "token").stat().st_mode & 0o777 == 0o600
    connections = [connection for process in processes_of(folder) for connection in process.net_connections("tcp")]
    listening = {connection.laddr[0] for connection in connections if connection.status == psutil.CONN_LISTEN}
    assert listening
    assert all(ipaddress.ip_address(address.removeprefix("::ffff:")).is_loopback for address in listening)

    command = next(line for line in printed.splitlines() if "job submit" in line).partition(" -- ")[0]
    job = f"{sys.executable} -c \"import os; print('to', os.environ['MLFLOW_TRACKING_URI'], os.getcwd())\""
    submitted = subprocess.run(f"{command} -- {job}", shell=True, capture_output=True, text=True)
    assert submitted.returncode == 0, submitted.stdout + submitted.stderr
    assert f"to {mlflow} {folder.parent}" in submitted.stdout
    for environment, complaint in (({}, "Missing"), ({"RAY_AUTH_TOKEN": "0" * 64}, "Invalid")):
        refused = subprocess.run(
            [*SUBMIT, "--address", dashboard, "--", "true"], capture_output=True, text=True,
            env={**os.environ, "RAY_AUTH_MODE": "token" if environment else "disabled", **environment},
        )  # fmt: skip
        assert refused.returncode == 1
        assert complaint in refused.stdout + refused.stderr

    code, said = programs("local_cluster", "start")
    assert code == 2
    assert f"got a cluster that runs, Ray at {dashboard} and MLflow at {mlflow}" in said

    there = processes_of(folder)
    record = json.loads((folder / "cluster.json").read_text())
    code, said = programs("local_cluster", "stop")
    assert (code, said) == (0, f"stopped: {len(there)} processes\n")
    assert ended(there)
    assert not Path(record["temporary"]).exists()
    code, said = programs("local_cluster", "stop")
    assert code == 2
    assert "got no cluster.json" in said


@pytest.mark.thorough
@pytest.mark.alone
def test_what_is_left_of_a_killed_cluster_is_stopped_by_the_next_start(started, programs, ports):
    folder, _ = started
    there = processes_of(folder)
    ray = next(own for own in local_cluster.Record.read(folder).processes if own.name == "ray")  # pyright: ignore
    os.kill(ray.pid, signal.SIGKILL)
    code, said = programs("local_cluster", "start", *ports)
    assert code == 0, said
    assert "a cluster from before ended without being stopped" in said
    assert ended(there)


def test_a_taken_port_is_named_with_who_holds_it(programs, own_token: None, ports: list[str]):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        code, said = programs("local_cluster", "start", *ports[:-2], "--mlflow-port", str(other.getsockname()[1]))
    assert code == 2
    assert f"--mlflow-port: got {other.getsockname()[1] if other.fileno() >= 0 else ''}" in said
    assert f"(process {os.getpid()}) listens; wanted a free one" in said


def test_want_of_room_a_stale_token_and_a_damaged_note_are_told(
    programs, own_token: None, ports, workplace: Path, monkeypatch
):
    code, said = programs("local_cluster", "start", *ports[:-2], "--object-store-megabytes", "100000000")
    assert code == 2
    assert "/dev/shm: got" in said
    assert "wanted 100000000 MB; --object-store-megabytes less" in said
    monkeypatch.setenv("RAY_AUTH_TOKEN", "stale")
    code, said = programs("local_cluster", "start", *ports)
    assert code == 2
    assert "RAY_AUTH_TOKEN: got another token than that in" in said
    monkeypatch.delenv("RAY_AUTH_TOKEN")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", "elsewhere")
    code, said = programs("local_cluster", "start", *ports)
    assert code == 2
    assert "RAY_AUTH_TOKEN_PATH: got elsewhere" in said
    monkeypatch.delenv("RAY_AUTH_TOKEN_PATH")
    (workplace / "cluster" / "cluster.json").write_text("{}")
    code, said = programs("local_cluster", "start", *ports)
    assert code == 2
    assert "cluster.json: got processes" in said
