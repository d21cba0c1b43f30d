"""Run one of the paper's ablations, or a search of one's own, on Ray Tune, and lay its table beside the paper's.

What is trained once, by this sweep or another, is not trained again.
"""

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import ValidationError

from dmil_core.errors import RunError, UserError, describe_errors, nearest
from services.cli.arguments import Quiet, exit_code, parse
from services.cli.places import announce
from services.cli.progress import Clock, console
from services.cli.yaml_files import read_yaml
from services.demonstrations.store import DATA, data_root, open_store
from services.distributed.cluster import joined
from services.storage.folder_lock import held
from services.storage.provenance import git_commit, library_versions
from services.storage.run_folders import IDENTITY, find_folder, new_name, resume_command
from services.suites.registry import open_suite
from services.sweeps.folders import MARK, SweepFolder, SweepRecord
from services.sweeps.settings import Preset, Sweep, planned
from services.tracking.delivery import Identity
from services.tracking.links import comparison_link, database, tracking_uri
from services.tracking.system import recording_system
from services.tracking.tracker import Tracker

CONFIGS = Path(__file__).with_name("tune_configs").resolve()
TUNE_SETTINGS = {
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_WARN_THRESHOLD_S": "10",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",
    "RAY_AIR_NEW_OUTPUT": "0",
}
"""Environment variables, which Tune reads when it is imported: trials stay in this folder; Ctrl-C comes to us; what it
would write for TensorBoard is in MLflow; between evaluations a trial only reports its iteration; we show progress."""


@dataclass(frozen=True)
class Arguments:
    """Arguments of ``tune_sweep``."""

    sweep: Annotated[str | None, tyro.conf.Positional] = None
    """File of the sweep, or the name of one in tune_configs."""
    preset: Annotated[Preset, tyro.conf.arg(aliases=["--scale"])] = "quick"
    """Settings that every training begins with: smoke (to see that all works), quick (some minutes each on one core)
    or paper."""
    suites: tuple[str, ...] | None = None
    """Suites in place of the sweep's."""
    seeds: tuple[int, ...] | None = None
    """Seeds in place of the sweep's."""
    runs: Path = Path("runs")
    """The folder that the sweep's own folder is made in, and where trained configurations are looked for."""
    name: str | None = None
    """Name of the sweep's folder; that of its file and the preset with the time if not given."""
    resume: str | None = None
    """Name or folder of a sweep to go on with: what is finished stays, what failed or was cut off goes on."""
    quiet: Quiet = False


def run(arguments: Sequence[str]) -> None:
    """Run the program."""
    args = parse(Arguments, _description(), arguments, Arguments())
    sweep = _resumed(args) if args.resume is not None else _begun(args)
    with held(sweep.path):
        _carry_out(sweep)


def _carry_out(sweep: SweepFolder) -> None:
    from services.sweeps.table_formats import publish, show, write_tables

    clock = Clock()
    with Tracker(sweep.path, f"dmil-{sweep.record.name}") as tracker:
        try:
            _record_settings(tracker, sweep)
            with recording_system(tracker), joined():
                clock.lap("start")
                _collect(sweep)
                clock.lap("collect")
                tracker.wait_for_run_id()  # trials are its children
                os.environ |= TUNE_SETTINGS
                from services.sweeps.tuning import tune_trials  # Tune reads them when it is imported

                tune_trials(sweep)
                clock.lap("trials")
            tables = write_tables(sweep)
            publish(tracker, tables, sweep)
        except KeyboardInterrupt:
            console.print(f"stopped; to go on: {resume_command(sweep.path, 'tune-sweep')}", soft_wrap=True)
            raise
    show(tables, sweep)
    console.print("seconds: " + ", ".join(f"{phase} {spent:.0f}" for phase, spent in clock.seconds.items()))
    for line in [*tracker.address_lines, *_side_by_side(sweep)]:
        console.print(line, soft_wrap=True)
    if failed := [name for name in sweep.trials if (result := sweep.result(name)) and result.status == "failed"]:
        raise RunError(
            f"{len(failed)} of {len(sweep.trials)} trials failed, see above; the others are in the table; to try them "
            f"again: {resume_command(sweep.path, 'tune-sweep')}"
        )


def _description() -> str:
    lines = []
    for file in sorted(CONFIGS.glob("*.yaml")):
        try:
            lines.append(f"  {file.stem:16}{_read(file).what}")
        except UserError as error:
            lines.append(f"  {file.stem:16}cannot be read: {error}")
    return (__doc__ or "") + "\n".join(["\nSweeps in tune_configs:", "", *lines])


def _read(file: Path) -> Sweep:
    try:
        return Sweep.model_validate(read_yaml(file, "SWEEP"))
    except ValidationError as error:
        raise UserError("\n".join(f"{file}: {line}" for line in describe_errors(error).splitlines())) from error


def _begun(args: Arguments) -> SweepFolder:
    """Make the folder of a new sweep."""
    known = [file.stem for file in sorted(CONFIGS.glob("*.yaml"))]
    if args.sweep is None:
        raise UserError(f"SWEEP: got none; wanted a file as tune_configs/em.yaml, or one of {', '.join(known)}")
    file = CONFIGS / f"{args.sweep}.yaml" if args.sweep in known else Path(args.sweep)
    if not file.exists():
        raise UserError(
            f"SWEEP: got {args.sweep}; wanted a readable YAML file, or one of "
            f"{', '.join(known)}{nearest(file.stem, known)}"
        )
    try:
        sweep = _read(file).at(args.preset, args.suites or (), args.seeds or ())
    except ValidationError as error:
        raise UserError("\n".join(f"--{line}" for line in describe_errors(error).splitlines())) from error
    for value, flag in ((sweep.suites, "--suites"), (sweep.seeds, "--seeds")):
        if len(set(value)) < len(value):
            raise UserError(f"{flag}: got {' '.join(map(str, value))}; wanted each once")
    for trial in planned(sweep, args.preset):
        open_suite(trial.config.suite)
    name = args.name or f"{file.stem}-{args.preset}-{datetime.now():%Y%m%d-%H%M%S}"
    folder = new_name(name, args.runs)
    _announce(folder)
    record = SweepRecord(
        name=file.stem,
        preset=args.preset,
        sweep=sweep,
        began=datetime.now(UTC),
        command=shlex.join(["python", "-m", "services.tune_sweep", *sys.argv[1:]]),
        commit=git_commit(),
        versions=library_versions(),
    )
    return SweepFolder.make(folder, record)


def _resumed(args: Arguments) -> SweepFolder:
    """Open the folder of a sweep that was begun."""
    if args.sweep or args.suites or args.seeds or args.name:
        raise UserError(
            "--resume: got SWEEP, --suites, --seeds or --name with it; wanted none: a sweep goes on with its own"
        )
    assert args.resume is not None
    folder = find_folder(args.resume, args.runs, MARK)
    _announce(folder)
    return SweepFolder(folder)


def _announce(folder: Path) -> None:
    announce(
        sweep=(folder, "--runs FOLDER"),
        demonstrations=(data_root(), f"{DATA}=FOLDER"),
        MLflow=(database(tracking_uri()), "MLFLOW_TRACKING_URI=sqlite:///FILE"),
    )


def _record_settings(tracker: Tracker, sweep: SweepFolder) -> None:
    record, settings = sweep.record, sweep.record.sweep
    suites, seeds = " ".join(settings.suites), " ".join(map(str, settings.seeds))
    methods = " ".join(dict.fromkeys(trial.config.method.name for trial in sweep.trials.values()))
    tracker.parameters({"sweep": record.name, "scale": record.preset, "suites": suites, "seeds": seeds})
    tracker.parameters({"rows": ", ".join(settings.row_names), "trials": len(sweep.trials)})
    tracker.tags({"sweep": record.name, "scale": record.preset, "suite": suites, "method": methods, "seed": seeds})
    tracker.tags({"git_commit": record.commit, "command": record.command})


def _side_by_side(sweep: SweepFolder) -> list[str]:
    """Return a line with the page that has the trials side by side, as far as MLflow knows them."""
    folders = [sweep.of_trial(name) for name in sweep.trials]
    trials = [Identity.of(folder) for folder in folders if (folder / IDENTITY).exists()]
    runs = [trial.run_id for trial in trials if trial.run_id is not None]
    experiment = next((trial.experiment_id for trial in trials if trial.experiment_id is not None), None)
    if experiment is None:
        return []
    return [f"its trials side by side: {comparison_link(tracking_uri(), experiment, runs)}"]


def _collect(sweep: SweepFolder) -> None:
    """Have all demonstrations there before the first trial, made on all CPUs."""
    from services.distributed.ray_runner import open_runner
    from services.experiments.experiment import Experiment

    store = open_store()
    configs = {(trial.config.suite, trial.config.demonstrations): trial.config for trial in sweep.trials.values()}
    for config in configs.values():
        experiment = Experiment(config, store)
        with open_runner("ray", experiment.suite, None) as runner:
            experiment.collect(runner)


if __name__ == "__main__":
    sys.exit(exit_code(run, sys.argv[1:]))
