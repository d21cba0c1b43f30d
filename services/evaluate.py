"""Adapt a model to each task with few demonstrations, and measure the success rates of what comes out.

Settings that are not given are those of the run that made it. Rows, summary and page go to a new folder each time, and
MLflow has the evaluation as a run of its own. For example:

  dmil evaluate ml10 --tasks drawer-open door-close
  dmil evaluate runs/NAME --demos npz:door-lock=mine.npz --evaluation.shots 1
"""

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from dmil_core.configs import EvaluationConfig, ExperimentConfig
from dmil_core.errors import RunError, UserError
from dmil_core.files import at_home, remove_folder, write_file
from services.cli.arguments import Quiet, exit_code, parse, peek
from services.cli.composition import checked, with_evaluation
from services.cli.places import announce
from services.cli.progress import Clock, console
from services.demonstrations.external import places_of
from services.demonstrations.store import DATA, open_store
from services.distributed.cluster import RunnerKind
from services.storage.folder_lock import held
from services.storage.run_folders import make_folder
from services.tracking.links import database, tracking_uri
from services.tracking.tracker import Tracker, record_settings

if TYPE_CHECKING:
    from dmil_core.checkpoint import Checkpoint
    from services.evaluation.summary import Summary
    from services.experiments.champions import Promotion
    from services.experiments.experiment import Experiment

logger = logging.getLogger(__name__)

EVALUATIONS = "evaluations"
"""In a run's folder, beside those on the way of meta-training, which are named by their iteration alone."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``evaluate``."""

    checkpoint: str
    """A run's name, its folder or that of a checkpoint, or a model that comes with the project, as ml10; it may also
    stand first without the flag."""
    evaluation: EvaluationConfig
    tasks: tuple[str, ...] | None = None
    """Adapt to these tasks alone, as meta-testing tasks; they need not be the run's, only of its kind of robot."""
    demos: str | None = None
    """Draw support sets from demonstrations of your own, as npz:TASK=mine.npz; without --tasks of these tasks alone,
    and without the run's controls."""
    output: Path | None = None
    """New folder for the rows, the summary and the page; evaluations/NAME-DATE in the run's folder if not given."""
    expect: bool = False
    """Adapt to meta-testing tasks alone, without controls, and compare with the figures that come with the model: exit
    code 1 where a success rate lies outside their 95% interval."""
    runner: RunnerKind = "ray"
    """Where to work: in Ray actors, or in this process; the result is the same."""
    workers: int | None = None
    """Ray workers, one for each CPU of the cluster if not given."""
    device: str = "auto"
    """What adapts, while policies act on the CPU: cpu; cuda, a GPU, or cuda:N with --runner local; auto takes the GPU
    that Ray gave a worker, see --gpus, else the CPU."""
    gpus: float | None = None
    """GPUs that Ray reserves for each worker, up to 1; as many workers share one. If not given: none, or with --device
    cuda an equal part of all."""
    promote: bool = False
    """Register the run's model in MLflow under the suite's name, and give it the alias champion if it is the first, or
    better than the champion outside the interval of their difference: the champion is then evaluated too, in the same
    episodes."""
    runs: Path = Path("runs")
    """The folder that runs' own folders are in."""
    quiet: Quiet = False


def run(arguments: Sequence[str]) -> None:
    """Run the program.

    Raises:
        RunError: if figures are not as --expect wants them.
    """
    if arguments and not arguments[0].startswith("-"):
        arguments = ["--checkpoint", *arguments]
    early = peek(arguments, checkpoint=str, demos=str, runs=Path)
    evaluation, checkpoint = EvaluationConfig(), None
    if early.checkpoint is not None:
        from dmil_core.checkpoint import opened
        from dmil_core.model import model_folder

        folder = model_folder(early.checkpoint, early.runs or Arguments.runs, "--checkpoint")
        checkpoint = opened(folder, logger.warning)
        evaluation = checkpoint.manifest.config.evaluation
        if early.demos is not None or "--expect" in arguments:  # they need the demonstrations of all tasks
            evaluation = evaluation.model_copy(update={"controls": ()})
    args = parse(Arguments, __doc__ or "", arguments, Arguments(early.checkpoint or tyro.MISSING, evaluation))
    assert checkpoint is not None, "without --checkpoint there is nothing that parses"
    from dmil_core.devices import Compute
    from dmil_core.methods.registry import method_type
    from services.distributed.ray_runner import check_compute
    from services.evaluation.expectation import expected_rows, verdicts
    from services.experiments.experiment import Experiment

    tasks = args.tasks if args.tasks is not None or early.demos is None else tuple(places_of(early.demos))
    config = _config(checkpoint, args, tasks, early.demos)
    check_compute(args.runner, Compute(args.device), method_type(config.method.name), args.gpus)
    experiment = Experiment(config, store := open_store())
    only = experiment.suite.test_tasks if args.expect else tasks
    experiment.read_sources(only)
    expected = expected_rows(checkpoint, experiment.suite.test_tasks) if args.expect else []
    output = _new_folder(args, checkpoint)
    announce(
        evaluation=(output, "--output FOLDER"),
        demonstrations=(store.root, f"{DATA}=FOLDER"),
        MLflow=(database(tracking_uri()), "MLFLOW_TRACKING_URI=sqlite:///FILE"),
    )
    make_folder(output)
    with held(output):
        promotion = _promotion(checkpoint, experiment, output) if args.promote else None
        summary = _carry_out(args, checkpoint, experiment, output, only, promotion)
    found = verdicts(summary, expected)
    for verdict in found:
        console.print(verdict.words, soft_wrap=True)
    if not all(verdict.met for verdict in found):
        raise RunError(f"{output}: got success rates outside the intervals of the model's own, see above")


def _config(
    checkpoint: "Checkpoint", args: Arguments, tasks: tuple[str, ...] | None, demos: str | None
) -> ExperimentConfig:
    """Return the settings of the evaluation."""
    config = with_evaluation(checkpoint.manifest.config, args.evaluation)
    changed: dict[str, dict[str, Any]] = {}
    if tasks is not None:
        if len(set(tasks)) < len(tasks):
            raise UserError(f"--tasks: got {', '.join(tasks)}; wanted each once: episodes would count twice")
        if args.promote:
            raise UserError(
                "--promote: got --tasks or --demos with it; wanted all of the suite's, by which models are compared"
            )
        changed["suite"] = {"test_tasks": tasks}
    if demos is not None:
        changed["demonstrations"] = {"source": demos}
    settings = config.model_dump()
    return checked(settings | {section: settings[section] | values for section, values in changed.items()})


def _new_folder(args: Arguments, checkpoint: "Checkpoint") -> Path:
    """Return the folder of an evaluation, which is not there yet."""
    if args.output is not None:
        if args.output.exists():
            raise UserError(f"--output: got {args.output}, which is there already; wanted the name of a new folder")
        return args.output
    from dmil_core.checkpoint import FOLDER

    of_run = checkpoint.path.parent.name == FOLDER
    home, model = (checkpoint.path.parents[1],) * 2 if of_run else (at_home(args.runs), checkpoint.path)
    first = home / EVALUATIONS / f"{model.resolve().name}-{datetime.now():%Y%m%d-%H%M%S}"
    numbered = (first if number == 1 else first.with_name(f"{first.name}-{number}") for number in count(1))
    return next(folder for folder in numbered if not folder.exists())


def _promotion(checkpoint: "Checkpoint", experiment: "Experiment", output: Path) -> "Promotion":
    """Open a promotion; where that is refused, the new folder `output` is removed."""
    from services.experiments.champions import ALIAS, open_promotion

    try:
        return open_promotion(checkpoint, experiment, output / ALIAS)
    except (UserError, RunError):
        remove_folder(output.parent, output.name)
        raise


def _carry_out(
    args: Arguments,
    checkpoint: "Checkpoint",
    experiment: "Experiment",
    output: Path,
    only: tuple[str, ...] | None,
    promotion: "Promotion | None",
) -> "Summary":
    from dmil_core.devices import Compute
    from services.distributed.ray_runner import open_runner
    from services.experiments.finished_run import EVALUATED
    from services.reporting.end_of_run import conclude, show

    write_file(output, EVALUATED, experiment.config.model_dump_json(indent=1) + "\n")
    clock = Clock()
    with Tracker(output, f"dmil-{experiment.config.suite.name}") as tracker:
        record_settings(tracker, experiment.config)
        tracker.tags({"evaluation_of": str(checkpoint.path)})
        with open_runner(args.runner, experiment.suite, args.workers, Compute(args.device), args.gpus) as runner:
            clock.lap("start")
            data = experiment.collect(runner, only)
            tracker.inputs({dataset.id: dataset.digest for dataset in data.values()})
            clock.lap("collect")
            evaluation = experiment.evaluate(runner, data, checkpoint, output, only)
            controls = experiment.evaluate_controls(runner, data, evaluation, output, only)
            if promotion is not None:
                promotion.evaluate_champion(runner, data)
            clock.lap("evaluate")
        summary = conclude(evaluation, controls, output, tracker, clock)
        lines = [] if promotion is None else promotion.decide(evaluation, output)
    show(summary, [*tracker.address_lines, *lines])
    return summary


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
