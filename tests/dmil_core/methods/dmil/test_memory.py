"""What a worker holds in memory while it computes, in a process of its own."""

import subprocess
import sys

import pytest

PEAK = """
from benchmarks.meta_gradient import Worker
from benchmarks.workload import settings
worker = Worker(settings("paper", 10, "second"), "paper", [0])
worker.gradients()
print(worker.peak_megabytes())
"""

GROWTH = """
import psutil
from benchmarks.meta_gradient import Worker
from benchmarks.workload import settings
worker, process = Worker(settings("quick", 3, "second"), "quick", [0]), psutil.Process()
def run(iterations):
    for _ in range(iterations):
        worker.gradients()
    return process.memory_info().rss / 2**20
print(-run(30) + run(150))
"""


def megabytes(program: str) -> float:
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return float(run.stdout)


@pytest.mark.thorough
def test_a_task_of_paper_size_with_ten_sub_skills_stays_under_one_and_a_half_gigabytes() -> None:
    assert megabytes(PEAK) < 1500


@pytest.mark.thorough
def test_memory_is_flat_over_150_iterations() -> None:
    assert megabytes(GROWTH) < 8
