"""Adapt a checkpoint to each task with few demonstrations, and measure the success rates of what comes out.

Settings that are not given are those of the run that made the checkpoint.
"""

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from dmil_core.checkpoint import Checkpoint, opened
from dmil_core.configs import EvaluationConfig
from dmil_core.errors import UserError
from services.cli.arguments import Quiet, exit_code, parse, peek
from services.cli.composition import with_evaluation
from services.cli.places import announce
from services.cli.progress import Clock, console
from services.demonstrations.store import DATA, open_store
from services.distributed.ray_runner import RunnerKind, open_runner
from services.evaluation.summary import summarise
from services.experiments.champions import ALIAS, open_promotion
from services.experiments.experiment import Experiment
from services.reporting.end_of_run import show, write_report
from services.storage.folder_lock import held

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``evaluate``."""

    checkpoint: Path
    """Folder of a checkpoint, or of a run, whose newest one is then taken."""
    evaluation: EvaluationConfig
    tasks: tuple[str, ...] | None = None
    """Adapt to these tasks alone, as meta-testing tasks; they need not be the run's, only of its kind of robot."""
    output: Path = Path("evaluation")
    """Folder for the rows, the summary and the report."""
    runner: RunnerKind = "ray"
    """Where to work: in Ray actors, or in this process; the result is the same."""
    workers: int | None = None
    """Ray workers, one for each CPU of the cluster if not given."""
    promote: bool = False
    """Register the run's model in MLflow under the suite's name, and give it the alias champion if it is the first, or
    better than the champion outside the interval of their difference: the champion is then evaluated too, in the same
    episodes."""
    quiet: Quiet = False


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    path: Path | None = peek(arguments, checkpoint=Path).checkpoint
    checkpoint = None if path is None else opened(path, logger.warning)
    evaluation = EvaluationConfig() if checkpoint is None else checkpoint.manifest.config.evaluation
    args = parse(Arguments, __doc__ or "", arguments, Arguments(path or tyro.MISSING, evaluation))
    assert checkpoint is not None, "without --checkpoint there is nothing that parses"
    config = with_evaluation(checkpoint.manifest.config, args.evaluation)
    if args.tasks is not None:
        if len(set(args.tasks)) < len(args.tasks):
            raise UserError(f"--tasks: got {', '.join(args.tasks)}; wanted each once: episodes would count twice")
        if args.promote:
            raise UserError("--promote: got --tasks with it; wanted all of the suite's, by which models are compared")
        config = config.model_copy(update={"suite": config.suite.model_copy(update={"test_tasks": args.tasks})})
    experiment = Experiment(config, store := open_store())
    announce(evaluation=(args.output, "--output FOLDER"), demonstrations=(store.root, f"{DATA}=FOLDER"))
    with held(args.output):
        _carry_out(args, checkpoint, experiment)


def _carry_out(args: Arguments, checkpoint: Checkpoint, experiment: Experiment) -> None:
    promotion = open_promotion(checkpoint, experiment, args.output / ALIAS) if args.promote else None
    clock = Clock()
    with open_runner(args.runner, experiment.suite, args.workers) as runner:
        clock.lap("start")
        data = experiment.collect(runner)
        clock.lap("collect")
        evaluation = experiment.evaluate(runner, data, checkpoint, args.output, args.tasks)
        controls = experiment.evaluate_controls(runner, data, evaluation, args.output, args.tasks)
        if promotion is not None:
            promotion.evaluate_champion(runner, data)
        clock.lap("evaluate")
    summary = summarise(evaluation, seconds=clock.seconds, folder=args.output, controls=controls)
    write_report(summary, args.output)
    show(summary)
    if promotion is not None:
        for line in promotion.decide(evaluation, args.output):
            console.print(line, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
