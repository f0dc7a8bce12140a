"""What figures depend on beside the code."""

import os
import platform
from importlib.metadata import version

import cv2

import cotarget
from cotarget.errors import CotargetError

PACKAGES = ("numpy", "scipy", "mujoco", "matplotlib", "gymnasium", "av")
# An environment variable: who draws, as a process is told by the one that starts it; to ask takes half a second.
OPENGL = "COTARGET_OPENGL"


def versions() -> dict[str, str]:
    """Of what the figures depend on; of OpenGL who draws too, nothing where nobody does."""
    if OPENGL not in os.environ:
        try:
            from cotarget.sim.render.opengl import renderer_version

            os.environ[OPENGL] = renderer_version()
        except CotargetError:  # what needs no pictures is done all the same
            os.environ[OPENGL] = ""
    found = {"cotarget": cotarget.__version__, "python": platform.python_version(), "opencv": cv2.__version__}
    return found | {name: version(name) for name in PACKAGES} | {"opengl": os.environ[OPENGL]}
