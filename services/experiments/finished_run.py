"""A run that has come to its end, read back from its folder."""

from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from dmil_core.checkpoint import FOLDER as CHECKPOINTS
from dmil_core.checkpoint import Checkpoint
from dmil_core.configs import ExperimentConfig
from dmil_core.errors import UserError
from dmil_core.files import inside, read_json
from services.demonstrations.store import TaskDemonstrations, open_store
from services.distributed.runner import LocalRunner
from services.evaluation.results import AdaptationResult, EpisodeResult, EvaluationFolder, read_rows
from services.evaluation.summary import Summary
from services.experiments.experiment import Experiment
from services.storage.checkpoints import Checkpoints
from services.storage.run_folders import CONFIG, SUMMARY, find_folder, resume_command
from services.tracking.history import Origin, read_metrics, read_origin

Result = TypeVar("Result", EpisodeResult, AdaptationResult)
REPORT, PAGE = "report", "report.html"
"""The folder of reports in a run's, and the page in it."""
EVALUATED = "evaluation.json"
"""In the folder of an evaluation: the settings that were in force."""
MOST_BYTES = 2**24
"""Of a summary or of settings."""


@dataclass(frozen=True)
class FinishedRun(EvaluationFolder):
    """What ``meta_train`` or ``evaluate`` left behind; each file is read when it is first used, once."""

    @staticmethod
    def find(name: str, runs: Path) -> "FinishedRun":
        """Return a run by its name in `runs`, or by its folder.

        Raises:
            UserError: if there is no folder of a run, it has not come to its end, or it is only an evaluation's.
        """
        try:
            folder = find_folder(name, runs, SUMMARY, "RUN")
        except UserError as error:
            for begun in (Path(name), runs / name):
                if (begun / CONFIG).is_file():
                    raise UserError(
                        f"RUN: got {begun}, which has not come to its end; wanted a finished run, with a {SUMMARY}; "
                        f"go on with it: {resume_command(begun)}"
                    ) from error
            raise
        if not (folder / CHECKPOINTS).is_dir() and not (folder / EVALUATED).is_file():
            raise UserError(
                f"RUN: got {folder}, which has neither {CHECKPOINTS} nor {EVALUATED}; wanted the folder of a run "
                "or of an evaluation"
            )
        return FinishedRun(folder)

    @property
    def name(self) -> str:
        """Its folder's."""
        return f"evaluation {self.folder.name}" if self.is_evaluation else self.folder.name

    @property
    def is_evaluation(self) -> bool:
        """Whether it evaluated the checkpoint of another run."""
        return (self.folder / EVALUATED).is_file()

    @cached_property
    def summary(self) -> Summary:
        """Success rates, with all that belongs to them.

        Raises:
            UserError: if the file is not as a run writes it.
        """
        advice = f"write it again: {resume_command(self.folder)}"
        return read_json(self.folder, SUMMARY, Summary, MOST_BYTES, f"wanted what a run writes at its end; {advice}")

    @cached_property
    def episodes(self) -> list[EpisodeResult]:
        """A row an episode of the evaluation at the end.

        Raises:
            UserError: if they are another checkpoint's than the summary.
        """
        return self._of_the_summary(super().episodes, "episodes.jsonl")

    @cached_property
    def adaptations(self) -> list[AdaptationResult]:
        """A row an adaptation, as `episodes`."""
        return self._of_the_summary(super().adaptations, "adaptations.jsonl")

    def _of_the_summary(self, rows: list[Result], name: str) -> list[Result]:
        wanted = self.summary.checkpoint_digest
        if strange := sorted({row.checkpoint for row in rows} - {wanted}):
            raise UserError(
                f"{self.folder / name}: checkpoint: got rows of {strange[0][:12]}; wanted those of {wanted[:12]}, as "
                f"checkpoint_digest in {SUMMARY} says; restore both, or write them again: {resume_command(self.folder)}"
            )
        return rows

    @cached_property
    def checkpoint(self) -> Checkpoint:
        """The last one; of an evaluation that which was evaluated.

        Raises:
            CheckpointError: if there is none, or it is damaged.
        """
        if self.is_evaluation:
            return Checkpoint(Path(self.summary.checkpoint))
        return Checkpoints(self.folder / CHECKPOINTS, kept=0).newest()

    @cached_property
    def config(self) -> ExperimentConfig:
        """All settings; of an evaluation those that were in force."""
        if self.is_evaluation:
            return read_json(self.folder, EVALUATED, ExperimentConfig, MOST_BYTES, "evaluate again")
        return self.checkpoint.manifest.config

    @cached_property
    def metrics(self) -> list[dict[str, float]]:
        """Those of each iteration, under ``iteration`` its number."""
        return read_metrics(self.folder)

    @cached_property
    def origin(self) -> Origin:
        """What it was made of."""
        return read_origin(self.folder)

    @cached_property
    def evaluations(self) -> dict[int, list[EpisodeResult]]:
        """The rows of each evaluation by its iteration: those on the way, and the one of the last checkpoint."""
        on_the_way = {
            int(path.parent.name): read_rows(inside(self.folder, path.relative_to(self.folder)), EpisodeResult)
            for path in sorted(
                (path for path in self.folder.glob("evaluations/*/episodes.jsonl") if path.parent.name.isdecimal()),
                key=lambda path: int(path.parent.name),
            )
        }
        return on_the_way if self.has_gone_on else on_the_way | {self.checkpoint.manifest.iteration: self.episodes}

    @property
    def best_score(self) -> int:
        """Of an episode in which all is done; 1 in suites without scores."""
        return max((cell.score.best for cell in self.summary.rows if cell.score), default=1)

    @property
    def has_gone_on(self) -> bool:
        """Whether it was trained on since its end, so that the last checkpoint is another than that evaluated."""
        return self.checkpoint.digest != self.summary.checkpoint_digest

    @cached_property
    def experiment(self) -> Experiment:
        """Its suite and method, put together again."""
        return Experiment(self.config, open_store())

    @cached_property
    def demonstrations(self) -> dict[str, TaskDemonstrations]:
        """Every task's, collected again where the store has lost them."""
        only = {row.task for row in self.episodes} if self.is_evaluation else None
        with closing(LocalRunner(self.experiment.suite)) as runner:
            return self.experiment.collect(runner, only)
