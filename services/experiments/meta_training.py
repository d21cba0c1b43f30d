"""The loop of meta-training, and what it leaves behind: checkpoints, metrics and warnings."""

import logging
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np

from dmil_core.checkpoint import Checkpoint, Manifest
from dmil_core.errors import RunError
from dmil_core.outer_loop import OuterState
from dmil_core.settings import MethodConfig
from services.cli.live_view import Status
from services.cli.progress import Bar, aside
from services.distributed.failures import keeping_failures
from services.distributed.metrics import CHECKPOINT_TIME, SPOOL_RECORDS
from services.distributed.runner import Plan, Runner
from services.evaluation.evaluator import Evaluations
from services.evaluation.summary import COLLAPSED, against_collapse
from services.experiments.iteration_metrics import iteration_metrics, nonfinite_message, shares_of, status_of
from services.storage.checkpoints import Checkpoints
from services.storage.run_folders import resume_command
from services.tracking.tracker import Tracker

logger = logging.getLogger(__name__)

RECENT = 50
"""Iterations behind the losses and the shares of sub-skills on the screen."""
COLLAPSED_ITERATIONS = 100
"""Iterations that one sub-skill may take nearly all states before a warning."""


class CheckpointWriter:
    """Writes a run's checkpoints, each with the mean loss since the one before."""

    def __init__(
        self,
        checkpoints: Checkpoints,
        manifest: Manifest,
        constants: Mapping[str, np.ndarray],
        runner: Runner,
        tracker: Tracker,
        needed: Callable[[], Collection[Path]],
        path: Path | None = None,
    ) -> None:
        """Write nothing yet: `manifest`, and `path` if it was written, are those of the state that is gone on from.

        `constants` are what the method learned once; `needed` returns the older checkpoints that must not be removed
        yet.
        """
        self.folder = checkpoints.folder.parent
        """Of the run."""
        self.manifest = manifest
        """Of the checkpoint that was written last."""
        self._checkpoints, self._constants, self._needed = checkpoints, constants, needed
        self._meter, self._tracker = runner.meter, tracker
        self._losses: list[float] = []
        self._environment_steps = manifest.environment_steps
        self._path = path

    def add(self, metrics: Mapping[str, float], *, stepped: bool) -> None:
        """Count an iteration; the loss of one without an outer step is left out."""
        self._environment_steps += int(metrics.get("environment_steps", 0))
        if stepped:
            self._losses.append(metrics["loss"])

    def write(self, state: OuterState) -> Path:
        """Write a checkpoint, unless the last one is of the same iteration, and return its folder."""
        if self._path is not None and self.manifest.iteration == state.iteration:
            return self._path
        is_last = state.iteration == self.manifest.config.training.iterations
        manifest = self.manifest.model_copy(
            update={
                "iteration": state.iteration,
                "loss": float(np.mean(self._losses)) if self._losses else None,
                "environment_steps": self._environment_steps,
                "mlflow_run_id": self._tracker.wait_for_run_id() if is_last else self._tracker.run_id,
            }
        )
        self._path = self._checkpoints.save(state, self._constants, manifest, self._needed())
        self.manifest = manifest  # not before: a stop amid saving saves once more
        self._losses.clear()
        self._meter.record(CHECKPOINT_TIME, time.time())
        logger.info(f"checkpoint: {self._path}")
        return self._path


class CollapseWatch:
    """Notices that one sub-skill takes nearly all states for long, and warns once."""

    def __init__(self, method: MethodConfig) -> None:
        self._method, self._iterations, self._has_warned = method, 0, False

    def update(self, iteration: int, metrics: Mapping[str, float]) -> str | None:
        """Return the warning, if it is due after an iteration with these metrics."""
        shares = shares_of(metrics)
        collapsed = len(shares) > 1 and shares.max() > COLLAPSED
        self._iterations = self._iterations + 1 if collapsed else 0
        if self._has_warned or self._iterations < COLLAPSED_ITERATIONS:
            return None
        self._has_warned = True
        return (
            f"sub-skill {shares.argmax()} has taken over {COLLAPSED:.0%} of the states for {COLLAPSED_ITERATIONS} "
            f"iterations, up to {iteration}: the hierarchy is not used; {against_collapse(self._method)}"
        )


class IterationLog:
    """Tracks the metrics of each iteration, and keeps the recent ones for the screen."""

    def __init__(self, runner: Runner, tracker: Tracker, evaluations: Evaluations) -> None:
        self._runner, self._tracker, self._evaluations = runner, tracker, evaluations
        self._recent: deque[Mapping[str, float]] = deque(maxlen=RECENT)
        self._collapse, self._device = CollapseWatch(evaluations.method), "cpu"

    def add(self, iteration: int, metrics: Mapping[str, float], device: str = "cpu") -> None:
        """Record an iteration's metrics, without those that are not finite, and what computed it if not the CPU."""
        if device != self._device:
            self._device = device
            self._tracker.tags({"device": device})
        self._tracker.metrics(iteration, {name: value for name, value in metrics.items() if np.isfinite(value)})
        self._runner.meter.record(SPOOL_RECORDS, float(self._tracker.waiting))
        self._recent.append(metrics)
        if warning := self._collapse.update(iteration, metrics):
            logger.warning(warning)
            self._tracker.tags({"warning.collapse": warning})

    def status(self) -> Status:
        """Return what the screen shows."""
        return status_of(list(self._recent))._replace(**self._evaluations.latest, workers=self._runner.worker_counts)


def meta_train(
    runner: Runner, plan: Plan, writer: CheckpointWriter, log: IterationLog, evaluations: Evaluations
) -> Path:
    """Meta-train from the plan's state to its last iteration, and return the last checkpoint's folder.

    Whatever ends it, a checkpoint of the last whole iteration is written first, if its disk takes it.

    Raises:
        RunError: where numbers are not finite, or for an error in a slot, which is named.
    """
    total, every = plan.settings.iterations, plan.settings.checkpoint_every
    with closing(runner.meta_train(plan)) as training:

        def write() -> Path:
            return writer.write(training.state())

        try:
            runner.meter.record(CHECKPOINT_TIME, time.time())
            with (
                Bar("meta-training", total, plan.state.iteration, "iterations", log.status) as bar,
                keeping_failures(writer.folder, writer.manifest.config, write),
            ):
                for iteration in training.iterations(total - plan.state.iteration):
                    metrics = iteration_metrics(iteration)
                    writer.add(metrics, stepped=iteration.stepped)
                    if not iteration.stepped:
                        problem = nonfinite_message(iteration)
                        if not plan.skip_nonfinite:
                            write()
                            raise _nonfinite_error(problem, writer.folder)
                        logger.warning(f"{problem}; the step is not taken")
                    log.add(iteration.number, metrics, iteration.device)
                    bar.advance(1)
                    evaluations.poll()
                    if iteration.number % every == 0 or iteration.number == total:
                        path = write()
                        if evaluations.is_due(iteration.number):
                            evaluations.begin(Checkpoint(path))
                evaluations.finish()
            return write()
        except BaseException:
            with aside("the checkpoint of the last iteration"):
                write()
            raise


def _nonfinite_error(problem: str, folder: Path) -> RunError:
    return RunError(
        f"{problem}; the step is not taken, the state before it is checkpointed; look at these demonstrations, or go "
        f"on without such steps: {resume_command(folder)} --on-nonfinite skip"
    )
