"""Recordings of episodes: the numbers that an environment reports at each step, and video. Pure, no Ray."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, SupportsFloat

import gymnasium
import numpy as np
from jaxtyping import Float64, UInt8

from dmil_core.configs import DemonstrationConfig
from dmil_core.methods.base import Policy
from dmil_core.trajectories import Episode, Rollout
from services.rollouts.episodes import demonstrate, rollout
from services.suites.base import Environment, Expert
from services.suites.rendering import Camera, View

NUMBER = (int, float, np.number, np.bool_)


class VideoSettings(NamedTuple):
    """How an episode is filmed."""

    view: str | View
    every: int
    """Steps from one frame to the next; the last frame shows the end all the same."""
    height: int = 360
    """Of a frame, in pixels."""
    width: int = 480


class Frame(NamedTuple):
    """One picture of a video."""

    step: int
    """Steps taken by then."""
    picture: UInt8[np.ndarray, "height width 3"]


class Recording(NamedTuple):
    """What an environment reported and showed in one episode, beside its trajectory."""

    infos: Mapping[str, Float64[np.ndarray, " steps"]]
    """The numbers that stand in the infos of all steps, by name."""
    frames: Sequence[Frame]
    """None, if it was not filmed."""


class _RecordingWrapper(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """Records an environment from its reset on, and changes nothing in it."""

    def __init__(self, env: Environment, video: VideoSettings | None) -> None:
        super().__init__(env)
        self._video, self._camera = video, None
        self._infos: list[Mapping[str, float]] = []
        self._frames: list[Frame] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        observation, info = self.env.reset(seed=seed, options=options)
        if self._video is not None:
            view, _, height, width = self._video
            self._camera = Camera(self.env, view, height, width, shadows=False)
            self._draw()
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, SupportsFloat, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._infos.append({name: float(value) for name, value in info.items() if isinstance(value, NUMBER)})
        if self._video is not None and len(self._infos) % self._video.every == 0:
            self._draw()
        return observation, reward, terminated, truncated, info

    def _draw(self) -> None:
        if self._camera is not None:
            self._frames.append(Frame(len(self._infos), self._camera.picture()))

    def recording(self) -> Recording:
        """Return what was recorded from the reset to now."""
        if self._frames and self._frames[-1].step < len(self._infos):
            self._draw()
        first = self._infos[0] if self._infos else {}
        names = [name for name in first if all(name in info for info in self._infos)]
        infos = {name: np.array([info[name] for info in self._infos]) for name in names}
        return Recording(infos, self._frames)

    def close_camera(self) -> None:
        """Free the camera; the environment stays open."""
        if self._camera is not None:
            self._camera.close()


def record_rollouts(
    policy: Policy, envs: Sequence[Environment], seeds: Sequence[int], horizon: int, videos: Mapping[int, VideoSettings]
) -> list[tuple[Rollout, Recording]]:
    """Run the episodes that `rollout` runs, to the same bits, and record them all.

    All episodes of an adaptation have to be run for that: what a network gives for a state may differ in its last bits
    with the number of states beside it, and so may the whole course of an episode. Those are filmed whose place among
    the seeds `videos` has.

    Raises:
        RenderingError: if OpenGL does not work here.
    """
    wrappers = [_RecordingWrapper(env, videos.get(place)) for place, env in enumerate(envs)]
    try:
        rollouts = rollout(policy, wrappers, seeds, horizon)
        return [(episode, wrapper.recording()) for episode, wrapper in zip(rollouts, wrappers, strict=True)]
    finally:
        for wrapper in wrappers:
            wrapper.close_camera()


def record_expert(
    expert: Expert, env: Environment, seed: int, horizon: int, config: DemonstrationConfig, video: VideoSettings
) -> tuple[Episode, Recording]:
    """Run the episode of an expert that `demonstrate` runs, and record it.

    Raises:
        RenderingError: if OpenGL does not work here.
    """
    wrapper = _RecordingWrapper(env, video)
    try:
        return demonstrate(expert, wrapper, seed, horizon, config), wrapper.recording()
    finally:
        wrapper.close_camera()
