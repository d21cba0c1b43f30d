"""Pictures of MuJoCo environments, drawn without a screen."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium
import mujoco as compiled_mujoco
import numpy as np
from jaxtyping import UInt8

from dmil_core.errors import UserError

__all__ = ["RenderingError", "View", "picture", "working_backend"]

mujoco: Any = compiled_mujoco  # compiled, so a type checker sees nothing of it

BACKENDS = {"egl": "libegl1 libgl1", "osmesa": "libosmesa6"}
"""What draws without a screen, by the names of ``MUJOCO_GL``, and the Debian packages that bring it."""


class RenderingError(UserError):
    """A picture that cannot be drawn."""


class View(NamedTuple):
    """A camera anywhere."""

    lookat: tuple[float, float, float]
    """The point in the middle of the picture, in metres."""
    distance: float
    """From that point, in metres."""
    azimuth: float
    """The direction it looks in, in degrees around the vertical."""
    elevation: float
    """In degrees above the horizon; below 0 it looks down."""


def picture(
    env: gymnasium.Env[Any, Any], camera: str | View, height: int = 360, width: int = 480
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw what a camera sees now, in red, green and blue; where it hangs upside down, the picture is turned upright.

    Args:
        env: has MuJoCo's ``model`` and ``data`` in it, and stays as it is.
        camera: one that the model names, in Meta-World for example corner2, or one of one's own.
        height: in pixels.
        width: in pixels.

    Raises:
        RenderingError: if the model has no such camera, or OpenGL does not work here.
    """
    unwrapped: Any = env.unwrapped
    model, data = unwrapped.model, unwrapped.data
    view = _camera(model, camera)
    scene, frame = mujoco.MjvScene(model, maxgeom=10_000), mujoco.MjrRect(0, 0, width, height)
    pixels = np.empty((height, width, 3), np.uint8)
    with _drawing(model, height, width) as context:
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
        mujoco.mjr_render(frame, scene, context)
        mujoco.mjr_readPixels(pixels, None, frame, context)
    upright = view.fixedcamid < 0 or data.cam_xmat[view.fixedcamid].reshape(3, 3)[2, 1] >= 0
    return (pixels[::-1] if upright else pixels[:, ::-1]).copy()  # OpenGL's first row is the lowest


def _camera(model: Any, camera: str | View) -> Any:
    view = mujoco.MjvCamera()
    if isinstance(camera, View):
        view.lookat[:], view.distance, view.azimuth, view.elevation = camera
        return view
    cameras = [model.camera(index).name for index in range(model.ncam)]
    if camera not in cameras:
        raise RenderingError(f"camera: got {camera}; wanted one of {', '.join(cameras)}")
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, cameras.index(camera)
    return view


@contextmanager
def _drawing(model: Any, height: int, width: int) -> Iterator[Any]:
    """Give what MuJoCo draws with, off the screen.

    The backend is loaded here and not, as ``mujoco.Renderer`` does, with MuJoCo itself: a machine without it can
    simulate all the same.
    """
    backend = os.environ.get("MUJOCO_GL") or "egl"
    if backend not in BACKENDS:
        raise RenderingError(f"MUJOCO_GL: got {backend}; wanted one of {', '.join(BACKENDS)}, which need no screen")
    try:
        surface = import_module(f"mujoco.{backend}").GLContext(width, height)
        surface.make_current()
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        # PyOpenGL meets a missing library as an attribute of None.
        ways = [f"MUJOCO_GL={name} with apt-get install {packages}" for name, packages in BACKENDS.items()]
        raise RenderingError(
            f"MUJOCO_GL: got {backend}, which does not work here ({type(error).__name__}: {error}); "
            f"wanted a backend of OpenGL that needs no screen: {', or '.join(ways)}"
        ) from error
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        mujoco.mjr_resizeOffscreen(width, height, context)
        yield context
    finally:
        context.free()
        surface.free()


def working_backend() -> str:
    """Return the backend that draws here, after having drawn nothing with it.

    Raises:
        RenderingError: if there is none.
    """
    with _drawing(mujoco.MjModel.from_xml_string("<mujoco/>"), height=16, width=16):
        return os.environ.get("MUJOCO_GL") or "egl"
