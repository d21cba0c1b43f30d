"""What all benchmarks share: rivals timed side by side in alternation, and rows written as JSON."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any


def alternate(
    functions: Mapping[str, Callable[[], object]],
    rounds: int,
    prepare: Mapping[str, Callable[[], object]] | None = None,
) -> dict[str, list[float]]:
    """Time rivals in alternation, so that whatever else the machine does meets all of them alike.

    Args:
        functions: the rivals by name, each without arguments.
        rounds: how often each is called; every other round goes backwards, so that none always follows the same.
        prepare: what is to be called before each call of the rival of that name, untimed.

    Returns:
        For each name the wall-clock seconds of its calls, in order: take medians, and ratios of medians.
    """
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for number in range(rounds):
        order = list(functions) if number % 2 == 0 else list(functions)[::-1]
        for name in order:
            if prepare is not None and name in prepare:
                prepare[name]()
            start = time.perf_counter()
            functions[name]()
            seconds[name].append(time.perf_counter() - start)
    return seconds


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a benchmark's rows to `path` as a JSON list, one row a line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("[\n" + ",\n".join(f"  {json.dumps(row, allow_nan=False)}" for row in rows) + "\n]\n")
