"""Show how often each scripted expert of a suite does its task, by the seeds of its episodes."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from dmil_core.errors import RunError, UserError, WorkError
from dmil_core.statistics import interval_text, success_rate
from services.cli.arguments import Quiet, exit_code, parse
from services.cli.composition import suite_settings
from services.cli.progress import Bar, console
from services.distributed.cluster import RunnerKind
from services.suites.base import TaskSuite
from services.suites.registry import open_suite

if TYPE_CHECKING:
    from services.rollouts.verification import VerificationRow

CHUNK = 5
"""Seeds in one call to a simulation worker."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``collect_demos verify``."""

    suite: str = "ml10"
    """Whose experts: the name of a suite, as ml45, push-around-wall or kitchen."""
    tasks: tuple[str, ...] | None = None
    """Only these tasks."""
    seeds: int = 20
    """Episodes of each task."""
    first_seed: int = 0
    """The seeds count up from it."""
    noise: float = 0.1
    """Standard deviation of the noise added to the executed actions."""
    runner: RunnerKind = "ray"
    """Where to work: in Ray actors, or in this process."""
    workers: int | None = None
    """Ray workers, one for each CPU of the cluster if not given."""
    quiet: Quiet = False


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, __doc__ or "", arguments, Arguments())
    from services.distributed.ray_runner import open_runner
    from services.distributed.work_items import Verification

    suite = open_suite(suite_settings(args.suite, args.tasks))
    tasks = args.tasks or getattr(suite, "expert_tasks", (*suite.train_tasks, *suite.test_tasks))
    tasks = [task for task in dict.fromkeys(tasks) if suite.expert(task) is not None]
    if not tasks:
        raise UserError(f"--tasks: got none that has a scripted expert in {suite.name}; wanted at least one")
    if args.seeds < 1 or args.first_seed < 0:
        raise UserError(
            f"--seeds, --first-seed: got {args.seeds} from {args.first_seed} on; wanted at least one, none below 0"
        )
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    items = [
        Verification(task, seeds[at : at + CHUNK], args.noise) for task in tasks for at in range(0, len(seeds), CHUNK)
    ]
    rows: list[VerificationRow] = []
    with open_runner(args.runner, suite, args.workers) as runner, Bar("verifying", len(tasks) * len(seeds)) as bar:
        try:
            for _, made in runner.simulate(items):
                rows += made
                bar.advance(len(made), made[0].task)
        except WorkError as error:
            raise RunError(f"{error}\n{error.trace}") from error
    console.print(_table(suite, tasks, rows, args))


def _table(suite: TaskSuite, tasks: Sequence[str], rows: "Sequence[VerificationRow]", args: Arguments) -> Table:
    seeds = f"seeds {args.first_seed} to {args.first_seed + args.seeds - 1}"
    view = Table(title=f"Experts ({suite.protocol}; noise {args.noise:g}; {seeds})")
    scored = suite.best_score > 1
    for column in ("task", "successes", "success rate", "95% interval", *(["score"] * scored), "steps", "longest"):
        view.add_column(column, justify="left" if column == "task" else "right")
    for task in [*tasks, None]:
        of_task = [row for row in rows if task in (row.task, None)]
        rate = success_rate([row.success for row in of_task])
        steps = [row.steps for row in of_task if row.success] or [0]
        view.add_row(
            task or "all",
            f"{sum(row.success for row in of_task)}/{rate.episodes}",
            f"{rate.mean:.3f}",
            interval_text(rate.low, rate.high, 3),
            *([f"{np.mean([row.score for row in of_task]):.2f}"] * scored),
            f"{np.mean(steps):.0f}",
            str(max(steps)),
            end_section=task == tasks[-1],
        )
    return view


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
