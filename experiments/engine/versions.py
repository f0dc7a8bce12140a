"""Versions of the software that figures depend on, besides the code."""

import os
import platform
from importlib.metadata import version

import cv2

import cotarget
from cotarget.errors import CotargetError

PACKAGES = ("numpy", "scipy", "mujoco", "matplotlib", "gymnasium", "av")
# Environment variable with the OpenGL renderer, which a child process inherits; finding it takes half a second.
OPENGL = "COTARGET_OPENGL"


def versions() -> dict[str, str]:
    """Give the versions of Python, the libraries and OpenGL's renderer; the latter is empty without OpenGL."""
    if OPENGL not in os.environ:
        try:
            from cotarget.sim.render.opengl import renderer_version

            os.environ[OPENGL] = renderer_version()
        except CotargetError:  # experiments without pictures run without OpenGL
            os.environ[OPENGL] = ""
    found = {"cotarget": cotarget.__version__, "python": platform.python_version(), "opencv": cv2.__version__}
    return found | {name: version(name) for name in PACKAGES} | {"opengl": os.environ[OPENGL]}
