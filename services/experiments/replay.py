"""The episodes of a finished run once more: each follows from its row of results, to the bit."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch

from dmil_core.demonstrations import Demonstration
from dmil_core.errors import UserError
from dmil_core.methods.base import FineTuning, Policy
from services.evaluation.results import EpisodeResult
from services.experiments.finished_run import FinishedRun
from services.rollouts.recording import Film, Footage, Watched, watch, watch_expert
from services.suites.base import Environment, build_env


class ReplayError(UserError):
    """An episode or a demonstration that cannot be run again."""


class Seen(NamedTuple):
    """An episode's row, and what was seen when it was run again."""

    row: EpisodeResult
    watched: Watched

    @property
    def footage(self) -> Footage:
        """What was to be seen."""
        return self.watched.footage

    @property
    def difference(self) -> str | None:
        """What came otherwise than the row says, in words: on another machine, or with other versions, it may."""
        episode, row = self.watched.episode, self.row
        for name in ("success", "score", "steps"):
            if (got := getattr(episode, name)) != (wanted := getattr(row, name)):
                return (
                    f"episode {row.episode} of {row.task}, {row.shots}-shot: {name} {got}, where the run had {wanted}"
                )
        if tuple(episode.sub_skill_steps) != row.sub_skill_steps:
            return f"episode {row.episode} of {row.task}, {row.shots}-shot: other sub-skills than in the run"
        return None


@dataclass
class Replay:
    """Runs a run's episodes again, in environments that it keeps."""

    run: FinishedRun
    _envs: dict[str, list[Environment]] = field(default_factory=dict)

    def rerun(self, row: EpisodeResult, film: Film | None = None, filmed: Sequence[int] = ()) -> list[Seen]:
        """Adapt as for the episode of `row`, and run all episodes of that adaptation, side by side as they were.

        Args:
            row: of any episode of the adaptation.
            film: how episodes are filmed.
            filmed: the numbers of those that are.

        Raises:
            ReplayError: if the checkpoint or the demonstrations are not those of the row.
            RenderingError: if there is nothing here to draw with.
        """
        rows = [other for other in self.run.episodes if _adaptation(other) == _adaptation(row)]
        policy = self._policy(row)
        films: Mapping[int, Film] = {
            place: film for place, other in enumerate(rows) if film is not None and other.episode in filmed
        }
        envs = self._environments(row.task, len(rows))
        watched = watch(policy, envs, [other.seed for other in rows], self.run.experiment.suite.horizon, films)
        return [Seen(*pair) for pair in zip(rows, watched, strict=True)]

    def demonstration(self, row: EpisodeResult, film: Film) -> tuple[Demonstration, Footage]:
        """Film the first demonstration of an episode's support set: its expert acts once more from its seed.

        Raises:
            ReplayError: if it has no seed, or something else comes of it here.
            RenderingError: if there is nothing here to draw with.
        """
        experiment, suite = self.run.experiment, self.run.experiment.suite
        settings = experiment.config.demonstrations
        data = self.run.demonstrations[row.task]
        wanted, expert = self._support(row)[0], suite.expert(row.task)
        where = f"--demonstration: got {wanted.id} of {row.task}, from {data.id}"
        if expert is None or data.id != experiment.store.dataset_id(row.task, suite, settings):
            raise ReplayError(
                f"{where}, which somebody recorded; wanted one of a scripted expert, which follows from its seed; "
                "leave --demonstration out"
            )
        place = next(i for i, demonstration in enumerate(data.demonstrations) if demonstration.id == wanted.id)
        seed = experiment.store.seed_of(data.id, place)
        (env,) = self._environments(row.task, 1)
        steps = settings.steps(row.task, suite.horizon)
        attempt, footage = watch_expert(expert, env, seed, steps, settings, film)
        if not np.array_equal(attempt.observations[:-1], wanted.observations):
            raise ReplayError(
                f"{where}; its seed {seed} leads to something else here than when it was recorded; wanted the versions "
                f"of that time, which {experiment.store.root / data.id} names in its metadata"
            )
        return wanted, footage

    def _policy(self, row: EpisodeResult) -> Policy:
        run = self.run
        checkpoint = run.checkpoint
        if checkpoint.digest != row.checkpoint:
            raise ReplayError(
                f"{checkpoint.path}: got the digest {checkpoint.digest[:12]}; the episodes are of "
                f"{row.checkpoint[:12]}; evaluate the run's end: python -m services.meta_train --resume {run.folder}"
            )
        method = checkpoint.method(run.experiment.suite.action_dim)
        fine_tuning = FineTuning(row.fine_tuning_steps, row.learning_rate)
        return method.adapt(checkpoint.tensors(), self._support(row), fine_tuning)

    def _support(self, row: EpisodeResult) -> Sequence[Demonstration]:
        data = self.run.demonstrations[row.task]
        if data.digest != row.data:
            raise ReplayError(
                f"{self.run.experiment.store.root / data.id}: got demonstrations with the SHA-256 {data.digest[:12]}; "
                f"the run adapted to those with {row.data[:12]}; point DMIL_DATA to these"
            )
        by_id = {demonstration.id: demonstration for demonstration in data.demonstrations}
        return [by_id[name] for name in row.support]

    def _environments(self, task: str, count: int) -> list[Environment]:
        envs = self._envs.setdefault(task, [])
        envs += [build_env(self.run.experiment.suite, task, measured=True) for _ in range(count - len(envs))]
        return envs[:count]

    def close(self) -> None:
        """Close all environments."""
        for envs in self._envs.values():
            for env in envs:
                env.close()
        self._envs.clear()


def _adaptation(row: EpisodeResult) -> tuple[object, ...]:
    return row.split, row.task, row.shots, row.draw


@contextmanager
def replaying(run: FinishedRun) -> Iterator[Replay]:
    """Give what runs the episodes of `run` again, on one thread, as the workers compute."""
    threads, replay = torch.get_num_threads(), Replay(run)
    torch.set_num_threads(1)
    try:
        yield replay
    finally:
        replay.close()
        torch.set_num_threads(threads)
