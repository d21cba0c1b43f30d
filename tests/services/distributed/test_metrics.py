"""What a run tells Ray of itself arrives at the endpoint that Prometheus asks, with the right counts."""

import re
import subprocess
import sys
import urllib.request
from collections.abc import Container, Iterator
from http.client import HTTPException
from pathlib import Path

import pytest

from services.distributed.metrics import MEASURES, NOTHING, Meter
from services.distributed.runner import LocalRunner

PROJECT = Path(__file__).parents[3]
LINE = re.compile(r"(ray_dmil_\w+)\{(.*)\} (\S+)")

SeriesKey = tuple[str, frozenset[tuple[str, str]]]
Series = dict[SeriesKey, float]


def scraped(port: int) -> Series:
    """Return the values of our metrics at a node, by name and our labels; none while it does not answer."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
            lines = answer.read().decode().splitlines()
    except (OSError, HTTPException):
        return {}
    found = {}
    for name, labels, value in (line.groups() for line in map(LINE.fullmatch, lines) if line):
        own = {
            (key, text) for key, text in re.findall(r'(\w+)="([^"]*)"', labels) if key.islower() and "otel" not in key
        }
        found[name, frozenset(own)] = float(value)
    return found


def key(name: str, **labels: str) -> SeriesKey:
    return f"ray_{name}", frozenset({"suite": "ml10-part", **labels}.items())


RUN = """
import os, signal, sys
from contextlib import suppress
from pathlib import Path

import ray

import services.distributed.ray_meta_training
from services import meta_train
from services.distributed.adaptation_worker import AdaptationWorker

note, port = Path("killed").absolute(), Path("port")


class Mortal(AdaptationWorker):
    # One of them is killed in the middle of its work, in the third iteration.
    def gradient(self, parameters, block, previous=()):
        if block.iteration == 2:
            with suppress(FileExistsError):  # the other one was first
                note.touch(exist_ok=False)
                os.kill(os.getpid(), signal.SIGKILL)
        return super().gradient(parameters, block, previous)


services.distributed.ray_meta_training.AdaptationWorker = Mortal
ray.init(log_to_driver=False)
meta_train.run(sys.argv[1:])
port.write_text(str(ray.nodes()[0]["MetricsExportPort"]))
sys.stdin.read()  # what it measured goes when it leaves the cluster
"""
SETTINGS = (
    "--preset", "ml10-smoke", "--name", "run", "--workers", "2", "--training.iterations", "6",
    "--training.tasks-per-iteration", "5", "--training.slots-per-group", "1", "--evaluation.shots", "1",
    "--evaluation.episodes", "1", "--evaluation.fine-tuning-steps", "1",
)  # fmt: skip


@pytest.fixture
def port(joined, workplace: Path, wait_for) -> Iterator[int]:
    """Of the endpoint, when the run is over; it has a process of its own, for Ray counts twice what joined it twice."""
    with (workplace / "printed.txt").open("w") as printed:
        command = [sys.executable, "-c", RUN, *SETTINGS]
        program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=printed, stderr=printed)
    file = workplace / "port"
    wait_for(lambda: program.poll() is not None or (file.exists() and file.read_text() != ""), "the run's end")
    assert program.poll() is None, (workplace / "printed.txt").read_text()
    yield int(file.read_text())
    program.communicate()


@pytest.mark.thorough
def test_a_run_with_a_killed_worker_arrives(port: int, workplace: Path, wait_for):
    adaptation, simulation = {"kind": "adaptation"}, {"kind": "simulation"}
    wanted: dict[SeriesKey, Container[float]] = {
        key("dmil_iterations_total"): {6},
        key("dmil_iteration_seconds_count"): {6},
        key("dmil_slots_redone_total"): range(1, 6),
        key("dmil_workers_lost_total", **adaptation): {1},
        key("dmil_workers_lost_total", **simulation): {NOTHING},
        key("dmil_workers_joined_total", **adaptation): {2, 3},  # the other one may come too late
        key("dmil_workers", **adaptation): {0},
        key("dmil_workers", **simulation): {0},
    }
    phases = [key("dmil_phase_seconds_total", phase=phase) for phase in ("broadcast", "compute", "step")]
    checkpoint, waiting = key("dmil_checkpoint_timestamp_seconds"), key("dmil_spool_records")
    rates = []
    for split, episodes in (("meta-training", 3), ("meta-testing", 1)):
        labels = {"split": split, "shots": "1"}
        wanted[key("dmil_episodes_total", **labels)] = {episodes}
        rates.append((key("dmil_successes_total", **labels), key("dmil_success_rate", **labels), episodes))
    present = {*phases, checkpoint, waiting, *(series for *both, _ in rates for series in both)}
    found: Series = {}

    def arrived() -> bool:
        """Each series has its own time, and comes first with what was counted until then."""
        found.clear()
        found.update(scraped(port))
        return present | wanted.keys() <= found.keys() and all(found[series] in wanted[series] for series in wanted)

    wait_for(arrived, f"{wanted}")
    assert all(found[phase] > 0 for phase in phases)
    for successes, rate, episodes in rates:
        assert found[rate] == round(found[successes]) / episodes
    written = (workplace / "runs/run/checkpoints/iteration-0000006/manifest.json").stat().st_mtime
    assert found[checkpoint] == pytest.approx(written, abs=600)
    assert found[waiting] >= 0
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
    assert not LocalRunner.worker_counts
