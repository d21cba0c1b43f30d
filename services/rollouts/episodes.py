"""Episodes of a policy or an expert in a suite's environments: pure, named by their seeds, no Ray."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box

from dmil_core.configs import DemonstrationConfig
from dmil_core.methods.base import Policy, Rollout
from dmil_core.seeding import named_rng, named_seed
from services.suites.base import Attempt, Environment, Expert


class Episode(NamedTuple):
    """What came of one episode of a policy."""

    seed: int
    goal: list[float]
    success: bool
    score: int
    """The best of the episode: sub-tasks done in suites that count them, else 1 for a success."""
    sub_skills: list[int]
    """The one that acted, at each step."""

    @property
    def steps(self) -> int:
        """How many it lasted."""
        return len(self.sub_skills)

    @property
    def sub_skill_steps(self) -> list[int]:
        """How many steps each sub-skill acted, up to the highest one that did."""
        return np.bincount(self.sub_skills).tolist()

    @property
    def outcome(self) -> dict[str, Any]:
        """What a row of results says of it."""
        told = self._asdict() | {"steps": self.steps, "sub_skill_steps": self.sub_skill_steps}
        return {name: value for name, value in told.items() if name != "sub_skills"}


def rollout(policy: Policy, envs: Sequence[Environment], seeds: Sequence[int], horizon: int) -> list[Episode]:
    """Run one episode for each seed, each in an environment of its own, with one call of the policy a step for all.

    The environments are of one task.

    An episode ends at its first success, or after `horizon` steps without one; a policy that diverged, so that an
    action is not finite, fails there and then.
    """
    resets = [env.reset(seed=seed) for env, seed in zip(envs, seeds, strict=True)]
    goals = [info.get("goal", []) for _, info in resets]
    observations = np.array([observation for observation, _ in resets], np.float32)
    alive = np.arange(len(seeds))
    memory = policy.start(len(seeds))
    success, score = np.zeros(len(seeds), bool), np.zeros(len(seeds), int)
    choices: list[list[int]] = [[] for _ in seeds]
    for _ in range(horizon):
        decision = policy.act(observations[alive], memory)
        finite = np.isfinite(decision.actions).all(axis=1)
        acting, actions = alive[finite].tolist(), _clip(decision.actions[finite], envs[0])
        for index, action, sub_skill in zip(acting, actions, decision.sub_skills[finite].tolist(), strict=True):
            observations[index], _, _, _, info = envs[index].step(action)
            success[index] = info["success"]
            score[index] = max(score[index], info.get("score", info["success"]))
            choices[index].append(sub_skill)
        going_on = ~success[alive] & finite
        alive, memory = alive[going_on], decision.memory[going_on]
        if not len(alive):
            break
    return [
        Episode(seed, goal, bool(done), int(best), chosen)
        for seed, goal, done, best, chosen in zip(seeds, goals, success, score, choices, strict=True)
    ]


def episodes_beside(steps: int, horizon: int) -> int:
    """Return how many episodes act in lockstep where a policy practises for so many steps."""
    return max(1, steps // horizon)


def collect_rollouts(policy: Policy, envs: Sequence[Environment], seed: int, steps: int, horizon: int) -> list[Rollout]:
    """Let a policy act for so many steps in all, in rounds of `episodes_beside` episodes; the last ones may be cut off.

    An episode ends as in `rollout`.

    Args:
        policy: what acts.
        envs: of one task, at least as many as act beside each other.
        seed: names the episodes.
        steps: of all episodes together.
        horizon: of an episode.
    """
    rollouts: list[Rollout] = []
    while steps > 0:
        numbers = range(len(rollouts), len(rollouts) + episodes_beside(steps, horizon))
        seeds = [named_seed(seed, "episode", number) for number in numbers]
        found = record(policy, envs, seeds, min(horizon, steps), horizon)
        steps -= sum(len(rollout.actions) for rollout in found)
        rollouts += found
    return rollouts


def record(policy: Policy, envs: Sequence[Environment], seeds: Sequence[int], most: int, horizon: int) -> list[Rollout]:
    """Record an episode for each seed, of at most so many steps; it is that of `rollout`, step by step.

    Args:
        policy: what acts.
        envs: of one task, at least one for each seed.
        seeds: of the episodes.
        most: steps that are recorded.
        horizon: steps in an episode.

    Raises:
        FloatingPointError: for an action that is not finite.
    """
    first = [env.reset(seed=seed)[0] for env, seed in zip(envs, seeds, strict=False)]
    observations = [[observation.astype(np.float32)] for observation in first]
    actions: list[list[np.ndarray]] = [[] for _ in seeds]
    sub_skills: list[list[int]] = [[] for _ in seeds]
    success, ended = np.zeros(len(seeds), bool), np.full(len(seeds), most == horizon)
    alive, memory = np.arange(len(seeds)), policy.start(len(seeds))
    for _ in range(most):
        decision = policy.act(np.stack([observations[index][-1] for index in alive]), memory)
        if not np.isfinite(decision.actions).all():
            raise FloatingPointError("got an action that is not finite; wanted a policy that has not diverged")
        for index, action, sub_skill in zip(alive.tolist(), decision.actions, decision.sub_skills, strict=True):
            observation, _, _, _, info = envs[index].step(_clip(action, envs[index]))
            observations[index].append(observation.astype(np.float32))
            actions[index].append(action)
            sub_skills[index].append(int(sub_skill))
            success[index] = info["success"]
        going_on = ~success[alive]
        alive, memory = alive[going_on], decision.memory[going_on]
        if not len(alive):
            break
    return [
        Rollout(np.array(seen), np.array(did, np.float32), np.array(chosen, np.int64), bool(done), bool(done or whole))
        for seen, did, chosen, done, whole in zip(observations, actions, sub_skills, success, ended, strict=True)
    ]


def demonstrate(expert: Expert, env: Environment, seed: int, horizon: int, config: DemonstrationConfig) -> Attempt:
    """Let an expert try once, and record what it saw and did until some steps after its first success.

    The environment executes the expert's action plus N(0, noise²), as in the authors' code; the action without the
    noise is what is stored unless `config` says otherwise, clipped to the action space as the environment clips it.

    Args:
        expert: of the task.
        env: of the task.
        seed: of the episode.
        horizon: the attempt is given up after so many steps.
        config: noise, labels and trailing steps.
    """
    disturbance = named_rng(seed, "expert noise")
    observation, info = env.reset(seed=seed)
    goal = info.get("goal", [])
    observations, actions = [observation], []
    solved_at, end = None, horizon
    while len(actions) < end:
        # A copy: some of Meta-World's experts add offsets to the positions in place.
        action = _clip(expert.get_action(info.get("full_observation", observation).copy()), env)
        executed = _clip(action + disturbance.normal(0, config.noise, action.shape), env)
        actions.append(executed if config.labels == "noisy" else action)
        observation, _, _, _, info = env.step(executed.astype(np.float32))
        observations.append(observation)
        if info["success"] and solved_at is None:
            solved_at = len(actions) - 1
            end = min(horizon, len(actions) + config.trailing_steps)
    return Attempt(seed, goal, solved_at, np.asarray(observations, np.float32), np.asarray(actions, np.float32))


def _clip(actions: np.ndarray, env: Environment) -> np.ndarray:
    space = env.action_space
    assert isinstance(space, Box)
    return np.clip(actions, space.low, space.high)
