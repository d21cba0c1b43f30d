"""The trials of a sweep on Ray Tune: which run beside each other, which are stopped early, how far they are."""

import logging
import os
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune import Callback, RunConfig, TuneConfig
from ray.tune.schedulers import AsyncHyperBandScheduler, TrialScheduler

from dmil_core.errors import UserError
from dmil_core.files import remove_file
from services.cli.progress import Bar
from services.demonstrations.store import data_root
from services.distributed.cluster import cpus
from services.distributed.gpus import gpus_of_each
from services.storage.remote import STORAGE
from services.sweeps.folders import RESULT, SweepFolder, TrialResult
from services.sweeps.trial import HELD_OUT, ITERATION, run_trial, tracker_of
from services.tracking.links import tracking_uri

logger = logging.getLogger(__name__)

DEATHS_ALLOWED = 3
"""So often is a trial begun again whose process ended."""


class Progress(Callback):
    """Shows how many trials are over, and how far the others are."""

    def __init__(self, sweep: SweepFolder, left: int) -> None:
        """Show nothing yet of the trials that are left: Tune makes a copy of this on disk first."""
        self._sweep, self._left = sweep, left
        self._at: dict[str, int] = {}
        self.held_out: dict[str, tuple[int, float]] = {}
        """Of each trial, what a search goes by, with the iteration it is of."""

    def setup(self, stop: Any = None, num_samples: Any = None, total_num_samples: Any = None, **info: Any) -> None:
        """Begin to show."""
        total = len(self._sweep.trials)
        self._bar = Bar("trials", total, total - self._left)
        self._bar.__enter__()

    def on_trial_start(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
        """Show one more."""
        self._note(trial, 0)

    def on_trial_result(self, iteration: int, trials: Any, trial: Any, result: Any, **info: Any) -> None:
        """Show how far it is."""
        if HELD_OUT in result:
            self.held_out[trial.config["trial"]] = result[ITERATION], result[HELD_OUT]
        self._note(trial, result.get(ITERATION, 0))

    def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
        """Say what came of it."""
        self._over(trial)

    def on_trial_recover(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
        """Say that it is begun again."""
        name = trial.config["trial"]
        self._at.pop(name, None)
        logger.warning(f"{name}: its process ended; it is begun again")

    def on_trial_error(self, iteration: int, trials: Any, trial: Any, **info: Any) -> None:
        """Say that its process ended."""
        self._over(trial)

    def on_experiment_end(self, trials: Any, **info: Any) -> None:
        """Stop showing."""
        self._bar.__exit__(None, None, None)

    def _note(self, trial: Any, done: int) -> None:
        self._at[trial.config["trial"]] = done
        self._bar.advance(0, self._running())

    def _over(self, trial: Any) -> None:
        name = trial.config["trial"]
        self._at.pop(name, None)
        result = self._sweep.result(name)
        message = "stopped early, for others are better" if result is None else result.error or result.status
        if result is not None and result.status == "failed":
            logger.error(f"{name}: {message}")
        else:
            logger.info(f"{name}: {message}")
        self._bar.advance(1, self._running())

    def _running(self) -> str:
        iterations = {name: self._sweep.trials[name].config.training.iterations for name in self._at}
        return "; ".join(f"{name} {done}/{iterations[name]}" for name, done in self._at.items())


def tune_trials(sweep: SweepFolder) -> None:
    """Run all trials that are not over yet, as many beside each other as the cluster has room for.

    What came of each is in its folder then.

    Raises:
        UserError: if the cluster has no room for even one.
    """
    results = {name: sweep.result(name) for name in sweep.trials}
    left = [name for name, result in results.items() if result is None or result.status == "failed"]
    if not left:
        return
    # They report files that are not written, and of a lost process by its traceback.
    for name in ("analysis.experiment_analysis", "execution.tune_controller"):
        logging.getLogger(f"ray.tune.{name}").setLevel(logging.CRITICAL)
    resources = sweep.record.sweep.resources
    if resources.workers > cpus():
        raise UserError(
            f"resources.workers: got {resources.workers} for each trial; the cluster has {cpus()} CPUs; wanted fewer"
        )
    gpus_of_each(resources.compute, resources.gpus, resources.workers)  # before a trial waits for ever
    for name in left:
        remove_file(sweep.of_trial(name), RESULT)
    folder, root = sweep.path.absolute(), data_root().absolute()
    environment = {"MLFLOW_TRACKING_URI": _everywhere(tracking_uri())}
    if STORAGE in os.environ:
        environment[STORAGE] = os.environ[STORAGE]

    def trial(config: dict[str, Any]) -> None:
        run_trial(folder, config["trial"], root, environment)

    # The trial's own process waits for its workers: they have the CPUs.
    bundles = [{"CPU": 1.0, **({"GPU": resources.gpus} if resources.gpus else {})}] * resources.workers
    progress = Progress(sweep, len(left))
    tuner = tune.Tuner(
        tune.with_resources(trial, tune.PlacementGroupFactory([{}, *bundles])),
        param_space={"trial": tune.grid_search(left)},
        tune_config=TuneConfig(scheduler=_scheduler(sweep)),
        run_config=RunConfig(
            name="tune",
            storage_path=str(folder),
            failure_config=tune.FailureConfig(max_failures=DEATHS_ALLOWED),
            callbacks=[progress],
            verbose=0,
        ),
    )
    outcomes = tuner.fit()
    errors = {outcome.config["trial"]: outcome.error for outcome in outcomes if outcome.config}
    for name in left:
        if sweep.result(name) is None:
            _note_the_end(sweep, name, errors.get(name), progress.held_out.get(name))


def _everywhere(uri: str) -> str:
    """Return an address that holds in whatever working directory."""
    path = uri.removeprefix("sqlite:///")
    return f"sqlite:///{Path(path).absolute()}" if uri.startswith("sqlite:///") else uri


def _scheduler(sweep: SweepFolder) -> TrialScheduler | None:
    search = sweep.record.sweep.search
    if search is None:
        return None
    config = next(iter(sweep.trials.values())).config
    every = config.evaluation.every or 1
    return AsyncHyperBandScheduler(
        time_attr=ITERATION,
        grace_period=every,
        max_t=config.training.iterations + every,  # at which it would stop trials that have come to their end
        reduction_factor=search.reduction,
        metric=HELD_OUT,
        mode="max",
    )


def _note_the_end(sweep: SweepFolder, name: str, error: Exception | None, held_out: tuple[int, float] | None) -> None:
    """Note what came of a trial whose process ended before it could do so itself."""
    tracker = tracker_of(sweep, sweep.trials[name])
    if error is None:
        iteration, value = held_out or (0, None)
        result = TrialResult(status="stopped", iteration=iteration, held_out=value)
    else:
        result = TrialResult(status="failed", error=f"its process ended {DEATHS_ALLOWED + 1} times: {error}"[:2000])
        tracker.tags({"error": str(result.error)})
    sweep.finish(name, result)
    tracker.close("FINISHED" if error is None else "FAILED")
