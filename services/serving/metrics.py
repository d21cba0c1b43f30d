"""What a replica counts, and all of them together, as Prometheus reads it."""

from collections.abc import Mapping

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.exposition import generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

LATENCIES = (0.001, 0.002, 0.004, 0.008, 0.02, 0.05, 0.1, 0.5, 2.0, 10.0)
"""Bounds of the classes of latencies, in seconds."""
Samples = Mapping[tuple[str, tuple[tuple[str, str], ...]], float]
"""Figures by name and labels."""


class Metrics:
    """Counters of one replica; `text` also takes those of the others."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "dmil_serving_requests", "Requests by route, method and status", ("route", "method", "status"),
            registry=self._registry,
        )  # fmt: skip
        self._seconds = Histogram(
            "dmil_serving_request_seconds", "Time to the answer, by route", ("route",), buckets=LATENCIES,
            registry=self._registry,
        )  # fmt: skip
        self.adaptations = Counter(
            "dmil_serving_adaptations", "Adaptations by how they ended", ("ended",), registry=self._registry
        )
        self.adaptation_seconds = Histogram(
            "dmil_serving_adaptation_seconds", "Time of an adaptation, without waiting", buckets=(*LATENCIES, 60.0),
            registry=self._registry,
        )  # fmt: skip
        self.steps = Counter("dmil_serving_steps", "Steps of control loops", registry=self._registry)

    def answered(self, route: str, method: str, status: int, seconds: float) -> None:
        """Count a request."""
        self._requests.labels(route, method, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def samples(self) -> Samples:
        """Return all figures so far; none of them ever falls, but when each was first counted is left out."""
        return {
            (sample.name, tuple(sample.labels.items())): sample.value
            for metric in self._registry.collect()
            for sample in metric.samples
            if not sample.name.endswith("_created")
        }

    def text(self, totals: Samples, **gauges: float) -> bytes:
        """Return figures in Prometheus' format: the sums of all replicas' `samples`, and others by name."""
        registry = CollectorRegistry()
        registry.register(_Totals(list(self._registry.collect()), totals, gauges))
        return generate_latest(registry)


class _Totals(Collector):
    def __init__(self, known: list[Metric], totals: Samples, gauges: Mapping[str, float]) -> None:
        self._known, self._totals, self._gauges = known, totals, gauges

    def collect(self) -> list[Metric]:
        found = []
        for metric in self._known:
            total = Metric(metric.name, metric.documentation, metric.type)
            for (name, labels), value in self._totals.items():
                if name.startswith(metric.name) and name[len(metric.name) :] in ("_total", "_bucket", "_count", "_sum"):
                    total.add_sample(name, dict(labels), value)
            found.append(total)
        for name, value in self._gauges.items():
            gauge = Metric(f"dmil_serving_{name}", name.replace("_", " "), "gauge")
            gauge.add_sample(gauge.name, {}, value)
            found.append(gauge)
        return found
