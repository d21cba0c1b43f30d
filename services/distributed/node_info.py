"""What a machine is and has, as far as a long run depends on it; in a cluster, of every node."""

import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from services.storage.provenance import library_versions

SECONDS_TO_ANSWER = 60.0
CONTROL_GROUP = Path("/sys/fs/cgroup")
CPU_LIMITS = (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"))
"""Files with the microseconds of processor time that a control group grants in so many, in its versions 2 and 1."""


class NodeFacts(NamedTuple):
    """What one machine reports of itself."""

    name: str
    versions: dict[str, str]
    """Of Python and of the libraries that a result depends on."""
    packages: str
    """All installed packages with their versions, in order: equal where the machines are set up alike."""
    cores: int
    cpus: float
    """Workers that may be there at a time, by Ray's count; the cores, without Ray."""
    memory: int
    """Bytes that are available."""
    shared_memory: int
    """Bytes that are free in /dev/shm."""
    disk: int
    """Bytes that are free where runs are kept."""
    threads: str | None
    """``OMP_NUM_THREADS``."""
    drawing: str
    """The backend of OpenGL, or what is wrong with it."""
    draws: bool
    sees_mark: bool
    """Whether the mark that the asking process made where runs are kept is there too."""
    skew: float = 0.0
    """Seconds by which its clock is ahead of the asking machine's, to within a round trip."""


def usable_cpus() -> int:
    """Return how many CPUs this process may use: of its affinity, and of the time that its control group grants."""
    cpus = len(os.sched_getaffinity(0))
    for names in CPU_LIMITS:
        with suppress(OSError, ValueError):  # no such file, or no limit
            quota, period = " ".join((CONTROL_GROUP / name).read_text() for name in names).split()
            if int(quota) > 0:
                return max(1, min(cpus, round(int(quota) / int(period))))
    return cpus


def facts(runs: str, mark: str, cpus: float | None = None) -> NodeFacts:
    """Return the facts of this machine, whose `cpus` Ray may count otherwise."""
    there = Path(runs).absolute()
    disk = shutil.disk_usage(next(folder for folder in (there, *there.parents) if folder.exists()))
    cores = usable_cpus()
    drawing, draws = _drawing()
    installed = sorted({f"{package.name}=={package.version}" for package in distributions()})
    return NodeFacts(
        name=platform.node(),
        versions={"python": platform.python_version(), **library_versions()},
        packages=" ".join(installed),
        cores=cores,
        cpus=cores if cpus is None else cpus,
        memory=psutil.virtual_memory().available,
        shared_memory=shutil.disk_usage("/dev/shm").free,
        disk=disk.free,
        threads=os.environ.get("OMP_NUM_THREADS"),
        drawing=drawing,
        draws=draws,
        sees_mark=(there / mark).exists(),
    )


def cluster_facts(runs: Path, mark: str) -> tuple[list[NodeFacts], list[str]]:
    """Return the facts of every node of the cluster that this process has joined, and the names of those silent."""
    import ray
    from ray.exceptions import RayError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    ask = ray.remote(num_cpus=0, max_retries=0)(facts)
    tell_time = ray.remote(num_cpus=0, max_retries=0)(_time)
    nodes, silent = [], []
    for node in (node for node in ray.nodes() if node["Alive"]):
        here = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)

        def answer(task: Any, *arguments: Any, here: NodeAffinitySchedulingStrategy = here) -> Any:
            asked = task.options(scheduling_strategy=here).remote(*arguments)
            return ray.get(asked, timeout=SECONDS_TO_ANSWER)

        try:
            node_facts: NodeFacts = answer(ask, str(runs.absolute()), mark, node["Resources"].get("CPU", 0.0))
            nodes.append(node_facts._replace(skew=_skew(partial(answer, tell_time))))
        except RayError:
            silent.append(f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})")
    return nodes, silent


def _drawing() -> tuple[str, bool]:
    """Return the backend of OpenGL, or what is wrong with it: found by a process of its own, for it may crash."""
    command = "from services.suites.rendering import working_backend; print(working_backend())"
    paths = os.pathsep.join(map(os.path.abspath, sys.path))  # with -P none that this process does not have
    environment = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-P", "-c", command], env=environment, capture_output=True, text=True)
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    return (lines[-1] if lines else f"ended with {done.returncode}"), done.returncode == 0


def _time() -> float:
    return time.time()


def _skew(clock: Callable[[], float]) -> float:
    """Return by how much another clock is ahead, from the quickest of a few readings."""
    readings = []
    for _ in range(3):
        before = time.time()
        reading = clock()
        after = time.time()
        readings.append((after - before, reading - (before + after) / 2))
    return min(readings)[1]
