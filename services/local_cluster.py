"""A Ray head and an MLflow server on this machine, on loopback, for Ray jobs: ``make cluster``, ``make cluster-stop``.

Jobs run in the folder that it was started in, and log to that MLflow server. Its token lies in FOLDER/token.
"""

import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import psutil
import tyro
from pydantic import BaseModel, ConfigDict, ValidationError

from dmil_core.errors import RunError, UserError, explain
from services.cli.arguments import exit_code, parse
from services.cli.progress import console
from services.storage.files import read_file, write_file

SECONDS_TO_START = 120.0
SECONDS_TO_STOP = 20.0
SECONDS_FOR_A_JOB = 60
"""A job that is stopped has so long to write its checkpoint; Ray's own is 3 s."""
DISK_BYTES = 2**30
"""For checkpoints and logs, so much must be free at least."""
MOST_BYTES = 100_000
LINES_OF_A_LOG = 15
OURS = {
    "RAY_AUTH_MODE": "token",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # listen on loopback only
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_JOB_STOP_WAIT_TIME_S": str(SECONDS_FOR_A_JOB),
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false",  # 2 processes in place of 10
}


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``local_cluster``."""

    do: Annotated[Literal["start", "stop"], tyro.conf.Positional]
    """What to do."""
    folder: Path = Path("cluster")
    """For the token, the logs and the note of what was started."""
    ray_port: int = 6379
    """Of Ray's head, for nodes and drivers."""
    dashboard_port: int = 8265
    """Of Ray's dashboard, for browsers and jobs."""
    mlflow_port: int = 5000
    """Of the MLflow server."""
    cpus: int | None = None
    """That Ray may use; all of this machine's if not given."""
    object_store_megabytes: int = 500
    """Of memory, for what Ray's processes share."""


class Started(BaseModel):
    """A process, identified by its number and start time: the number alone may be another's by now."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    pid: int
    began: float

    @staticmethod
    def of(name: str, pid: int) -> "Started":
        """Return the record of a running process."""
        return Started(name=name, pid=pid, began=psutil.Process(pid).create_time())

    def process(self) -> psutil.Process | None:
        """Return the process, if it still runs."""
        try:
            process = psutil.Process(self.pid)
            same = process.create_time() == self.began and process.status() != psutil.STATUS_ZOMBIE
            return process if same else None
        except psutil.NoSuchProcess:
            return None


class Record(BaseModel):
    """What was started, ``cluster.json``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    processes: list[Started]
    temporary: Path
    """Ray's folder of sockets and logs."""
    dashboard: str
    mlflow: str

    @staticmethod
    def read(folder: Path) -> "Record | None":
        """Read the record in a folder, if there is one.

        Raises:
            UserError: if it is damaged.
        """
        path = folder / "cluster.json"
        if not path.exists():
            return None
        try:
            return Record.model_validate_json(read_file(path, MOST_BYTES))
        except (OSError, ValidationError) as error:
            got = explain(error) if isinstance(error, ValidationError) else str(error)
            raise UserError(
                f"{path}: got {'; '.join(got.splitlines())}; wanted the note of what was started; look for it with "
                "`ps`, end it, and remove the file"
            ) from error


class Server(NamedTuple):
    """A server to start."""

    name: str
    command: Sequence[str]
    url: str
    """It answers once the server is up."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    settings = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    if settings.do == "start":
        _start(settings)
    else:
        _stop(settings.folder)


def _start(settings: Arguments) -> None:
    folder = settings.folder.absolute()
    _check_not_running(folder)
    token = _token(folder)
    for flag in ("ray_port", "dashboard_port", "mlflow_port"):
        _check_port(f"--{flag.replace('_', '-')}", getattr(settings, flag))
    _check_space(folder, DISK_BYTES, "free some, or start in another folder")
    _check_space(Path("/dev/shm"), settings.object_store_megabytes * 10**6, "--object-store-megabytes less")
    dashboard, mlflow = (f"http://127.0.0.1:{port}" for port in (settings.dashboard_port, settings.mlflow_port))
    environment = {**os.environ, **OURS, "RAY_AUTH_TOKEN_PATH": str(token), "MLFLOW_TRACKING_URI": mlflow}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
    environment.pop("RAY_ADDRESS", None)
    temporary = Path(tempfile.mkdtemp(prefix="dmil-"))  # short: paths of Ray's sockets have 107 bytes at most
    started: list[Started] = []
    try:
        for server in _servers(settings, temporary, dashboard, mlflow):
            with (folder / f"{server.name}.log").open("w") as log:
                process = subprocess.Popen(
                    server.command, env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL,
                    start_new_session=True,
                )  # fmt: skip
            started.append(Started.of(server.name, process.pid))
            record = Record(processes=started, temporary=temporary, dashboard=dashboard, mlflow=mlflow)
            write_file(folder / "cluster.json", record.model_dump_json(indent=1) + "\n")
            console.print(f"starting {server.name} ...")
            _wait(server, process, folder / f"{server.name}.log", token.read_text())
    except BaseException:
        _stop(settings.folder)
        raise
    auth = f"RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH={token}"
    job = "python -m services.meta_train --preset ml10-smoke"
    console.print(f"Ray dashboard: {dashboard} (it asks for the token in {token})", soft_wrap=True)
    console.print(f"MLflow:        {mlflow}")
    console.print(f"jobs:          {dashboard}, for example:\n")
    ray = Path(sys.executable).with_name("ray")
    console.print(f"{auth} {ray} job submit --address {dashboard} -- {job}\n", soft_wrap=True, markup=False)
    console.print("to stop both: make cluster-stop")


def _servers(settings: Arguments, temporary: Path, dashboard: str, mlflow: str) -> list[Server]:
    """Return MLflow first: jobs log to it."""
    home = Path.cwd()
    ray = [
        sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--node-ip-address=127.0.0.1",
        f"--port={settings.ray_port}", "--dashboard-host=127.0.0.1", f"--dashboard-port={settings.dashboard_port}",
        "--include-dashboard=true", f"--dashboard-agent-listen-port={_free_port()}", f"--temp-dir={temporary}",
        f"--object-store-memory={settings.object_store_megabytes * 10**6}", "--disable-usage-stats",
    ]  # fmt: skip
    if settings.cpus is not None:
        ray.append(f"--num-cpus={settings.cpus}")
    server = [
        sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{home / 'mlflow.db'}",
        "--artifacts-destination", str(home / "mlartifacts"), "--host", "127.0.0.1",
        "--port", str(settings.mlflow_port), "--workers", "1",
    ]  # fmt: skip
    return [
        Server("mlflow", server, f"{mlflow}/health"),
        Server("ray", ray, f"{dashboard}/api/version"),
    ]


def _check_not_running(folder: Path) -> None:
    record = Record.read(folder)
    if record is None:
        return
    if all(started.process() for started in record.processes):
        raise UserError(
            f"{folder}: got a cluster that runs, Ray at {record.dashboard} and MLflow at {record.mlflow}; wanted none; "
            "use it, or stop it: make cluster-stop"
        )
    console.print(f"{folder}: a cluster from before ended without being stopped; what is left of it is stopped first")
    _stop(folder)


def _token(folder: Path) -> Path:
    """Return the file of the token, made if there is none yet.

    Raises:
        UserError: if the environment has another, which Ray's programs would use.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    path = folder / "token"
    if not path.exists():
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(32))
    if os.environ.get("RAY_AUTH_TOKEN", (token := path.read_text())) != token:
        raise UserError(
            f"RAY_AUTH_TOKEN: got another token than that in {path}, perhaps of an earlier cluster; wanted none, or "
            "the same: unset RAY_AUTH_TOKEN"
        )
    if Path(os.environ.get("RAY_AUTH_TOKEN_PATH", path)).absolute() != path:
        raise UserError(
            f"RAY_AUTH_TOKEN_PATH: got {os.environ['RAY_AUTH_TOKEN_PATH']}; wanted {path}, or none: unset it"
        )
    return path


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _check_port(flag: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do: closed connections do not count
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise UserError(
                f"{flag}: got {port}, where {_listener_name(port)} listens; wanted a free one; stop that, or give "
                "another"
            ) from error


def _listener_name(port: int) -> str:
    for connection in psutil.net_connections("tcp"):
        if connection.status == psutil.CONN_LISTEN and tuple(connection.laddr)[1:] == (port,) and connection.pid:
            return f"{psutil.Process(connection.pid).name()} (process {connection.pid})"
    return "somebody"


def _check_space(folder: Path, needed: int, remedy: str) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise UserError(f"{folder}: got {free / 1e6:.0f} MB free; wanted {needed / 1e6:.0f} MB; {remedy}")


def _wait(server: Server, process: subprocess.Popen[bytes], log: Path, token: str) -> None:
    """Wait until a server answers.

    Raises:
        RunError: if it ends before, or does not within two minutes.
    """
    deadline = time.monotonic() + SECONDS_TO_START
    while not _answers(server.url, token):
        if process.poll() is not None or time.monotonic() > deadline:
            ended = "ended" if process.poll() is not None else f"did not answer within {SECONDS_TO_START:.0f} s"
            last = "\n".join(log.read_text(errors="replace").splitlines()[-LINES_OF_A_LOG:])
            raise RunError(f"{server.name} {ended}; the end of its log {log}:\n{last}")
        time.sleep(0.2)


def _answers(url: str, token: str) -> bool:
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"})
    try:
        with urllib.request.urlopen(request, timeout=5) as answer:
            return answer.status == 200
    except urllib.error.HTTPError as error:
        if error.code in (401, 403):
            raise RunError(f"{url}: refuses the token of this cluster; it belongs to another one") from error
        return False
    except OSError:
        return False


def _stop(folder: Path) -> None:
    """Stop the servers by SIGTERM, as ``ray stop`` cannot: it stops every cluster of the user."""
    record = Record.read(folder.absolute())
    if record is None:
        raise UserError(f"{folder}: got no cluster.json; wanted the folder of a cluster that was started")
    servers = [process for started in record.processes if (process := started.process())]
    processes = list(servers)
    for server in servers:
        with suppress(psutil.NoSuchProcess):
            processes += server.children(recursive=True)
    for server in servers:
        with suppress(psutil.NoSuchProcess):
            server.terminate()
    _, alive = psutil.wait_procs(processes, SECONDS_TO_STOP)
    for process in alive:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(alive, SECONDS_TO_STOP)
    shutil.rmtree(record.temporary, ignore_errors=True)
    (folder / "cluster.json").unlink()
    console.print(f"stopped: {len(processes)} processes" if processes else "nothing of it was running any more")


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
