"""One trial of a sweep, in the process that Tune gives it: the same experiment as ``meta_train``."""

import logging
import os
import time
from collections.abc import Mapping
from contextlib import redirect_stdout
from io import TextIOWrapper
from pathlib import Path

import numpy as np
import torch
from pydantic import TypeAdapter

from dmil_core.checkpoint import Checkpoint
from dmil_core.errors import RunError, UserError
from dmil_core.files import append_to, read_file, write_file
from services.cli.composition import with_evaluation
from services.cli.progress import Clock, console_logging
from services.demonstrations.store import DemoStore
from services.distributed.ray_runner import RayRunner
from services.evaluation.results import EpisodeResult, read_rows
from services.evaluation.summary import rates, summary_rows
from services.experiments.experiment import Experiment
from services.storage.checkpoints import Checkpoints
from services.storage.folder_lock import held
from services.storage.remote import given_storage
from services.storage.replication import replicated
from services.storage.run_folders import CONFIG
from services.sweeps.folders import TRAINED, SweepFolder, TrialResult, evaluated, trained
from services.sweeps.settings import PlannedTrial
from services.tracking.history import read_metrics
from services.tracking.tracker import Tracker, record_settings

logger = logging.getLogger(__name__)

HELD_OUT, ITERATION = "held_out", "iteration"
"""What a trial reports to Tune."""
REPORT_SECONDS = 2.0
MOST_BYTES = 2**28
_METRICS = TypeAdapter(list[dict[str, float]])


class ReportingTracker(Tracker):
    """Reports to Tune too how far the trial is, and what a search goes by."""

    goes_by: str
    _last = 0.0

    def metrics(self, step: int, values: Mapping[str, float], *, anew: bool = False) -> None:
        """Record metrics of one iteration."""
        from ray import tune

        super().metrics(step, values, anew=anew)
        held_out = [value for name, value in values.items() if name.startswith(self.goes_by)]
        if held_out:
            tune.report({ITERATION: step, HELD_OUT: float(np.mean(held_out))})
        elif time.monotonic() - self._last > REPORT_SECONDS:
            self._last = time.monotonic()
            tune.report({ITERATION: step})


def tracker_of(sweep: SweepFolder, trial: PlannedTrial, kind: type[Tracker] = Tracker) -> Tracker:
    """Return what records a trial as a child of the sweep's MLflow run."""
    return kind(sweep.of_trial(trial.name), f"dmil-{sweep.record.name}", parent=sweep.path)


def run_trial(folder: Path, name: str, demonstrations: Path, environment: Mapping[str, str]) -> None:
    """Run a trial of the sweep in `folder` to its end, or from where it was stopped, and note what came of it.

    An error in it is noted and tracked, and is no failure to Tune, which would only try again. If the process dies,
    Tune starts it again. `environment` has variables of the sweep's program, as the addresses of MLflow and of a
    storage.
    """
    torch.set_num_threads(1)
    os.environ |= environment
    sweep = SweepFolder(folder)
    trial = sweep.trials[name]
    tracker = tracker_of(sweep, trial, ReportingTracker)
    assert isinstance(tracker, ReportingTracker)
    tracker.goes_by = f"{sweep.record.sweep.metric}/meta-testing/"
    status = "KILLED"
    log_file = TextIOWrapper(append_to(sweep.of_trial(name), "log.txt"), "utf-8", line_buffering=True)
    with log_file as log, redirect_stdout(log), console_logging(quiet=False):
        try:
            record_settings(tracker, trial.config)
            tracker.tags({"sweep": sweep.record.name, "variant": trial.variant, "scale": sweep.record.preset})
            sweep.finish(name, _run(sweep, trial, DemoStore(demonstrations, given_storage()), tracker))
            status = "FINISHED"
        except Exception as error:  # noqa: BLE001  whatever it is, it is shown, and the other trials go on
            status = "FAILED"
            message = str(error) if isinstance(error, UserError | RunError) else f"{type(error).__name__}: {error}"
            logger.error(message)
            tracker.tags({"error": message[:5000]})
            sweep.finish(name, TrialResult(status="failed", error=message))
        finally:
            tracker.close(status)


def _run(sweep: SweepFolder, trial: PlannedTrial, store: DemoStore, tracker: Tracker) -> TrialResult:
    config, resources, clock = trial.config, sweep.record.sweep.resources, Clock()
    experiment = Experiment(config, store)
    runner = RayRunner(experiment.suite, resources.workers, resources.gpus, resources.compute)
    try:
        clock.lap("start")
        data = experiment.collect(runner)
        digests = {task: dataset.digest for task, dataset in data.items()}
        tracker.inputs({dataset.id: dataset.digest for dataset in data.values()})
        home = trained(sweep.runs, config, digests)
        tracker.tags({"trained": home.name})
        clock.lap("collect")
        with held(home, wait=True):  # two sweeps may want it
            with replicated(home, TRAINED, restore=True):
                checkpoints = Checkpoints(home / "checkpoints", config.training.checkpoints_kept)
                checkpoint = checkpoints.newest() if checkpoints.all() else None
                if checkpoint is None or checkpoint.manifest.iteration < config.training.iterations:
                    write_file(home, CONFIG, config.model_dump_json(indent=1) + "\n")
                    checkpoint = experiment.train(
                        runner, data, checkpoints, tracker, checkpoint, overlap_evaluation=False
                    )
                    curves = read_metrics(sweep.of_trial(trial.name))
                    write_file(home, "metrics.json", _METRICS.dump_json(curves))
                else:
                    logger.info(f"trained already: {home}")
                    _copy_curves(home, tracker)
            clock.lap("train")
            tasks = [task for split, task in experiment.tasks if split in sweep.record.sweep.splits]
            folders = {}
            for row, evaluation in trial.evaluations.items():
                evaluated_experiment = Experiment(with_evaluation(config, evaluation), store)
                folders[row] = evaluated(home, evaluation, tasks)
                if not (folders[row] / "episodes.jsonl").exists():
                    evaluated_experiment.evaluate(runner, data, checkpoint, folders[row], tasks)
            clock.lap("evaluate")
    finally:
        runner.close()
    held_out = [
        _record(tracker, folder, row if len(folders) > 1 else "", experiment, checkpoint, sweep.record.sweep.metric)
        for row, folder in folders.items()
    ]
    return TrialResult(
        status="finished",
        trained=str(home.relative_to(sweep.runs)),
        evaluated={row: str(folder.relative_to(sweep.runs)) for row, folder in folders.items()},
        seconds=clock.seconds,
        iteration=checkpoint.manifest.iteration,
        environment_steps=checkpoint.manifest.environment_steps,
        held_out=float(np.mean(held_out)),
    )


def _copy_curves(home: Path, tracker: Tracker) -> None:
    """Record what another trial recorded when it trained."""
    if (home / "metrics.json").exists():
        for row in _METRICS.validate_json(read_file(home, "metrics.json", MOST_BYTES)):
            iteration = int(row.pop("iteration"))
            tracker.metrics(iteration, row)


def _record(
    tracker: Tracker, folder: Path, prefix: str, experiment: Experiment, checkpoint: Checkpoint, metric: str
) -> float:
    """Record the rates of an evaluation, and return what a search would go by."""
    rows = read_rows(folder / "episodes.jsonl", EpisodeResult)
    metrics = rates(summary_rows(rows, experiment.suite.best_score, experiment.config.method), {})
    iteration = checkpoint.manifest.iteration
    tracker.metrics(iteration, {f"{prefix}/{name}" if prefix else name: value for name, value in metrics.items()})
    return float(np.mean([value for name, value in metrics.items() if name.startswith(f"{metric}/meta-testing/")]))
