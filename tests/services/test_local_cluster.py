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
from tests.services.programs import shared_memory_of

JOB = """import os, pathlib
from services.tracking.client import connect
print('to', os.environ['MLFLOW_TRACKING_URI'], os.getcwd())
pathlib.Path('artifact').write_text('x' * 3000)
client = connect(os.environ['MLFLOW_TRACKING_URI'])
run = client.create_run(client.create_experiment('x')).info
client.log_artifact(run.run_id, 'artifact')
print(client.list_artifacts(run.run_id)[0].file_size, 'bytes below', run.artifact_uri)"""
PROXY = "http://127.0.0.1:9"
"""Where nobody listens."""
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
def started(
    programs, own_token: None, ports: list[str], workplace: Path, monkeypatch: pytest.MonkeyPatch, wait_for
) -> Iterator[tuple[Path, str]]:
    """A cluster of its own, and what it said when it was started."""
    with monkeypatch.context() as behind_a_proxy:
        behind_a_proxy.setenv("http_proxy", PROXY)
        code, printed = programs("local_cluster", "start", *ports)
    assert code == 0, printed
    wait_for(lambda: bool(shared_memory_of(processes_of(workplace / "cluster"))), "the object store")
    shared = shared_memory_of(processes_of(workplace / "cluster"))
    yield workplace / "cluster", printed
    if (workplace / "cluster" / "cluster.json").exists():
        programs("local_cluster", "stop")
    assert not [path for path in shared if path.exists()]


def processes_of(folder: Path) -> list[psutil.Process]:
    record = local_cluster.Record.read(folder)
    assert record is not None
    parents = [process for started in record.processes if (process := started.process())]
    return [*parents, *(child for process in parents for child in process.children(recursive=True))]


def ended(processes: list[psutil.Process]) -> bool:
    return not any(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in processes)


@pytest.mark.thorough
def test_a_cluster_takes_jobs_with_its_token_and_leaves_nothing_behind(started, programs, answers, doors, ports):
    """Nor does one that was killed, once the next is started."""
    folder, printed = started
    dashboard, mlflow = re.findall(r"^(?:Ray dashboard|MLflow): +(\S+)", printed, re.MULTILINE)
    assert answers(dashboard)
    assert answers(f"{mlflow}/health")
    assert [path.stat().st_mode & 0o777 for path in (folder, folder / "token")] == [0o700, 0o600]
    connections = [connection for process in processes_of(folder) for connection in process.net_connections("tcp")]
    listening = {connection.laddr[0] for connection in connections if connection.status == psutil.CONN_LISTEN}
    assert listening
    assert all(ipaddress.ip_address(address.removeprefix("::ffff:")).is_loopback for address in listening)

    command = next(line for line in printed.splitlines() if "job submit" in line).partition(" -- ")[0]
    job = f'{sys.executable} -c "{JOB}"'
    submitted = subprocess.run(  # noqa: S602  the line as it is printed
        f"{command} -- {job}", shell=True, capture_output=True, text=True, env={**os.environ, "http_proxy": PROXY}
    )
    assert submitted.returncode == 0, submitted.stdout + submitted.stderr
    assert f"to {mlflow} {folder.parent}" in submitted.stdout
    assert "3000 bytes below mlflow-artifacts:/" in submitted.stdout
    assert len(list((folder.parent / "mlartifacts").rglob("artifact"))) == 1
    for environment, complaint in (({}, "Missing"), ({"RAY_AUTH_TOKEN": "0" * 64}, "Invalid")):
        refused = subprocess.run(
            [*SUBMIT, "--address", dashboard, "--", "true"], capture_output=True, text=True,
            env={**os.environ, "RAY_AUTH_MODE": "token" if environment else "disabled", **environment},
        )  # fmt: skip
        assert refused.returncode == 1
        assert complaint in refused.stdout + refused.stderr

    record = json.loads((folder / "cluster.json").read_text())
    found = doors(folder, Path(record["temporary"]), *(process["pid"] for process in record["processes"]))
    if found is not None:
        assert found.doors[0] == "GET /: 200"  # the dashboard's page, which is empty without a token
        assert all(door.startswith("figures: ") for door in found.doors[1:])
        assert min(found.ports, found.sockets) > 5
        assert found.paths > 50

    there = processes_of(folder)
    ray = next(own for own in local_cluster.Record.read(folder).processes if own.name == "ray")  # pyright: ignore
    os.kill(ray.pid, signal.SIGKILL)
    code, said = programs("local_cluster", "start", *ports)
    assert code == 0, said
    assert "a cluster from before ended without being stopped" in said
    assert ended(there)
    assert not Path(record["temporary"]).exists()

    code, said = programs("local_cluster", "start")
    assert code == 2
    assert f"got a cluster that runs, Ray at {dashboard} and MLflow at {mlflow}" in said

    there, record = processes_of(folder), json.loads((folder / "cluster.json").read_text())
    code, said = programs("local_cluster", "stop")
    assert code == 0
    assert re.fullmatch(r"stopped: \d\d processes\n", said)
    assert ended(there)
    assert not Path(record["temporary"]).exists()
    code, said = programs("local_cluster", "stop")
    assert code == 2
    assert "got no cluster.json" in said


def test_a_taken_port_is_named_with_who_holds_it(programs, own_token: None, ports: list[str]):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        code, said = programs("local_cluster", "start", *ports[:-2], "--mlflow-port", str(other.getsockname()[1]))
    assert code == 2
    assert f"--mlflow-port: got {other.getsockname()[1] if other.fileno() >= 0 else ''}" in said
    assert f"(process {os.getpid()}) listens; wanted a free one" in said


def test_want_of_room_a_stale_token_and_a_damaged_note_are_reported(
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


@pytest.mark.parametrize("fault", ["mode", "mark", "name", "link", ""])
def test_a_note_removes_no_folder_but_the_one_that_was_made_for_it(tmp_path: Path, monkeypatch, capsys, fault: str):
    monkeypatch.chdir(tmp_path)
    folder, thesis = tmp_path / "cluster", tmp_path / "thesis"
    folder.mkdir()
    thesis.mkdir(mode=0o755 if fault == "mode" else 0o700)
    (thesis / "text").write_text("chapter 1")
    if fault != "mark":
        (thesis / local_cluster.MARK).write_bytes(os.fsencode(tmp_path / "other" if fault == "name" else folder))
    named = thesis
    if fault == "link":
        named = tmp_path / "link"
        named.symlink_to(thesis)
    record = local_cluster.Record(processes=[], temporary=named, dashboard="", mlflow="")
    (folder / "cluster.json").write_text(record.model_dump_json())
    local_cluster.run(["stop"])
    said = capsys.readouterr().out
    assert (thesis / "text").exists() == bool(fault)
    assert (f"temporary: got {named}, which was not made for this cluster" in said) == bool(fault)
    assert not (folder / "cluster.json").exists()


@pytest.mark.parametrize(
    ("mode", "token_mode", "told"),
    [
        (0o777, 0o600, "cluster: got mode 0777"),
        (0o720, 0o600, "cluster: got mode 0720"),
        (0o700, 0o604, "token: got mode 0604"),
        (0o755, 0o600, None),
    ],
)
def test_a_token_that_others_could_know_is_not_used(
    complaint, own_token: None, tmp_path: Path, monkeypatch, mode: int, token_mode: int, told: str | None
):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "cluster"
    folder.mkdir()
    (folder / "token").write_text("known")
    (folder / "token").chmod(token_mode)
    folder.chmod(mode)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        said = complaint(local_cluster.run, "start", "--ray-port", str(other.getsockname()[1]))
    assert "--ray-port: got" in said
    assert ("open to other users; it is closed, and a new token made" in said) == (told is not None)
    assert told is None or told in said
    token = folder / "token"
    assert (token.read_text() == "known") == (told is None)
    assert token.stat().st_mode & 0o777 == 0o600
    assert not folder.stat().st_mode & 0o022


def test_an_empty_token_is_made_anew_and_a_link_is_refused(complaint, own_token: None, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    token = tmp_path / "cluster" / "token"
    token.parent.mkdir(mode=0o700)
    token.touch(mode=0o600)
    complaint(local_cluster.run, "start", "--object-store-megabytes", "100000000")
    assert re.fullmatch("[0-9a-f]{64}", token.read_text())
    other = token.rename(tmp_path / "other")
    token.symlink_to(other)
    said = complaint(local_cluster.run, "start", "--object-store-megabytes", "100000000")
    assert "token: got a link, or another user's; wanted your own" in said


@pytest.mark.parametrize("port", ["-1", "65536"])
def test_a_port_that_there_is_not_is_named(complaint, own_token: None, tmp_path: Path, monkeypatch, port: str):
    monkeypatch.chdir(tmp_path)
    said = complaint(local_cluster.run, "start", "--ray-port", port)
    assert f"--ray-port: got {port}, which cannot be listened on (bind(): port must be 0-65535.)" in said
