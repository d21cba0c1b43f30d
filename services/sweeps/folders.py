"""A sweep on disk: what it is, what came of each trial, and the trained configurations that sweeps share.

::

    runs/NAME/sweep.json                     what it is
    runs/NAME/trials/TRIAL/result.json       what came of a trial, there once it is over
    runs/trained/DIGEST/checkpoints          of one configuration on one set of demonstrations
    runs/trained/DIGEST/evaluated/DIGEST     the rows of one evaluation of it
"""

from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Literal

from pydantic import AliasChoices, BaseModel, ConfigDict, Field

from dmil_core.checksums import sha256
from dmil_core.configs import EvaluationConfig, ExperimentConfig
from dmil_core.files import inside, read_json, write_file
from services.storage.run_folders import make_folder
from services.sweeps.settings import PlannedTrial, Preset, Sweep, planned

MOST_BYTES = 2**22
ADVICE = "wanted that of a sweep, as in runs/NAME; start the sweep again, what is trained stays"
MARK = "sweep.json"
"""What a sweep's folder is known by."""
RESULT, TABLES = "result.json", "tables"
TRAINED = "trained"
DIGITS = 24
"""Of a digest, in a folder's name."""


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SweepRecord(_Record):
    """``sweep.json``."""

    name: str
    """Of the file."""
    preset: Preset = Field(validation_alias=AliasChoices("preset", "size"))
    """Older records call it size."""
    sweep: Sweep
    """As it is at this preset."""
    began: datetime
    command: str
    commit: str
    versions: dict[str, str]


class TrialResult(_Record):
    """``result.json``: how a trial ended."""

    status: Literal["finished", "failed", "stopped"]
    """Stopped: by a search, for others were better."""
    error: str | None = None
    trained: str | None = None
    """Folder of the trained configuration, in the folder of all runs."""
    evaluated: dict[str, str] = {}
    """Folder of each evaluation's rows, in the folder of all runs, by the table's row."""
    seconds: dict[str, float] = {}
    iteration: int = 0
    environment_steps: int = 0
    """That its meta-training took."""
    held_out: float | None = None
    """What a search goes by: the mean over shots on the held-out tasks."""


class SweepFolder:
    """The folder of a sweep."""

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            UserError: if it is no folder of a sweep.
        """
        self.path, self.runs = path, path.parent
        self.record = read_json(path, MARK, SweepRecord, MOST_BYTES, ADVICE)

    @classmethod
    def make(cls, path: Path, record: SweepRecord) -> "SweepFolder":
        """Make it, with what the sweep is."""
        make_folder(path, {MARK: record.model_dump_json(indent=1) + "\n"})
        return cls(path)

    @cached_property
    def trials(self) -> dict[str, PlannedTrial]:
        """All trials by name."""
        return {trial.name: trial for trial in planned(self.record.sweep, self.record.preset)}

    def of_trial(self, name: str) -> Path:
        """Return the folder of a trial, which may not be there yet."""
        return inside(self.path, Path("trials", name))

    def result(self, name: str) -> TrialResult | None:
        """Return what came of a trial, if it is over.

        Raises:
            UserError: if the record of it is damaged.
        """
        path = (self.of_trial(name) / RESULT).relative_to(self.path)
        exists = (self.path / path).exists()
        return read_json(self.path, path, TrialResult, MOST_BYTES, ADVICE) if exists else None

    def finish(self, name: str, result: TrialResult) -> None:
        """Note what came of a trial."""
        write_file(self.of_trial(name), RESULT, result.model_dump_json(indent=1) + "\n")


def trained(runs: Path, config: ExperimentConfig, data: Mapping[str, str]) -> Path:
    """Return the folder of a configuration trained on demonstrations of these digests, by task.

    Evaluations, and which checkpoints are kept, do not make it another; nor does who trains it.
    """
    described = config.model_dump_json(exclude={"evaluation": True, "training": {"checkpoints_kept"}})
    digests = "".join(f"\n{task} {digest}" for task, digest in sorted(data.items()))
    return runs / TRAINED / sha256((described + digests).encode())[:DIGITS]


def evaluated(home: Path, evaluation: EvaluationConfig, tasks: Sequence[str]) -> Path:
    """Return the folder of an evaluation's rows on some tasks, in that of the trained configuration."""
    described = "\n".join([evaluation.model_dump_json(exclude={"every"}), *tasks])
    return home / "evaluated" / sha256(described.encode())[:DIGITS]
