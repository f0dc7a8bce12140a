"""MuJoCo with an offscreen OpenGL backend that needs no screen.

Import ``mujoco`` from this module before anything renders: it sets MUJOCO_GL, which mujoco reads when it is imported.
"""

import atexit
import ctypes.util
import os
import sys
import threading
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cotarget.errors import DeviceError
from cotarget.geometry import Array
from cotarget.rig import Image

__all__ = ["BACKEND", "TALLY", "Canvas", "make_renderer", "mujoco"]
INSTALL = {
    "egl": "install it: apt-get install -y libegl1 libgl1-mesa-dri libgl1",
    "osmesa": "install it: apt-get install -y libosmesa6, or unset MUJOCO_GL",
}
OTHERWISE = "unset MUJOCO_GL to render without a screen"
KEPT = 2  # renderers that a thread keeps after they were closed: an environment may have pictures of two sizes
# Environment variable: a file that grows by one byte with each picture drawn, in any process. It also counts the
# pictures of processes that are killed.
TALLY = "COTARGET_TALLY"


def choose_backend() -> str:
    """Set MUJOCO_GL, unless the user has, to the first offscreen backend whose library is installed.

    Must run before mujoco is imported, because mujoco reads the variable then.
    """
    chosen = os.environ.get("MUJOCO_GL", "")
    if not chosen and sys.platform == "linux":
        chosen = "osmesa" if not ctypes.util.find_library("EGL") and ctypes.util.find_library("OSMesa") else "egl"
        os.environ["MUJOCO_GL"] = chosen
    return chosen


BACKEND = choose_backend()
try:
    import mujoco
except RuntimeError as error:
    raise DeviceError(f"MUJOCO_GL={BACKEND}: {error}; unset MUJOCO_GL, or set it to egl, osmesa or glfw") from None
except (ImportError, AttributeError, OSError) as error:
    raise DeviceError(
        f"no OpenGL library for rendering without a screen ({BACKEND}): {error}; {INSTALL.get(BACKEND, OTHERWISE)}"
    ) from None

# What mujoco renders with: by the variable's value when mujoco was imported, which may have been before this module.
IN_USE = getattr(mujoco, "GLContext", str).__module__.rpartition(".")[2]


def make_renderer(model: "mujoco.MjModel", width: int, height: int) -> "mujoco.Renderer":
    """Open an offscreen renderer on this thread.

    Raises:
        DeviceError: the machine has no suitable OpenGL, mujoco was imported without MUJOCO_GL, or this process was
            forked from one that has rendered.
    """
    if IN_USE == "glfw" != BACKEND and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise DeviceError(
            "mujoco was imported before cotarget.sim and renders with GLFW, which needs a display; set "
            f"MUJOCO_GL={BACKEND} in the environment, or import cotarget.sim.world before mujoco"
        )
    if _first_process() != os.getpid() and BACKEND != "osmesa":  # it would wait for threads that a fork does not copy
        raise DeviceError(
            "a process that was forked after something was rendered cannot render; start it with the method 'spawn', "
            "as AsyncVectorEnv(..., context='spawn') does"
        )
    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # PyOpenGL and the backends raise whatever they meet
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        if "ramebuffer" in reason:
            raise DeviceError(
                f"OpenGL ({BACKEND}) renders no picture of {width}x{height}: {reason}; give the cameras a smaller size"
            ) from None
        raise DeviceError(
            f"OpenGL ({BACKEND}) cannot render without a screen: {reason}; {INSTALL.get(BACKEND, OTHERWISE)}"
        ) from None


@cache
def _first_process() -> int:
    """Give the id of the first process that opens OpenGL; a forked process inherits the value."""
    return os.getpid()


class _Kept(threading.local):
    """Closed renderers of a thread, the newest last; to open OpenGL with all textures takes a fifth of a second."""

    def __init__(self) -> None:
        self._renderers: list[tuple[tuple[object, ...], Any]] = []

    def add(self, renderer: Any, uploaded: tuple[object, ...]) -> None:
        """Keep a renderer, which has uploaded these parts of its model; the oldest is closed if there are too many."""
        self._renderers.append((uploaded, renderer))
        if len(self._renderers) > KEPT:
            self._renderers.pop(0)[1].close()

    def take(self, model: "mujoco.MjModel", uploaded: tuple[object, ...]) -> Any:
        """Take a renderer out whose model differs in mesh vertices at most, and turn it to this one; None without."""
        if _first_process() != os.getpid():
            return None
        for each in self._renderers:
            parts, renderer = each
            if parts == uploaded and np.array_equal(renderer._model.tex_data, model.tex_data):
                self._renderers.remove(each)
                renderer._model = model
                _make_current(renderer)
                for mesh in range(model.nmesh):
                    mujoco.mjr_uploadMesh(model, renderer._mjr_context, mesh)
                return renderer
        return None

    def close(self) -> None:
        """Close all."""
        while self._renderers:
            self._renderers.pop()[1].close()


_kept = _Kept()
atexit.register(_kept.close)


class Canvas:
    """Offscreen renderer that draws a pinhole view, or a part of one, of any size up to its own.

    Attributes:
        drawn: number of pictures that all canvases of this process have drawn; a part of a picture counts as that part.
        samples: number of samples a pixel; 0 without multisampling.
    """

    drawn: ClassVar[float] = 0.0

    def __init__(self, model: "mujoco.MjModel", size: tuple[int, int], shadows: bool) -> None:
        """Open OpenGL on this thread, or go on with what a closed canvas had opened for a model that looks the same.

        Args:
            model: compiled model to draw.
            size: (width, height) of the largest picture [px].
            shadows: whether lights cast shadows.

        Raises:
            DeviceError: the machine has no suitable OpenGL.
        """
        self._thread = threading.get_ident()
        self._uploaded = (size, *_uploaded_parts(model))
        self._renderer: Any = _kept.take(model, self._uploaded) or make_renderer(model, *size)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._option = mujoco.MjvOption()
        self._option.sitegroup[:], self._option.geomgroup[1:] = 0, 0
        context = self._renderer._mjr_context
        self.samples = context.offSamples
        # MuJoCo resolves samples into a second buffer, which has one sample a pixel.
        self._buffers = {True: context.offFBO, False: context.offFBO_r if self.samples else context.offFBO}
        self._pixels = np.empty(3 * context.offWidth * context.offHeight, dtype=np.uint8)

    def look(self, data: "mujoco.MjData", camera_id: int) -> None:
        """Load the geoms of group 0 in their current poses, from the camera of the model with this id."""
        self._renderer.update_scene(data, camera_id, self._option)

    def draw(
        self,
        eye: Array,
        axes: Array,
        tangents: tuple[float, float, float, float],
        size: tuple[int, int],
        part: float = 1.0,
        multisampled: bool = True,
    ) -> Image:
        """Draw the scene, RGB; the next call overwrites the picture.

        Args:
            eye: optical centre in the world [m], (3,).
            axes: world coordinates of right, down and forward as columns, (3, 3).
            tangents: tangents of the picture's borders: left, right, bottom, top; right and up are positive.
            size: (width, height) [px].
            part: fraction of a picture that it counts as in `drawn`.
            multisampled: whether the picture is antialiased, if the model is to be.
        """
        renderer, (left, right, bottom, top) = self._renderer, tangents
        for camera in renderer.scene.camera:  # MuJoCo keeps two for stereo; both get the same pose
            near = camera.frustum_near
            camera.pos, camera.forward, camera.up = eye, axes[:, 2], -axes[:, 1]
            camera.frustum_center, camera.frustum_width = near * (left + right) / 2, near * (right - left) / 2
            camera.frustum_bottom, camera.frustum_top = near * bottom, near * top
        rect = mujoco.MjrRect(0, 0, *size)
        image = self._pixels[: 3 * size[0] * size[1]].reshape(size[1], size[0], 3)
        # mujoco.Renderer draws whole pictures of its own size only.
        _make_current(renderer)
        context = renderer._mjr_context
        context.offFBO, context.offSamples = self._buffers[multisampled], self.samples * multisampled
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        mujoco.mjr_render(rect, renderer.scene, context)
        mujoco.mjr_readPixels(image, None, rect, context)
        before = int(Canvas.drawn)
        Canvas.drawn += part
        if (tally := os.environ.get(TALLY)) and (more := int(Canvas.drawn) - before):
            with Path(tally).open("ab", buffering=0) as file:
                file.write(b"." * more)
        return image[::-1]  # OpenGL's rows begin at the bottom

    def close(self) -> None:
        """Release OpenGL, or keep it for this thread's next canvas; safe to call more than once."""
        renderer, self._renderer = self._renderer, None
        if renderer is None:
            return
        if threading.get_ident() != self._thread:
            renderer.close()
            return
        context = renderer._mjr_context
        context.offFBO, context.offSamples = self._buffers[True], self.samples
        _kept.add(renderer, self._uploaded)


def _make_current(renderer: Any) -> None:
    if renderer._gl_context:
        renderer._gl_context.make_current()


def _uploaded_parts(model: "mujoco.MjModel") -> tuple[object, ...]:
    """List what is uploaded to OpenGL once for a model, except textures and mesh vertices."""
    visual, planes = model.vis, model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    return (
        *(model.ntex, model.nmesh, model.nhfield, model.nskin, model.stat.extent),
        *(visual.global_.offwidth, visual.global_.offheight, visual.quality.offsamples, visual.quality.shadowsize),
        *(model.geom_size[planes].tobytes(), model.mesh_vertnum.tobytes(), model.mesh_face.tobytes()),
    )
