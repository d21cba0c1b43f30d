"""Episodes seen step by step: what was done, what the environment told, and pictures of it. Pure, no Ray."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, SupportsFloat

import gymnasium
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dmil_core.configs import DemonstrationConfig
from dmil_core.methods.base import Policy
from services.rollouts.episodes import Episode, demonstrate, rollout
from services.suites.base import Attempt, Environment, Expert
from services.suites.rendering import Camera, View


class Film(NamedTuple):
    """How an episode is filmed."""

    view: str | View
    every: int
    """Steps from one picture to the next; the last one shows the end all the same."""
    height: int = 360
    """Of a picture, in pixels."""
    width: int = 480


class Frame(NamedTuple):
    """A picture from a film."""

    step: int
    """How many steps were taken by then."""
    picture: UInt8[np.ndarray, "height width 3"]


class Footage(NamedTuple):
    """What was to be seen of one episode."""

    actions: Float32[np.ndarray, "steps action_dim"]
    """As the environment executed them."""
    numbers: Mapping[str, Float64[np.ndarray, " steps"]]
    """Those in the infos of all steps, by name."""
    frames: Sequence[Frame]
    """None, if it was not filmed."""


class Watched(NamedTuple):
    """An episode of a policy, and what was to be seen of it."""

    episode: Episode
    footage: Footage


class _Observer(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Keeps what happens in an environment from its reset on, and changes nothing in it."""

    def __init__(self, env: Environment, film: Film | None) -> None:
        super().__init__(env)
        self._film, self._camera = film, None
        self._actions: list[np.ndarray] = []
        self._infos: list[Mapping[str, Any]] = []
        self._frames: list[Frame] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        if self._film is not None:
            view, _, height, width = self._film
            self._camera = Camera(self.env, view, height, width, shadows=False)
            self._draw()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._actions.append(np.asarray(action, np.float32))
        self._infos.append(info)
        if self._film is not None and len(self._actions) % self._film.every == 0:
            self._draw()
        return observation, reward, terminated, truncated, info

    def _draw(self) -> None:
        if self._camera is not None:
            self._frames.append(Frame(len(self._actions), self._camera.picture()))

    def footage(self) -> Footage:
        """Return what was to be seen from the reset to now."""
        if self._frames and self._frames[-1].step < len(self._actions):
            self._draw()
        first = self._infos[0] if self._infos else {}
        names = [name for name in first if all(_is_number(info.get(name)) for info in self._infos)]
        numbers = {name: np.array([float(info[name]) for info in self._infos]) for name in names}
        actions = np.array(self._actions, np.float32).reshape(-1, *(self.action_space.shape or ()))
        return Footage(actions, numbers, self._frames)

    def stop(self) -> None:
        """Let the camera go; the environment stays open."""
        if self._camera is not None:
            self._camera.close()


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number | np.bool_)


def watch(
    policy: Policy, envs: Sequence[Environment], seeds: Sequence[int], horizon: int, films: Mapping[int, Film]
) -> list[Watched]:
    """Run the episodes that `rollout` runs, to the same bits, and watch them all.

    All episodes of an adaptation have to be run for that: what a network gives for a state may differ in its last bits
    with the number of states beside it, and so may the whole course of an episode.

    Args:
        policy: what acts.
        envs: of one task, one for each seed.
        seeds: of the episodes.
        horizon: of an episode.
        films: how the episodes are filmed, by their place among the seeds; the others are not.

    Raises:
        RenderingError: if there is nothing here to draw with.
    """
    observers = [_Observer(env, films.get(place)) for place, env in enumerate(envs)]
    try:
        episodes = rollout(policy, observers, seeds, horizon)
        return [Watched(episode, observer.footage()) for episode, observer in zip(episodes, observers, strict=True)]
    finally:
        for observer in observers:
            observer.stop()


def watch_expert(
    expert: Expert, env: Environment, seed: int, horizon: int, config: DemonstrationConfig, film: Film
) -> tuple[Attempt, Footage]:
    """Let an expert try once more as in `demonstrate`, and film it.

    Raises:
        RenderingError: if there is nothing here to draw with.
    """
    observer = _Observer(env, film)
    try:
        return demonstrate(expert, observer, seed, horizon, config), observer.footage()
    finally:
        observer.stop()
