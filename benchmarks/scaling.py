"""How meta-training scales with Ray's workers, and where the time of an iteration goes.

Demonstrations are made up, in the shape of Meta-World's: 39-dimensional observations, 4-dimensional actions, ten tasks,
100 steps, five slots a group. The local runner, one worker and two take turns, and medians over all iterations are
given.

The seconds of an iteration are divided up whole, see `services.timing.Timing`. The overhead's share is what is left of
the iteration beside an ideal one: 1 - (worker compute seconds / workers + step seconds) / iteration seconds. So waiting
for the slower worker counts as overhead too.
"""

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from benchmarks.cluster_model import Costs, Network, Prediction, calls_of_a_tree, predict
from benchmarks.timing import alternate, write_rows
from dmil_core.configs import PRESETS
from dmil_core.demonstrations import Demonstration
from dmil_core.dmil_config import DmilConfig
from dmil_core.methods.dmil import Dmil
from dmil_core.networks import flatten
from dmil_core.outer_loop import OuterState, add
from dmil_core.seeding import stream
from services.actors.freight import pack
from services.command_line import exit_code, parse
from services.progress import console
from services.ray_meta_training import FAN_IN, RayMetaTraining
from services.ray_runner import RayRunner
from services.runners import LocalMetaTraining, MetaTraining, Plan
from services.suites.metaworld import MetaWorldSuite
from services.timing import Timing

__all__ = ["Arguments", "run"]

Size = Literal["quick", "paper"]
WORKERS = (1, 2)
STEPS = 100
"""Of a made-up demonstration."""
CALLS = 200
"""That the cost of one is the mean of."""


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
class Arguments:
    """Arguments of ``scaling``."""

    sizes: tuple[Size, ...] = ("quick", "paper")
    """Networks, batches and windows of the presets ml10-quick and ml10-paper."""
    rounds: int | None = None
    """Turns that each takes; by default 6 at quick size and 2 at paper size."""
    json: Path | None = None
    """File for the rows."""
    simulate: int | None = None
    """Also predict, from what was measured, the iteration's time with up to so many workers."""


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


def made_up_plan(size: Size) -> Plan:
    """Return a plan as a preset's, with demonstrations of noise."""
    config = PRESETS[f"ml10-{size}"]
    suite = MetaWorldSuite(config.suite)
    settings = config.demonstrations
    draw = np.random.default_rng(0)
    demonstrations = {
        task: [
            Demonstration(
                f"{index:03d}",
                task,
                draw.normal(size=(STEPS, suite.obs_dim)).astype(np.float32),
                draw.uniform(-1, 1, size=(STEPS, suite.action_dim)).astype(np.float32),
            )
            for index in range(settings.per_task - settings.held_out)
        ]
        for task in suite.train_tasks
    }
    assert isinstance(config.method, DmilConfig)
    method = Dmil.prepared(config.method, suite.action_dim, [d for task in demonstrations.values() for d in task])
    initial = method.initial_parameters(stream(0, "initial parameters"))
    shapes = {name: tensor.shape for name, tensor in initial.items()}
    state = OuterState.start(flatten(initial).numpy())
    training = config.training.model_copy(update={"slots_per_group": SLOTS_PER_GROUP})
    return Plan(method, shapes, demonstrations, state, training, seed=0)


def measure(trainings: Mapping[str, MetaTraining], turns: Turns) -> dict[str, list[Timing]]:
    """Let rivals meta-train in turns, and return the timing of each one's iterations."""
    timings: dict[str, list[Timing]] = {name: [] for name in trainings}

    def turn(name: str) -> Callable[[], None]:
        def go_on() -> None:
            iterations = list(trainings[name].iterations(1 + turns.iterations))
            timings[name] += [iteration.timing for iteration in iterations[1:]]

        return go_on

    alternate({name: turn(name) for name in trainings}, turns.rounds)
    return timings


def rows_of(size: Size, trainings: Mapping[str, MetaTraining], timings: Mapping[str, list[Timing]]) -> list[Row]:
    """Return a row for each rival."""
    seconds = {name: float(np.median([timing.iteration for timing in found])) for name, found in timings.items()}
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
    found = []
    for row in rows:
        if row.runner == "ray" and row.workers == 2:
            if row.overhead_share > OVERHEAD[row.size]:
                found.append(f"{row.size}: overhead {row.overhead_share:.1%}, wanted {OVERHEAD[row.size]:.0%} at most")
            if row.speedup < SPEEDUP:
                found.append(f"{row.size}: speedup {row.speedup:.2f}, wanted {SPEEDUP} at least")
    return found


def table(rows: Sequence[Row]) -> Table:
    """Lay the rows out for the terminal."""
    view = Table(
        title="Iterations a second, and of one iteration milliseconds and MB of parameters and gradients", box=SIMPLE
    )
    columns = ("size", "runner", "workers", "it/s", "speedup", "overhead")
    for column in (*columns, *Timing._fields, "MB out", "MB in"):
        view.add_column(column, justify="left" if column in ("size", "runner") else "right")
    for row in rows:
        view.add_row(
            row.size,
            row.runner,
            str(row.workers),
            f"{row.iterations_per_s:.3g}",
            f"{row.speedup:.2f}",
            f"{row.overhead_share:.1%}",
            *(f"{1e3 * seconds:.1f}" for seconds in row.seconds),
            f"{row.parameter_bytes / 1e6:.1f}",
            f"{row.gradient_bytes / 1e6:.1f}",
        )
    return view


def measured_costs(training: RayMetaTraining, timings: Sequence[Timing], slots: int) -> Costs:
    """Return what the model of a cluster is fed with.

    Args:
        training: by one Ray worker, with all slots in one block.
        timings: of its iterations.
        slots: of an iteration.
    """
    import ray

    parameters = training.state().parameters
    pool = training._pool
    small = [np.zeros(1, np.float32)]

    def seconds(work: Callable[[], object]) -> float:
        began = time.perf_counter()
        work()
        return time.perf_counter() - began

    def call() -> None:
        pool.result(pool.submit("add", small))

    def many() -> None:
        calls = [pool.submit("add", small, beside=first) for _ in range(CALLS)]
        pool.result(calls[-1])

    first = pool.submit("add", small)
    pool.result(first)
    compute = [timing.compute for timing in timings]
    return Costs(
        slot=float(np.median(compute)) / slots,
        spread=float(np.std(compute) / np.mean(compute)),
        step=float(np.median([timing.step for timing in timings])),
        call=float(np.median([seconds(call) for _ in range(CALLS // 4)])),
        submit=seconds(many) / CALLS,
        buffer=parameters.nbytes,
        store=parameters.nbytes / float(np.median([seconds(lambda: ray.put(pack(parameters))) for _ in range(10)])),
        add=FAN_IN
        * parameters.nbytes
        / float(np.median([seconds(lambda: add([parameters] * FAN_IN)) for _ in range(5)])),
    )


def predictions(costs: Costs, most: int, *, weak: bool, relayed: bool) -> list[Prediction]:
    """Return what is expected of 1, 2, 4 ... and `most` workers.

    Args:
        costs: measured.
        most: workers.
        weak: a slot for each worker; else `most` slots however many workers.
        relayed: see `predict`.
    """
    counts = [2**power for power in range(most.bit_length()) if 2**power < most] + [most]
    return [
        predict(costs, Network(), workers, workers if weak else most, FAN_IN, relayed=relayed) for workers in counts
    ]


def prediction_table(title: str, found: Sequence[Prediction]) -> Table:
    """Lay predictions out for the terminal; efficiency is against one worker."""
    view = Table(title=title, box=SIMPLE)
    for column in ("workers", *Prediction._fields[1:], "iteration", "efficiency", "largest overhead"):
        view.add_column(column, justify="right")
    one = found[0]
    for this in found:
        # Slots a second and worker: the slots are in proportion to compute times workers.
        work, work_of_one = this.compute * this.workers, one.compute
        efficiency = work / this.iteration / this.workers / (work_of_one / one.iteration)
        view.add_row(
            str(this.workers),
            *(f"{1e3 * seconds:.1f}" for seconds in (*this[1:], this.iteration)),
            f"{efficiency:.0%}",
            this.largest,
        )
    return view


def show_predictions(size: Size, costs: Costs, most: int) -> None:
    """Print how the iteration's time is expected to grow."""
    network = Network()
    console.print(f"\n{size}: measured costs: {_in_words(costs)}")
    console.print(
        f"assumed: {network.workers_per_node} workers a node, {network.bytes_per_second * 8e-9:.0f} Gbit/s and "
        f"{network.latency * 1e3:.1f} ms between nodes, fan-in {FAN_IN}"
    )
    for weak in (True, False):
        for relayed in (False, True):
            title = (
                f"{size}: {'a slot for each worker' if weak else f'{most} slots'}, parameters "
                f"{'relayed from node to node' if relayed else 'fetched from the learner by every node'}; milliseconds"
            )
            console.print(prediction_table(title, predictions(costs, most, weak=weak, relayed=relayed)))


def _in_words(costs: Costs) -> str:
    return (
        f"slot {1e3 * costs.slot:.2f} ms ± {costs.spread:.0%}, step {1e3 * costs.step:.2f} ms, call "
        f"{1e3 * costs.call:.2f} ms, driver {1e3 * costs.submit:.2f} ms a call, buffer {costs.buffer / 1e6:.1f} MB, "
        f"into the store {costs.store / 1e9:.1f} GB/s, adding {costs.add / 1e9:.1f} GB/s"
    )


def run(arguments: Sequence[str]) -> None:
    """Run the benchmark."""
    given = parse(Arguments, __doc__ or "", arguments, Arguments())
    rows: list[Row] = []
    costs: dict[Size, Costs] = {}
    runner = RayRunner(MetaWorldSuite(PRESETS["ml10-quick"].suite), sum(WORKERS))
    try:
        for size in given.sizes:
            plan, turns = made_up_plan(size), TURNS[size]
            turns = turns._replace(rounds=given.rounds or turns.rounds)
            console.print(f"{size}: {turns.rounds} rounds of {turns.iterations} iterations")
            trainings: dict[str, MetaTraining] = {"local": LocalMetaTraining(plan)}
            by_ray = {f"ray {workers}": RayMetaTraining(plan, workers) for workers in WORKERS}
            trainings |= by_ray
            timings = measure(trainings, turns)
            rows += rows_of(size, trainings, timings)
            if given.simulate:
                one = f"ray {WORKERS[0]}"
                costs[size] = measured_costs(by_ray[one], timings[one], plan.settings.tasks_per_iteration)
            for training in trainings.values():
                training.close()
    finally:
        runner.close()
    console.print(table(rows))
    console.print(f"{os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")
    console.print("\n".join(f"missed: {line}" for line in misses(rows)) or "all targets are met")
    for size, found in costs.items():
        show_predictions(size, found, given.simulate or 1)
    if given.json is not None:
        machine: dict[str, Any] = {"cpus": os.cpu_count(), "load_average": os.getloadavg()[0]}
        write_rows(given.json, [row._asdict() | {"seconds": row.seconds._asdict()} | machine for row in rows])


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
