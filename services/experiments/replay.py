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
from dmil_core.trajectories import Rollout
from services.evaluation.results import EpisodeResult
from services.experiments.finished_run import FinishedRun
from services.rollouts.adaptations import EpisodeOutcome
from services.rollouts.recording import Recording, VideoSettings, record_expert, record_rollouts
from services.storage.run_folders import resume_command
from services.suites.base import Environment, build_env


class ReplayError(UserError):
    """An episode or a demonstration that cannot be run again."""


class ReplayedEpisode(NamedTuple):
    """An episode's row, and the rollout and the recording of it that was run again."""

    row: EpisodeResult
    rollout: Rollout
    recording: Recording

    @property
    def difference(self) -> str | None:
        """The first difference from the row, in words: on another machine, or with other versions, there may be one."""
        outcome, row = EpisodeOutcome.of(self.rollout), self.row
        for name in ("success", "score", "steps"):
            if (got := getattr(outcome, name)) != (wanted := getattr(row, name)):
                return (
                    f"episode {row.episode} of {row.task}, {row.shots}-shot: {name} {got}, where the run had {wanted}"
                )
        if tuple(outcome.sub_skill_steps) != row.sub_skill_steps:
            return f"episode {row.episode} of {row.task}, {row.shots}-shot: other sub-skills than in the run"
        return None


@dataclass
class Replay:
    """Runs a run's episodes again, in environments that it keeps."""

    run: FinishedRun
    _envs: dict[str, list[Environment]] = field(default_factory=dict)

    def rerun(
        self, row: EpisodeResult, video: VideoSettings | None = None, filmed: Sequence[int] = ()
    ) -> list[ReplayedEpisode]:
        """Adapt as for the episode of `row`, and run all episodes of that adaptation, side by side as they were.

        The episodes with the numbers `filmed` are filmed as `video` says.

        Raises:
            ReplayError: if the checkpoint or the demonstrations are not those of the row.
            RenderingError: if OpenGL does not work here.
        """
        rows = [other for other in self.run.episodes if _adaptation(other) == _adaptation(row)]
        policy = self._policy(row)
        videos: Mapping[int, VideoSettings] = {
            place: video for place, other in enumerate(rows) if video is not None and other.episode in filmed
        }
        envs = self._environments(row.task, len(rows))
        seeds = [other.seed for other in rows]
        recorded = record_rollouts(policy, envs, seeds, self.run.experiment.suite.horizon, videos)
        return [ReplayedEpisode(row, *pair) for row, pair in zip(rows, recorded, strict=True)]

    def demonstration(self, row: EpisodeResult, video: VideoSettings) -> tuple[Demonstration, Recording]:
        """Film the first demonstration of an episode's support set: its expert acts once more from its seed.

        Raises:
            ReplayError: if it has no seed, or something else comes of it here.
            RenderingError: if OpenGL does not work here.
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
        episode, recording = record_expert(expert, env, seed, steps, settings, video)
        if not np.array_equal(episode.observations[:-1], wanted.observations):
            raise ReplayError(
                f"{where}; its seed {seed} leads to something else here than when it was recorded; wanted the versions "
                f"of that time, which {experiment.store.root / data.id} names in its metadata"
            )
        return wanted, recording

    def _policy(self, row: EpisodeResult) -> Policy:
        run = self.run
        checkpoint = run.checkpoint
        if checkpoint.digest != row.checkpoint:
            raise ReplayError(
                f"{checkpoint.path}: got the digest {checkpoint.digest[:12]}; the episodes are of "
                f"{row.checkpoint[:12]}; evaluate the run's end: {resume_command(run.folder)}"
            )
        method = checkpoint.method(run.experiment.suite.action_dim)
        fine_tuning = FineTuning(row.fine_tuning_steps, row.learning_rate, row.optimiser, row.displaced)
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
