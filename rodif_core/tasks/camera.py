"""Pictures of a task's scene, drawn off screen from stored physics positions.

The OpenGL context is made by the first picture and not before, in the process and thread that draw:
a child forked from a process that has drawn with EGL would hang in its first picture, so that is
refused. Which OpenGL is used is looked up at that moment too, because `import mujoco` with
MUJOCO_GL=egl fails where there is none, and most of what is done here needs no OpenGL.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from rodif_core.errors import GraphicsError, UnknownNameError
from rodif_core.tasks.base import Task
from rodif_core.tasks.panda import Mesh

# What MUJOCO_GL may say on Linux, with the library that it needs and the Debian packages that bring
# it; in the order in which they are tried when it says nothing.
LINUX_GL = {
    "egl": ("libEGL.so.1", "libegl1 libgl1-mesa-dri libopengl0"),
    "osmesa": ("libOSMesa.so.8", "libosmesa6"),
}
MAX_SHAPES = 4000  # things in one picture; a scene has some 50, the rest is for trails

# Process that has drawn. A module variable, because a forked child inherits it.
_drew_in: int | None = None


@dataclass(frozen=True, eq=False)
class Trail:
    """A line in space: points (N, 3) in metres, colour red, green, blue, alpha in 0 … 1."""

    points: NDArray[np.floating[Any]]
    rgba: tuple[float, float, float, float]
    width: float = 3.0  # px


class Camera:
    """Draws one task's scene; `picture` as often as wanted, then `close`, or use it in a `with`.

    width, height  px of the pictures
    mesh           "col": the low-poly arm (about 0.5 ms for 96 x 96 px in software); "viz": the
                   detailed one (about 10 ms)
    samples        of the smoothing of edges; 0 for what policies see, 4 for people

    The same positions give the same picture on the same machine.
    """

    def __init__(
        self, task: Task, width: int, height: int, *, mesh: Mesh = "col", samples: int = 0
    ) -> None:
        self._size = (width, height)
        self._model = task.build_model(mesh)
        self._model.vis.quality.offsamples = samples
        self._model.vis.global_.offwidth = width
        self._model.vis.global_.offheight = height
        self._data = mujoco.MjData(self._model)
        self._scene = mujoco.MjvScene(self._model, MAX_SHAPES)
        self._option = mujoco.MjvOption()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._name = ""  # of the OpenGL that draws
        self._gl: Any = None
        self._context: mujoco.MjrContext | None = None

    @property
    def views(self) -> list[str]:
        """Names of the scene's cameras."""
        return [self._model.camera(i).name for i in range(self._model.ncam)]

    def start(self) -> str:
        """Make an OpenGL context, unless there is one, and make it current, as `picture` does;
        which OpenGL it is, such as "egl". Raises GraphicsError when this machine cannot draw."""
        if self._context is not None:
            self._gl.make_current()
            return self._name
        self._name, self._gl = _new_context(*self._size)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        return self._name

    def picture(
        self,
        qpos: NDArray[np.floating[Any]],
        view: str | mujoco.MjvCamera = "front",
        trails: Sequence[Trail] = (),
    ) -> NDArray[np.uint8]:
        """(height, width, 3) uint8 RGB of the scene at physics positions (Q,).

        view  one of `views`, or a free camera of MuJoCo

        Raises UnknownNameError for a view that does not exist and GraphicsError when this machine
        cannot draw.
        """
        seen_from = self._view(view)
        self.start()
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, seen_from, everything, self._scene
        )
        for trail in trails:
            self._add(trail)
        pixels = np.empty((self._size[1], self._size[0], 3), dtype=np.uint8)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._context)
        return pixels[::-1].copy()  # OpenGL counts rows from the bottom

    def close(self) -> None:
        """Give the OpenGL context back; a later picture makes a new one."""
        if self._context is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
        self._context = self._gl = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _view(self, view: str | mujoco.MjvCamera) -> mujoco.MjvCamera:
        if not isinstance(view, str):
            return view
        if view not in self.views:
            raise UnknownNameError("view", view, self.views)
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = self._model.camera(view).id
        return camera

    def _add(self, trail: Trail) -> None:
        colour = np.array(trail.rgba, dtype=np.float32)
        points = np.asarray(trail.points, dtype=np.float64)
        for start, end in zip(points[:-1], points[1:], strict=True):
            if self._scene.ngeom == self._scene.maxgeom:
                return
            geom = self._scene.geoms[self._scene.ngeom]
            line = mujoco.mjtGeom.mjGEOM_LINE
            mujoco.mjv_initGeom(geom, line, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
            mujoco.mjv_connector(geom, line, trail.width, start, end)
            self._scene.ngeom += 1


def _new_context(width: int, height: int) -> tuple[str, Any]:
    """Name and off-screen OpenGL context of MuJoCo; raises GraphicsError saying what to install."""
    global _drew_in
    if _drew_in not in (None, os.getpid()):
        raise GraphicsError(
            f"process {os.getpid()} was forked from process {_drew_in}, which has drawn pictures:"
            " OpenGL would hang here; start the child with `spawn`, or draw in the parent only"
        )
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    name = wanted or _usual()
    if name not in ("egl", "osmesa", "glfw", "cgl"):
        raise GraphicsError(f"MUJOCO_GL is {wanted!r}; legal values are egl, osmesa, glfw, cgl")
    try:
        module = importlib.import_module(f"mujoco.{name}")
        context = module.GLContext(width, height)
    # PyOpenGL raises AttributeError for a library that is not there, and errors of its own.
    except Exception as error:
        packages = LINUX_GL.get(name, ("", ""))[1]
        raise GraphicsError(
            f"cannot draw pictures with MUJOCO_GL={name}: {error}. " + _advice(packages)
        ) from error
    _drew_in = os.getpid()
    return name, context


def _usual() -> str:
    """The first off-screen OpenGL that this machine has."""
    if platform.system() == "Darwin":
        return "cgl"
    if platform.system() != "Linux":
        return "glfw"
    for name, (library, _) in LINUX_GL.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return name
    libraries = " and no ".join(library for library, _ in LINUX_GL.values())
    raise GraphicsError(f"this machine has no {libraries}. " + _advice(LINUX_GL["egl"][1]))


def _advice(packages: str) -> str:
    install = f"On Debian or Ubuntu: sudo apt-get install -y {packages}. " if packages else ""
    return f"{install}`rodif doctor` checks it; only films and tasks with cameras need OpenGL"
