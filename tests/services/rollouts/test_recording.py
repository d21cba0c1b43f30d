"""Recording an episode changes nothing in it, and keeps every step of it."""

import numpy as np
import pytest

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from dmil_core.methods.base import Decision, Policy
from dmil_core.trajectories import Rollout
from services.rollouts.adaptations import EpisodeOutcome
from services.rollouts.episodes import demonstrate, rollout
from services.rollouts.recording import Recording, VideoSettings, record_expert, record_rollouts
from services.suites.base import build_env, measure_of
from services.suites.registry import open_suite
from services.suites.rendering import RenderingError

SUITE = open_suite(SuiteConfig(train_tasks=("reach",), test_tasks=("reach",)))
SEEDS, HORIZON = [3, 4], 7


class Wandering(Policy):
    """Moves by what it sees, beyond what the environment lets it."""

    def act(self, observations: np.ndarray, memory: np.ndarray) -> Decision:
        actions = np.float32(3) * np.sin(np.float32(20) * observations[:, :4])
        return Decision(actions, np.zeros(len(observations), np.int64), memory)


def recorded(videos: dict[int, VideoSettings]) -> list[tuple[Rollout, Recording]]:
    envs = [build_env(SUITE, "reach", measured=True) for _ in SEEDS]
    try:
        return record_rollouts(Wandering(), envs, SEEDS, HORIZON, videos)
    except RenderingError as error:
        pytest.skip(str(error))


def test_a_recorded_rollout_is_one_that_is_not_recorded():
    plain = rollout(Wandering(), [build_env(SUITE, "reach") for _ in SEEDS], SEEDS, HORIZON)
    for (one, _), other in zip(recorded({}), plain, strict=True):
        assert EpisodeOutcome.of(one) == EpisodeOutcome.of(other)
        assert np.array_equal(one.observations, other.observations)
        assert np.array_equal(one.actions, other.actions)


def test_a_recording_has_the_numbers_of_every_step():
    measure = measure_of(SUITE, "reach")
    assert measure is not None
    for seed, (one, recording) in zip(SEEDS, recorded({}), strict=True):
        assert one.actions.shape == (HORIZON, 4)
        assert np.abs(one.actions).max() > 1, "as the policy chose them"
        assert recording.frames == []
        env = build_env(SUITE, "reach", measured=True)
        env.reset(seed=seed)
        wanted = [env.step(np.clip(action, -1, 1))[-1][measure.name] for action in one.actions]
        assert recording.infos[measure.name].tolist() == wanted
        assert all(len(course) == HORIZON for course in recording.infos.values())


def test_a_video_has_a_frame_at_the_reset_at_every_so_many_steps_and_at_the_end():
    (_, filmed), (_, unfilmed) = recorded({0: VideoSettings(SUITE.camera, 3, 48, 64)})  # type: ignore[attr-defined]
    assert [frame.step for frame in filmed.frames] == [0, 3, 6, 7]
    assert {frame.picture.shape for frame in filmed.frames} == {(48, 64, 3)}
    assert not np.array_equal(filmed.frames[0].picture, filmed.frames[-1].picture), "the robot moves"
    assert unfilmed.frames == []


def test_an_expert_that_is_recorded_demonstrates_the_same():
    config, expert = DemonstrationConfig(), SUITE.expert("reach")
    assert expert is not None
    wanted = demonstrate(expert, build_env(SUITE, "reach"), 5, 100, config)
    try:
        video = VideoSettings(SUITE.camera, 50, 48, 64)  # type: ignore[attr-defined]
        attempt, recording = record_expert(expert, build_env(SUITE, "reach"), 5, 100, config, video)
    except RenderingError as error:
        pytest.skip(str(error))
    assert attempt.solved_at == wanted.solved_at is not None
    assert np.array_equal(attempt.observations, wanted.observations)
    assert len(attempt) == recording.frames[-1].step
