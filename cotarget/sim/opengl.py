"""MuJoCo with an offscreen OpenGL that works without a screen; import mujoco from here before anything renders."""

import ctypes.util
import os
import sys

from cotarget.errors import DeviceError

__all__ = ["BACKEND", "make_renderer", "mujoco"]

INSTALL = {
    "egl": "install it: apt-get install -y libegl1 libgl1-mesa-dri libgl1",
    "osmesa": "install it: apt-get install -y libosmesa6, or unset MUJOCO_GL",
}
OTHERWISE = "unset MUJOCO_GL to render without a screen"


def choose_backend() -> str:
    """Set MUJOCO_GL, where the user has not, to the first offscreen backend whose library is on this machine.

    Must run before mujoco is imported, because it reads the variable then.
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


def make_renderer(model: "mujoco.MjModel", width: int, height: int) -> "mujoco.Renderer":
    """Open an offscreen renderer on this thread.

    Raises:
        DeviceError: the machine has no OpenGL that can do it.
    """
    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # PyOpenGL and the backends raise whatever they meet
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DeviceError(
            f"OpenGL ({BACKEND}) cannot render without a screen: {reason}; {INSTALL.get(BACKEND, OTHERWISE)}"
        ) from None
