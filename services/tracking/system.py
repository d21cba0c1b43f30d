"""Load of the machine that a program runs on, recorded while it runs and read by MLflow's own monitors."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from dmil_core.errors import RunError
from services.tracking.tracker import Tracker

if TYPE_CHECKING:
    from mlflow.system_metrics.metrics.base_metrics_monitor import BaseMetricsMonitor

SECONDS = 10.0
"""Between two samples, as MLflow has it."""


@contextmanager
def recording_system(tracker: Tracker) -> Iterator[None]:
    """Record processor, memory, disk, network and GPUs every some seconds, in a thread of its own.

    MLflow shows them among a run's system metrics. Those of other machines of a cluster are Ray's to tell.
    """
    over = threading.Event()
    thread = threading.Thread(target=_record, args=(tracker, over), name="system metrics", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(SECONDS)


def _record(tracker: Tracker, over: threading.Event) -> None:
    from mlflow.system_metrics.metrics.cpu_monitor import CPUMonitor
    from mlflow.system_metrics.metrics.disk_monitor import DiskMonitor
    from mlflow.system_metrics.metrics.network_monitor import NetworkMonitor

    monitors: list[BaseMetricsMonitor] = [CPUMonitor(), DiskMonitor(), NetworkMonitor(), *_gpu_monitors()]
    _sample(monitors)  # the processor's load is that since the sample before
    ended = False
    while not ended:
        ended = over.wait(SECONDS)  # a short run has one sample, at its end
        try:
            tracker.system(_sample(monitors))
        except (OSError, RunError, ValueError):  # of a full disk training itself tells; or the records are closed
            return


def _sample(monitors: "Sequence[BaseMetricsMonitor]") -> dict[str, float]:
    values: dict[str, float] = {}
    for monitor in monitors:
        monitor.collect_metrics()
        values.update(monitor.aggregate_metrics() or {})
        monitor.clear_metrics()
    return values


def _gpu_monitors() -> "Iterator[BaseMetricsMonitor]":
    """Yield the monitor of the GPUs here, if there are any whose library is installed."""
    from mlflow.system_metrics.metrics.gpu_monitor import GPUMonitor
    from mlflow.system_metrics.metrics.rocm_monitor import ROCMMonitor

    for kind in (GPUMonitor, ROCMMonitor):
        try:
            yield kind()
        except (ImportError, RuntimeError):
            continue
