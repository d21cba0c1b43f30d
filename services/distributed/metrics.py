"""The metrics of a run that Ray's dashboard and Prometheus show, and the meters that record them.

Ray puts ``ray_`` before each name, and ``_total`` behind that of a counter; docs/operations.md lists them.
"""

import logging
from typing import Any, Literal, NamedTuple

from services.cli.live_view import Workers
from services.distributed.adaptation_worker import Block
from services.distributed.calls import Call, PoolListener
from services.distributed.timing import Timing
from services.storage.redaction import error_line

logger = logging.getLogger(__name__)


class Measure(NamedTuple):
    """A metric of a run."""

    name: str
    kind: Literal["counter", "gauge", "histogram"]
    meaning: str
    labels: tuple[str, ...] = ()
    """Besides ``suite``, which all have."""


ITERATIONS = Measure("dmil_iterations", "counter", "Completed iterations of meta-training.")
ITERATION_SECONDS = Measure(
    "dmil_iteration_seconds", "histogram", "Time from the end of one outer step to the end of the next."
)
PHASE_SECONDS = Measure(
    "dmil_phase_seconds",
    "counter",
    "Seconds of iterations by phase: broadcast, compute, waiting, reduction, step; their sum is the iterations'.",
    ("phase",),
)
SLOTS_REDONE = Measure(
    "dmil_slots_redone",
    "counter",
    "Slots computed again because their worker died or was slow, or because a lost learner's iterations are repeated.",
)
WORKERS = Measure("dmil_workers", "gauge", "Workers that are up.", ("kind",))
WORKERS_JOINED = Measure("dmil_workers_joined", "counter", "Workers that started, including the first ones.", ("kind",))
WORKERS_LOST = Measure(
    "dmil_workers_lost", "counter", "Workers that died or were ended because they were slow.", ("kind",)
)
EPISODES = Measure("dmil_episodes", "counter", "Episodes of evaluations.", ("split", "shots"))
SUCCESSES = Measure("dmil_successes", "counter", "Successful episodes of evaluations.", ("split", "shots"))
SUCCESS_RATE = Measure(
    "dmil_success_rate", "gauge", "Success rate of the evaluation that finished last.", ("split", "shots")
)
SPOOL_RECORDS = Measure("dmil_spool_records", "gauge", "Records on disk that wait for MLflow.")
CHECKPOINT_TIME = Measure(
    "dmil_checkpoint_timestamp_seconds",
    "gauge",
    "Time of the newest checkpoint, in seconds since 1970; before the first, the start of meta-training.",
)
MEASURES = (
    ITERATIONS, ITERATION_SECONDS, PHASE_SECONDS, SLOTS_REDONE, WORKERS, WORKERS_JOINED, WORKERS_LOST, EPISODES,
    SUCCESSES, SUCCESS_RATE, SPOOL_RECORDS, CHECKPOINT_TIME,
)  # fmt: skip

BOUNDS = [0.001 * 2**power for power in range(18)]
"""Bounds of the histogram's buckets, in seconds: a millisecond to some two minutes."""
NOTHING = 1e-300
"""Added in place of 0, which Ray's counters refuse; it is lost in whatever is added to it."""


class Meter:
    """Receives what is counted and measured, and ignores it: without Ray, metrics cost nothing."""

    def record(self, measure: Measure, value: float = 1.0, **labels: str) -> None:
        """Add to a counter, set a gauge, or observe a value of a histogram."""

    def iteration(self, timing: Timing) -> None:
        """Count an iteration, and the seconds of its phases."""


class RayMeter(Meter):
    """Records in Ray's metrics: a number in memory each, which Ray collects every few seconds."""

    def __init__(self, suite: str) -> None:
        """Start all counters that have no labels but the suite."""
        self._has_failed = False
        self._metrics = {measure: _of_ray(measure, suite) for measure in MEASURES}
        for measure in MEASURES:
            if measure.kind == "counter" and not measure.labels:
                self.record(measure, 0.0)

    def record(self, measure: Measure, value: float = 1.0, **labels: str) -> None:
        """Add to a counter, set a gauge, or observe a value of a histogram.

        Adding 0 or less to a counter makes it exist without changing it: an alert on its growth needs to see it before
        it grows. What Ray raises, whatever it is, is logged once, and the run goes on.
        """
        metric = self._metrics[measure]
        record = {"counter": "inc", "gauge": "set", "histogram": "observe"}[measure.kind]
        try:
            getattr(metric, record)(value if value > 0 or measure.kind != "counter" else NOTHING, labels)
        except Exception as error:  # noqa: BLE001  whatever Ray raises
            if not self._has_failed:
                logger.warning(f"Ray takes no metrics ({error_line(error)}); going on without")
            self._has_failed = True

    def iteration(self, timing: Timing) -> None:
        """Count an iteration, and the seconds of its phases."""
        self.record(ITERATIONS)
        self.record(ITERATION_SECONDS, timing.iteration)
        for phase, seconds in timing._asdict().items():
            self.record(PHASE_SECONDS, seconds, phase=phase)


def _of_ray(measure: Measure, suite: str) -> Any:
    from ray.util.metrics import Counter, Gauge, Histogram

    labels = ("suite", *measure.labels)
    if measure.kind == "histogram":
        metric = Histogram(measure.name, measure.meaning, BOUNDS, labels)
    else:
        metric = {"counter": Counter, "gauge": Gauge}[measure.kind](measure.name, measure.meaning, labels)
    return metric.set_default_tags({"suite": suite})


class WorkerCounter(PoolListener):
    """Counts the workers of one kind, in one pool or several, and the slots that are computed again."""

    def __init__(self, kind: str, meter: Meter) -> None:
        self._kind, self._meter = kind, meter
        self._alive = self._lost = 0
        for measure in (WORKERS_JOINED, WORKERS_LOST, WORKERS):
            meter.record(measure, 0.0, kind=kind)

    @property
    def count(self) -> Workers:
        """How many are alive, and how many were replaced."""
        return Workers(self._kind, self._alive, self._lost)

    def worker_started(self) -> None:
        """Count a worker that started."""
        self._meter.record(WORKERS_JOINED, kind=self._kind)
        self._add(1)

    def worker_lost(self) -> None:
        """Count a worker that died or was killed for slowness."""
        self._lost += 1
        self._meter.record(WORKERS_LOST, kind=self._kind)
        self._add(-1)

    def worker_stopped(self) -> None:
        """Subtract a worker whose pool is closed."""
        self._add(-1)

    def call_resent(self, call: Call) -> None:
        """Count the slots of a block that is computed again."""
        self.slots_redone(sum(len(argument.slots) for argument in call.arguments if isinstance(argument, Block)))

    def slots_redone(self, slots: int) -> None:
        """Count slots that are computed again."""
        self._meter.record(SLOTS_REDONE, float(slots))

    def _add(self, workers: int) -> None:
        self._alive += workers
        self._meter.record(WORKERS, float(self._alive), kind=self._kind)
