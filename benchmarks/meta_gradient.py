"""The meta-gradient against a masked reference in the plain style, and against the bare matrix products in it.

Three computations take turns in one run, on the same two single-threaded worker processes: ours, the reference
(benchmarks/masked_reference.py), and the roofline, which repeats every matrix product that ours makes, on matrices of
the same shapes and layouts, as many as ours and reused in the same order, so that the caches are as cold. Two threads
of one process would wait for each other at each product, beside other work a hundred times as long as they compute.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.harness import BenchmarkArguments, Ratio, Row, alternate, lay_out, main
from benchmarks.masked_reference import MaskedReference
from benchmarks.workload import OBS_DIM, Size, as_in_a_run, draw_parameters, draw_sets, settings
from dmil_core.methods.dmil.config import DmilConfig
from dmil_core.methods.dmil.meta_gradient import task_gradient
from services.cli.progress import Bar, console

WORKERS = 2
TASKS = {"paper": 2, "quick": 10}
"""Tasks in a batch; a worker computes an equal share of them."""
TARGETS = {("paper", "second", 3): 2.2, ("paper", "second", 10): 4.3, ("quick", "first", 3): 3.0}
"""Wanted: at least so many times the reference's speed."""
ROOFLINE_TARGET = 0.85


@dataclass(frozen=True)
class Arguments(BenchmarkArguments):
    """Arguments of ``benchmarks.meta_gradient``."""

    sizes: tuple[Size, ...] = ("paper", "quick")
    """paper: width 512, 16 trajectories of 100 steps; quick: width 256, 4 windows of 24 steps."""
    sub_skills: tuple[int, ...] = (3,)
    """K; the table of docs/performance.md has 3 and 10, which takes some minutes more."""
    orders: tuple[Literal["first", "second"], ...] = ("second", "first")
    """Of the meta-gradient."""
    rounds: int = 3
    """How often each is timed; the table shows medians, with the least and the most."""


Layout: TypeAlias = tuple[int, tuple[int, ...], tuple[int, ...]]
"""Where a matrix lies in memory: address, shape and strides."""


class Product(NamedTuple):
    """A matrix product."""

    left: Layout
    right: Layout
    result: Layout
    added: bool
    """Whether it is added to what the result holds."""


class ProductRecorder(TorchDispatchMode):
    """Notes every matrix product."""

    def __init__(self) -> None:
        super().__init__()
        self.products: list[Product] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if name in ("mm", "addmm", "addmm_"):
            matrices = (*args[-2:], result)
            layouts = ((matrix.data_ptr(), tuple(matrix.shape), matrix.stride()) for matrix in matrices)
            self.products.append(Product(*layouts, added=name == "addmm_"))
        return result


class Worker:
    """One of our workers: a share of the tasks on one thread."""

    def __init__(self, config: DmilConfig, size: Size, tasks: Sequence[int]) -> None:
        self.config, self.parameters = config, as_in_a_run(draw_parameters(config))
        self.sets = [draw_sets(size, config, task) for task in tasks]
        self.products: list[tuple[Tensor, Tensor, Tensor, bool]] = []
        self._masked = MaskedReference(config)

    def masked_gradients(self) -> None:
        """Compute them as the reference does."""
        for sets in self.sets:
            self._masked.gradient(self.parameters, sets)

    def gradients(self) -> None:
        """Compute the gradients as a worker does."""
        for sets in self.sets:
            task_gradient(self.parameters, *sets, self.config)

    def peak_megabytes(self) -> float:
        """Return the most memory that this process ever held; getrusage would count its parent's too."""
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) / 1024

    def record(self) -> float:
        """Note the matrix products, lay out their operands, and return their floating-point operations."""
        with ProductRecorder() as recorder:
            self.gradients()
        operands: dict[Layout, Tensor] = {}

        def operand(layout: Layout) -> Tensor:
            _, (rows, columns), stride = layout
            if layout not in operands:
                extent = (rows - 1) * stride[0] + (columns - 1) * stride[1] + 1
                operands[layout] = torch.randn(extent).as_strided((rows, columns), stride)
            return operands[layout]

        self.products = [
            (operand(product.left), operand(product.right), operand(product.result), product.added)
            for product in recorder.products
        ]
        return sum(2.0 * left.shape[0] * left.shape[1] * right.shape[1] for left, right, _, _ in self.products)

    @torch.no_grad()
    def bare_products(self) -> None:
        """Make the same products and nothing else."""
        for left, right, result, added in self.products:
            if added:
                result.addmm_(left, right, alpha=-1e-9)
            else:
                torch.mm(left, right, out=result)


_worker: Worker


def _start(config: DmilConfig, size: Size, tasks: Sequence[int]) -> None:
    global _worker
    torch.set_num_threads(1)
    _worker = Worker(config, size, tasks)


def _call(method: str) -> Any:
    return getattr(_worker, method)()


@contextmanager
def _workers(config: DmilConfig, size: Size) -> Iterator[Callable[[str], list[Any]]]:
    """Start the workers; yield what calls a method of all of them at once and waits for the results."""
    shares = [range(index, TASKS[size], WORKERS) for index in range(WORKERS)]
    with ExitStack() as stack:
        pools = [
            stack.enter_context(ProcessPoolExecutor(1, get_context("spawn"), _start, (config, size, share)))
            for share in shares
        ]

        def everywhere(method: str) -> list[Any]:
            return [future.result() for future in [pool.submit(_call, method) for pool in pools]]

        yield everywhere


def measure(size: Size, order: Literal["first", "second"], sub_skills: int, rounds: int) -> dict[str, Any]:
    """Return the row of one configuration; seconds are those of one task."""
    config, tasks = settings(size, sub_skills, order), TASKS[size]
    parameters, sets = draw_parameters(config), draw_sets(size, config, 0)
    ours = task_gradient(parameters, *sets, config).gradient
    error = ((ours - (plain := MaskedReference(config).gradient(parameters, sets)[0])).norm() / plain.norm()).item()
    with _workers(config, size) as everywhere:
        everywhere("gradients")
        peak = max(everywhere("peak_megabytes"))
        operations = sum(everywhere("record")) / tasks
        seconds = alternate(
            {
                "ours": lambda: everywhere("gradients"),
                "twin": lambda: everywhere("masked_gradients"),
                "roofline": lambda: everywhere("bare_products"),
            },
            rounds,
        )
    ours_seconds, twin_seconds, roofline_seconds = (median(seconds[name]) / tasks for name in seconds)
    faster, share = (Ratio.of(seconds[name], seconds["ours"]) for name in ("twin", "roofline"))
    return {
        "size": size,
        "order": order,
        "k": sub_skills,
        "seconds": ours_seconds,
        "twin_seconds": twin_seconds,
        "least_seconds": min(seconds["ours"]) / tasks,
        "most_seconds": max(seconds["ours"]) / tasks,
        "ratio": faster.median,
        "ratio_spread": [faster.least, faster.most],
        "roofline_seconds": roofline_seconds,
        "roofline_share": share.median,
        "roofline_spread": [share.least, share.most],
        "forwards": operations / _forward_operations(config, len(sets[0].states)),
        "gflops": operations / ours_seconds / 1e9,
        "peak_mb": peak,
        "relative_error": error,
        "rounds": rounds,
    }


def _forward_operations(config: DmilConfig, steps: int) -> float:
    """Return F, the operations of one network's forward on a task's states, without its narrow last layer."""
    return 2.0 * steps * config.hidden_units * (OBS_DIM + (config.hidden_layers - 1) * config.hidden_units)


def _cells(row: Row) -> dict[str, str]:
    wanted = TARGETS.get((row["size"], row["order"], row["k"]))
    share = ROOFLINE_TARGET if row["size"] == "paper" and row["order"] == "second" else None
    return {
        "size": row["size"],
        "order": row["order"],
        "K": str(row["k"]),
        "ours": f"{row['seconds'] * 1e3:.1f} ms",
        "twin": f"{row['twin_seconds'] * 1e3:.1f} ms",
        "faster": str(Ratio(row["ratio"], *row["ratio_spread"])) + _verdict(row["ratio"], wanted, "x"),
        "of the roofline": str(Ratio(row["roofline_share"], *row["roofline_spread"]))
        + _verdict(row["roofline_share"], share, "x"),
        "work": f"{row['forwards']:.0f} F",
        "peak": f"{row['peak_mb']:.0f} MB",
        "error": f"{row['relative_error']:.0e}",
    }


def _verdict(value: float | None, wanted: float | None, unit: str) -> str:
    if wanted is None or value is None:
        return ""
    return f" ({'meets' if value >= wanted else 'misses'} {wanted}{unit})"


def run(args: Arguments) -> Sequence[Row]:
    """Run the benchmark."""
    torch.set_num_threads(1)
    plan = list(itertools.product(args.sizes, args.orders, args.sub_skills))
    rows = []
    with Bar("measuring", len(plan)) as bar:
        for size, order, k in plan:
            rows.append(measure(size, order, k, args.rounds))
            bar.advance(1, f"{size}, {order} order, K = {k}")
    title = f"one task's meta-gradient, ours and the reference's, on {WORKERS} workers of one thread"
    console.print(lay_out(title, [_cells(row) for row in rows], words=2))
    return rows


if __name__ == "__main__":
    main(run, Arguments(), __doc__)
