"""Demonstrations on disk: one Minari data set a task, under a data root that Minari's own tools can read.

``MINARI_DATASETS_PATH=data minari list local`` shows what is there.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from dmil_core.demonstrations import Demonstration, DemonstrationError, digest
from services.suites.base import Attempt

__all__ = ["DemoStore", "TaskDemonstrations", "data_root"]

LIBRARIES = ("gymnasium", "metaworld", "minari", "mujoco", "numpy")


@dataclass(frozen=True)
class TaskDemonstrations:
    """One task's data set: its demonstrations, how many attempts failed, and the SHA-256 of its arrays."""

    id: str
    demonstrations: tuple[Demonstration, ...]
    failed: int
    digest: str


def data_root() -> Path:
    """Return ``DMIL_DATA``, or ``data`` in the working directory."""
    return Path(os.environ.get("DMIL_DATA") or "data")


class DemoStore:
    """The data sets under one data root."""

    def __init__(self, root: Path) -> None:
        """Use the data sets under `root`, which is made with the first of them."""
        self.root = root.resolve()

    @staticmethod
    def dataset_id(task: str, suite: SuiteConfig, config: DemonstrationConfig) -> str:
        """Return the Minari id of a task's demonstrations: other settings, other id."""
        settings = {"horizon": suite.steps, **config.model_dump(exclude={"held_out"})}
        if not suite.goal_visible:
            settings["goal_visible"] = False
        key = hashlib.sha256(json.dumps([task, settings], sort_keys=True).encode()).hexdigest()[:10]
        return f"{task}/scripted-{key}-v1"

    def load(self, dataset_id: str, task: str) -> TaskDemonstrations | None:
        """Read a task's demonstrations, or `None` if they are not collected yet.

        Raises:
            DemonstrationError: if the data set cannot be read or its arrays are not those that were written.
        """
        path = self.root / dataset_id / "data"
        if not path.exists():
            return None
        try:
            storage = MinariStorage.read(path)
            metadata = storage.metadata
            demonstrations = tuple(
                Demonstration(f"{index:03d}", task, episode["observations"][:-1], episode["actions"])
                for index, episode in enumerate(storage.get_episodes(range(storage.total_episodes)))
            )
            found = TaskDemonstrations(dataset_id, demonstrations, int(metadata["failed"]), digest(demonstrations))
            intact = metadata["digest"] == found.digest
        except (OSError, KeyError, ValueError, TypeError, AssertionError) as error:
            raise self._damaged(path, f"{type(error).__name__}: {error}") from error
        if not intact:
            raise self._damaged(path, f"arrays with the SHA-256 {found.digest[:12]}, not the one in its metadata")
        return found

    @staticmethod
    def _damaged(path: Path, got: str) -> DemonstrationError:
        return DemonstrationError(
            f"{path}: got {got}; wanted a whole data set as collect_demos writes it; "
            f"remove {path.parent} and collect again"
        )

    def save(
        self, dataset_id: str, task: str, successes: Sequence[Attempt], failed: int, settings: dict[str, Any]
    ) -> TaskDemonstrations:
        """Write a task's demonstrations beside, then rename: a data set is there whole, or not at all."""
        path = self.root / dataset_id
        writing = self.root / f".writing-{os.getpid()}"
        shutil.rmtree(writing, ignore_errors=True)
        writing.mkdir(parents=True)
        demonstrations = [
            Demonstration(f"{index:03d}", task, attempt.observations[:-1], attempt.actions)
            for index, attempt in enumerate(successes)
        ]
        sha = digest(demonstrations)
        storage = MinariStorage.new(
            writing / "data",
            observation_space=_box(successes[0].observations),
            action_space=gymnasium.spaces.Box(-1, 1, successes[0].actions.shape[1:], np.float32),
        )
        storage.update_metadata(
            {
                "dataset_id": dataset_id,
                "minari_version": minari.__version__,
                "algorithm_name": "scripted expert",
                "description": "reward 1 at the step that solves the task for the first time, 0 elsewhere",
                "failed": failed,
                "digest": sha,
                "settings": json.dumps(settings),
                "versions": json.dumps({library: version(library) for library in LIBRARIES}),
            }
        )
        storage.update_episodes([_episode(attempt) for attempt in successes])
        path.parent.mkdir(parents=True, exist_ok=True)
        writing.replace(path)
        return TaskDemonstrations(dataset_id, tuple(demonstrations), failed, sha)


def _box(observations: np.ndarray) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(-np.inf, np.inf, observations.shape[1:], np.float32)


def _episode(attempt: Attempt) -> EpisodeBuffer:
    steps = len(attempt.actions)
    return EpisodeBuffer(
        seed=attempt.seed,
        options={"goal": attempt.goal},
        observations=attempt.observations,  # type: ignore[arg-type]
        actions=attempt.actions,  # type: ignore[arg-type]
        rewards=[float(step == attempt.solved_at) for step in range(steps)],
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
    )
