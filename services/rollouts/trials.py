"""Episodes of a policy or an expert in a suite's environments: pure, named by their seeds, no Ray."""

from collections.abc import Sequence
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box

from dmil_core.configs import DemonstrationConfig, EvaluationConfig
from dmil_core.demonstrations import Demonstration
from dmil_core.methods.base import FineTuning, Method, Policy, Rollout, SubSkillUse
from dmil_core.networks import Parameters
from dmil_core.seeding import stream, stream_seed
from services.evaluation.results import Split
from services.suites.base import Attempt, Environment, Expert

__all__ = [
    "Episode",
    "Imitation",
    "Trial",
    "TrialOutcome",
    "demonstrate",
    "episodes_beside",
    "imitate",
    "imitation_error",
    "practise",
    "record",
    "rollout",
    "trials",
    "try_out",
]


class Trial(NamedTuple):
    """One adaptation to one support set, and the episodes that judge it."""

    split: Split
    task: str
    shots: int
    draw: int
    episodes: tuple[int, ...]

    @property
    def in_words(self) -> str:
        """Its name in messages."""
        return f"{self.split} task {self.task}, {self.shots}-shot, support set {self.draw}"

    @property
    def piece(self) -> dict[str, str | int]:
        """What names it among all trials."""
        return {"split": self.split, "task": self.task, "shots": self.shots, "draw": self.draw}

    def support(self, held_out: Sequence[Demonstration]) -> Sequence[Demonstration]:
        """Return this draw's support set: draws of one size are disjoint."""
        return held_out[self.draw * self.shots : (self.draw + 1) * self.shots]


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


def practise(policy: Policy, envs: Sequence[Environment], seed: int, steps: int, horizon: int) -> list[Rollout]:
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
        seeds = [stream_seed(seed, "episode", number) for number in numbers]
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
    disturbance = stream(seed, "expert noise")
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


def imitation_error(policy: Policy, demonstrations: Sequence[Demonstration]) -> float:
    """Return ‖π(s) − a‖² averaged over all steps: how far a policy is from what was demonstrated, in its states.

    What the policy remembers between steps is its own; the states are the demonstrations', whatever it does.

    Args:
        policy: adapted.
        demonstrations: at least one.
    """
    total, memory = 0.0, policy.start(len(demonstrations))
    alive = list(demonstrations)
    for step in range(max(map(len, demonstrations))):
        going_on = [step < len(demonstration) for demonstration in alive]
        alive, memory = list(compress(alive, going_on)), memory[going_on]
        decision = policy.act(np.stack([demonstration.observations[step] for demonstration in alive]), memory)
        wanted = np.stack([demonstration.actions[step] for demonstration in alive])
        total, memory = total + float(np.square(decision.actions - wanted).sum()), decision.memory
    return total / sum(map(len, demonstrations))


def trials(tasks: Sequence[tuple[Split, str]], evaluation: EvaluationConfig) -> list[Trial]:
    """Return all adaptations of an evaluation, a task's episodes spread over its support sets."""
    return [
        Trial(split, task, shots, draw, tuple(range(draw, evaluation.episodes, evaluation.support_draws)))
        for split, task in tasks
        for shots in evaluation.shots
        for draw in range(min(evaluation.support_draws, evaluation.episodes))
    ]


class TrialOutcome(NamedTuple):
    """The episodes of a trial, and the sub-skills along the held-out demonstrations it did not adapt to."""

    episodes: list[Episode]
    use: list[SubSkillUse]


def try_out(
    method: Method,
    parameters: Parameters,
    trial: Trial,
    held_out: Sequence[Demonstration],
    envs: Sequence[Environment],
    horizon: int,
    evaluation: EvaluationConfig,
    seed: int,
) -> TrialOutcome:
    """Adapt to a trial's support set and run its episodes: a pure function of its arguments.

    Args:
        method: what adapts.
        parameters: meta-trained.
        trial: which support set and episodes.
        held_out: demonstrations of the task that meta-training has not seen.
        envs: of the task, at least one for each episode.
        horizon: steps in an episode.
        evaluation: how to adapt.
        seed: of the experiment; an episode is named by it, the task and the episode's number, so that all shots
            and methods meet the same episodes.
    """
    support = trial.support(held_out)
    policy = method.adapt(parameters, support, FineTuning(evaluation.fine_tuning_steps, evaluation.learning_rate))
    seeds = [stream_seed(seed, "evaluation", trial.task, episode) for episode in trial.episodes]
    others = [demonstration for demonstration in held_out if demonstration not in support]
    episodes = rollout(policy, envs[: len(seeds)], seeds, horizon)
    return TrialOutcome(episodes, [policy.sub_skill_use(demonstration) for demonstration in others])


class Imitation(NamedTuple):
    """The `imitation_error` of an adapted policy."""

    support: float
    """On what it was adapted to."""
    held_out: float | None
    """On the held-out demonstrations of the task that it was not adapted to, where there are any."""


def imitate(
    method: Method,
    parameters: Parameters,
    trial: Trial,
    held_out: Sequence[Demonstration],
    evaluation: EvaluationConfig,
) -> Imitation:
    """Adapt to a trial's support set, and compare the policy with demonstrations: no episodes, else as `try_out`."""
    support = trial.support(held_out)
    policy = method.adapt(parameters, support, FineTuning(evaluation.fine_tuning_steps, evaluation.learning_rate))
    others = [demonstration for demonstration in held_out if demonstration not in support]
    return Imitation(imitation_error(policy, support), imitation_error(policy, others) if others else None)
