"""What a cluster of any size would give meta-training: predicted from costs measured here, for presets of Meta-World.

Measured are, on synthetic demonstrations in Meta-World's shapes: the gradient of a slot, the outer step and the sum
of gradients in processor seconds, the least of several rounds, so that other work on the machine counts little; and a
call, the driver's share of one, and a write into the object store in seconds, on a Ray cluster of one worker. The
network is assumed, and `benchmarks.cluster_model` puts all together.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rich.box import SIMPLE

from benchmarks import harness
from benchmarks.cluster_model import Costs, Network, Prediction, predict, seconds_of_a_tree
from benchmarks.harness import BenchmarkArguments, alternate, lay_out, main
from benchmarks.workload import made_up_plan
from dmil_core.configs import PRESETS
from dmil_core.networks import unflatten
from dmil_core.outer_loop import add, group_gradient
from services.cli.progress import console
from services.distributed.chunking import to_chunks
from services.distributed.learner import Learner
from services.distributed.ray_meta_training import FAN_IN, RayMetaTraining
from services.distributed.ray_runner import RayRunner
from services.distributed.runner import Plan
from services.suites.metaworld import MetaWorldSuite

CALLS = 200
"""That the cost of one is the mean of."""


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``sizing``."""

    presets: tuple[str, ...] = ("ml10-quick", "ml10-paper", "ml45-paper")
    """Of Meta-World, and of the method dmil."""
    workers: tuple[int, ...] = (1, 10, 100, 1000)
    """How many to predict for; a worker is one CPU."""
    rounds: int = 5
    """Of each measurement."""
    price: float = 0.04
    """Of a CPU's hour, in dollars: an assumption."""
    faster: float = 1.0
    """Predict for a slot computed so many times as fast, as on a GPU: an assumption too."""


class Row(NamedTuple):
    """What is expected of one number of workers, with one number of slots."""

    preset: str
    workers: int
    used: int
    """Workers that have something to do."""
    slots: int
    """Of an iteration."""
    iteration: float
    """Seconds."""
    efficiency: float
    """Slots a second and worker, against one worker's."""
    efficiency_relayed: float
    """The same if nodes pass the parameters on."""
    learner: float
    """The outer step's part of an iteration."""
    sent: float
    """Bytes a second that leave the learner's node for the others, unless nodes pass the parameters on."""
    store: int
    """Bytes in a node's object store."""
    memory: int
    """Bytes of a node, the store and the workers."""
    tree: float
    """Seconds to add all gradients, by workers in a tree."""
    alone: float
    """Seconds of the same by one process that fetches all of them."""
    largest: str
    """What costs most besides compute."""
    hours: float
    """Of the preset's iterations."""
    dollars: float
    """Of all workers in these hours."""


def least(rounds: int, work: Callable[[], object], clock: Callable[[], float] | None = None) -> float:
    """Return the least seconds of some work, done once beforehand."""
    work()
    return min(alternate({"work": work}, rounds, clock=clock)["work"])


def slot_seconds(plan: Plan, rounds: int) -> list[float]:
    """Return the processor seconds of the gradient of each slot of the first iteration."""
    parameters, tasks = unflatten(torch.from_numpy(plan.state.parameters), plan.shapes), plan.tasks(0)

    def gradient(slot: int) -> Callable[[], object]:
        return lambda: group_gradient(plan.method, plan.demonstrations, parameters, plan.seed, 0, tasks, [slot])

    return [least(rounds, gradient(slot), time.process_time) for slot in range(len(tasks))]


def own_status(_: object) -> str:
    """Return what the kernel reports of the process that calls this."""
    return Path("/proc/self/status").read_text()


def measured_costs(plan: Plan, rounds: int) -> Costs:
    """Return what the model of a cluster is fed with; a Ray cluster must be joined."""
    import ray

    torch.set_num_threads(1)
    slots = slot_seconds(plan, rounds)
    parameters = plan.state.parameters
    gradients, chunks = [parameters.copy() for _ in range(FAN_IN)], to_chunks(parameters)
    learner = Learner(plan.state, plan.settings)
    training = RayMetaTraining(plan, 1)
    try:
        list(training.iterations(1))
        pool, small = training._pool, [np.zeros(1, np.float32)]
        first = pool.submit("add", small)
        pool.result(first)

        def many() -> None:
            pool.result([pool.submit("add", small, same_worker_as=first) for _ in range(CALLS)][-1])

        def one_by_one() -> None:
            for _ in range(CALLS):
                pool.result(pool.submit("add", small))

        status: str = ray.get(pool._workers[0].actor.__ray_call__.remote(own_status))
        return Costs(
            slot=float(np.mean(slots)),
            spread=float(np.std(slots) / np.mean(slots)),
            step=least(rounds, lambda: learner.step(chunks), time.process_time),
            call=least(rounds, one_by_one) / CALLS,
            submit=least(rounds, many) / CALLS,
            buffer=parameters.nbytes,
            store=parameters.nbytes / least(rounds, lambda: ray.put(chunks)),
            add=FAN_IN * parameters.nbytes / least(rounds, lambda: add(gradients), time.process_time),
            demonstrations=sum(
                demonstration.observations.nbytes + demonstration.actions.nbytes
                for of_task in plan.demonstrations.values()
                for demonstration in of_task
            ),
            resident=1024 * int(status.partition("VmHWM:")[2].split()[0]),
        )
    finally:
        training.close()


def row(arguments: Arguments, preset: str, costs: Costs, workers: int, slots: int) -> Row:
    """Return what is expected of so many workers, with so many slots in an iteration."""
    training, network = PRESETS[preset].training, Network()

    def expected(workers: int, slots: int, *, relayed: bool) -> Prediction:
        return predict(costs, network, workers, slots, FAN_IN, relayed=relayed, together=training.slots_per_group)

    one = expected(1, slots, relayed=False)
    this, relayed = (expected(workers, slots, relayed=relayed) for relayed in (False, True))
    on_node = min(this.workers, network.workers_per_node)
    # The parameters of this iteration and of the last, a gradient of each worker, and the sum.
    store = costs.demonstrations + (3 + on_node) * costs.buffer
    hours = training.iterations * this.iteration / 3600
    return Row(
        preset,
        workers,
        this.workers,
        slots,
        this.iteration,
        one.iteration / this.iteration / workers,
        one.iteration / relayed.iteration / workers,
        this.step / this.iteration,
        (network.nodes(this.workers) - 1) * costs.buffer / this.iteration,
        store,
        store + on_node * costs.resident,
        seconds_of_a_tree(costs, network, this.workers, FAN_IN),
        seconds_of_a_tree(costs, network, this.workers, this.workers),
        this.largest,
        hours,
        hours * workers * arguments.price,
    )


def cells_as_it_is(row: Row) -> dict[str, str]:
    """Return the cells of what more workers do for a preset as it is."""
    return {
        "workers": f"{row.workers:,}",
        "used": str(row.used),
        "s/iteration": f"{row.iteration:.3g}",
        "speedup": f"{row.efficiency * row.workers:.2f}",
        "efficiency": f"{row.efficiency:.1%}",
        "hours": f"{row.hours:.2f}",
        "CPU hours": f"{row.hours * row.workers:.1f}",
        "$": f"{row.dollars:.2f}",
    }


def cells_grown(row: Row) -> dict[str, str]:
    """Return the cells of what is expected where an iteration has a group of slots for each worker."""
    return {
        "workers": f"{row.workers:,}",
        "slots": f"{row.slots:,}",
        "s/iteration": f"{row.iteration:.3g}",
        "efficiency": f"{row.efficiency:.0%}",
        "if relayed": f"{row.efficiency_relayed:.0%}",
        "learner": f"{row.learner:.1%}",
        "MB/s sent": f"{row.sent / 1e6:.0f}",
        "MB store": f"{row.store / 1e6:.0f}",
        "GB a node": f"{row.memory / 1e9:.1f}",
        "tree": f"{row.tree:.3f} s",
        "alone": f"{row.alone:.3f} s",
        "largest": row.largest,
    }


def describe(costs: Costs) -> str:
    """Return what was measured, in words."""
    return (
        f"slot {1e3 * costs.slot:.1f} ms ± {costs.spread:.1%}, step {1e3 * costs.step:.2f} ms, call "
        f"{1e3 * costs.call:.2f} ms, driver {1e3 * costs.submit:.2f} ms a call, parameters {costs.buffer / 1e6:.1f} "
        f"MB, into the store {costs.store / 1e9:.1f} GB/s, adding {costs.add / 1e9:.1f} GB/s, demonstrations "
        f"{costs.demonstrations / 1e6:.0f} MB, worker {costs.resident / 1e6:.0f} MB"
    )


def run(args: Arguments) -> Sequence[harness.Row]:
    """Run the benchmark."""
    network, rows = Network(), list[Row]()
    console.print(
        f"assumed: {network.workers_per_node} workers a node, {network.bytes_per_second * 8e-9:.0f} Gbit/s and "
        f"{network.latency * 1e3:.1f} ms between nodes, ${args.price} a CPU's hour"
    )
    runner = RayRunner(MetaWorldSuite(PRESETS[args.presets[0]].suite), 1)
    try:
        for preset in args.presets:
            training = PRESETS[preset].training
            costs = measured_costs(made_up_plan(preset), args.rounds)
            console.print(f"\n{preset}, {training.iterations} iterations; measured: {describe(costs)}")
            if args.faster != 1:
                console.print(f"assumed: a slot takes {args.faster:g} times less")
            costs = costs._replace(slot=costs.slot / args.faster)
            fixed = [row(args, preset, costs, workers, training.tasks_per_iteration) for workers in args.workers]
            each = [row(args, preset, costs, workers, workers * training.slots_per_group) for workers in args.workers]
            console.print(lay_out("The preset as it is", [*map(cells_as_it_is, fixed)], words=0, box=SIMPLE))
            title = "Another experiment: a group of slots for each worker"
            console.print(lay_out(title, [*map(cells_grown, each)], words=0, box=SIMPLE))
            rows += fixed + each
    finally:
        runner.close()
    assumed = {"fan_in": FAN_IN, "price": args.price, "faster": args.faster}
    return [row._asdict() | assumed for row in rows]


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
