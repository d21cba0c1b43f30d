"""The Ray cluster that this process works in: one that it belongs to, or one of its own on loopback."""

import logging
import os
import secrets
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

OBJECT_STORE_BYTES = 500_000_000


@contextmanager
def joined(workers: int | None = None) -> Iterator[None]:
    """Be in a cluster, and leave it in the end.

    It is the one joined already, as in a trial of a sweep, which is not left; the one that ``RAY_ADDRESS`` names, as in
    a Ray job; or one on this machine alone that listens on loopback only,
    with at least `workers` CPUs.
    """
    if "RAY_ADDRESS" not in os.environ:
        _secure_local_cluster()
    # Ray would print every error of a call that the pool made again.
    os.environ.setdefault("RAY_IGNORE_UNHANDLED_ERRORS", "1")
    import ray

    if ray.is_initialized():
        yield
        return
    on_termination = signal.getsignal(signal.SIGTERM)
    if "RAY_ADDRESS" in os.environ:
        ray.init(logging_level=logging.WARNING)
    else:
        ray.init(
            address="local",
            num_cpus=max(os.cpu_count() or 1, workers or 0),
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            logging_level=logging.WARNING,
            log_to_driver=False,
            _node_ip_address="127.0.0.1",
        )
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_termination)  # Ray puts its own there, which ends at once
    try:
        yield
    finally:
        ray.shutdown()


def cpus() -> int:
    """Return how many CPUs the cluster has now: nodes come and go."""
    import ray

    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def _secure_local_cluster() -> None:
    """Bind Ray to loopback, ask for a token that only this process's children know, send no usage statistics.

    Ray reads these when it is imported.
    """
    os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
