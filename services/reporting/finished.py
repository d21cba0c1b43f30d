"""A run that has come to its end, as its folder tells of it."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pydantic import ValidationError

from dmil_core.configs import ExperimentConfig
from dmil_core.errors import UserError, explain
from services.checkpoints import Checkpoint, Checkpoints
from services.demo_store import TaskDemonstrations, open_store
from services.disk import read_file
from services.experiment import Experiment
from services.folders import find_folder
from services.report import read_metrics
from services.results import AdaptationResult, EpisodeResult, read_rows
from services.runners import LocalRunner
from services.summary import Summary

__all__ = ["FinishedRun", "UnfinishedError"]

MARK = "summary.json"
"""What a finished run's folder is known by."""
MOST_BYTES = 2**24
"""In it."""


class UnfinishedError(UserError):
    """A run of which there is not all that is to be shown."""


@dataclass(frozen=True)
class FinishedRun:
    """What ``meta_train`` left behind; each file is read when it is asked for, once."""

    folder: Path

    @staticmethod
    def found(name: str, runs: Path) -> "FinishedRun":
        """Return a run by its name in `runs`, or by its folder.

        Raises:
            FolderError: if there is no folder of a finished run.
        """
        return FinishedRun(find_folder(name, runs, MARK, "RUN"))

    @property
    def name(self) -> str:
        """Its folder's."""
        return self.folder.name

    @cached_property
    def summary(self) -> Summary:
        """Success rates, with all that belongs to them.

        Raises:
            UnfinishedError: if the file is not as a run writes it.
        """
        path = self.folder / MARK
        try:
            return Summary.model_validate_json(read_file(path, MOST_BYTES))
        except ValidationError as error:
            raise UnfinishedError(
                f"{path}: got {'; '.join(explain(error).splitlines())}; wanted what a run writes at its end; "
                f"write it again: python -m services.meta_train --resume {self.folder}"
            ) from error

    @cached_property
    def checkpoint(self) -> Checkpoint:
        """The last one.

        Raises:
            CheckpointError: if there is none, or it is damaged.
        """
        return Checkpoints(self.folder / "checkpoints", kept=0).newest()

    @cached_property
    def config(self) -> ExperimentConfig:
        """All settings."""
        return self.checkpoint.manifest.config

    @cached_property
    def episodes(self) -> list[EpisodeResult]:
        """A row an episode."""
        return read_rows(self.folder / "episodes.jsonl", EpisodeResult)

    @cached_property
    def adaptations(self) -> list[AdaptationResult]:
        """A row an adaptation."""
        return read_rows(self.folder / "adaptations.jsonl", AdaptationResult)

    @cached_property
    def metrics(self) -> list[dict[str, float]]:
        """Those of each iteration, under ``iteration`` its number."""
        return read_metrics(self.folder)

    @cached_property
    def experiment(self) -> Experiment:
        """Its suite and method, put together again."""
        return Experiment(self.config, open_store())

    @cached_property
    def demonstrations(self) -> dict[str, TaskDemonstrations]:
        """Every task's, collected again where the store has lost them."""
        return self.experiment.collect(LocalRunner(self.experiment.suite))
