"""What listens does so on loopback, strangers are refused, and secrets stay where they were given."""

import ipaddress
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import psutil
import pytest

from services.storage.checkpoints import Checkpoints
from services.tracking.tracker import Tracker
from tests.services.programs import QUICK_EVALUATION

PROJECT = Path(__file__).parents[2]
SECURED_BY = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "RAY_USAGE_STATS_ENABLED")


def holding(secret: str, *places: Path) -> list[Path]:
    """Return the files below some folders that hold a secret."""
    files = [path for place in places for path in place.rglob("*") if path.is_file() and not path.is_symlink()]
    assert len(files) > 3, "a search among nothing finds nothing"
    return [path for path in files if secret.encode() in path.read_bytes()]


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A folder for Ray, whose sockets cannot lie as deep as pytest's."""
    folder = Path(tempfile.mkdtemp(prefix="dmil"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def listening(program: int) -> dict[str, str]:
    """Return the addresses that a program and all that it started listen on, and who does."""
    found = {}
    for process in (parent := psutil.Process(program), *parent.children(recursive=True)):
        try:
            for connection in process.net_connections("inet"):
                if connection.status == psutil.CONN_LISTEN or not connection.raddr:
                    found[connection.laddr.ip] = f"{process.name()}, port {connection.laddr.port}"
        except psutil.NoSuchProcess:
            continue
    return found


def on_loopback(address: str) -> bool:
    parsed = ipaddress.ip_address(address)
    return (getattr(parsed, "ipv4_mapped", None) or parsed).is_loopback


@pytest.mark.parametrize(
    ("address", "wanted"),
    [("127.0.0.1", True), ("::1", True), ("::ffff:127.0.0.1", True), ("0.0.0.0", False), ("::", False)],
)
def test_loopback_is_recognised(address: str, wanted: bool):
    assert on_loopback(address) == wanted


def test_a_cluster_as_the_readme_starts_it_listens_on_loopback(cluster):
    port = int(cluster.address.rpartition(":")[2])
    servers = [process for process in psutil.process_iter(["name"]) if process.info["name"] == "gcs_server"]
    head = next(
        server.parent() for server in servers if any(link.laddr.port == port for link in server.net_connections("inet"))
    )
    assert head is not None
    found = listening(head.pid)
    assert len(found) > 0
    assert {address: who for address, who in found.items() if not on_loopback(address)} == {}


FAILS = """
import os, shutil, sys, time
from pathlib import Path
from services import meta_train
from services.cli.arguments import exit_code
from services.experiments.experiment import Experiment
def fail(*arguments):
    while not Path("looked").exists():
        time.sleep(0.1)
    shutil.copytree(os.environ["RAY_TMPDIR"], "of-ray", symlinks=True, ignore=shutil.ignore_patterns("sockets"))
    raise ZeroDivisionError("made to fail")
Experiment.evaluate = fail
sys.exit(exit_code(meta_train.run, sys.argv[1:]))
"""


@pytest.mark.thorough
def test_a_run_on_ray_lets_nobody_in_and_keeps_its_secrets_when_it_fails(
    workplace: Path, short_folder: Path, free_port, wait_for, doors, monkeypatch
):
    planted = {name: secrets.token_hex(32) for name in ("user", "password", "token")}
    for name in SECURED_BY:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("RAY_TMPDIR", str(short_folder))
    monkeypatch.setenv("RAY_ADDRESS", "")
    monkeypatch.setenv("HOME", str(workplace))
    monkeypatch.setenv("RAY_AUTH_TOKEN", planted["token"])
    address = f"http://{planted['user']}:{planted['password']}@127.0.0.1:{free_port()}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
    monkeypatch.setenv("PYTHONPATH", str(PROJECT))
    arguments = ["--preset", "ml10-smoke", "--name", "run", "--training.checkpoint-every", "5"]
    arguments += ["--training.iterations", "10"]
    with (workplace / "printed").open("w") as output:
        program = subprocess.Popen(
            [sys.executable, "-c", FAILS, *arguments], stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
    checkpoints = Checkpoints(workplace / "runs" / "run" / "checkpoints", 3)
    wait_for(lambda: bool(checkpoints.all()) or program.poll() is not None, "the first checkpoint")
    found, let_in = listening(program.pid), doors(*short_folder.iterdir(), program.pid)
    (workplace / "looked").touch()
    program.wait()
    printed = (workplace / "printed").read_text()
    assert found, printed
    assert {address: who for address, who in found.items() if not on_loopback(address)} == {}

    assert program.returncode == 1
    assert "Traceback" in printed
    assert "ZeroDivisionError: made to fail" in printed
    assert "MLflow at http://...@127.0.0.1" in printed
    assert "dmil tracking flush runs/run" in printed
    if let_in is not None:
        assert set(let_in.doors) <= {"figures: autoscaler_worker_cr", "figures: ray_dashboard_api_re"}
        assert let_in.ports > 5
        assert let_in.sockets > 1
        assert let_in.paths > 50
    assert list(short_folder.iterdir()) == [], "what Ray made is gone"
    assert not (workplace / ".ray").exists()
    assert any("gcs_server" in path.name for path in (workplace / "of-ray").rglob("*.out")), "Ray's logs are elsewhere"
    for name, secret in planted.items():
        assert holding(secret, workplace) == [], name


@pytest.mark.thorough
def test_a_whole_run_keeps_its_secrets(programs, train, workplace: Path, monkeypatch):
    planted = secrets.token_hex(32)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{workplace / 'store.db'}")
    for name in ("MLFLOW_TRACKING_USERNAME", "MLFLOW_TRACKING_PASSWORD", "MLFLOW_TRACKING_TOKEN", "RAY_AUTH_TOKEN"):
        monkeypatch.setenv(name, planted)
    short = ("--training.iterations", "2", "--training.checkpoint-every", "2", *QUICK_EVALUATION)
    code, printed = programs("meta_train", "--preset", "ml10-smoke", "--runner", "local", "--name", "run", *short)
    assert (code, printed.count(planted)) == (0, 0), printed
    assert (workplace / "store.db").exists()
    assert (workplace / "mlartifacts").is_dir()
    assert holding(planted, workplace) == []


class Refusing(BaseHTTPRequestHandler):
    """An MLflow server that lets nobody in."""

    asked: list[str]

    def do_GET(self) -> None:
        self.asked.append(str(self.headers["Authorization"]))
        self.send_error(403)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@pytest.mark.parametrize(
    ("where", "scheme"),
    [("address", "Basic"), ("MLFLOW_TRACKING_PASSWORD", "Basic"), ("MLFLOW_TRACKING_TOKEN", "Bear")],
)
def test_a_refused_tracker_tells_no_secret(tmp_path: Path, where: str, scheme: str, wait_for, logged, monkeypatch):
    planted = secrets.token_hex(16)
    handler = type("Handler", (Refusing,), {"asked": []})
    server = HTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    user = f"user:{planted}@" if where == "address" else ""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://{user}127.0.0.1:{server.server_address[1]}")
    if where != "address":
        monkeypatch.setenv("MLFLOW_TRACKING_USERNAME", "user" if "PASSWORD" in where else "")
        monkeypatch.setenv(where, planted)
    tracker = Tracker(tmp_path, "refused")
    wait_for(lambda: bool(logged()), "a refusal")
    assert not tracker.close("FINISHED")
    server.shutdown()
    server.server_close()
    assert handler.asked[0].startswith(scheme), "the secret was used"
    assert not any(planted in text for text in (*logged(), tracker.uri))
    assert "403" in logged()[0]
    assert all(planted not in path.read_text() for path in tmp_path.iterdir())


@pytest.mark.parametrize(
    ("environment", "refusal"),
    [
        ({"RAY_AUTH_MODE": "disabled"}, "Unauthorized: Missing authentication token"),
        ({"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}, "Forbidden: Invalid authentication token"),
    ],
    ids=["no token", "a wrong token"],
)
def test_a_stranger_s_job_is_refused(cluster, tmp_path: Path, environment: dict[str, str], refusal: str):
    without = {name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")}
    command = [
        sys.executable, "-m", "ray.scripts.scripts", "job", "submit", "--address", cluster.dashboard, "--",
        "touch", str(tmp_path / "ran"),
    ]  # fmt: skip
    submitted = subprocess.run(
        command, env={**without, **environment, "HOME": str(tmp_path)}, capture_output=True, text=True
    )
    assert submitted.returncode != 0
    assert refusal in (printed := submitted.stdout + submitted.stderr), printed
    body = json.dumps({"entrypoint": f"touch {tmp_path / 'ran'}"}).encode()
    token = {"Authorization": f"Bearer {environment['RAY_AUTH_TOKEN']}"} if "RAY_AUTH_TOKEN" in environment else {}
    request = urllib.request.Request(
        f"{cluster.dashboard}/api/jobs/", body, {"Content-Type": "application/json", **token}
    )
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request)
    assert refused.value.code == (403 if token else 401)
    refused.value.close()

    ours = {"Authorization": f"Bearer {os.environ['RAY_AUTH_TOKEN']}"}
    with urllib.request.urlopen(urllib.request.Request(f"{cluster.dashboard}/api/jobs/", headers=ours)) as answer:
        jobs = json.load(answer)
    assert [job for job in jobs if str(tmp_path) in job["entrypoint"]] == []
    assert not (tmp_path / "ran").exists()
