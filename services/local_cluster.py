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
from collections.abc import Callable, Mapping, Sequence
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


class ClusterError(UserError):
    """A cluster that cannot be started or stopped as things are here."""


class StartError(RunError):
    """A server that did not come up."""


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
    """A process, known again by when it began: a number alone may be another's by now."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    pid: int
    began: float

    @staticmethod
    def of(name: str, pid: int) -> "Started":
        """Note a process that lives."""
        return Started(name=name, pid=pid, began=psutil.Process(pid).create_time())

    def process(self) -> psutil.Process | None:
        """Return the process, if it lives."""
        try:
            found = psutil.Process(self.pid)
            return found if found.create_time() == self.began and found.status() != psutil.STATUS_ZOMBIE else None
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
        """Read the note in a folder, if there is one.

        Raises:
            ClusterError: if it is damaged.
        """
        path = folder / "cluster.json"
        if not path.exists():
            return None
        try:
            return Record.model_validate_json(read_file(path, MOST_BYTES))
        except (OSError, ValidationError) as error:
            got = explain(error) if isinstance(error, ValidationError) else str(error)
            raise ClusterError(
                f"{path}: got {'; '.join(got.splitlines())}; wanted the note of what was started; look for it with "
                "`ps`, end it, and remove the file"
            ) from error


class Server(NamedTuple):
    """What is started, and how one knows that it answers."""

    name: str
    command: Sequence[str]
    url: str
    flag: str
    """That its port was given by."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    given = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING))
    if given.do == "start":
        _start(given)
    else:
        _stop(given.folder)


def _start(given: Arguments) -> None:
    folder = given.folder.absolute()
    _refuse_a_second(folder)
    token = _token(folder)
    for flag in ("ray_port", "dashboard_port", "mlflow_port"):
        _refuse_a_taken(f"--{flag.replace('_', '-')}", getattr(given, flag))
    _refuse_without_room(folder, DISK_BYTES, "free some, or start in another folder")
    _refuse_without_room(Path("/dev/shm"), given.object_store_megabytes * 10**6, "--object-store-megabytes less")
    dashboard, mlflow = (f"http://127.0.0.1:{port}" for port in (given.dashboard_port, given.mlflow_port))
    environment = {**os.environ, **OURS, "RAY_AUTH_TOKEN_PATH": str(token), "MLFLOW_TRACKING_URI": mlflow}
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
    environment.pop("RAY_ADDRESS", None)
    temporary = Path(
        tempfile.mkdtemp(prefix="dmil-")
    )  # short: Ray's sockets lie in it, with paths of 107 bytes at most
    started: list[Started] = []
    try:
        for server in _servers(given, temporary, dashboard, mlflow):
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
        _stop(given.folder)
        raise
    told = f"RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH={token}"
    job = "python -m services.meta_train --preset ml10-smoke"
    console.print(f"Ray dashboard: {dashboard} (it asks for the token in {token})", soft_wrap=True)
    console.print(f"MLflow:        {mlflow}")
    console.print(f"jobs:          {dashboard}, for example:\n")
    ray = Path(sys.executable).with_name("ray")
    console.print(f"{told} {ray} job submit --address {dashboard} -- {job}\n", soft_wrap=True, markup=False)
    console.print("to stop both: make cluster-stop")


def _servers(given: Arguments, temporary: Path, dashboard: str, mlflow: str) -> list[Server]:
    """Return MLflow first: jobs log to it."""
    home = Path.cwd()
    ray = [
        sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--node-ip-address=127.0.0.1",
        f"--port={given.ray_port}", "--dashboard-host=127.0.0.1", f"--dashboard-port={given.dashboard_port}",
        "--include-dashboard=true", f"--dashboard-agent-listen-port={_free_port()}", f"--temp-dir={temporary}",
        f"--object-store-memory={given.object_store_megabytes * 10**6}", "--disable-usage-stats",
    ]  # fmt: skip
    if given.cpus is not None:
        ray.append(f"--num-cpus={given.cpus}")
    server = [
        sys.executable, "-m", "mlflow", "server", "--backend-store-uri", f"sqlite:///{home / 'mlflow.db'}",
        "--artifacts-destination", str(home / "mlartifacts"), "--host", "127.0.0.1",
        "--port", str(given.mlflow_port), "--workers", "1",
    ]  # fmt: skip
    return [
        Server("mlflow", server, f"{mlflow}/health", "--mlflow-port"),
        Server("ray", ray, f"{dashboard}/api/version", "--dashboard-port"),
    ]


def _refuse_a_second(folder: Path) -> None:
    record = Record.read(folder)
    if record is None:
        return
    if all(started.process() for started in record.processes):
        raise ClusterError(
            f"{folder}: got a cluster that runs, Ray at {record.dashboard} and MLflow at {record.mlflow}; wanted none; "
            "use it, or stop it: make cluster-stop"
        )
    console.print(f"{folder}: a cluster from before ended without being stopped; what is left of it is stopped first")
    _stop(folder)


def _token(folder: Path) -> Path:
    """Return the file of the token, made if there is none yet.

    Raises:
        ClusterError: if the environment has another, which Ray's programs would use.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    path = folder / "token"
    if not path.exists():
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(32))
    if os.environ.get("RAY_AUTH_TOKEN", (token := path.read_text())) != token:
        raise ClusterError(
            f"RAY_AUTH_TOKEN: got another token than that in {path}, perhaps of an earlier cluster; wanted none, or "
            "the same: unset RAY_AUTH_TOKEN"
        )
    if Path(os.environ.get("RAY_AUTH_TOKEN_PATH", path)).absolute() != path:
        raise ClusterError(
            f"RAY_AUTH_TOKEN_PATH: got {os.environ['RAY_AUTH_TOKEN_PATH']}; wanted {path}, or none: unset it"
        )
    return path


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _refuse_a_taken(flag: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do: closed connections do not count
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise ClusterError(
                f"{flag}: got {port}, where {_listener(port)} listens; wanted a free one; stop that, or give another"
            ) from error


def _listener(port: int) -> str:
    for connection in psutil.net_connections("tcp"):
        if connection.status == psutil.CONN_LISTEN and tuple(connection.laddr)[1:] == (port,) and connection.pid:
            return f"{psutil.Process(connection.pid).name()} (process {connection.pid})"
    return "somebody"


def _refuse_without_room(folder: Path, needed: int, remedy: str) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise ClusterError(f"{folder}: got {free / 1e6:.0f} MB free; wanted {needed / 1e6:.0f} MB; {remedy}")


def _wait(server: Server, process: subprocess.Popen[bytes], log: Path, token: str) -> None:
    """Wait until a server answers.

    Raises:
        StartError: if it ends before, or does not within two minutes.
    """
    until = time.monotonic() + SECONDS_TO_START
    while not _answers(server.url, {"Authorization": f"Bearer {token}"}):
        if process.poll() is not None or time.monotonic() > until:
            ended = "ended" if process.poll() is not None else f"did not answer within {SECONDS_TO_START:.0f} s"
            last = "\n".join(log.read_text(errors="replace").splitlines()[-LINES_OF_A_LOG:])
            raise StartError(f"{server.name} {ended}; the end of its log {log}:\n{last}")
        time.sleep(0.2)


def _answers(url: str, headers: Mapping[str, str]) -> bool:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=dict(headers)), timeout=5) as answer:
            return answer.status == 200
    except urllib.error.HTTPError as error:
        if error.code in (401, 403):
            raise StartError(f"{url}: refuses the token of this cluster; it belongs to another one") from error
        return False
    except OSError:
        return False


def _stop(folder: Path) -> None:
    record = Record.read(folder.absolute())
    if record is None:
        raise ClusterError(f"{folder}: got no cluster.json; wanted the folder of a cluster that was started")
    there = [process for started in record.processes if (process := started.process())]
    all_of_them = [*there, *(child for process in there for child in _children(process))]
    for process in there:
        _ignoring_the_dead(process.terminate)
    _, left = psutil.wait_procs(all_of_them, SECONDS_TO_STOP)
    for process in left:
        _ignoring_the_dead(process.kill)
    psutil.wait_procs(left, SECONDS_TO_STOP)
    shutil.rmtree(record.temporary, ignore_errors=True)
    (folder / "cluster.json").unlink()
    console.print(f"stopped: {len(all_of_them)} processes" if all_of_them else "nothing of it was running any more")


def _children(process: psutil.Process) -> list[psutil.Process]:
    try:
        return process.children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _ignoring_the_dead(end: Callable[[], None]) -> None:
    try:
        end()
    except psutil.NoSuchProcess:
        return


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
