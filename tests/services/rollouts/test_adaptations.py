"""Episodes: what the expert's demonstrations hold, and that episodes in lockstep are the single ones."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from dmil_core.configs import DemonstrationConfig, EvaluationConfig, SuiteConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import Decision, Policy
from services.rollouts.adaptations import EpisodeOutcome, imitation_error, plan_adaptations
from services.rollouts.episodes import collect_rollouts, demonstrate, rollout
from services.rollouts.recording import record_rollouts
from services.suites.base import Environment, Expert
from services.suites.metaworld import MetaWorldSuite

HORIZON = 150


class ExpertPolicy(Policy):
    """An expert that acts as a policy does, and remembers all that it saw and how many steps an episode has had."""

    def __init__(self, expert: Expert) -> None:
        self.expert = expert
        self.seen: dict[tuple[int, int], np.ndarray] = {}

    def start(self, episodes: int) -> np.ndarray:
        return np.stack([np.arange(episodes), np.zeros(episodes, np.int64)], axis=1)

    def act(self, observations: np.ndarray, memory: np.ndarray) -> Decision:
        self.seen |= {(int(e), int(s)): o.copy() for o, (e, s) in zip(observations, memory, strict=True)}
        actions = np.array([self.expert.get_action(observation.astype(np.float64)) for observation in observations])
        return Decision(actions.astype(np.float32), memory[:, 1] // 10 % 3, memory + np.array([0, 1]))

    def episode(self, number: int) -> np.ndarray:
        return np.array([observation for (episode, _), observation in self.seen.items() if episode == number])


@pytest.fixture(scope="module")
def suite() -> MetaWorldSuite:
    return MetaWorldSuite(SuiteConfig())


@pytest.fixture(scope="module")
def make_envs(suite: MetaWorldSuite) -> Callable[[str, int], list[Environment]]:
    return lambda task, count: [suite.make_env(task) for _ in range(count)]


@pytest.mark.parametrize("task", ["reach", "door-close"])
def test_a_demonstration_holds_clean_clipped_actions_and_ends_soon_after_success(suite, make_envs, task: str):
    (env,) = make_envs(task, 1)
    attempt = demonstrate(suite.expert(task), env, 5, 300, DemonstrationConfig(trailing_steps=7))
    assert attempt.solved_at is not None
    assert len(attempt.actions) == attempt.solved_at + 1 + 7
    assert attempt.observations.shape == (len(attempt.actions) + 1, 39)
    expert = suite.expert(task)
    seen = attempt.observations[:-1].astype(np.float64)
    wanted = [np.clip(expert.get_action(observation), -1, 1) for observation in seen]
    assert np.abs(attempt.actions).max() <= 1
    assert np.allclose(attempt.actions, wanted, atol=1e-4)


@pytest.mark.parametrize("task", ["door-close", "lever-pull", "reach"])
def test_a_demonstration_holds_what_a_policy_sees(suite, make_envs, task: str):
    """Some experts change the observation that they are handed."""
    (env,) = make_envs(task, 1)
    attempt = demonstrate(suite.expert(task), env, 5, 40, DemonstrationConfig(noise=0, trailing_steps=0))
    observation, _ = env.reset(seed=5)
    seen = [observation, *(env.step(action)[0] for action in attempt.actions)]
    assert np.array_equal(attempt.observations, np.asarray(seen, np.float32))


@pytest.mark.parametrize("trailing_steps", [0, 10])
def test_a_demonstration_replayed_without_noise_is_solved_at_the_same_step(suite, make_envs, trailing_steps: int):
    (env,) = make_envs("reach", 1)
    config = DemonstrationConfig(noise=0, trailing_steps=trailing_steps)
    attempt = demonstrate(suite.expert("reach"), env, 5, 300, config)
    env.reset(seed=5)
    solved = [env.step(action)[-1]["success"] for action in attempt.actions]
    assert solved.index(1.0) == attempt.solved_at


def test_noise_changes_what_is_executed_and_follows_from_the_seed(suite, make_envs):
    (env,) = make_envs("push", 1)
    clean, noisy, again = (
        demonstrate(suite.expert("push"), env, 5, 300, DemonstrationConfig(noise=noise)) for noise in (0, 0.1, 0.1)
    )
    assert np.array_equal(clean.observations[0], noisy.observations[0])
    assert not np.array_equal(clean.observations[1], noisy.observations[1])
    assert np.array_equal(clean.actions[0], noisy.actions[0])
    assert np.array_equal(noisy.observations, again.observations)
    assert np.array_equal(noisy.actions, again.actions)


def test_noisy_labels_are_what_was_executed(suite, make_envs):
    (env,) = make_envs("push", 1)
    attempt = demonstrate(suite.expert("push"), env, 5, 300, DemonstrationConfig(labels="noisy"))
    clean = demonstrate(suite.expert("push"), env, 5, 300, DemonstrationConfig())
    assert np.array_equal(attempt.observations, clean.observations)
    assert 0.01 < np.abs(attempt.actions - clean.actions).mean() < 0.2
    observation, _ = env.reset(seed=5)
    seen = [observation, *(env.step(action)[0] for action in attempt.actions)]
    assert np.array_equal(attempt.observations, np.asarray(seen, np.float32))


def test_a_demonstration_never_passes_the_horizon(suite, make_envs):
    (env,) = make_envs("pick-place", 1)
    attempt = demonstrate(suite.expert("pick-place"), env, 5, 9, DemonstrationConfig(noise=0))
    assert attempt.solved_at is None
    assert (len(attempt.actions), len(attempt.observations)) == (9, 10)
    (env,), config = make_envs("reach", 1), DemonstrationConfig(noise=0, trailing_steps=10)
    whole = demonstrate(suite.expert("reach"), env, 5, HORIZON, config)
    assert whole.solved_at is not None
    cut = demonstrate(suite.expert("reach"), env, 5, whole.solved_at + 4, config)
    assert (cut.solved_at, len(cut.actions)) == (whole.solved_at, whole.solved_at + 4)


@pytest.mark.parametrize("task", ["reach", "push"])
def test_episodes_in_lockstep_are_the_single_ones(suite, make_envs, task: str):
    envs, seeds = make_envs(task, 4), [11, 12, 13, 14]
    together = ExpertPolicy(suite.expert(task))
    episodes = rollout(together, envs, seeds, HORIZON)
    assert len({len(episode) for episode in episodes}) > 1, "the episodes end together: the test shows nothing"
    for number, (seed, env) in enumerate(zip(seeds, reversed(envs), strict=True)):
        alone = ExpertPolicy(suite.expert(task))
        (single,) = rollout(alone, [env], [seed], HORIZON)
        assert EpisodeOutcome.of(single) == EpisodeOutcome.of(episodes[number])
        assert np.array_equal(single.actions, episodes[number].actions)
        assert np.array_equal(alone.episode(0), together.episode(number))


def test_an_episode_ends_at_its_first_success(suite, make_envs):
    (env,) = make_envs("reach", 1)
    policy = ExpertPolicy(suite.expert("reach"))
    (episode,) = rollout(policy, [env], [11], HORIZON)
    assert episode.success
    switching = replace(episode, sub_skills=np.arange(len(episode)) // 4 % 2)
    assert EpisodeOutcome.of(switching).sub_skill_switches == (len(episode) - 1) // 4
    assert sum(EpisodeOutcome.of(episode).sub_skill_steps) == len(episode) == len(policy.episode(0)) < HORIZON
    (cut_short,) = rollout(policy, [env], [11], len(episode) - 1)
    assert (cut_short.success, len(cut_short)) == (False, len(episode) - 1)


def test_a_policy_that_diverged_fails_there_and_then(suite, make_envs):
    class Diverging(ExpertPolicy):
        def act(self, observations: np.ndarray, memory: np.ndarray) -> Decision:
            decision = super().act(observations, memory)
            decision.actions[(memory[:, 0] == 1) & (memory[:, 1] == 4), 2] = np.nan
            return decision

    envs = make_envs("reach", 3)
    episodes = rollout(Diverging(suite.expert("reach")), envs, [11, 12, 13], HORIZON)
    sound = rollout(ExpertPolicy(suite.expert("reach")), envs, [11, 12, 13], HORIZON)
    assert (episodes[1].success, len(episodes[1]), episodes[1].goal) == (False, 4, sound[1].goal)
    assert [episode.diverged for episode in episodes] == [False, True, False]
    for episode, of_sound in zip(episodes[::2], sound[::2], strict=True):
        assert EpisodeOutcome.of(episode) == EpisodeOutcome.of(of_sound)
    with pytest.raises(FloatingPointError, match="not finite"):
        collect_rollouts(Diverging(suite.expert("reach")), envs, 11, 3 * HORIZON, HORIZON)


def test_an_expert_as_a_policy_solves_its_task(suite, make_envs):
    episodes = rollout(ExpertPolicy(suite.expert("reach")), make_envs("reach", 20), range(20), 300)
    assert sum(episode.success for episode in episodes) > 16
    assert len({tuple(episode.goal) for episode in episodes}) == 20


@pytest.mark.parametrize(("episodes", "draws"), [(20, 4), (7, 3), (2, 4), (5, 1)])
def test_episodes_are_spread_evenly_over_disjoint_support_sets(episodes: int, draws: int):
    settings = EvaluationConfig(shots=(1, 3), episodes=episodes, support_draws=draws)
    plan = plan_adaptations([("meta-training", "reach"), ("meta-testing", "push")], settings)
    held_out = [
        Demonstration(str(index), "reach", np.zeros((1, 2), np.float32), np.zeros((1, 1), np.float32))
        for index in range(12)
    ]
    for task in ("reach", "push"):
        for shots in (1, 3):
            of_one = [adaptation for adaptation in plan if (adaptation.task, adaptation.shots) == (task, shots)]
            assert sorted(number for adaptation in of_one for number in adaptation.episodes) == list(range(episodes))
            sizes = [len(adaptation.episodes) for adaptation in of_one]
            assert min(sizes) >= max(1, max(sizes) - 1)
            support = [demonstration.id for adaptation in of_one for demonstration in adaptation.support(held_out)]
            assert len(support) == len(set(support)) == shots * len(of_one)


def test_few_demonstrations_make_as_many_disjoint_support_sets_as_they_can():
    settings = EvaluationConfig(shots=(1, 2, 3), episodes=6, support_draws=4)
    plan = plan_adaptations([("meta-testing", "push")], settings, {"push": 5})
    assert [(one.shots, one.draw, one.episodes) for one in plan] == [
        (1, 0, (0, 4)), (1, 1, (1, 5)), (1, 2, (2,)), (1, 3, (3,)),
        (2, 0, (0, 2, 4)), (2, 1, (1, 3, 5)),
        (3, 0, (0, 1, 2, 3, 4, 5)),
    ]  # fmt: skip


class Remembering(Policy):
    """Does in each step as many units as it has taken steps."""

    def start(self, episodes: int) -> np.ndarray:
        return np.zeros((episodes, 1), np.int64)

    def act(self, observations: np.ndarray, memory: np.ndarray) -> Decision:
        return Decision(memory.astype(np.float32), np.zeros(len(memory), np.int64), memory + 1)


def demonstration(*actions: float) -> Demonstration:
    return Demonstration("0", "task", np.zeros((len(actions), 2), np.float32), np.array(actions, np.float32)[:, None])


def test_the_error_is_of_each_step_with_the_memory_of_its_own_episode():
    policy = Remembering()
    assert imitation_error(policy, [demonstration(0, 1, 2, 3)]) == 0
    assert imitation_error(policy, [demonstration(1), demonstration(0, 1, 4)]) == (1 + 0 + 0 + 4) / 4


def test_a_rollout_holds_what_the_policy_saw_and_is_cut_off_at_the_limit(suite, make_envs):
    envs, seeds = make_envs("reach", 2), [5, 6]
    policy = ExpertPolicy(suite.expert("reach"))
    whole, cut_off = (rollout(policy, envs, seeds, HORIZON, limit) for limit in (None, 3))
    for number, (episode, part) in enumerate(zip(whole, cut_off, strict=True)):
        assert np.array_equal(episode.observations[:-1], policy.episode(number))
        assert (episode.ended, part.ended, len(part)) == (True, False, 3)
        assert np.array_equal(episode.observations[:4], part.observations)
        assert np.array_equal(episode.sub_skills[:3], part.sub_skills)


class OneBuffer(gymnasium.Env[np.ndarray, np.ndarray]):
    """Counts its steps, and returns the same arrays and dictionaries all the time."""

    observation_space, action_space = Box(-9, 9, (2,), np.float32), Box(-1, 1, (1,), np.float32)

    def __init__(self) -> None:
        self._state, self._goal = np.zeros(2, np.float32), np.zeros(1)
        self._info: dict[str, Any] = {"success": False, "goal": self._goal, "steps": np.int64(0)}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self._state[:], self._goal[:], self._info["steps"] = 0, seed, np.int64(0)
        return self._state, self._info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._state += 1
        self._goal -= 1
        self._info["steps"] += 1
        return self._state, 0.0, False, False, self._info


class OneAction(Policy):
    """Acts by what it sees, in the same array all the time; an expert too."""

    def __init__(self) -> None:
        self._actions = np.zeros((1, 1), np.float32)

    def act(self, observations: np.ndarray, memory: np.ndarray) -> Decision:
        return Decision(self.get_action(observations[0])[None], np.zeros(1, np.int64), memory)

    def get_action(self, obs: np.ndarray, /) -> np.ndarray:
        self._actions[:] = obs[0] / 8
        return self._actions[0]


def test_what_comes_by_reference_is_copied():
    (acted, recording), *_ = record_rollouts(OneAction(), [OneBuffer()], [7], 4, {})
    shown = demonstrate(OneAction(), OneBuffer(), 7, 4, DemonstrationConfig(noise=0))
    for episode in (acted, shown):
        assert episode.observations.tolist() == [[step, step] for step in range(5)]
        assert episode.actions.tolist() == [[0], [0.125], [0.25], [0.375]]
        assert episode.goal == [7]
    assert recording.infos["steps"].tolist() == [1, 2, 3, 4]
