"""DMIL's outer gradients on each device and by each path, side by side: on one thread of the CPU, and on a GPU.

Slots are made-up tasks of the presets' sizes. The share of the roofline is the loop's matrix products against a large
product of the same device; padding counts as nothing. Without a GPU the CPU's two paths are measured.
"""

import statistics
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.harness import BenchmarkArguments, Row, alternate, lay_out, machine, main
from benchmarks.masked_reference import Sets
from benchmarks.workload import Size, as_in_a_run, draw_parameters, draw_sets, made_up_plan, settings
from dmil_core.devices import CPU, Compute, computing_on, describe, device_of
from dmil_core.losses import Steps
from dmil_core.methods.dmil.batched import task_gradients
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.meta_gradient import task_gradient
from dmil_core.networks import Parameters
from services.cli.progress import Bar, console
from services.distributed.runner import LocalMetaTraining

SLOTS = 10
"""In an iteration."""
CPU_SLOTS = {"quick": 10, "paper": 2}
"""Measured in one round on the CPU, where time is linear in them."""
ORDERS = {"quick": "first", "paper": "second"}
PATHS = ("loop", "batched")
PRODUCT = {"cpu": 1024, "cuda": 8192}
"""Rows and columns of the large product."""
TARGET_MS = 60.0
"""Wanted of an H100-class card: at most, for an iteration at paper size by the batched path."""


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``benchmarks.device``."""

    sizes: tuple[Size, ...] = ("quick", "paper")
    """quick: width 256, 4 windows of 24 steps, first order; paper: width 512, 16 trajectories of 100 steps, second."""
    rounds: int = 3
    """How often each is timed, in alternation; the table shows medians."""
    whole: bool = True
    """Also measure a whole iteration of ml10-paper with one group of ten slots: what is drawn, copied, added and
    stepped, too."""


class ProductCounter(TorchDispatchMode):
    """Adds up the floating-point operations of matrix products."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0.0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if func.overloadpacket.__name__ in ("mm", "addmm", "addmm_", "bmm", "baddbmm", "baddbmm_"):
            self.operations += 2.0 * result.numel() * args[-1].shape[-2]
        return result


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _waiting(work: Callable[[], object], device: torch.device) -> None:
    with computing_on(device):
        work()
        _wait(device)


def product_rate(device: torch.device, rounds: int) -> float:
    """Return the operations a second of a large float32 product, the best of some."""
    size = PRODUCT[device.type]
    left, right = (torch.randn(size, size, device=device) for _ in range(2))
    work = partial(_waiting, lambda: left @ right, device)
    work()
    return 2.0 * size**3 / min(alternate({"product": work}, rounds)["product"])


def _slots(size: Size, config: DmilConfig, count: int, device: torch.device) -> list[Sets]:
    """Draw τ1 to τ4 of some tasks on a device."""

    def moved(steps: Steps) -> Steps:
        return Steps(*(tensor.to(device) for tensor in steps))

    drawn = [draw_sets(size, config, task) for task in range(count)]
    return [(moved(one), moved(two), moved(three), moved(four)) for one, two, three, four in drawn]


def _work(path: str, parameters: Parameters, slots: Sequence[Sets], config: DmilConfig) -> None:
    if path == "loop":
        for sets in slots:
            task_gradient(parameters, *sets, config)
    else:
        task_gradients(parameters, slots, config)


def measure(size: Size, devices: Sequence[torch.device], rates: Sequence[float], rounds: int) -> list[Row]:
    """Return a row for each device and path."""
    config = settings(size, 3, ORDERS[size])  # pyright: ignore[reportArgumentType]
    shared = as_in_a_run(draw_parameters(config))
    with ProductCounter() as counter:
        _work("loop", shared, _slots(size, config, 1, CPU), config)
    works: dict[tuple[int, str], Callable[[], None]] = {}
    for index, device in enumerate(devices):
        parameters = {name: tensor.to(device) for name, tensor in shared.items()}
        slots = _slots(size, config, CPU_SLOTS[size] if device == CPU else SLOTS, device)
        for path in PATHS:
            work = partial(_waiting, partial(_work, path, parameters, slots, config), device)
            work()
            works[index, path] = work
    seconds = alternate({f"{index} {path}": work for (index, path), work in works.items()}, rounds)
    rows = []
    for index, path in works:
        device, times = devices[index], seconds[f"{index} {path}"]
        slots = CPU_SLOTS[size] if device == CPU else SLOTS
        slot = statistics.median(times) / slots
        rows.append(
            {
                "size": size,
                "order": ORDERS[size],
                "device": describe(device),
                "path": path,
                "ms_a_slot": slot * 1e3,
                "ms_an_iteration": slot * SLOTS * 1e3,
                "slots_measured": slots,
                "least_ms_a_slot": min(times) / slots * 1e3,
                "most_ms_a_slot": max(times) / slots * 1e3,
                "roofline_share": counter.operations / slot / rates[index],
                "product_gflops": rates[index] / 1e9,
                "peak_mb": _peak_megabytes(device, works[index, path]),
                "rounds": rounds,
            }
        )
    return rows


def _peak_megabytes(device: torch.device, work: Callable[[], None]) -> float | None:
    """Return the most memory of a GPU that the work holds; of the CPU's none is known apart."""
    if device == CPU:
        return None
    torch.cuda.reset_peak_memory_stats(device)
    work()
    return torch.cuda.max_memory_allocated(device) / 1e6


def whole_iterations(devices: Sequence[torch.device], rounds: int) -> list[Row]:
    """Return the seconds of whole iterations of ml10-paper, with one group of ten slots, for each device and path."""
    rows, plan = [], made_up_plan("ml10-paper", SLOTS)
    for device in devices:
        for path in PATHS:
            count = 1 if device == CPU else rounds + 1
            with closing(LocalMetaTraining(plan, Compute(str(device), path))) as training:
                compute = [iteration.timing for iteration in training.iterations(count)]
            seconds = statistics.median(timing.iteration for timing in compute[-rounds:])
            rows.append({"device": describe(device), "path": path, "paper_iteration_seconds": seconds})
    return rows


def _cells(row: Row) -> dict[str, str]:
    target = ""
    if row["size"] == "paper" and row["device"] != "cpu" and row["path"] == "batched":
        target = f" ({'meets' if row['ms_an_iteration'] <= TARGET_MS else 'misses'} {TARGET_MS:.0f})"
    return {
        "size": row["size"],
        "device": row["device"],
        "path": row["path"],
        "ms a slot": f"{row['ms_a_slot']:.2f}",
        "least to most": f"{row['least_ms_a_slot']:.2f} to {row['most_ms_a_slot']:.2f}",
        "ms an iteration": f"{row['ms_an_iteration']:.1f}{target}",
        "of the roofline": f"{row['roofline_share']:.0%}",
        "peak": "" if row["peak_mb"] is None else f"{row['peak_mb']:.0f} MB",
    }


def run(args: Arguments) -> Sequence[Row]:
    """Run the benchmark."""
    torch.set_num_threads(1)
    devices = [CPU]
    if torch.cuda.is_available():
        devices.append(device_of("cuda"))
    else:
        console.print("no GPU here: the CPU's two paths alone")
    rates = [product_rate(device, 5) for device in devices]
    rows: list[Row] = []
    with Bar("measuring", len(args.sizes) + args.whole) as bar:
        for size in args.sizes:
            rows += measure(size, devices, rates, args.rounds)
            bar.advance(1, size)
        whole = whole_iterations(devices, args.rounds) if args.whole else []
    title = f"one slot, and an iteration of {SLOTS}; K = 3, one thread of the CPU"
    console.print(lay_out(title, [_cells(row) for row in rows], words=3))
    for row in whole:
        console.print(
            f"a whole iteration of ml10-paper, {row['device']}, {row['path']}: {row['paper_iteration_seconds']:.2f} s"
        )
    return [{**row, **machine()} for row in [*rows, *whole]]


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
