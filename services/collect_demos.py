"""Let the scripted experts make the demonstrations of an experiment, and show what is in the store.

What is there already is not made again.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from dmil_core.configs import ExperimentConfig
from services.command_line import DEFAULT_PRESET, config_from, exit_code, parse, peek
from services.demo_store import DemoStore, TaskDemonstrations, data_root
from services.experiment import Experiment, RunnerKind, open_runner
from services.progress import Clock, console

__all__ = ["Arguments", "run"]


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``collect_demos``."""

    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")]
    preset: str = DEFAULT_PRESET
    """Settings to begin with; those of suite and demonstrations count here."""
    config: Path | None = None
    """YAML file of settings in the preset's place."""
    runner: RunnerKind = "ray"
    """Where to work: in Ray actors, or in this process; the demonstrations are the same to the byte."""
    workers: int | None = None
    """Ray workers, one for each CPU of the cluster if not given."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    early = peek(arguments, preset=str, config=Path)
    defaults = config_from(early.preset or DEFAULT_PRESET, early.config)
    given = parse(Arguments, __doc__ or "", arguments, Arguments(defaults))
    store = DemoStore(data_root())
    experiment = Experiment(given.experiment, store)
    clock = Clock()
    with open_runner(given.runner, experiment.suite, given.workers) as runner:
        clock.lap("start")
        data = experiment.collect(runner)
        clock.lap("collect")
    console.print(_table(data))
    console.print(f"{store.root}: {len(data)} data sets; {clock.seconds['total']:.0f} s")


def _table(data: dict[str, TaskDemonstrations]) -> Table:
    view = Table(title="Demonstrations")
    for column in ("task", "demonstrations", "failed attempts", "mean steps", "longest", "SHA-256", "Minari id"):
        view.add_column(column, justify="left" if column in ("task", "Minari id") else "right")
    for task, dataset in data.items():
        lengths = [len(demonstration) for demonstration in dataset.demonstrations]
        view.add_row(
            task,
            str(len(lengths)),
            str(dataset.failed),
            f"{np.mean(lengths):.1f}",
            str(max(lengths)),
            dataset.digest[:12],
            dataset.id,
        )
    return view


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
