"""Evaluations of checkpoints: who is tried out on what, the rows that come of it, and those made on the way."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dmil_core.configs import ExperimentConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.dmil import Dmil
from services.checkpoints import Checkpoint
from services.demo_store import TaskDemonstrations
from services.progress import console
from services.provenance import library_versions
from services.results import AdaptationResult, EpisodeResult, Split, write_rows
from services.rollouts import Trial, TrialOutcome, trials
from services.runners import Runner, Simulation
from services.suites.base import TaskSuite
from services.summary import Evaluation, cells, rates, sub_skill_use
from services.tracking import Tracker

__all__ = ["Evaluations", "Evaluator", "write_evaluation"]


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
        """Share the support demonstrations with the runner's workers.

        Args:
            runner: does the work.
            config: of the experiment.
            suite: of the experiment.
            tasks: all tasks with their split.
            data: every task's demonstrations.
            held_out: of each task, those that support sets are drawn from.
        """
        self._runner, self._config, self._suite, self._data, self._held_out = runner, config, suite, data, held_out
        self.trials = trials(tasks, config.evaluation)
        self._shared = {task: runner.share(demonstrations) for task, demonstrations in held_out.items()}

    def calls(self, checkpoint: Checkpoint) -> list[tuple[Any, ...]]:
        """Return the arguments of `SimulationWorker.try_out` for each trial; the checkpoint is not read again."""
        method = self._method(checkpoint)
        shapes = {name: torch.Size(shape) for name, shape in checkpoint.manifest.shapes.items()}
        parameters = self._runner.share(checkpoint.state.parameters)
        config = self._config
        return [
            (method, parameters, shapes, trial, self._shared[trial.task], config.evaluation, config.seed)
            for trial in self.trials
        ]

    def evaluation(self, checkpoint: Checkpoint, outcomes: Iterable[TrialOutcome]) -> Evaluation:
        """Return a row for each episode and each adaptation, from the outcomes of the trials in their order."""
        settings = self._config.evaluation
        common = {"suite": self._suite.name, "protocol": self._suite.protocol, "method": self._config.method.name}
        common |= {"checkpoint": checkpoint.digest, "versions": library_versions()}
        common |= {"fine_tuning_steps": settings.fine_tuning_steps, "learning_rate": settings.learning_rate}
        episodes, adaptations = [], []
        for trial, outcome in zip(self.trials, outcomes, strict=True):
            row = common | {
                "split": trial.split,
                "task": trial.task,
                "shots": trial.shots,
                "draw": trial.draw,
                "support": [demonstration.id for demonstration in trial.support(self._held_out[trial.task])],
                "data": self._data[trial.task].digest,
            }
            episodes += _episode_rows(row, trial, outcome)
            adaptations.append(_adaptation_row(row, outcome, self._config.method.sub_skills))
        failed = {task: dataset.failed for task, dataset in self._data.items()}
        return Evaluation(checkpoint, self._suite.protocol, failed, episodes, adaptations)

    def _method(self, checkpoint: Checkpoint) -> Dmil:
        return Dmil.restored(self._config.method, self._suite.action_dim, checkpoint.constants)


class Evaluations:
    """The evaluations on the way of meta-training: beside it, or in pauses of it; the rows are the same.

    Beside it, one is under way at a time; where the next begins before its end, meta-training waits for it.
    """

    def __init__(self, runner: Runner, evaluator: Evaluator, folder: Path, tracker: Tracker, *, overlap: bool) -> None:
        """Evaluate nothing yet.

        Args:
            runner: does the work.
            evaluator: of the experiment.
            folder: gets a folder for each evaluation, named by the iteration.
            tracker: takes the success rates.
            overlap: evaluate beside meta-training.
        """
        self._runner, self._evaluator, self._folder, self._tracker = runner, evaluator, folder, tracker
        self._overlap = overlap
        self._under_way: tuple[Checkpoint, Simulation] | None = None

    def begin(self, checkpoint: Checkpoint) -> None:
        """Evaluate a checkpoint, which may be deleted meanwhile."""
        self.finish()
        calls = self._evaluator.calls(checkpoint)
        if self._overlap:
            self._under_way = checkpoint, self._runner.simulate_beside("try_out", calls)
        else:
            outcomes = dict(self._runner.simulate("try_out", calls))
            self._record(checkpoint, [outcomes[index] for index in range(len(calls))])

    def look(self) -> None:
        """Record the evaluation under way, if it has come to its end."""
        if self._under_way is not None and self._under_way[1].done():
            self.finish()

    def finish(self) -> None:
        """Wait for the evaluation under way, if there is one."""
        if self._under_way is not None:
            checkpoint, simulation = self._under_way
            self._record(checkpoint, simulation.results())
            self._under_way = None

    def _record(self, checkpoint: Checkpoint, outcomes: Sequence[TrialOutcome]) -> None:
        iteration = checkpoint.manifest.iteration
        evaluation = self._evaluator.evaluation(checkpoint, outcomes)
        write_evaluation(evaluation, self._folder / f"{iteration:07d}")
        found = cells(evaluation.episodes)
        self._tracker.metrics(iteration, rates(found, sub_skill_use(evaluation.adaptations)))
        in_words = "; ".join(f"{cell.split} {cell.shots}-shot {cell.success_rate:.3f}" for cell in found)
        console.print(f"success rates after {iteration} iterations: {in_words}")


def write_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Write an evaluation's rows to ``adaptations.jsonl`` and ``episodes.jsonl``, in place of those there were.

    Each is written whole, the episodes last: where they are, the evaluation is complete.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_rows(folder / "adaptations.jsonl", evaluation.adaptations)
    write_rows(folder / "episodes.jsonl", evaluation.episodes)


def _episode_rows(row: Mapping[str, object], trial: Trial, outcome: TrialOutcome) -> list[EpisodeResult]:
    return [
        EpisodeResult.model_validate({**row, "episode": number, **episode._asdict()})
        for number, episode in zip(trial.episodes, outcome.episodes, strict=True)
    ]


def _adaptation_row(row: Mapping[str, object], outcome: TrialOutcome, sub_skills: int) -> AdaptationResult:
    none = np.zeros(0, np.int64)  # where the support set is all that is held out
    chosen = np.concatenate([none, *(use.chosen for use in outcome.use)])
    best = np.concatenate([none, *(use.best for use in outcome.use)])
    counts = np.bincount(chosen, minlength=sub_skills)
    return AdaptationResult.model_validate(
        {**row, "steps": len(chosen), "agreeing": int((chosen == best).sum()), "sub_skill_steps": counts.tolist()}
    )
