"""What a run tells Ray of itself arrives at the endpoint that Prometheus asks, with the right counts."""

import logging
import os
import re
import signal
import time
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import ray

from services.actors.adaptation import AdaptationWorker
from services.metrics import MEASURES, Meter, RayMeter
from services.runners import LocalRunner

PROJECT = Path(__file__).parents[2]
LINE = re.compile(r"(ray_dmil_\w+)\{(.*)\} (\S+)")

Series = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scraped(port: int) -> Series:
    """Return the values of our metrics at a node, by name and our labels."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=30) as answer:
        lines = answer.read().decode().splitlines()
    found = {}
    for name, labels, value in (line.groups() for line in map(LINE.fullmatch, lines) if line):
        own = {
            (key, text) for key, text in re.findall(r'(\w+)="([^"]*)"', labels) if key.islower() and "otel" not in key
        }
        found[name, frozenset(own)] = float(value)
    return found


SUITE = "of this test"
"""Its label: Ray goes on counting, in one process, from cluster to cluster."""


def key(name: str, **labels: str) -> tuple[str, frozenset[tuple[str, str]]]:
    return f"ray_{name}", frozenset({"suite": SUITE, **labels}.items())


@pytest.fixture
def port(joined) -> Iterator[int]:
    """Of the endpoint; this process stays in the cluster during the whole test."""
    ray.init(logging_level=logging.WARNING, log_to_driver=False)
    yield ray.nodes()[0]["MetricsExportPort"]
    ray.shutdown()


@pytest.mark.slow
def test_a_run_with_a_killed_worker_arrives(
    port: int, train, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wait_for
):
    note, began = tmp_path / "killed", time.time()

    class Mortal(AdaptationWorker):
        """One of them is killed in the middle of its work, in the third iteration."""

        def gradient(self, parameters, iteration, tasks, block, before=()):
            if iteration == 2:
                with suppress(FileExistsError):  # the other one was first
                    note.touch(exist_ok=False)
                    os.kill(os.getpid(), signal.SIGKILL)
            return super().gradient(parameters, iteration, tasks, block, before)

    monkeypatch.setattr("services.ray_meta_training.AdaptationWorker", Mortal)
    monkeypatch.setattr("services.ray_runner.RayMeter", lambda suite: RayMeter(SUITE))
    arguments = ["--workers", "2", "--training.tasks-per-iteration", "5", "--training.slots-per-group", "1"]
    train("run", "--runner", "ray", "--training.iterations", "6", *arguments)

    found: Series = {}

    def arrived() -> bool:
        found.update(scraped(port))
        return key("dmil_success_rate", split="meta-testing", shots="1") in found

    wait_for(arrived, "the metrics", 60)
    assert found[key("dmil_iterations_total")] == 6
    assert found[key("dmil_iteration_seconds_count")] == 6
    phases = [found[key("dmil_phase_seconds_total", phase=phase)] for phase in ("broadcast", "compute", "step")]
    assert all(seconds > 0 for seconds in phases)
    assert found[key("dmil_slots_redone_total")] in range(1, 6)
    assert found[key("dmil_workers_lost_total", kind="adaptation")] == 1
    assert found[key("dmil_workers_joined_total", kind="adaptation")] in (2, 3), "the other one may come too late"
    assert found[key("dmil_workers_lost_total", kind="simulation")] < 1e-200
    assert found[key("dmil_workers", kind="adaptation")] == found[key("dmil_workers", kind="simulation")] == 0
    for split, episodes in (("meta-training", 3), ("meta-testing", 1)):
        labels = {"split": split, "shots": "1"}
        assert found[key("dmil_episodes_total", **labels)] == episodes
        successes = round(found[key("dmil_successes_total", **labels)])
        assert found[key("dmil_success_rate", **labels)] == successes / episodes
    assert began < found[key("dmil_checkpoint_timestamp_seconds")] < time.time()
    assert found[key("dmil_spool_records")] >= 0
    names = {name for name, _ in found}
    assert all(any(name.startswith(f"ray_{measure.name}") for name in names) for measure in MEASURES)


def test_every_metric_is_documented():
    page = (PROJECT / "docs" / "operations.md").read_text()
    for measure in MEASURES:
        suffix = {"counter": "_total"}.get(measure.kind, "")
        (line,) = [line for line in page.splitlines() if line.startswith(f"| `ray_{measure.name}{suffix}` |")]
        _, _, kind, labels, meaning, _ = (part.strip() for part in line.split("|"))
        assert kind == measure.kind
        assert labels == ", ".join(f"`{label}`" for label in ("suite", *measure.labels))
        assert meaning == measure.meaning


def test_without_ray_nobody_listens():
    assert type(LocalRunner.meter) is Meter
    assert not LocalRunner.staff
