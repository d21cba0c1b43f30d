"""Evaluations of checkpoints: what is adapted to what, the result rows, and evaluations on the way."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dmil_core.checkpoint import Checkpoint, CheckpointError, iteration_of
from dmil_core.configs import ExperimentConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.files import inside
from dmil_core.settings import MethodConfig, sub_skills_of
from services.cli.live_view import Tally
from services.demonstrations.store import TaskDemonstrations
from services.distributed.failures import keeping_failures
from services.distributed.metrics import EPISODES, SUCCESS_RATE, SUCCESSES, Meter
from services.distributed.runner import Runner, Simulation
from services.distributed.work_items import AdaptationItem, AdaptationRollouts
from services.evaluation.results import AdaptationResult, EpisodeResult, ImitationResult, write_rows
from services.evaluation.summary import Evaluation, faults_of, rates, sub_skill_shares, summary_rows
from services.rollouts.adaptations import Adaptation, AdaptationOutcome, ImitationErrors, plan_adaptations
from services.storage.checkpoints import Checkpoints
from services.storage.provenance import library_versions
from services.suites.base import Split, TaskSuite
from services.tracking.tracker import Tracker

logger = logging.getLogger(__name__)

Item = TypeVar("Item", bound=AdaptationItem)


class Tallies:
    """Counts the episodes of an evaluation as they come, by split and size of support set."""

    def __init__(self, meter: Meter) -> None:
        self._meter = meter
        self._counts: dict[tuple[Split, int], tuple[int, int]] = {}

    def __iter__(self) -> Iterator[Tally]:
        """Go through the counts so far, those of meta-training tasks first."""
        tallies = [Tally(*where, *counts) for where, counts in list(self._counts.items())]
        return iter(sorted(tallies, key=lambda tally: (tally.split == "meta-testing", tally.shots)))

    def add(self, adaptation: Adaptation, outcome: AdaptationOutcome) -> None:
        """Count an adaptation's episodes, without those that the simulator spoiled."""
        sound = [episode for episode in outcome.episodes if episode.fault is None]
        if not sound:
            return
        successes, episodes = sum(episode.success for episode in sound), len(sound)
        before = self._counts.get((adaptation.split, adaptation.shots), (0, 0))
        self._counts[adaptation.split, adaptation.shots] = before[0] + successes, before[1] + episodes
        self._meter.record(EPISODES, float(episodes), split=adaptation.split, shots=str(adaptation.shots))
        self._meter.record(SUCCESSES, float(successes), split=adaptation.split, shots=str(adaptation.shots))

    def finish(self) -> None:
        """Record the success rates, now that all episodes are counted."""
        for tally in self:
            rate = tally.successes / tally.episodes
            self._meter.record(SUCCESS_RATE, rate, split=tally.split, shots=str(tally.shots))


class Evaluator:
    """What all evaluations of an experiment share; its checkpoints come one by one."""

    def __init__(
        self,
        runner: Runner,
        config: ExperimentConfig,
        suite: TaskSuite,
        tasks: Sequence[tuple[Split, str]],
        data: Mapping[str, TaskDemonstrations],
        held_out: Mapping[str, Sequence[Demonstration]],
    ) -> None:
        """Share the demonstrations that support sets are drawn from, `held_out`, with the runner's workers."""
        self._runner, self.config, self._suite, self._data, self._held_out = runner, config, suite, data, held_out
        self.adaptations = plan_adaptations(tasks, config.evaluation, {task: len(held_out[task]) for task in held_out})
        self._shared = {task: runner.share(demonstrations) for task, demonstrations in held_out.items()}

    def is_due(self, iteration: int) -> bool:
        """Tell whether a checkpoint is evaluated on the way."""
        every = self.config.evaluation.every
        return every is not None and 0 < iteration < self.config.training.iterations and iteration % every == 0

    def items(self, checkpoint: Checkpoint, kind: type[Item]) -> list[Item]:
        """Return a work item of `kind` for each adaptation; the checkpoint is not read again."""
        method, shapes = checkpoint.method(self._suite.action_dim), checkpoint.manifest.torch_shapes
        parameters, config = self._runner.share(checkpoint.flat), self.config
        return [
            kind(method, shapes, parameters, adaptation, self._shared[adaptation.task], config.evaluation, config.seed)
            for adaptation in self.adaptations
        ]

    def evaluation(self, checkpoint: Checkpoint, outcomes: Iterable[AdaptationOutcome]) -> Evaluation:
        """Return a row for each episode and each adaptation, from the outcomes of the adaptations in their order."""
        episodes, adaptations = [], []
        for adaptation, outcome in zip(self.adaptations, outcomes, strict=True):
            row = self._row(checkpoint, adaptation, outcome.device)
            episodes += _episode_rows(row, adaptation, outcome)
            adaptations.append(_adaptation_row(row, outcome, sub_skills_of(self.config.method)))
        failed = {task: dataset.failed for task, dataset in self._data.items()}
        counts = {task: len(dataset.demonstrations) for task, dataset in self._data.items()}
        suite = self._suite
        return Evaluation(checkpoint, suite.protocol, suite.best_score, failed, counts, episodes, adaptations)

    def imitation(self, checkpoint: Checkpoint, outcomes: Iterable[ImitationErrors]) -> list[ImitationResult]:
        """Return a row for each adaptation, from their `AdaptationImitation` in order."""
        return [
            ImitationResult.model_validate(
                {
                    **self._row(checkpoint, adaptation, outcome.device),
                    "support_error": _finite(outcome.support),
                    "held_out_error": _finite(outcome.held_out),
                }
            )
            for adaptation, outcome in zip(self.adaptations, outcomes, strict=True)
        ]

    def _row(self, checkpoint: Checkpoint, adaptation: Adaptation, device: str) -> dict[str, object]:
        """Return what names an adaptation in all of its rows."""
        settings = self.config.evaluation
        return {
            "suite": self._suite.name,
            "protocol": self._suite.protocol,
            "method": self.config.method.name,
            "checkpoint": checkpoint.digest,
            "versions": library_versions(),
            "device": device,
            "fine_tuning_steps": settings.fine_tuning_steps,
            "learning_rate": settings.learning_rate,
            "optimiser": settings.optimiser,
            "displaced": settings.displaced,
            "split": adaptation.split,
            "task": adaptation.task,
            "shots": adaptation.shots,
            "draw": adaptation.draw,
            "support": [demonstration.id for demonstration in adaptation.support(self._held_out[adaptation.task])],
            "data": self._data[adaptation.task].digest,
        }


class Evaluations:
    """The evaluations on the way of meta-training: beside it, or in pauses of it; the rows are the same.

    Beside it, one is under way at a time; where the next begins before its end, meta-training waits for it.
    """

    def __init__(
        self, runner: Runner, evaluator: Evaluator, checkpoints: Checkpoints, tracker: Tracker, *, overlap: bool
    ) -> None:
        """Evaluate nothing yet; with `overlap`, later beside meta-training.

        The folder ``evaluations`` beside that of the checkpoints gets a folder for each evaluation, named by the
        iteration.
        """
        self._runner, self._evaluator, self._checkpoints, self._tracker = runner, evaluator, checkpoints, tracker
        self._run = checkpoints.folder.parent
        self._damaged: set[Path] = set()
        self._overlap = overlap
        self._under_way: tuple[Checkpoint, Simulation[AdaptationOutcome]] | None = None
        self.latest: dict[str, Any] = {}
        """What the last one came to, as fields of `Status`: the ``success``, and ``after`` how many iterations."""

    @property
    def method(self) -> MethodConfig:
        """The settings of the method that is evaluated."""
        return self._evaluator.config.method

    def is_due(self, iteration: int) -> bool:
        """Tell whether the checkpoint of an iteration is evaluated on the way; the last one is when all is over."""
        return self._evaluator.is_due(iteration)

    def pending(self) -> list[Path]:
        """Return the checkpoints whose evaluation is due and not complete, oldest first."""
        due = [
            path for path in self._checkpoints.all() if self.is_due(iteration_of(path)) and path not in self._damaged
        ]
        return [path for path in due if not (self._folder_of(iteration_of(path)) / "episodes.jsonl").exists()]

    def _folder_of(self, iteration: int) -> Path:
        return inside(self._run, f"evaluations/{iteration:07d}")

    def catch_up(self) -> None:
        """Evaluate the checkpoints whose evaluation was dropped when the run was stopped, but no damaged ones."""
        for path in self.pending():
            try:
                checkpoint = Checkpoint(path)
            except CheckpointError as error:
                logger.warning(f"{error}; it is not evaluated")
                self._damaged.add(path)
            else:
                self.begin(checkpoint)

    def begin(self, checkpoint: Checkpoint) -> None:
        """Evaluate a checkpoint."""
        self.finish()
        items = self._evaluator.items(checkpoint, AdaptationRollouts)
        with self._keeping_failures(checkpoint):
            if self._overlap:
                self._under_way = checkpoint, self._runner.simulate_in_background(items)
            else:
                outcomes = dict(self._runner.simulate(items))
                self._record(checkpoint, [outcomes[index] for index in range(len(items))])

    def _keeping_failures(self, checkpoint: Checkpoint) -> AbstractContextManager[None]:
        return keeping_failures(self._run, self._evaluator.config, lambda: checkpoint.path)

    def poll(self) -> None:
        """Record the evaluation under way, if it has come to its end."""
        if self._under_way is not None and self._under_way[1].done():
            self.finish()

    def finish(self) -> None:
        """Wait for the evaluation under way, if there is one."""
        if self._under_way is not None:
            checkpoint, simulation = self._under_way
            with self._keeping_failures(checkpoint):
                self._record(checkpoint, simulation.result())
            self._under_way = None

    def _record(self, checkpoint: Checkpoint, outcomes: Sequence[AdaptationOutcome]) -> None:
        iteration = checkpoint.manifest.iteration
        evaluation = self._evaluator.evaluation(checkpoint, outcomes)
        write_evaluation(evaluation, self._folder_of(iteration))
        tallies = Tallies(self._runner.meter)
        for adaptation, outcome in zip(self._evaluator.adaptations, outcomes, strict=True):
            tallies.add(adaptation, outcome)
        tallies.finish()
        self.latest = {"success": list(tallies), "after": iteration}
        rows = summary_rows(evaluation.episodes, evaluation.best_score, self._evaluator.config.method)
        self._tracker.metrics(iteration, rates(rows, sub_skill_shares(evaluation.adaptations, evaluation.episodes)))
        success_rates = "; ".join(f"{cell.split} {cell.shots}-shot {cell.success_rate:.3f}" for cell in rows)
        logger.info(f"success rates after {iteration} iterations: {success_rates}")
        if faults := faults_of(evaluation.episodes):
            logger.warning(f"after {iteration} iterations: {faults}")


def write_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Write an evaluation's rows to ``adaptations.jsonl`` and ``episodes.jsonl``, in place of those there were.

    Each is written whole, the episodes last: where they are, the evaluation is complete.
    """
    write_rows(folder / "adaptations.jsonl", evaluation.adaptations)
    write_rows(folder / "episodes.jsonl", evaluation.episodes)


def _finite(error: float | None) -> float | None:
    return error if error is not None and np.isfinite(error) else None


def _episode_rows(row: Mapping[str, object], adaptation: Adaptation, outcome: AdaptationOutcome) -> list[EpisodeResult]:
    return [
        EpisodeResult.model_validate({**row, "episode": number, **episode._asdict()})
        for number, episode in zip(adaptation.episodes, outcome.episodes, strict=True)
    ]


def _adaptation_row(row: Mapping[str, object], outcome: AdaptationOutcome, sub_skills: int) -> AdaptationResult:
    none = np.zeros(0, np.int64)  # where the support set is all that is held out
    chosen = np.concatenate([none, *(use.chosen for use in outcome.use)])
    best = np.concatenate([none, *(use.best for use in outcome.use)])
    counts = np.bincount(chosen, minlength=sub_skills)
    return AdaptationResult.model_validate(
        {**row, "steps": len(chosen), "agreeing": int((chosen == best).sum()), "sub_skill_steps": counts.tolist()}
    )
