"""Let the scripted experts make the demonstrations of an experiment, and show what is in the store.

What is there already is not made again. With a word before all flags it does other things, each with a --help of its
own: verify counts how often each expert does its task, inspect looks into a data set, record stores rollouts of any
policy as demonstrations. For example:

  dmil collect-demos --suite ml45
  dmil collect-demos inspect mine.npz
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from dmil_core.settings import Settings
from services import inspect_demos, record_demos, verify_experts
from services.cli.arguments import Quiet, exit_code, parse, peek
from services.cli.composition import DEFAULT_PRESET, EARLY, defaults_from
from services.cli.places import announce
from services.cli.progress import Clock, console
from services.demonstrations.store import DATA, TaskDemonstrations, open_store
from services.distributed.cluster import RunnerKind


class Collection(Settings):
    """Which demonstrations are made: the settings of an experiment that matter here."""

    suite: SuiteConfig
    demonstrations: DemonstrationConfig


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``collect_demos``."""

    collection: Annotated[Collection, tyro.conf.arg(name="")]
    preset: str = DEFAULT_PRESET
    """Settings to begin with."""
    suite: str | None = None
    """The suite, as ml10, ml45, ML1-reach, push-around-wall or kitchen; short for --suite.name."""
    demos: str | None = None
    """Where demonstrations come from, as minari:ID,TASK=ID; short for --demonstrations.source."""
    config: Path | None = None
    """YAML file of settings in the preset's place."""
    runner: RunnerKind = "ray"
    """Where to work: in Ray actors, or in this process; the demonstrations are the same to the byte."""
    workers: int | None = None
    """Ray workers, one for each CPU of the cluster if not given."""
    quiet: Quiet = False


OTHERS = {"verify": verify_experts.run, "inspect": inspect_demos.run, "record": record_demos.run}


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    if arguments and arguments[0] in OTHERS:
        OTHERS[arguments[0]](arguments[1:])
        return
    config = defaults_from(peek(arguments, **EARLY))
    defaults = Collection(suite=config.suite, demonstrations=config.demonstrations)
    args = parse(Arguments, __doc__ or "", arguments, Arguments(defaults))
    from services.distributed.ray_runner import open_runner
    from services.experiments.experiment import Experiment

    store = open_store()
    announce(demonstrations=(store.root, f"{DATA}=FOLDER"))
    experiment = Experiment(config.model_copy(update=dict(args.collection)), store)
    clock = Clock()
    with open_runner(args.runner, experiment.suite, args.workers) as runner:
        clock.lap("start")
        data = experiment.collect(runner)
        clock.lap("collect")
    console.print(_table(data))
    console.print(f"{store.root}: {len(data)} data sets; {clock.seconds['total']:.0f} s")


def _table(data: dict[str, TaskDemonstrations]) -> Table:
    view = Table(title="Demonstrations")
    for column in ("task", "demonstrations", "failed attempts", "mean steps", "longest", "SHA-256", "Minari id"):
        view.add_column(column, justify="left" if column in ("task", "Minari id") else "right", overflow="fold")
    for task, dataset in data.items():
        lengths = [len(demonstration) for demonstration in dataset.demonstrations]
        steps = [f"{np.mean(lengths):.1f}", str(max(lengths))]
        view.add_row(task, str(len(lengths)), str(dataset.failed), *steps, dataset.digest[:12], dataset.id)
    return view


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
