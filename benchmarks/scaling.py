"""How meta-training scales with Ray's workers, and where the time of an iteration goes.

Demonstrations are synthetic, in the shape of Meta-World's: 39-dimensional observations, 4-dimensional actions, ten
tasks, 100 steps, five slots a group. The local runner, one worker and two take turns; the table has medians over all
iterations.

The seconds of an iteration are divided up whole, see `services.distributed.timing.Timing`. The share of the overhead
is what is left of the iteration beside an ideal one: 1 - (worker compute seconds / workers + step seconds) / iteration
seconds. So waiting for the slower worker counts as overhead too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from rich.box import SIMPLE

from benchmarks import harness
from benchmarks.cluster_model import calls_of_a_tree
from benchmarks.harness import BenchmarkArguments, alternate, lay_out, machine, main
from benchmarks.workload import Size, made_up_plan
from dmil_core.configs import PRESETS
from services.cli.progress import console
from services.distributed.ray_meta_training import FAN_IN, RayMetaTraining
from services.distributed.ray_runner import RayRunner
from services.distributed.runner import LocalMetaTraining, MetaTraining
from services.distributed.timing import Timing
from services.suites.metaworld import MetaWorldSuite

WORKERS = (1, 2)


class Turns(NamedTuple):
    """How long is measured."""

    rounds: int
    iterations: int
    """In each turn, after a first one that is not counted: its calls are not submitted ahead."""


TURNS: Mapping[Size, Turns] = {"quick": Turns(6, 30), "paper": Turns(2, 2)}
OVERHEAD: Mapping[Size, float] = {"quick": 0.25, "paper": 0.05}
"""Overhead's largest share on two workers."""
SLOTS_PER_GROUP = 5
"""As in ml10-quick: two workers have one group each of the ten slots, and add its gradients before they travel."""
SPEEDUP = 1.85
"""Least iterations/s of two workers against one."""


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``scaling``."""

    sizes: tuple[Size, ...] = ("quick", "paper")
    """Networks, batches and windows of the presets ml10-quick and ml10-paper."""
    iterations: int | None = None
    """In each turn, if not as many as a size has on its own."""
    rounds: int | None = None
    """Turns that each takes; by default 6 at quick size and 2 at paper size."""


class Row(NamedTuple):
    """What one runner did at one size."""

    runner: Literal["local", "ray"]
    workers: int
    size: Size
    iterations_per_s: float
    overhead_share: float
    speedup: float
    """Iterations/s against one Ray worker's."""
    seconds: Timing
    parameter_bytes: int
    """Written once an iteration, and read by each node once."""
    gradient_bytes: int
    """Written by workers in an iteration: a gradient for each block and each addition."""


def measure(trainings: Mapping[str, MetaTraining], turns: Turns) -> dict[str, list[Timing]]:
    """Let rivals meta-train in turns, and return the timing of each one's iterations."""
    timings: dict[str, list[Timing]] = {name: [] for name in trainings}

    def turn(name: str) -> None:
        iterations = list(trainings[name].iterations(1 + turns.iterations))
        timings[name] += [iteration.timing for iteration in iterations[1:]]

    alternate({name: partial(turn, name) for name in trainings}, turns.rounds)
    return timings


def rows_of(size: Size, trainings: Mapping[str, MetaTraining], timings: Mapping[str, list[Timing]]) -> list[Row]:
    """Return a row for each runner."""
    seconds = {name: float(np.median([timing.iteration for timing in of_name])) for name, of_name in timings.items()}
    rows = []
    for name, training in trainings.items():
        workers, parameters, gradients = 1, 0, 0
        if isinstance(training, RayMetaTraining):
            blocks = len(training.blocks)
            workers, parameters = len(training), training.state().parameters.nbytes
            # Where each worker has one block, the last of each few has added the others before it writes anything.
            terms = -(-blocks // FAN_IN) if blocks <= workers else blocks
            gradients = (blocks + calls_of_a_tree(terms, FAN_IN)) * parameters
        rows.append(
            Row(
                "ray" if parameters else "local",
                workers,
                size,
                1 / seconds[name],
                float(np.median([timing.overhead_share for timing in timings[name]])),
                seconds[f"ray {WORKERS[0]}"] / seconds[name],
                Timing(*np.median(timings[name], axis=0).tolist()),
                parameters,
                gradients,
            )
        )
    return rows


def misses(rows: Sequence[Row]) -> list[str]:
    """Return the targets that two workers miss, in words."""
    missed = []
    for row in rows:
        if row.runner == "ray" and row.workers == 2:
            if row.overhead_share > OVERHEAD[row.size]:
                missed.append(f"{row.size}: overhead {row.overhead_share:.1%}, wanted {OVERHEAD[row.size]:.0%} at most")
            if row.speedup < SPEEDUP:
                missed.append(f"{row.size}: speedup {row.speedup:.2f}, wanted {SPEEDUP} at least")
    return missed


def cells(row: Row) -> dict[str, str]:
    """Return the row of the table."""
    return {
        "size": row.size,
        "runner": row.runner,
        "workers": str(row.workers),
        "it/s": f"{row.iterations_per_s:.3g}",
        "speedup": f"{row.speedup:.2f}",
        "overhead": f"{row.overhead_share:.1%}",
        **{name: f"{1e3 * seconds:.1f}" for name, seconds in row.seconds._asdict().items()},
        "MB out": f"{row.parameter_bytes / 1e6:.1f}",
        "MB in": f"{row.gradient_bytes / 1e6:.1f}",
    }


def run(args: Arguments) -> Sequence[harness.Row]:
    """Run the benchmark."""
    rows: list[Row] = []
    runner = RayRunner(MetaWorldSuite(PRESETS["ml10-quick"].suite), sum(WORKERS))
    try:
        for size in args.sizes:
            plan, turns = made_up_plan(f"ml10-{size}", SLOTS_PER_GROUP), TURNS[size]
            turns = Turns(args.rounds or turns.rounds, args.iterations or turns.iterations)
            console.print(f"{size}: {turns.rounds} rounds of {turns.iterations} iterations")
            trainings: dict[str, MetaTraining] = {"local": LocalMetaTraining(plan)}
            trainings |= {f"ray {workers}": RayMetaTraining(plan, workers) for workers in WORKERS}
            timings = measure(trainings, turns)
            rows += rows_of(size, trainings, timings)
            for training in trainings.values():
                training.close()
    finally:
        runner.close()
    title = "Iterations a second, and of one iteration milliseconds and MB of parameters and gradients"
    console.print(lay_out(title, [cells(row) for row in rows], words=2, box=SIMPLE))
    here = machine()
    console.print(f"{here['cpus']} CPUs, load average {here['load_average']:.1f}")
    console.print("\n".join(f"missed: {line}" for line in misses(rows)) or "all targets are met")
    return [row._asdict() | {"seconds": row.seconds._asdict()} | here for row in rows]


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
