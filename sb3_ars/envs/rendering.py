"""How frames come about: which OpenGL MuJoCo draws with, and its pictures right side up; must not know the learner."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from typing import Any

import numpy.typing as npt

from sb3_ars.errors import ConfigError, nearest

__all__ = ["DEFAULT_CAMERA", "MujocoCamera", "find_gl_backend", "select_gl_backend"]

DEFAULT_CAMERA = "front"
"""A view of our own on the whole table; the others are those of the simulated model."""

_LOOKS_AT = (0.0, 0.65, 0.15)
_STANDS_AT = (1.6, 325.0, -35.0)
"""Distance in metres, azimuth and elevation in degrees."""

_PROBE = (
    "import mujoco\n"
    "model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size=\"1\"/></worldbody></mujoco>')\n"
    "mujoco.Renderer(model, 16, 16).render()"
)


def find_gl_backend() -> str:
    """Return the name of the backend with which MuJoCo can draw off screen here; change nothing.

    ``MUJOCO_GL`` decides where it is set; else what can draw is looked for: a window where there is a display, then
    EGL, then OSMesa.

    :raises ConfigError: if there is none
    """
    given = os.environ.get("MUJOCO_GL")
    candidates = [given] if given else _candidates()
    said = {}
    for backend in candidates:
        said[backend] = _complaint(backend)
        if not said[backend]:
            return backend
    tried = "; ".join(f"{backend}: {complaint}" for backend, complaint in said.items())
    raise ConfigError(
        "MuJoCo finds no OpenGL to draw with, so Meta-World cannot be rendered here. Install libegl1 (with a GPU's "
        "driver or Mesa's) or libosmesa6, and set MUJOCO_GL=egl or MUJOCO_GL=osmesa, or leave MUJOCO_GL unset. "
        f"Tried {tried}"
    )


def select_gl_backend() -> str:
    """Name the backend MuJoCo is to draw with in ``MUJOCO_GL``, for this process and its children; return it.

    :raises ConfigError: if there is none
    """
    backend = find_gl_backend()
    os.environ["MUJOCO_GL"] = backend
    return backend


def camera_index(model: Any, camera: str) -> int:
    """Return MuJoCo's index of a camera, -1 for `DEFAULT_CAMERA`, which stands free.

    :param model: MuJoCo's
    :param camera: `DEFAULT_CAMERA`, or the name of one of the model's
    :raises ConfigError: for an unknown camera
    """
    names = [DEFAULT_CAMERA, *(model.camera(index).name for index in range(model.ncam))]
    if camera not in names:
        raise ConfigError(
            f"camera={camera!r} is unknown; choose one of {', '.join(names)}." + nearest(camera, names)
        )
    return names.index(camera) - 1


class MujocoCamera:
    """Draws a MuJoCo model; what a camera that hangs upside down sees, as Meta-World's in the corners do, is turned.

    :param model: ``MjModel``
    :param data: ``MjData``
    :param camera: `DEFAULT_CAMERA`, or the name of one of the model's
    :param size: width and height in pixels
    :raises ConfigError: for an unknown camera
    """

    def __init__(self, model: Any, data: Any, camera: str, size: int) -> None:
        # here and not above: importing them loads OpenGL, and who does not draw need not have it
        import mujoco
        from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

        self._index = camera_index(model, camera)
        self._data = data
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, size)
        model.vis.global_.offheight = max(model.vis.global_.offheight, size)
        self._viewer: Any = OffScreenViewer(model, data, size, size)
        self._viewer.cam.lookat = _LOOKS_AT
        self._viewer.cam.distance, self._viewer.cam.azimuth, self._viewer.cam.elevation = _STANDS_AT
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._viewer.scn.flags[flag] = False  # they double the time that a processor takes for a frame

    def draw(self, mode: str = "rgb_array") -> npt.NDArray[Any]:
        """Return ``(size, size, 3)`` uint8, or for ``"depth_array"`` ``(size, size)`` float32, right side up."""
        # several envs in one process have a context each, and draw with whichever is current
        self._viewer.make_context_current()
        frame: npt.NDArray[Any] = self._viewer.render(mode, camera_id=self._index)
        frame = frame[::-1, ::-1] if self._hangs() else frame
        upright: npt.NDArray[Any] = frame.copy()
        return upright

    def close(self) -> None:
        """Free the drawing context."""
        self._viewer.close()

    def _hangs(self) -> bool:
        # the camera's y axis is up in the picture; looking straight down it lies level
        return self._index >= 0 and bool(self._data.cam_xmat[self._index].reshape(3, 3)[2, 1] < -0.1)


def _candidates() -> list[str]:
    if not sys.platform.startswith("linux"):
        return ["glfw"]
    has_display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return ["glfw", "egl", "osmesa"] if has_display else ["egl", "osmesa"]


@cache
def _complaint(backend: str) -> str:
    """Return why the backend cannot draw, in one line; empty if it can."""
    # in a process of its own: a missing GL library can abort the process, or fill the screen with warnings
    environment = {**os.environ, "MUJOCO_GL": backend}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env=environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "no answer within a minute"
    if done.returncode == 0:
        return ""
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    raised = [line for line in lines if line.split(":")[0].endswith(("Error", "Exception"))]
    return (raised or lines or [f"exit status {done.returncode}"])[0]
