"""Pictures of MuJoCo environments, drawn without a screen."""

import os
from importlib import import_module
from typing import Any, NamedTuple

import gymnasium
import mujoco as compiled_mujoco
import numpy as np
from jaxtyping import UInt8

from dmil_core.errors import UserError

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


class Camera:
    """Draws what happens in one environment, picture after picture; to be used in a ``with``.

    What is costly, to bring the model's meshes and textures to OpenGL, is done once.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        view: str | View,
        height: int = 360,
        width: int = 480,
        *,
        shadows: bool = True,
    ) -> None:
        """Look at an environment that has MuJoCo's ``model`` and ``data`` in it, and stays as it is.

        The view is one that the model names, in Meta-World for example corner2, or one of one's own; height and width
        are in pixels. Without shadows a picture takes a third to an eighth of the time.

        Raises:
            RenderingError: if the model has no such camera, or OpenGL does not work here.
        """
        self._env: Any = env.unwrapped
        model = self._env.model
        self._view = _camera(model, view)
        self._scene, self._frame = mujoco.MjvScene(model, maxgeom=10_000), mujoco.MjrRect(0, 0, width, height)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._surface = _surface(height, width)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        mujoco.mjr_resizeOffscreen(width, height, self._context)

    def picture(self) -> UInt8[np.ndarray, "height width 3"]:
        """Draw what it sees now, in red, green and blue; where it hangs upside down, the picture is turned upright."""
        model, data = self._env.model, self._env.data
        pixels = np.empty((self._frame.height, self._frame.width, 3), np.uint8)
        self._surface.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, self._view, every, self._scene)
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._frame, self._context)
        number = self._view.fixedcamid
        upright = number < 0 or data.cam_xmat[number].reshape(3, 3)[2, 1] >= 0
        return (pixels[::-1] if upright else pixels[:, ::-1]).copy()  # OpenGL's first row is the lowest

    def __enter__(self) -> "Camera":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Give back what OpenGL holds."""
        self._surface.make_current()
        self._context.free()
        self._surface.free()


def picture(
    env: gymnasium.Env[Any, Any], view: str | View, height: int = 360, width: int = 480
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a single picture, see `Camera`."""
    with Camera(env, view, height, width) as camera:
        return camera.picture()


def _camera(model: Any, view: str | View) -> Any:
    looking = mujoco.MjvCamera()
    if isinstance(view, View):
        looking.lookat[:], looking.distance, looking.azimuth, looking.elevation = view
        return looking
    cameras = [model.camera(index).name for index in range(model.ncam)]
    if view not in cameras:
        raise RenderingError(f"camera: got {view}; wanted one of {', '.join(cameras)}")
    looking.type, looking.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, cameras.index(view)
    return looking


def _surface(height: int, width: int) -> Any:
    """Return what OpenGL draws on off the screen, and draw on it from now on.

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
    return surface


def working_backend() -> str:
    """Return the backend that draws here, after having drawn nothing with it.

    Raises:
        RenderingError: if there is none.
    """
    _surface(height=16, width=16).free()
    return os.environ.get("MUJOCO_GL") or "egl"
