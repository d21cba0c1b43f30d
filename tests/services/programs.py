"""What tests start and wait for: programs, a Ray cluster, an MLflow server."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import psutil

PROJECT = Path(__file__).parents[2]
ON_RAY = {"cluster", "joined"}
"""Fixtures of the session's Ray cluster."""
QUICK_EVALUATION = ("--evaluation.shots", "1", "--evaluation.episodes", "1", "--evaluation.fine-tuning-steps", "1")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(condition: Callable[[], bool], what: str) -> None:
    print(f"waiting for {what}")  # shown where the test's own limit ends it
    while not condition():
        time.sleep(0.1)


def answers(url: str) -> bool:
    """Tell whether a server answers with anything at all."""
    try:
        urllib.request.urlopen(url, timeout=5).close()
    except urllib.error.HTTPError:
        return True
    except OSError:
        return False
    return True


class Doors(NamedTuple):
    """What another user of the machine tried, and what let it in."""

    ports: int
    sockets: int
    paths: int
    doors: list[str]


def shared_memory_of(processes: list[psutil.Process]) -> set[Path]:
    """Return the files in memory that processes have open."""
    found = set[Path]()
    for process in processes:
        with suppress(psutil.Error):
            found |= {Path(part.path) for part in process.memory_maps() if part.path.startswith("/dev/shm/")}
    return found


class Cluster(NamedTuple):
    """A Ray cluster on loopback, started from the project's root as a user would."""

    address: str
    dashboard: str | None
    """Its address, which takes jobs; its ten processes take as long to start as all others."""
    head: int
    """The process that started it."""


class Head:
    """One `ray start --head` with room for three workers, which is there from the first test that wants it."""

    def __init__(self, log: Path) -> None:
        self._log, self._folder = log, ""
        self._process: subprocess.Popen[bytes] | None = None
        self._cluster: Cluster | None = None

    def cluster(self, *, dashboard: bool) -> Cluster:
        """Start it, unless it runs, with a dashboard where one is wanted."""
        if self._cluster is None or (dashboard and self._cluster.dashboard is None):
            self.stop()
            self._folder = tempfile.mkdtemp(prefix="dmil")  # Ray's sockets lie in it: over 107 bytes are too long
            self._process, self._cluster = self._start(dashboard)
            for _ in range(2):  # somebody else was faster to take one of its ports, or is so busy that Ray gives up
                if self._process.poll() is not None:
                    self._process, self._cluster = self._start(dashboard)
            assert self._process.poll() is None, self._log.read_text()
        return self._cluster

    def _start(self, dashboard: bool) -> tuple[subprocess.Popen[bytes], Cluster]:
        """Start Ray, and wait until it answers or has ended."""
        port, dashboard_port = free_port(), free_port()
        command = [
            sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--num-cpus=3",
            "--node-ip-address=127.0.0.1", f"--port={port}", "--dashboard-host=127.0.0.1",
            f"--dashboard-port={dashboard_port}", f"--include-dashboard={dashboard}", f"--temp-dir={self._folder}",
            f"--dashboard-agent-listen-port={free_port()}",  # another cluster may hold the usual one
            "--object-store-memory=200000000", "--disable-usage-stats", "--include-log-monitor=false",
        ]  # fmt: skip
        unbuffered = os.environ | {"PYTHONUNBUFFERED": "1"}
        with self._log.open("w") as output:
            head = subprocess.Popen(command, cwd=PROJECT, stdout=output, stderr=output, env=unbuffered)
        url = f"http://127.0.0.1:{dashboard_port}" if dashboard else None
        cluster = Cluster(f"127.0.0.1:{port}", url, head.pid)

        def is_up() -> bool:
            """Tell also whether its node is: the dashboard is there before."""
            return "Ray runtime started" in self._log.read_text() and (url is None or answers(f"{url}/api/version"))

        wait_for(lambda: is_up() or head.poll() is not None, "ray start")
        return head, cluster

    def stop(self) -> None:
        """End it, if it runs: its processes are never quite idle."""
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait()
            shutil.rmtree(self._folder, ignore_errors=True)
        self._process = self._cluster = None


class Server:
    """A real MLflow server on loopback that can go away and come back with its database."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [
            sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{self.folder}/server.db",
            "--artifacts-destination", str(self.folder / "artifacts"), "--host", "127.0.0.1", "--port", str(self.port),
            "--workers", "1",
        ]  # fmt: skip
        with (self.folder / "server.log").open("a") as log:
            environment = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}  # of eight processes more
            self._process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=environment)
        wait_for(lambda: answers(f"{self.uri}/health"), "mlflow server")

    def stop(self) -> None:
        if self._process is not None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait()
            self._process = None
            wait_for(lambda: not answers(f"{self.uri}/health"), "the end of mlflow server")


class Programs:
    """Starts programs as a user does, in the test's working directory and environment."""

    def __init__(self) -> None:
        self._started: list[subprocess.Popen[str]] = []

    def start(self, name: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", f"services.{name}", *arguments]
        program = subprocess.Popen(
            command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True
        )
        self._started.append(program)
        return program

    def __call__(self, name: str, *arguments: str) -> tuple[int, str]:
        """Run a program to its end; return its exit code, and what it printed."""
        program = self.start(name, *arguments)
        printed, _ = program.communicate()
        return program.returncode, printed

    def kill(self) -> None:
        """End what a failed test has left running."""
        for program in self._started:
            if program.poll() is None:
                os.killpg(program.pid, signal.SIGKILL)
                program.communicate()
