"""Collect demonstrations, meta-train, adapt to unseen tasks and measure the success rates.

Every setting is a flag; what is not given comes from the YAML file of --config, and else from --preset. For example:

  dmil meta-train --preset ml10-quick
  dmil meta-train --suite kitchen --method mil --seed 1
  dmil meta-train --resume NAME --training.iterations 5000
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from pydantic import ValidationError

from dmil_core.configs import DEFAULT_METHOD, ExperimentConfig
from dmil_core.errors import UserError, describe_errors
from dmil_core.files import check_folder, read_file, write_file
from dmil_core.settings import GradientPath, OnNonfinite
from services.cli.arguments import Quiet, exit_code, parse, peek
from services.cli.composition import DEFAULT_PRESET, EARLY, defaults_from
from services.cli.places import announce
from services.cli.progress import Clock, console
from services.demonstrations.store import DATA, open_store
from services.distributed.cluster import RunnerKind
from services.storage.folder_lock import held
from services.storage.redaction import redacted
from services.storage.remote import STORAGE
from services.storage.run_folders import CONFIG, find_folder, make_folder, new_name, resume_command
from services.tracking.links import database, tracking_uri
from services.tracking.system import recording_system
from services.tracking.tracker import Tracker, record_settings

if TYPE_CHECKING:
    from dmil_core.devices import Compute
    from services.experiments.experiment import Experiment
    from services.storage.checkpoints import Checkpoints

MOST_BYTES = 2**20
"""In it."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``meta_train``."""

    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")]
    preset: str = DEFAULT_PRESET
    """Settings to begin with: quick (some minutes on two cores), paper (its tables to the letter) or smoke (a minute);
    also with the suite's name before, as ml10-quick."""
    suite: str | None = None
    """The suite, as ml10, ml45, ML1-reach, push-around-wall or kitchen; short for --suite.name."""
    method: str | None = None
    """The method: dmil, option-gail, option-gail-offline, mil, mlsh, pemirl, behaviour-cloning, per-task,
    nearest-neighbour, tracking, or what an installed package brings; its settings are those of --method.… below."""
    demos: str | None = None
    """Where demonstrations come from, as minari:ID,TASK=ID; short for --demonstrations.source."""
    config: Path | None = None
    """YAML file of settings in the preset's place, for example `method: {sub_skills: 5}`."""
    runner: RunnerKind = "ray"
    """Where to work: in Ray actors, or in this process; the result is the same to the bit."""
    workers: int | None = None
    """Ray workers of each kind, one for each CPU of the cluster if not given; they do not change the result. Those that
    it has no CPU for yet join when it has grown."""
    device: str = "auto"
    """What computes gradients and adaptations: cpu; cuda, a GPU, or cuda:N with --runner local; auto takes the GPU that
    Ray gave a worker, see --gpus, else the CPU."""
    gpus: float | None = None
    """GPUs that Ray reserves for each worker, up to 1; as many workers share one. If not given: none, or with --device
    cuda an equal part of all."""
    path: GradientPath = "auto"
    """How a group's gradients are computed: loop, one slot after the other; batched, all slots at once, which differs
    by rounding; auto is batched on a GPU."""
    overlap_evaluation: bool = True
    """Go on with meta-training during the evaluations that --evaluation.every asks for; the results are the same."""
    on_nonfinite: OnNonfinite = "stop"
    """Where a loss or a gradient is not finite: stop, or go on without that step."""
    runs: Path = Path("runs")
    """The folder that the run's own folder is made in."""
    name: str | None = None
    """Name of the run's folder; the suite's and the preset's with the time if not given."""
    resume: str | None = None
    """Name or folder of a run to go on with, with its own settings."""
    quiet: Quiet = False

    @property
    def compute(self) -> "Compute":
        """What computes."""
        from dmil_core.devices import Compute

        return Compute(self.device, self.path)


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args, folder = _read(arguments)
    from dmil_core.methods.registry import method_type
    from services.distributed.ray_runner import check_compute
    from services.experiments.experiment import Experiment
    from services.storage.replication import claim_name, replicated

    check_compute(args.runner, args.compute, method_type(args.experiment.method.name), args.gpus)
    experiment = Experiment(args.experiment, store := open_store())
    announce(
        run=(folder, "--runs FOLDER"),
        demonstrations=(store.root, f"{DATA}=FOLDER"),
        MLflow=(database(tracking_uri()), "MLFLOW_TRACKING_URI=sqlite:///FILE"),
    )
    experiment.read_sources()
    if args.resume is None:
        make_folder(folder, {CONFIG: args.experiment.model_dump_json(indent=1) + "\n"})
    with held(folder):
        if args.resume is None:
            claim_name(folder)
        with replicated(folder):
            _carry_out(args, folder, experiment)


def _carry_out(args: Arguments, folder: Path, experiment: "Experiment") -> None:
    from services.distributed.ray_runner import open_runner
    from services.experiments.experiment import check_settings
    from services.reporting.end_of_run import conclude, show
    from services.storage.checkpoints import Checkpoints

    config = args.experiment
    checkpoints = Checkpoints(folder / "checkpoints", config.training.checkpoints_kept)
    checkpoint = checkpoints.newest() if checkpoints.all() else None
    if checkpoint is not None:
        check_settings(checkpoint, experiment.config, folder / CONFIG)
    clock = Clock()
    write_file(folder, CONFIG, config.model_dump_json(indent=1) + "\n")
    with Tracker(folder, f"dmil-{config.suite.name}") as tracker, _telling_how_to_go_on(folder, checkpoints):
        record_settings(tracker, config)
        with (
            recording_system(tracker),
            open_runner(args.runner, experiment.suite, args.workers, args.compute, args.gpus) as runner,
        ):
            clock.lap("start")
            data = experiment.collect(runner)
            tracker.inputs({dataset.id: dataset.digest for dataset in data.values()})
            clock.lap("collect")
            trained = experiment.train(
                runner,
                data,
                checkpoints,
                tracker,
                checkpoint,
                overlap_evaluation=args.overlap_evaluation,
                on_nonfinite=args.on_nonfinite,
            )
            clock.lap("train")
            evaluation = experiment.evaluate(runner, data, trained, folder)
            controls = experiment.evaluate_controls(runner, data, evaluation, folder)
            clock.lap("evaluate")
        check_folder(folder, CONFIG)
        summary = conclude(evaluation, controls, folder, tracker, clock)
        tracker.model(trained.path, experiment.held_out_sets(data)[experiment.tasks[-1][1]][:1])
    show(summary, tracker.address_lines)


@contextmanager
def _telling_how_to_go_on(folder: Path, checkpoints: "Checkpoints") -> Iterator[None]:
    """Where a run is stopped, or fails when it has a checkpoint, print the line that goes on with it."""
    try:
        yield
    except BaseException as error:
        stopped = isinstance(error, KeyboardInterrupt)
        if stopped or (checkpoints.all() and not isinstance(error, UserError)):
            console.print(f"{'stopped; ' if stopped else ''}to go on: {resume_command(folder)}", soft_wrap=True)
        raise


def _read(arguments: Sequence[str]) -> tuple[Arguments, Path]:
    """Return the arguments and the run's folder, which a new one does not have yet."""
    early = peek(arguments, **EARLY, resume=str, runs=Path, name=str)
    if early.resume is None:
        args = parse(Arguments, __doc__ or "", arguments, Arguments(defaults_from(early)))
        config = args.experiment
        named = "" if config.method.name == DEFAULT_METHOD else f"{config.method.name}-"
        kind = f"{config.suite.name}-{named}{args.preset.rpartition('-')[2]}"
        return args, new_name(args.name or f"{kind}-{datetime.now():%Y%m%d-%H%M%S}", args.runs)
    if any(getattr(early, name) for name in EARLY):
        raise UserError(
            "--resume: got --preset, --config, --suite, --method or --demos with it; wanted none: a run goes on with "
            "its own settings"
        )
    if early.name is not None:
        raise UserError(
            f"--name: got {early.name} with --resume; wanted one of them: a run that goes on keeps its name"
        )
    from services.storage.replication import restored

    runs = early.runs or Arguments.runs
    wanted = Path(early.resume) if Path(early.resume).name != early.resume else runs / early.resume
    if restored(wanted):
        console.print(f"fetched from {redacted(os.environ[STORAGE])}: {wanted}")
    folder = find_folder(early.resume, runs, CONFIG)
    try:
        before = ExperimentConfig.model_validate_json(read_file(folder, CONFIG, MOST_BYTES))
    except (OSError, ValidationError) as error:
        got = describe_errors(error) if isinstance(error, ValidationError) else error
        raise UserError(f"{folder / 'config.json'}: {got}; start a new run") from error
    args = parse(Arguments, __doc__ or "", arguments, Arguments(before))
    _same_run(before, args.experiment)
    return args, folder


def _same_run(before: ExperimentConfig, now: ExperimentConfig) -> None:
    """Refuse to go on under other settings than the run began with."""
    from services.experiments.experiment import changed_settings

    if changed := changed_settings(before, now):
        raise UserError(
            f"--resume: got other settings of {', '.join(changed)} than the run began with; wanted the same, except "
            "for those of evaluation and training's iterations, checkpoint_every and checkpoints_kept; start a new run "
            "for others"
        )


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
