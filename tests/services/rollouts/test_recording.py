"""Who watches an episode changes nothing in it, and sees every step of it."""

import numpy as np
import pytest

from dmil_core.configs import DemonstrationConfig, SuiteConfig
from dmil_core.methods.base import Decision, Flat
from services.rollouts.episodes import demonstrate, rollout
from services.rollouts.recording import Film, Watched, watch, watch_expert
from services.suites.base import build_env, measure_of
from services.suites.registry import open_suite
from services.suites.rendering import RenderingError

SUITE = open_suite(SuiteConfig(train_tasks=("reach",), test_tasks=("reach",)))
SEEDS, HORIZON = [3, 4], 7


class Wandering(Flat):
    """Moves by what it sees, beyond what the environment lets it."""

    def act(self, observations: np.ndarray, memory: np.ndarray) -> Decision:
        actions = np.float32(3) * np.sin(np.float32(20) * observations[:, :4])
        return Decision(actions, np.zeros(len(observations), np.int64), memory)


def watched(films: dict[int, Film]) -> list[Watched]:
    envs = [build_env(SUITE, "reach", measured=True) for _ in SEEDS]
    try:
        return watch(Wandering(), envs, SEEDS, HORIZON, films)
    except RenderingError as error:
        pytest.skip(str(error))


def test_a_watched_episode_is_that_of_an_unwatched_rollout():
    plain = rollout(Wandering(), [build_env(SUITE, "reach") for _ in SEEDS], SEEDS, HORIZON)
    assert [one.episode for one in watched({})] == plain


def test_all_that_was_done_and_told_is_seen_step_by_step():
    measure = measure_of(SUITE, "reach")
    assert measure is not None
    for seed, one in zip(SEEDS, watched({}), strict=True):
        footage = one.footage
        assert footage.actions.shape == (HORIZON, 4)
        assert np.abs(footage.actions).max() == 1, "as clipped to the action space"
        assert footage.frames == []
        env = build_env(SUITE, "reach", measured=True)
        env.reset(seed=seed)
        told = [env.step(action)[-1][measure.name] for action in footage.actions]
        assert footage.numbers[measure.name].tolist() == told
        assert all(len(course) == HORIZON for course in footage.numbers.values())


def test_a_film_has_a_picture_at_the_reset_at_every_so_many_steps_and_at_the_end():
    filmed, unfilmed = watched({0: Film(SUITE.camera, 3, 48, 64)})  # type: ignore[attr-defined]
    assert [frame.step for frame in filmed.footage.frames] == [0, 3, 6, 7]
    assert {frame.picture.shape for frame in filmed.footage.frames} == {(48, 64, 3)}
    assert not np.array_equal(filmed.footage.frames[0].picture, filmed.footage.frames[-1].picture), "the robot moves"
    assert unfilmed.footage.frames == []


def test_an_expert_that_is_watched_demonstrates_the_same():
    config, expert = DemonstrationConfig(), SUITE.expert("reach")
    assert expert is not None
    wanted = demonstrate(expert, build_env(SUITE, "reach"), 5, 100, config)
    try:
        film = Film(SUITE.camera, 50, 48, 64)  # type: ignore[attr-defined]
        attempt, footage = watch_expert(expert, build_env(SUITE, "reach"), 5, 100, config, film)
    except RenderingError as error:
        pytest.skip(str(error))
    assert attempt.solved_at == wanted.solved_at is not None
    assert np.array_equal(attempt.observations, wanted.observations)
    assert len(footage.actions) == len(attempt.actions) == footage.frames[-1].step
