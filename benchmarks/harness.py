"""What all benchmarks share: functions timed side by side in alternation, tables, and rows written as JSON."""

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, NoReturn, TypeAlias, TypeVar

from rich.table import Table

from services.cli.arguments import exit_code, parse
from services.cli.places import announce

Row: TypeAlias = Mapping[str, Any]


@dataclass(frozen=True)
class BenchmarkArguments:
    """Arguments of every benchmark."""

    json: Path | None = None
    """Write the rows to this file."""


A = TypeVar("A", bound=BenchmarkArguments)


def main(run: Callable[[A], Sequence[Row] | Row], defaults: A, description: str | None) -> NoReturn:
    """Run a benchmark as a program: read its arguments, and write what it returns as JSON if that is asked for."""

    def program(arguments: Sequence[str]) -> None:
        args = parse(type(defaults), description or "", arguments, defaults)
        announce(rows=(args.json, "--json FILE"))
        rows = run(args)
        if args.json is not None:
            write_rows(args.json, rows)

    sys.exit(exit_code(program, sys.argv[1:]))


def alternate(
    functions: Mapping[str, Callable[[], object]],
    rounds: int,
    prepare: Mapping[str, Callable[[], object]] | None = None,
    clock: Callable[[], float] | None = None,
) -> dict[str, list[float]]:
    """Return the seconds of each function's calls, in order: take medians, and ratios of medians.

    The functions take turns, so that whatever else the machine does meets all of them alike; every other round goes
    backwards, so that none always follows the same. What `prepare` has under a function's name is called before it,
    untimed. The clock is that of the wall if none is given.
    """
    clock = clock or time.perf_counter
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for number in range(rounds):
        order = list(functions) if number % 2 == 0 else list(functions)[::-1]
        for name in order:
            if prepare is not None and name in prepare:
                prepare[name]()
            start = clock()
            functions[name]()
            seconds[name].append(clock() - start)
    return seconds


DISAGREEING = 1.5
"""Where the ratios of the rounds lie further apart than so many times, other work was beside it, and none is given."""


class Ratio(NamedTuple):
    """How many times as long one function took as another, round by round."""

    median: float | None
    """None if the rounds disagree by more than `DISAGREEING` times."""
    least: float
    most: float

    @classmethod
    def of(cls, slower: Sequence[float], faster: Sequence[float]) -> "Ratio":
        """Compare the seconds of calls that took turns."""
        rounds = [slow / fast for slow, fast in zip(slower, faster, strict=True)]
        agree = max(rounds) <= DISAGREEING * min(rounds)
        return cls(median(rounds) if agree else None, min(rounds), max(rounds))

    def __str__(self) -> str:
        """Return the median with the least and the most, or why there is none."""
        spread = f"{self.least:.2f} to {self.most:.2f}"
        return f"the rounds disagree, {spread}" if self.median is None else f"{self.median:.2f}x ({spread})"


def lay_out(title: str, rows: Sequence[Mapping[str, str]], words: int = 1, **options: Any) -> Table:
    """Lay out rows, whose keys are the heads; the first columns, so many, hold words, and all others numbers."""
    table = Table(title=title, **options)
    for index, head in enumerate(rows[0]):
        table.add_column(head, justify="left" if index < words else "right")
    for row in rows:
        table.add_row(*row.values())
    return table


def machine() -> dict[str, Any]:
    """Return what a row holds of the machine."""
    return {"cpus": os.cpu_count(), "load_average": os.getloadavg()[0]}


def write_rows(path: Path, rows: Sequence[Row] | Row) -> None:
    """Write rows to `path` as a JSON list, one row a line, or one row alone as an object."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(rows, Mapping):
        text = json.dumps(rows, indent=1, allow_nan=False)
    else:
        text = "[\n" + ",\n".join(f"  {json.dumps(row, allow_nan=False)}" for row in rows) + "\n]"
    path.write_text(text + "\n")
