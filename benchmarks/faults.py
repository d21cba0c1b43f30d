"""A campaign of kills: quick experiments whose processes are killed at random moments, against an undisturbed one.

Workers (one, or all at once), the learner and the program itself are killed with SIGKILL; a killed program is resumed.
In the end, parameters, Adam's moments and all result rows are compared to the bit with those of the undisturbed run.
What a kill of each kind cost is estimated from the runs' seconds by least squares.
"""

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from rich.box import SIMPLE
from scipy.optimize import nnls

from benchmarks.harness import BenchmarkArguments, Row, lay_out, main
from services.cli.progress import Bar, console

VICTIMS = {"worker": 7, "all workers": 1, "learner": 2, "driver": 1}
"""What is killed, and how often against the others."""
KILLS_PER_RUN = 10
SETTINGS = (
    "--preset", "ml10-smoke", "--workers", "2", "--training.checkpoint-every", "20",
    "--training.tasks-per-iteration", "4",
)  # fmt: skip
SECONDS_BETWEEN = 3.0
"""Mean time from one kill to the next, while a learner or a worker is there."""
STARTING = 0.03
"""How probable a kill then is in the seconds in which a program starts, when it alone is there."""
RUN_SECONDS = 600.0
"""A run that takes longer counts as lost."""
ATTEMPTS = 3
"""So often may a program end with an error of its own, and be resumed, before its run counts as lost."""


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``faults``."""

    kills: int = 200
    """How many processes, or groups of them at once, are killed in all."""
    seed: int = 0
    """Of the moments and the victims."""
    iterations: int = 480
    """Of each run; it is evaluated after each third of them."""
    folder: Path | None = None
    """Keep demonstrations and runs here; else they go when all is over."""


class Outcome(NamedTuple):
    """What came of one disturbed run."""

    kills: Counter[str]
    seconds: float
    found: str | None
    """Digest of what it ended with; none if it did not end."""


class Campaign:
    """Runs of one experiment in one folder."""

    def __init__(self, folder: Path, draw: random.Random, iterations: int) -> None:
        """Run in `folder`, where all runs share their demonstrations."""
        self.folder, self._draw = folder, draw
        schedule = ("--training.iterations", str(iterations), "--evaluation.every", str(max(1, iterations // 3)))
        self._settings = (*SETTINGS, *schedule)
        self._environment = os.environ | {"MLFLOW_TRACKING_URI": f"sqlite:///{folder / 'mlflow.db'}"}
        self._environment.pop("RAY_ADDRESS", None)
        self._environment["PYTHONPATH"] = str(Path(__file__).parents[1])

    def collect(self) -> None:
        """Make the demonstrations, which no run's seconds are to hold."""
        command = [sys.executable, "-m", "services.collect_demos", *SETTINGS[:2], "--runner", "local"]
        subprocess.run(command, cwd=self.folder, env=self._environment, check=True, stdout=subprocess.DEVNULL)

    def run(self, name: str, kills: int) -> Outcome:
        """Run the experiment, killing something of it so many times unless it ends before."""
        began, done, errors = time.monotonic(), Counter[str](), 0
        log = (self.folder / f"{name}.log").open("w")
        program = self._start(name, log)
        try:
            while time.monotonic() - began < RUN_SECONDS:
                pause = self._draw.expovariate(1 / SECONDS_BETWEEN) if done.total() < kills else RUN_SECONDS
                if not _ended(program, pause):
                    if victim := self._kill(program):
                        done[victim] += 1
                elif program.returncode == 0:
                    return Outcome(done, time.monotonic() - began, outcome_digest(self.folder / "runs" / name))
                else:
                    if program.returncode != -signal.SIGKILL:
                        errors += 1
                    if errors == ATTEMPTS:
                        break
                    program = self._start(name, log)
            return Outcome(done, time.monotonic() - began, None)
        finally:
            _kill([program, *_descendants(program)])
            log.close()

    def _start(self, name: str, log: Any) -> psutil.Popen:
        begun = (self.folder / "runs" / name / "config.json").exists()
        which = ["--resume", name] if begun else ["--name", name, *self._settings]
        command = [sys.executable, "-m", "services.meta_train", *which]
        return psutil.Popen(
            command,
            cwd=self.folder,
            env=self._environment,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )

    def _kill(self, program: psutil.Popen) -> str | None:
        """Kill a random one of those that there are; return what it was."""
        titles = {process: _title(process) for process in _descendants(program)}
        workers = [p for p, title in titles.items() if "Worker" in title and title.startswith("ray::")]
        learners = [p for p, title in titles.items() if title.startswith("ray::Learner")]
        there: dict[str, list[Any]] = {"worker": workers[:], "learner": learners, "driver": [program]}
        there["all workers"] = workers if len(workers) > 1 else []
        kinds = [kind for kind in VICTIMS if there[kind]]
        if kinds == ["driver"] and self._draw.random() > STARTING:
            return None
        kind = self._draw.choices(kinds, [VICTIMS[kind] for kind in kinds])[0]
        if kind == "driver":
            left = _descendants(program)
            _kill([program])
            _, alive = psutil.wait_procs(left, timeout=20)  # a new program must not meet the old one's processes
            _kill(alive)
        else:
            _kill([self._draw.choice(there[kind])] if kind == "worker" else there[kind])
        return kind


def outcome_digest(run: Path) -> str:
    """Return the SHA-256 of a run's last parameters, optimiser state and rows, those of evaluations on the way too."""
    last = max((run / "checkpoints").glob("iteration-*"))
    files = [last / "parameters.safetensors", last / "optimiser.safetensors", *sorted(run.rglob("*.jsonl"))]
    sha = hashlib.sha256(last.name.encode())
    for file in files:
        if file.name != "tracking.jsonl":
            sha.update(str(file.relative_to(run)).encode() + hashlib.sha256(file.read_bytes()).digest())
    return sha.hexdigest()


def _ended(program: psutil.Popen, seconds: float) -> bool:
    try:
        program.wait(seconds)
    except psutil.TimeoutExpired:
        return False
    return True


def _descendants(program: psutil.Popen) -> list[psutil.Process]:
    try:
        return program.children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _title(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def _kill(processes: Sequence[Any]) -> None:
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.kill()


def _costs(outcomes: Sequence[Outcome], undisturbed: float) -> dict[str, float]:
    """Return the seconds that a kill of each kind cost, which add up to those that the runs took longer."""
    counts = np.array([[outcome.kills[kind] for kind in VICTIMS] for outcome in outcomes], float)
    longer = np.array([outcome.seconds - undisturbed for outcome in outcomes])
    seconds, _ = nnls(counts, np.maximum(longer, 0))
    return dict(zip(VICTIMS, map(float, seconds), strict=True))


def _cells(kind: str, counts: Counter[str], cost: float | None) -> dict[str, str]:
    return {
        "killed": kind,
        "kills": str(counts.total()),
        "survived": str(counts["equal"]),
        "lost": str(counts["lost"]),
        "different": str(counts["different"]),
        "seconds each cost": "" if cost is None else f"{cost:.1f}",
    }


def _counts(outcomes: Sequence[Outcome], wanted: str | None, kind: str = "all") -> Counter[str]:
    counts: Counter[str] = Counter()
    for outcome in outcomes:
        became = "lost" if outcome.found is None else "equal" if outcome.found == wanted else "different"
        counts[became] += outcome.kills.total() if kind == "all" else outcome.kills[kind]
    return counts


def run(args: Arguments) -> Row:
    """Run the benchmark."""
    folder = args.folder or Path(tempfile.mkdtemp(prefix="dmil-faults-"))
    folder.mkdir(parents=True, exist_ok=True)
    campaign = Campaign(folder.resolve(), random.Random(args.seed), args.iterations)
    try:
        campaign.collect()
        undisturbed = campaign.run("undisturbed", 0)
        outcomes: list[Outcome] = []
        with Bar("kills", args.kills) as bar:
            while (done := sum(outcome.kills.total() for outcome in outcomes)) < args.kills:
                outcome = campaign.run(f"run-{len(outcomes):03d}", min(KILLS_PER_RUN, args.kills - done))
                outcomes.append(outcome)
                bar.advance(outcome.kills.total(), f"{len(outcomes)} runs, {_counts(outcomes, undisturbed.found)}")
    finally:
        if args.folder is None:
            shutil.rmtree(folder, ignore_errors=True)
    counts = _counts(outcomes, undisturbed.found)
    costs = _costs(outcomes, undisturbed.seconds)
    cells = [_cells(kind, _counts(outcomes, undisturbed.found, kind), costs.get(kind)) for kind in (*VICTIMS, "all")]
    console.print(lay_out("Kills, by what became of the runs that they struck", cells, box=SIMPLE))
    console.print(
        f"{len(outcomes)} runs of {undisturbed.seconds:.0f} s undisturbed; {counts['equal']} of {counts.total()} kills "
        "struck runs that ended with the same bits"
    )
    row = {"kills": counts.total(), **{name: counts[name] for name in ("equal", "lost", "different")}}
    return row | {"runs": len(outcomes), "seconds": undisturbed.seconds, "cost": costs}


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
