"""Episodes of a policy or an expert in a suite's environments: pure, named by their seeds, no Ray."""

from collections.abc import Sequence
from itertools import compress
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from dmil_core.configs import DemonstrationConfig
from dmil_core.errors import UserError
from dmil_core.methods.base import Policy
from dmil_core.seeding import named_rng, named_seed
from dmil_core.trajectories import Episode, Rollout
from services.suites.base import Environment, Expert

RESET = ("observation", "info")
STEP = ("observation", "reward", "terminated", "truncated", "info")
"""What the methods of gymnasium's environments return."""


def _reset(env: Environment, seed: int) -> object:
    try:
        return env.reset(seed=seed)
    except TypeError as error:
        if "unexpected keyword argument" not in str(error):
            raise
        raise UserError(f"reset: got {error}; wanted gymnasium's reset(*, seed=None, options=None)") from error


def _checked(env: Environment, method: str, returned: Any, wanted: tuple[str, ...]) -> Any:
    """Return what a method of an environment returned, if it is what was wanted, with the observation as an array."""
    if not isinstance(returned, tuple) or len(returned) != len(wanted):
        got = f"{len(returned)} values" if isinstance(returned, tuple) else f"a {type(returned).__name__}"
        raise UserError(
            f"{method}: got {got}; wanted gymnasium's ({', '.join(wanted)}); an environment of the older gym needs a "
            "wrapper"
        )
    observation, shape = np.asarray(returned[0]), env.observation_space.shape
    if observation.shape != shape:
        raise UserError(
            f"{method}: got an observation of the shape {observation.shape}; wanted {shape}, as its observation_space "
            "says"
        )
    return observation, *returned[1:]


class _Recorder:
    """Resets an environment, and records all steps of the episode that begins.

    What an environment, an expert or a policy hands over is copied: it may be a buffer that the next step overwrites.
    """

    def __init__(self, env: Environment, seed: int) -> None:
        self._env, self._seed = env, seed
        self.observation, self.info = _checked(env, "reset", _reset(env, seed), RESET)
        self._goal: list[float] = np.array(self.info.get("goal", []), np.float64).ravel().tolist()
        self.observations = [self.observation.astype(np.float32)]
        self.actions: list[np.ndarray] = []
        self.sub_skills: list[int] = []
        self.solved_at: int | None = None
        self.diverged = False
        self._score = 0

    def step(self, executed: np.ndarray, recorded: np.ndarray) -> None:
        """Execute an action; the one that is recorded need not be the same."""
        self.observation, _, _, _, self.info = _checked(self._env, "step", self._env.step(executed), STEP)
        if (success := self.info.get("success", self.info.get("is_success"))) is None:
            raise UserError(
                "info of a step: got no success; wanted success or is_success, whether the task is solved; have step() "
                "say so"
            )
        if success and self.solved_at is None:
            self.solved_at = len(self.actions)
        self._score = max(self._score, int(np.asarray(self.info.get("score", success)).item()))
        self.observations.append(self.observation.astype(np.float32))
        self.actions.append(recorded.copy())

    def act(self, action: np.ndarray, sub_skill: int) -> None:
        """Execute what a policy chose, unless it is not finite: then the episode is over."""
        self.diverged = not np.isfinite(action).all()
        if not self.diverged:
            self.step(_clip(action, self._env), action)
            self.sub_skills.append(sub_skill)

    def episode(self) -> dict[str, Any]:
        """Return the fields of the `Episode` so far."""
        actions = np.array(self.actions, np.float32).reshape(-1, *(self._env.action_space.shape or ()))
        return {
            "observations": np.array(self.observations),
            "actions": actions,
            "seed": self._seed,
            "goal": self._goal,
            "solved_at": self.solved_at,
            "score": self._score,
        }


def rollout(
    policy: Policy, envs: Sequence[Environment], seeds: Sequence[int], horizon: int, limit: int | None = None
) -> list[Rollout]:
    """Run one episode for each seed in lockstep: one call of the policy chooses the next action in all of them.

    An episode ends at its first success, or after `horizon` steps without one; a `limit` cuts it off before. Where a
    policy has diverged, so that an action is not finite, that episode ends there, as a failure, and the others go on.
    """
    steps = horizon if limit is None else limit
    recorders = [_Recorder(env, seed) for env, seed in zip(envs[: len(seeds)], seeds, strict=True)]
    alive, memory = recorders, policy.start(len(seeds))
    for _ in range(steps):
        decision = policy.act(np.stack([recorder.observations[-1] for recorder in alive]), memory)
        for recorder, action, sub_skill in zip(alive, decision.actions, decision.sub_skills.tolist(), strict=True):
            recorder.act(action, sub_skill)
        going_on = [recorder.solved_at is None and not recorder.diverged for recorder in alive]
        alive, memory = list(compress(alive, going_on)), decision.memory[going_on]
        if not alive:
            break
    return [
        Rollout(
            **recorder.episode(),
            sub_skills=np.array(recorder.sub_skills, np.int64),
            ended=recorder.solved_at is not None or steps == horizon,
            diverged=recorder.diverged,
        )
        for recorder in recorders
    ]


def parallel_episodes(steps: int, horizon: int) -> int:
    """Return how many episodes run in lockstep where a policy collects so many steps."""
    return max(1, steps // horizon)


def collect_rollouts(policy: Policy, envs: Sequence[Environment], seed: int, steps: int, horizon: int) -> list[Rollout]:
    """Collect so many steps of a policy, in rounds of `parallel_episodes` episodes; the last ones may be cut off.

    Raises:
        FloatingPointError: for an action that is not finite.
    """
    rollouts: list[Rollout] = []
    while steps > 0:
        numbers = range(len(rollouts), len(rollouts) + parallel_episodes(steps, horizon))
        seeds = [named_seed(seed, "episode", number) for number in numbers]
        collected = rollout(policy, envs, seeds, horizon, min(horizon, steps))
        if any(episode.diverged for episode in collected):
            raise FloatingPointError("got an action that is not finite; wanted a policy that has not diverged")
        steps -= sum(map(len, collected))
        rollouts += collected
    return rollouts


def demonstrate(expert: Expert, env: Environment, seed: int, horizon: int, config: DemonstrationConfig) -> Episode:
    """Run one episode of an expert, until some steps after its first success, or to the horizon.

    The environment executes the expert's action plus N(0, noise²), as in the authors' code; the action without the
    noise is what is stored unless `config` says otherwise, clipped to the action space as the environment clips it.
    """
    rng = named_rng(seed, "expert noise")
    recorder, end = _Recorder(env, seed), horizon
    while len(recorder.actions) < end:
        observation = recorder.info.get("full_observation", recorder.observation)
        # A copy: some of Meta-World's experts add offsets to the positions in place.
        action = _clip(expert.get_action(observation.copy()), env)
        executed = _clip(action + rng.normal(0, config.noise, action.shape), env)
        recorder.step(executed.astype(np.float32), executed if config.labels == "noisy" else action)
        if recorder.solved_at is not None:
            end = min(horizon, recorder.solved_at + 1 + config.trailing_steps)
    return Episode(**recorder.episode())


def _clip(actions: np.ndarray, env: Environment) -> np.ndarray:
    space = env.action_space
    assert isinstance(space, Box)
    return np.clip(actions, space.low, space.high)
