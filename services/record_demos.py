"""Store rollouts of any policy, or of a person, as the demonstrations of a task."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.trajectories import Episode
from services.cli.arguments import exit_code, parse
from services.cli.composition import suite_settings
from services.cli.places import announce
from services.cli.progress import console
from services.demonstrations.external import FORMS, demonstrations
from services.demonstrations.store import DATA, open_store
from services.suites.registry import open_suite

MOST = 10_000
"""Demonstrations that are read, as many as an experiment may ask for."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``collect_demos record``."""

    suite: str
    """The suite that has the task."""
    task: str
    """The task that the rollouts do."""
    source: Annotated[str, tyro.conf.arg(name="from")]
    """The rollouts: npz:PATH, hdf5:PATH or minari:ID; see docs/data.md."""


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments(tyro.MISSING, tyro.MISSING, tyro.MISSING))
    if args.source.partition(":")[0] not in FORMS:
        raise UserError(f"--from: got {args.source}; wanted npz:PATH, hdf5:PATH or minari:ID")
    suite, store = open_suite(suite_settings(args.suite, (args.task,))), open_store()
    announce(demonstrations=(store.root, f"{DATA}=FOLDER"))
    recorded = demonstrations(args.task, args.source, suite, MOST)
    dataset_id = f"{suite.family}/{args.task}/recorded-{recorded.digest[:10]}-v2"
    saved = store.save(
        dataset_id,
        args.task,
        [_episode(demonstration) for demonstration in recorded.demonstrations],
        failed=0,
        settings={"protocol": suite.protocol, "source": args.source},
        algorithm="recorded",
    )
    steps = sum(len(demonstration) for demonstration in saved.demonstrations)
    console.print(
        f"{store.root / dataset_id}: {len(saved.demonstrations)} demonstrations of {steps} steps\n"
        f"to use them: --suite {args.suite} --demos minari:{args.task}={dataset_id}"
    )


def _episode(demonstration: Demonstration) -> Episode:
    """Return what the store takes; the observation after the last action, which no one needs, is the one before it."""
    observations = np.concatenate((demonstration.observations, demonstration.observations[-1:]))
    return Episode(observations, demonstration.actions)


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
