"""Pictures: upright, true to what happens, and of no consequence for it."""

from typing import Any

import numpy as np
import pytest

from dmil_core.configs import SuiteConfig
from services.suites import rendering
from services.suites.base import Environment
from services.suites.metaworld import MetaWorldSuite
from services.suites.rendering import RenderingError, picture


@pytest.fixture(scope="module")
def env() -> Environment:
    env = MetaWorldSuite(SuiteConfig()).make_env("push-wall")
    env.reset(seed=1)
    return env


def draw(env: Environment, camera: str, height: int = 90, width: int = 120) -> np.ndarray:
    try:
        return picture(env, camera, height, width)
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("size", [(90, 120), (500, 600)])
def test_a_picture_has_the_size_that_was_asked_for(env, size):
    drawn = draw(env, "corner2", *size)
    assert (drawn.shape, drawn.dtype) == ((*size, 3), np.uint8)
    assert drawn.std() > 10


@pytest.mark.parametrize("camera", ["corner", "corner2", "corner4"])
def test_a_picture_is_upright(env, camera):
    """These cameras see a plain sky along the upper edge, the robot, its table or the floor along the lower one."""
    drawn = draw(env, camera)
    upper, lower = (len(np.unique(row, axis=0)) for row in (drawn[0], drawn[-1]))
    assert upper < lower


def test_a_picture_shows_what_happens_and_changes_nothing():
    def episode(*, drawn: bool) -> tuple[np.ndarray, list[np.ndarray]]:
        env = MetaWorldSuite(SuiteConfig()).make_env("push-wall")
        observations, pictures = [env.reset(seed=1)[0]], []
        for _ in range(3):
            for _ in range(5):
                observations.append(env.step(np.array((1, 0, 0, 1), np.float32))[0])
            if drawn:
                pictures.append(draw(env, "corner3"))
        return np.array(observations), pictures

    (watched, pictures), (alone, _) = episode(drawn=True), episode(drawn=False)
    assert np.array_equal(watched, alone)
    assert not np.array_equal(pictures[0], pictures[2])


def test_an_unknown_camera_is_named_with_the_known_ones(env):
    with pytest.raises(RenderingError, match="camera: got moon; wanted one of topview, corner, corner2"):
        picture(env, "moon")


@pytest.mark.parametrize("broken", [ImportError("no libEGL"), AttributeError("'NoneType' object has no ...")])
def test_without_opengl_the_packages_are_named(env, monkeypatch, broken):
    def missing(name: str) -> Any:
        raise broken

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering, "import_module", missing)
    with pytest.raises(RenderingError) as error:
        picture(env, "corner2")
    message = str(error.value)
    assert message.startswith("MUJOCO_GL: got egl, which does not work here")
    assert all(package in message for package in ("libegl1", "libosmesa6"))


def test_a_backend_that_needs_a_screen_is_refused(env, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    with pytest.raises(RenderingError, match="MUJOCO_GL: got glfw; wanted one of egl, osmesa"):
        picture(env, "corner2")
