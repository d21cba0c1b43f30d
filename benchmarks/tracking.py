"""What tracking costs meta-training: none, MLflow not there, MLflow slow, MLflow taking records into SQLite.

Five runs of the quick size, with made-up demonstrations as in `benchmarks.scaling`, take turns in this process. The
trackers' threads work beside. Each is opened and has asked MLflow for the first time before anything is measured; then
the slow server waits ten seconds before each answer. Ratios are medians over rounds, each against the turn without
tracking of the same round; a second run without tracking shows how far such a ratio can be trusted here.
"""

import os
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.box import SIMPLE

from benchmarks import harness
from benchmarks.harness import BenchmarkArguments, alternate, lay_out, machine, main
from benchmarks.workload import made_up_plan
from services.cli.progress import console
from services.distributed.runner import LocalMetaTraining
from services.experiments.iteration_metrics import iteration_metrics
from services.tracking.delivery import Identity
from services.tracking.spool import read_spool
from services.tracking.tracker import Tracker

DELAY = 10.0
"""Seconds that the slow server waits before each answer."""
LEAST = 0.95
"""Of the speed without tracking."""
WARM_UP = 3
NONE = "no tracking"
CONTROL = "no tracking, again"


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``tracking``."""

    rounds: int = 24
    """Turns that each takes."""
    iterations: int = 5
    """Of one turn."""


class Row(NamedTuple):
    """What one run did."""

    mlflow: str
    iterations: int
    iterations_per_s: float
    ratio: float
    """Of iterations/s to those without tracking."""
    cpu_ratio: float
    """Of the processor's seconds, all threads together, without tracking to those with it."""
    call_us: float
    """Median microseconds that meta-training gives to recording an iteration."""
    records: int
    """On disk."""
    delivered: int


@contextmanager
def slow_server() -> Iterator[str]:
    """Yield the address of a server that waits before it answers."""
    over = threading.Event()

    class Slow(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            over.wait(DELAY)
            self.send_error(503)

        do_POST = do_GET  # noqa: N815

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Slow)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        over.set()
        server.shutdown()
        server.server_close()


class Run:
    """Meta-training, with a tracker or without."""

    def __init__(self, name: str, folder: Path, uri: str | None) -> None:
        """Open the tracker, and let it ask for the first time."""
        self.name, self.folder = name, folder
        self.cpu_seconds: list[float] = []
        self.call_seconds: list[float] = []
        self._training = LocalMetaTraining(made_up_plan("ml10-quick"))
        self.tracker: Tracker | None = None
        if uri is not None:
            folder.mkdir()
            os.environ["MLFLOW_TRACKING_URI"] = uri
            self.tracker = Tracker(folder, "benchmark")
            self.tracker.wait_for_run_id()

    def go_on(self, count: int) -> None:
        """Do the next iterations and track them, as an experiment does."""
        began = time.process_time()
        for iteration in self._training.iterations(count):
            metrics = iteration_metrics(iteration)
            if self.tracker is not None:
                called = time.perf_counter()
                self.tracker.metrics(iteration.number, metrics)
                self.call_seconds.append(time.perf_counter() - called)
        self.cpu_seconds.append(time.process_time() - began)

    def row(self, seconds: Mapping[str, list[float]], cpu: list[float], iterations: int) -> Row:
        """Close the tracker and return what has been found."""
        if self.tracker is not None:
            self.tracker.close("FINISHED")
        return Row(
            self.name,
            iterations * len(seconds[self.name]),
            float(iterations / np.median(seconds[self.name])),
            float(np.median(np.divide(seconds[NONE], seconds[self.name]))),
            float(np.median(np.divide(cpu, self.cpu_seconds))),
            1e6 * float(np.median(self.call_seconds or 0)),
            sum(1 for _ in read_spool(self.folder / "tracking.jsonl")),
            Identity.of(self.folder).delivered if self.tracker is not None else 0,
        )


def measure(folder: Path, slow: str, rounds: int, iterations: int) -> list[Row]:
    """Let them take turns."""
    addresses = {
        NONE: None,
        "down": "http://127.0.0.1:1",  # where nobody listens
        "slow": slow,
        "up (SQLite)": f"sqlite:///{folder / 'mlflow.db'}",
        CONTROL: None,
    }
    runs = {name: Run(name, folder / str(number), uri) for number, (name, uri) in enumerate(addresses.items())}
    for each in runs.values():
        each.go_on(WARM_UP)
        each.cpu_seconds.clear()
    seconds = alternate({name: partial(each.go_on, iterations) for name, each in runs.items()}, rounds)
    return [each.row(seconds, runs[NONE].cpu_seconds, iterations) for each in runs.values()]


def cells(row: Row) -> dict[str, str]:
    """Return the row of the table."""
    return {
        "MLflow": row.mlflow,
        "iterations": str(row.iterations),
        "it/s": f"{row.iterations_per_s:.2f}",
        "of none": f"{row.ratio:.3f}",
        "by CPU time": f"{row.cpu_ratio:.3f}",
        "µs a call": f"{row.call_us:.0f}",
        "records": str(row.records),
        "delivered": str(row.delivered),
    }


def run(args: Arguments) -> Sequence[harness.Row]:
    """Run the benchmark."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        rows = measure(folder, stack.enter_context(slow_server()), args.rounds, args.iterations)
    console.print(lay_out("Meta-training of the quick size beside MLflow", [cells(row) for row in rows], box=SIMPLE))
    here = machine()
    console.print(f"{here['cpus']} CPUs, load average {here['load_average']:.1f}, {args.rounds} rounds")
    missed = [row for row in rows if row.records and row.ratio < LEAST]
    lines = [f"missed: {row.mlflow}: {row.ratio:.3f} of the speed without tracking, wanted {LEAST}" for row in missed]
    console.print("\n".join(lines) or "all targets are met")
    return [row._asdict() | here for row in rows]


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
