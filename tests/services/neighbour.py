"""Goes round some processes as another user of the machine would, and prints as JSON what let it in.

usage: neighbour.py FOLDER... PROCESS...; as root, for it becomes the user nobody.
"""

import email.parser  # noqa: F401  what is imported late must be there before: root's Python is closed to nobody
import encodings.idna  # noqa: F401
import http.client
import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import grpc
import psutil

NOBODY = 65534
REQUESTS = {
    "GET": [
        "/", "/version", "/metrics", "/nodes?view=summary", "/api/version", "/api/jobs/", "/api/job_agent/jobs/",
        "/logs/", "/api/v0/logs", "/api/v0/tasks", "/api/actors", "/api/cluster_status", "/worker/traceback?pid=1",
        "/log_proxy?url=http://127.0.0.1:1/", "/get-artifact?path=x", "/api/2.0/mlflow-artifacts/artifacts", "/graphql",
        "/api/2.0/mlflow/experiments/search?max_results=1", "/ajax-api/3.0/mlflow/assistant/config",
    ],
    "POST": [
        "/api/jobs/", "/api/job_agent/jobs/", "/get_or_create_runtime_env", "/api/2.0/mlflow/experiments/create",
        "/api/2.0/mlflow/runs/create", "/ajax-api/3.0/mlflow/assistant/message", "/ajax-api/3.0/jobs", "/v1/traces",
        "/ajax-api/2.0/mlflow/upload-artifact",
    ],
}  # fmt: skip
REFUSED = {400, 401, 403, 404, 405}
FIGURES = b"# HELP "
"""With which what Prometheus asks for begins."""
CALLS = [
    "NodeInfoGcsService/GetAllNodeInfo", "InternalKVGcsService/InternalKVKeys", "NodeManagerService/GetNodeStats",
    "NodeManagerService/RequestWorkerLease", "ObjectManagerService/Push", "ObjectManagerService/Pull",
    "CoreWorkerService/GetCoreWorkerStats", "CoreWorkerService/PushTask", "CoreWorkerService/Exit",
    "ReporterService/GetTraceback", "LogService/ListLogs", "LogService/StreamLog",
    "RuntimeEnvService/GetOrCreateRuntimeEnv", "RayletDriver/Init", "RayletDriver/Schedule",
    "events.EventAggregatorService/AddEvents",
]  # fmt: skip
CLOSED = {
    grpc.StatusCode.UNAUTHENTICATED, grpc.StatusCode.PERMISSION_DENIED, grpc.StatusCode.UNIMPLEMENTED,
    grpc.StatusCode.UNAVAILABLE,  # a worker that has ended meanwhile
}  # fmt: skip
SECONDS = 5.0


def main() -> None:
    """Look as root at what there is, become nobody, and try it all."""
    parents = [psutil.Process(int(given)) for given in sys.argv[1:] if given.isdigit()]
    folders = [Path(given) for given in sys.argv[1:] if not given.isdigit()]
    processes = [*parents, *(child for parent in parents for child in parent.children(recursive=True))]
    links = [link for process in processes for link in _links(process)]
    ports = sorted({link.laddr.port for link in links if link.status == psutil.CONN_LISTEN})
    sockets = sorted({link.laddr for link in links if link.family == socket.AF_UNIX and link.laddr})
    paths = [path for folder in folders for path in (folder, *folder.rglob("*"))]
    for process in processes:
        paths.append(Path(f"/proc/{process.pid}/environ"))
        with suppress(psutil.Error):  # one that has ended meanwhile
            paths += [Path(file.path) for file in process.open_files() if file.path.startswith("/dev/shm")]
    grpc.insecure_channel("127.0.0.1:1").close()  # it imports too
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)
    doors = [*_files(paths), *_sockets(sockets), *(door for port in ports for door in _port(port))]
    print(json.dumps({"ports": len(ports), "sockets": len(sockets), "paths": len(paths), "doors": sorted(set(doors))}))


def _links(process: psutil.Process) -> list:
    try:
        return process.net_connections("all")
    except psutil.Error:
        return []


def _files(paths: list[Path]) -> Iterator[str]:
    for path in paths:
        try:
            next(path.iterdir(), None) if path.is_dir() else path.open("rb").read(1)
        except OSError:
            pass
        else:
            yield f"read {path}"
        try:
            (path / "planted").touch() if path.is_dir() else path.open("ab").close()
        except OSError:
            pass
        else:
            yield f"write {path}"


def _sockets(sockets: list[str]) -> Iterator[str]:
    for path in sockets:
        with socket.socket(socket.AF_UNIX) as own:
            try:
                own.connect(path)
            except OSError:
                continue
            yield f"connect {path}"


def _port(port: int) -> Iterator[str]:
    for method, path in ((method, path) for method, paths in REQUESTS.items() for path in paths):
        asked = http.client.HTTPConnection("127.0.0.1", port, timeout=SECONDS)
        try:
            asked.request(method, path, "{}" if method == "POST" else None, {"Content-Type": "application/json"})
            answer = asked.getresponse()
            text = answer.read(len(FIGURES) + 20)
        except (OSError, http.client.HTTPException):
            break  # no HTTP/1 here
        finally:
            asked.close()
        if text.startswith(FIGURES):
            yield f"figures: {text.removeprefix(FIGURES).decode()}"
        elif answer.status not in REFUSED:
            yield f"{method} {path}: {answer.status}"
    else:
        return
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        for name in CALLS:
            try:
                channel.unary_unary(f"/ray.rpc.{name}")(b"", timeout=SECONDS)
            except grpc.RpcError as error:
                code = error.code()  # pyright: ignore[reportAttributeAccessIssue]
                if code not in CLOSED:
                    yield f"{name}: {code.name}"
            else:
                yield f"{name}: OK"


if __name__ == "__main__":
    main()
