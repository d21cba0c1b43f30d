"""Check a machine, or the cluster that RAY_ADDRESS names, before a long run; with a remedy where something is wrong.

It changes nothing that stays, but for an MLflow experiment named dmil-doctor, whose run it deletes again.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple
from uuid import uuid4

from rich.table import Table

from dmil_core.errors import RunError
from dmil_core.files import DiskFullError, read_file, remove_file, write_file
from services.cli.arguments import exit_code, parse
from services.cli.progress import console
from services.demonstrations.store import data_root
from services.distributed.cluster import joined, named_address
from services.distributed.node_info import NodeFacts, cluster_facts, facts
from services.storage.redaction import error_line, redacted
from services.tracking.client import connect
from services.tracking.links import tracking_uri

Verdict = Literal["good", "warning", "bad"]
DISK_BYTES = 2 * 10**9
"""A run at paper size keeps some hundred MB of checkpoints, ML45's demonstrations take as much."""
WORKER_BYTES = 7 * 10**8
"""An adaptation worker at paper size with K = 10 (docs/performance.md)."""
SHARED_BYTES = 5 * 10**8
SKEW_SECONDS = 1.0
SECONDS_FOR_MLFLOW = "10"


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``doctor``."""

    runs: Path = Path("runs")
    """The folder that runs are to be kept in; in a cluster, one that all nodes see."""


class Finding(NamedTuple):
    """What came of one check."""

    what: str
    verdict: Verdict
    got: str
    remedy: str = ""
    """What to do, unless all is good."""


def run(arguments: Sequence[str]) -> None:
    """Run the program.

    Raises:
        RunError: if something is bad.
    """
    args = parse(Arguments, __doc__ or "", arguments, Arguments())
    mark = f".doctor-{uuid4().hex}"
    findings = [*_storage("runs", args.runs, mark), *_storage("demonstrations", data_root(), mark)]
    if named_address() is not None:
        with joined(), _marked(args.runs / mark):
            nodes, silent = cluster_facts(args.runs, mark)
    else:
        nodes, silent = [facts(str(args.runs), mark)], []
    findings += [Finding(f"node {name}", "bad", "does not answer", "look at it, or take it away") for name in silent]
    findings += [*examine(nodes), _mlflow()]
    table = Table("check", "", "found", "what to do", title="before a long run")
    for finding in findings:
        table.add_row(*finding)
    console.print(table)
    if bad := [finding.what for finding in findings if finding.verdict == "bad"]:
        raise RunError(f"{len(bad)} of {len(findings)} checks are bad: {', '.join(bad)}; see what to do above")
    console.print("all that a run needs is there")


@contextmanager
def _marked(mark: Path) -> Iterator[None]:
    write_file(mark.parent, mark.name, b"")
    try:
        yield
    finally:
        remove_file(mark.parent, mark.name)


def examine(nodes: Sequence[NodeFacts]) -> Iterator[Finding]:
    """Yield the findings on some machines that work together."""
    yield _versions(nodes)
    for node in nodes:
        yield _enough(f"{node.name}: disk", node.disk, DISK_BYTES, "free some, or give --runs on another disk")
        wanted = int(WORKER_BYTES * node.cpus)
        yield _enough(
            f"{node.name}: memory for {node.cpus:g} workers", node.memory, wanted,
            "close other programs, or give Ray fewer CPUs (--workers, ray start --num-cpus)",
        )  # fmt: skip
        yield _enough(
            f"{node.name}: /dev/shm", node.shared_memory, SHARED_BYTES,
            "mount it larger (docker run --shm-size 1g), or Ray's object store goes to the disk",
        )  # fmt: skip
        yield _cpus(node)
        yield Finding(
            f"{node.name}: drawing", "good" if node.draws else "warning", node.drawing, "" if node.draws else
            "only videos need it: apt-get install libegl1 libgl1, or libosmesa6 with MUJOCO_GL=osmesa")  # fmt: skip
        if len(nodes) > 1:
            yield _clock(node)
            yield Finding(
                f"{node.name}: shared storage", "good" if node.sees_mark else "bad",
                "sees the runs" if node.sees_mark else "does not see the folder of runs",
                "" if node.sees_mark else "mount the same folder under the same path on all nodes (docs/deploy.md)",
            )  # fmt: skip


def _versions(nodes: Sequence[NodeFacts]) -> Finding:
    first = nodes[0]
    differing = {
        f"{name} {first.versions[name]} on {first.name}, {node.versions.get(name)} on {node.name}"
        for node in nodes
        for name in first.versions
        if node.versions.get(name) != first.versions[name]
    }
    remedy = "install the same constraints.txt on all nodes; results depend on these"
    if differing:
        return Finding("versions", "bad", "; ".join(sorted(differing)), remedy)
    text = ", ".join(f"{name} {version}" for name, version in first.versions.items())
    if len({node.packages for node in nodes}) > 1:
        return Finding("versions", "warning", f"{text}; other packages differ between nodes", remedy)
    return Finding("versions", "good", text)


def _enough(what: str, got: int, wanted: int, remedy: str) -> Finding:
    text = f"{got / 1e9:.1f} GB, wanted {wanted / 1e9:.1f}"
    return Finding(what, "good", text) if got >= wanted else Finding(what, "bad", text, remedy)


def _cpus(node: NodeFacts) -> Finding:
    what = f"{node.name}: CPUs"
    if node.cpus > node.cores:
        text = f"Ray counts {node.cpus:g}, there are {node.cores} cores"
        return Finding(what, "warning", text, "workers would share cores: ray start --num-cpus with as many as cores")
    if node.threads not in (None, "1"):
        text = f"{node.cores} cores, OMP_NUM_THREADS={node.threads}"
        return Finding(what, "warning", text, "a worker computes on one thread: unset it, or set it to 1")
    return Finding(what, "good", f"{node.cpus:g} workers at a time, one thread each, on {node.cores} cores")


def _clock(node: NodeFacts) -> Finding:
    text = f"{node.skew:+.2f} s from this machine's"
    if abs(node.skew) <= SKEW_SECONDS:
        return Finding(f"{node.name}: clock", "good", text)
    return Finding(f"{node.name}: clock", "warning", text, "records would be out of order: let NTP set the clocks")


def _storage(what: str, folder: Path, mark: str) -> Iterator[Finding]:
    """Write a file in place of another, as checkpoints and records are."""
    name, there = f"{mark}-file", folder.exists()
    try:
        write_file(folder, name, b"before")
        write_file(folder, name, b"after")
        if (content := read_file(folder, name, 100)) != b"after":
            yield Finding(f"storage of {what}", "bad", f"{folder}: a file that was replaced still holds {content!r}",
                          "use a file system with atomic renames")  # fmt: skip
            return
        yield Finding(f"storage of {what}", "good", f"{folder.absolute()}: written, synced and replaced")
    except (OSError, DiskFullError) as error:
        remedy = "make it writable for you, or name another: --runs, DMIL_DATA"
        yield Finding(f"storage of {what}", "bad", f"{folder}: {error}", remedy)
    finally:
        remove_file(folder, name)
        if folder.exists() and not there:
            folder.rmdir()


def _mlflow() -> Finding:
    """Make a run in MLflow and delete it."""
    os.environ["MLFLOW_HTTP_REQUEST_TIMEOUT"] = SECONDS_FOR_MLFLOW
    uri = tracking_uri()
    try:
        client = connect(uri)
        experiment = client.get_experiment_by_name("dmil-doctor")
        made = client.create_experiment("dmil-doctor") if experiment is None else experiment.experiment_id
        run_id = client.create_run(made).info.run_id
        client.log_metric(run_id, "checked", 1.0)
        client.delete_run(run_id)
    except Exception as error:  # noqa: BLE001  whatever MLflow raises is reported
        return Finding(
            "MLflow", "bad", f"{redacted(uri)}: {error_line(error)}",
            "start it, or mend MLFLOW_TRACKING_URI; a run would go on without, and keep its records",
        )  # fmt: skip
    return Finding("MLflow", "good", f"{redacted(uri)}: takes records")


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
