"""A Ray head and an MLflow server on this machine, on loopback, for Ray jobs: ``make cluster``, ``make cluster-stop``.

Jobs run in the folder that it was started in, and log to that MLflow server. The token of both lies in FOLDER/token.
"""

import os
import shutil
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple
from urllib.error import HTTPError
from urllib.request import ProxyHandler, Request, build_opener, getproxies, proxy_bypass

import psutil
import tyro
from pydantic import BaseModel, ConfigDict

from dmil_core.errors import RunError, UserError
from dmil_core.files import append_to, read_file, read_json, write_file
from services.cli.arguments import exit_code, parse
from services.cli.progress import console
from services.distributed.node_info import usable_cpus
from services.storage.private import bypass_proxies, make_private_folder, private_token
from services.tracking.server import LOGINS, server_command, server_environment

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
    "RAY_USAGE_STATS_REPORT_URL": "",  # where Ray would report that it reports none
    "RAY_JOB_STOP_WAIT_TIME_S": str(SECONDS_FOR_A_JOB),
}
MARK = "made-for"
"""In the folder of Ray's sockets and logs, names the cluster's own: a note that anybody wrote has no folder removed."""


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
    """That Ray may use; all that this process may use if not given."""
    object_store_megabytes: int = 500
    """Of memory, for what Ray's processes share."""


class Started(BaseModel):
    """A process, identified by its number and start time: the number alone may be another's by now."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    pid: int
    began: float
    ticks: str | None = None
    """Since the machine's start, which a change of the clock does not move; and the start's own id."""

    @staticmethod
    def of(name: str, pid: int) -> "Started":
        """Return the record of a running process."""
        return Started(name=name, pid=pid, began=psutil.Process(pid).create_time(), ticks=_ticks(pid))

    def process(self) -> psutil.Process | None:
        """Return the process, if it still runs."""
        try:
            process = psutil.Process(self.pid)
            same = process.create_time() == self.began if self.ticks is None else _ticks(self.pid) == self.ticks
            return process if same and process.status() != psutil.STATUS_ZOMBIE else None
        except psutil.NoSuchProcess:
            return None


def _ticks(pid: int) -> str | None:
    """Return when a process began, by the kernel's own count, or None where there is no such count."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return f"{after_name[19]} {Path('/proc/sys/kernel/random/boot_id').read_text().strip()}"
    except (OSError, IndexError):
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
        if not (folder / "cluster.json").exists():
            return None
        advice = "wanted the note of what was started; look for it with `ps`, end it, and remove the file"
        return read_json(folder, "cluster.json", Record, MOST_BYTES, advice)


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
    environment = {name: value for name, value in os.environ.items() if name not in ("RAY_ADDRESS", *LOGINS)}
    environment |= {**OURS, "RAY_AUTH_TOKEN_PATH": str(token), "MLFLOW_TRACKING_URI": mlflow}
    environment |= server_environment(f"sqlite:///{Path.cwd() / 'mlflow.db'}", token.read_text())
    environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
    bypass_proxies(environment)
    temporary = make_private_folder()
    (temporary / MARK).write_bytes(os.fsencode(folder))
    started: list[Started] = []
    try:
        for server in _servers(settings, temporary, dashboard, mlflow):
            write_file(folder, f"{server.name}.log", b"")
            with append_to(folder, f"{server.name}.log") as log:
                process = subprocess.Popen(
                    server.command, env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL,
                    start_new_session=True,
                )  # fmt: skip
            started.append(Started.of(server.name, process.pid))
            record = Record(processes=started, temporary=temporary, dashboard=dashboard, mlflow=mlflow)
            write_file(folder, "cluster.json", record.model_dump_json(indent=1) + "\n")
            console.print(f"starting {server.name} ...")
            _wait(server, process, folder / f"{server.name}.log", token.read_text())
    except BaseException:
        _stop(settings.folder)
        raise
    auth = f"RAY_AUTH_MODE=token RAY_AUTH_TOKEN_PATH={token}"
    if "http" in getproxies() and not proxy_bypass("127.0.0.1"):
        auth += f" no_proxy={environment['no_proxy']}"
    job = "python -m services.meta_train --preset ml10-smoke"
    ray = Path(sys.executable).with_name("ray")
    login = f"MLFLOW_TRACKING_URI={mlflow} MLFLOW_TRACKING_TOKEN=$(cat {token})"
    for line in (
        f"Ray dashboard: {dashboard} (it asks for the token in {token})",
        f"MLflow:        {mlflow} (any user; the token is the password)",
        f"from a shell:  {login}",
        f"jobs:          {dashboard}, for example:\n",
        f"{auth} {ray} job submit --address {dashboard} -- {job}\n",
    ):
        console.print(line, soft_wrap=True)
    console.print("to stop both: make cluster-stop")


def _servers(settings: Arguments, temporary: Path, dashboard: str, mlflow: str) -> list[Server]:
    """Return MLflow first: jobs log to it."""
    ray = [
        sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--block", "--node-ip-address=127.0.0.1",
        f"--port={settings.ray_port}", "--dashboard-host=127.0.0.1", f"--dashboard-port={settings.dashboard_port}",
        "--include-dashboard=true", f"--dashboard-agent-listen-port={_free_port()}", f"--temp-dir={temporary / 'ray'}",
        f"--object-store-memory={settings.object_store_megabytes * 10**6}", "--disable-usage-stats",
        f"--num-cpus={settings.cpus or usable_cpus()}",
    ]  # fmt: skip
    server = server_command(Path.cwd() / "mlartifacts", settings.mlflow_port)
    return [
        Server("mlflow", server, f"{mlflow}/version"),
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
    """Return the file of the token, made anew if it must be, and no other's in the environment."""
    path = private_token(folder, lambda exposed: console.print(exposed, soft_wrap=True))
    if os.environ.get("RAY_AUTH_TOKEN", (token := read_file(folder, path.name, MOST_BYTES).decode())) != token:
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
        except (OSError, OverflowError) as error:
            listener = _listener_name(port)
            why = f"where {listener} listens" if listener else f"which cannot be listened on ({error})"
            raise UserError(f"{flag}: got {port}, {why}; wanted a free one; stop that, or give another") from error


def _listener_name(port: int) -> str | None:
    for connection in psutil.net_connections("tcp"):
        if connection.status == psutil.CONN_LISTEN and tuple(connection.laddr)[1:] == (port,) and connection.pid:
            return f"{psutil.Process(connection.pid).name()} (process {connection.pid})"
    return None


def _check_space(folder: Path, needed: int, remedy: str) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise UserError(f"{folder}: got {free / 1e6:.0f} MB free; wanted {needed / 1e6:.0f} MB; {remedy}")


def _wait(server: Server, process: subprocess.Popen[bytes], log: Path, token: str) -> None:
    """Wait until a server answers."""
    deadline = time.monotonic() + SECONDS_TO_START
    while not _answers(server.url, token):
        if process.poll() is not None or time.monotonic() > deadline:
            ended = "ended" if process.poll() is not None else f"did not answer within {SECONDS_TO_START:.0f} s"
            last = "\n".join(log.read_text(errors="replace").splitlines()[-LINES_OF_A_LOG:])
            raise RunError(f"{server.name} {ended}; the end of its log {log}:\n{last}")
        time.sleep(0.2)


def _answers(url: str, token: str) -> bool:
    """Ask a server of this machine: directly, and with the token for itself alone, wherever it redirects."""
    request = Request(url)
    request.add_unredirected_header("Authorization", f"Bearer {token}")
    try:
        with build_opener(ProxyHandler({})).open(request, timeout=5) as answer:
            return answer.status == 200
    except HTTPError as error:
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
    if _made_for(record.temporary, folder.absolute()):
        shutil.rmtree(record.temporary, ignore_errors=True)
    elif record.temporary.exists():
        console.print(
            f"{folder / 'cluster.json'}: temporary: got {record.temporary}, which was not made for this cluster: it "
            "stays", soft_wrap=True,
        )  # fmt: skip
    (folder / "cluster.json").unlink()
    console.print(f"stopped: {len(processes)} processes" if processes else "nothing of it was running any more")


def _made_for(temporary: Path, folder: Path) -> bool:
    """Tell whether a folder is the private one that was made for the cluster in `folder`."""
    try:
        found = temporary.lstat()
        private = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077
        return private and read_file(temporary, MARK, MOST_BYTES) == os.fsencode(folder)
    except OSError:
        return False


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
