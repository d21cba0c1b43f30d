"""The Ray cluster that this process works in: one that it belongs to, or one of its own on loopback."""

import gc
import logging
import os
import secrets
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import psutil

from dmil_core.errors import RunError, UserError
from services.distributed.node_info import usable_cpus
from services.storage.private import LOOPBACK, bypass_proxies, private_folder
from services.storage.redaction import error_line, redacted

if TYPE_CHECKING:
    from ray.job_config import JobConfig

logger = logging.getLogger(__name__)

RunnerKind = Literal["ray", "local"]
"""Where a program works: in Ray actors, or in this process."""
OBJECT_STORE_BYTES = 500_000_000
SECONDS_TO_ANSWER = 20.0
ON_NETWORK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Where it is 0, Ray keeps to loopback."""


@contextmanager
def joined(workers: int | None = None) -> Iterator[None]:
    """Be in a cluster, and leave it in the end.

    It is the one joined already, as in a trial of a sweep, which is not left; the one that ``RAY_ADDRESS`` names, as in
    a Ray job; or one on this machine alone that listens on loopback only, with at least `workers` CPUs.

    Raises:
        UserError: if nothing that can be joined answers at ``RAY_ADDRESS``.
    """
    bypass_proxies(os.environ)
    address = named_address()
    if address is None:
        _secure_local_cluster()
    elif _only_on_loopback(address):
        os.environ.setdefault(ON_NETWORK, "0")  # else Ray would ask for it at this machine's address in the network
    # Ray would print every error of a call that the pool made again.
    os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")
    import ray

    if ray.is_initialized():
        yield
        return
    on_termination = signal.getsignal(signal.SIGTERM)
    with ExitStack() as stack:
        if address is None:
            folder = stack.enter_context(private_folder())
            stack.callback(_leave)
            _start(
                folder / "ray",
                address="local",
                num_cpus=max(usable_cpus(), workers or 0),
                include_dashboard=False,
                job_config=_job_config(),
                object_store_memory=OBJECT_STORE_BYTES,
                logging_level=logging.WARNING,
                log_to_driver=False,
                _node_ip_address="127.0.0.1",
                _system_config={"enable_metrics_collection": False},  # they would be served to everybody
            )
        else:
            stack.callback(_leave)
            _join(address)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, on_termination)  # Ray puts its own there, which ends at once
        yield


def _start(folder: Path, **options: Any) -> None:
    """Start Ray in a folder that it makes, once more if it takes longer than the 30 s that Ray gives itself."""
    import ray

    for last in (False, True):
        try:
            ray.init(**options, _temp_dir=str(folder))
            return
        except Exception as error:  # Ray raises plain ones
            _end_children_of(folder)
            if last or "timed out during startup" not in str(error):
                raise RunError(
                    f"Ray does not start on this machine: {error_line(error)}; start again, with less beside it, or "
                    "without Ray: --runner local"
                ) from error
            logger.warning("Ray is slow to start here; it is started once more")


def _leave() -> None:
    """Leave the cluster, and collect no garbage meanwhile.

    Ray ends the process, without a word, if another thread then frees a reference to an object or an actor.
    """
    import ray

    collected = gc.isenabled()
    gc.disable()
    try:
        ray.shutdown()
    finally:
        if collected:
            gc.enable()


def _end_children_of(folder: Path) -> None:
    """End the processes below this one that were told to work in a folder: they would make it anew."""
    ended = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if any(str(folder) in part for part in process.cmdline()):
                process.kill()
                ended.append(process)
    psutil.wait_procs(ended, SECONDS_TO_ANSWER)


def named_address() -> str | None:
    """Return what ``RAY_ADDRESS`` names, or None if it is unset, empty or ``local``: a cluster of one's own."""
    address = os.environ.get("RAY_ADDRESS", "")
    return None if address in ("", "local") else address


def _only_on_loopback(address: str) -> bool:
    """Tell whether loopback is named, and what listens there is not at 127.0.0.2 too, as on all interfaces."""
    host, _, port = address.rpartition(":")
    if host not in LOOPBACK.split(","):
        return False
    try:
        socket.create_connection(("127.0.0.2", int(port)), timeout=SECONDS_TO_ANSWER).close()
    except (OSError, ValueError, OverflowError):
        return True
    return False


def _join(address: str) -> None:
    """Join a cluster, if a Ray of this version answers there, with this token."""
    import ray
    from ray._private.services import canonicalize_bootstrap_address_or_die  # finds `auto`
    from ray.exceptions import RayError

    wanted = "wanted a Ray head that runs, as HOST:PORT, or none: unset it"
    if "://" in address:
        whose = "Ray's client" if address.startswith("ray://") else "a dashboard, which takes jobs"
        raise UserError(f"RAY_ADDRESS: got {redacted(address)}, perhaps for {whose}; {wanted}")
    try:
        refusal = _refusal(canonicalize_bootstrap_address_or_die(address))
        if refusal is None:
            ray.init(address, job_config=_job_config(), logging_level=logging.WARNING)
            return
    except (ConnectionError, RuntimeError, ValueError, RayError) as error:
        refusal = f"none can be joined: {error_line(error)}"
    raise UserError(f"RAY_ADDRESS: got {address}, where {refusal}; {wanted}")


def _refusal(host: str) -> str | None:
    """Return why a cluster would not be joined where Ray itself would try for minutes, or None."""
    import grpc
    from ray._private.authentication.authentication_token_setup import maybe_enable_token_auth_if_token_available
    from ray._private.grpc_utils import init_grpc_channel  # has Ray's token and TLS

    maybe_enable_token_auth_if_token_available(warn_if_disabled=False)  # as ray.init does
    channel: Any = init_grpc_channel(host, [("grpc.enable_http_proxy", 0)])
    try:
        grpc.channel_ready_future(channel).result(SECONDS_TO_ANSWER)
        channel.unary_unary("/ray.rpc.NodeInfoGcsService/GetClusterId")(b"", timeout=SECONDS_TO_ANSWER)
    except grpc.FutureTimeoutError:
        return "no Ray answers"
    except grpc.RpcError as error:
        if error.code() == grpc.StatusCode.UNAUTHENTICATED:  # pyright: ignore[reportAttributeAccessIssue]
            return "another token is asked for (RAY_AUTH_MODE=token, RAY_AUTH_TOKEN_PATH=FILE)"
    finally:
        channel.close()
    return None


def cpus() -> int:
    """Return how many CPUs the cluster has now: nodes come and go."""
    import ray

    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def _job_config() -> "JobConfig":
    """Return a job whose workers import from the working directory only if this process does.

    Ray would always have them do so: the code that lies in somebody else's folder would run where she is only read.
    """
    from ray.job_config import JobConfig

    own = Path.cwd() in [Path(path).absolute() for path in sys.path]
    return JobConfig(_client_job=not own)  # as though its client were on another machine


def _secure_local_cluster() -> None:
    """Bind Ray to loopback, ask for a token that only this process's children know, send no usage statistics.

    Ray reads these when it is imported, also in the processes that it starts.
    """
    os.environ.pop("RAY_ADDRESS", None)  # for Ray an empty one is set
    os.environ.setdefault(ON_NETWORK, "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    if "RAY_AUTH_TOKEN_PATH" not in os.environ:
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
