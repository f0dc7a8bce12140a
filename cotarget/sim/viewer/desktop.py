"""A world in MuJoCo's own viewer, on a machine with a display."""

import os
import sys
import warnings

import cv2
import numpy as np

from cotarget.errors import DeviceError
from cotarget.rig import Image
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.truth import Truth
from cotarget.sim.viewer.scene import Onlooker, Snapshot, line_geoms

OTHERWISE = "--browser shows the scene in a web browser instead"
PICTURE_SHARE = 0.3  # of the window's width, for each camera's picture
MARGIN_PX = 8


class DesktopWindow:
    """MuJoCo's passive viewer, with the frusta in the scene and both cameras' pictures at the window's right."""

    def __init__(self, truth: Truth) -> None:
        """Open the window; `check_display` has been asked before the world was made.

        Args:
            truth: of the world that is shown.

        Raises:
            DeviceError: the viewer does not open.
        """
        import mujoco.viewer  # which needs GLFW

        self._onlooker = Onlooker(truth)
        try:
            self._handle = mujoco.viewer.launch_passive(
                self._onlooker.model, self._onlooker.data, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:  # macOS asks for its own launcher
            raise DeviceError(f"the viewer does not open: {error}; {OTHERWISE}") from None
        with self._handle.lock():
            self._onlooker.aim(self._handle.cam, self._handle.opt)

    where = "the viewer's window"

    def is_open(self) -> bool:
        """Whether nobody has closed it."""
        return bool(self._handle.is_running())

    def show(self, sight: Snapshot) -> None:
        """Show a moment."""
        handle = self._handle
        with handle.lock():
            self._onlooker.come_to(sight.t)
            handle.user_scn.ngeom = line_geoms(sight, iter(handle.user_scn.geoms))
        handle.set_texts((None, None, sight.caption, None))
        whole = handle.viewport
        if whole is not None and whole.width > 0:
            handle.set_images(_placed(list(sight.pictures.values()), whole.width, whole.height))
        handle.sync()

    def close(self) -> None:
        """Close the window; more than once does no harm."""
        self._handle.close()


def _placed(pictures: list[Image], width: int, height: int) -> "list[tuple[mujoco.MjrRect, Image]]":
    """Pictures in RGB, one above the other at a window's right, as far as they fit."""
    placed, top = [], height - MARGIN_PX
    for picture in pictures:
        high, wide = picture.shape[:2]
        scale = min(PICTURE_SHARE * width / wide, (height / len(pictures) - 2 * MARGIN_PX) / high)
        size = max(int(scale * wide), 1), max(int(scale * high), 1)
        small = cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB)
        top -= size[1]
        placed.append((mujoco.MjrRect(width - MARGIN_PX - size[0], top, *size), np.asarray(small, np.uint8)))
        top -= MARGIN_PX
    return placed


def check_display() -> None:
    """Refuse a machine on which the viewer would wait for ever; to be asked before anything is rendered.

    A window of GLFW's that is opened and closed after that leaves Mesa with a context that no thread can take.

    Raises:
        DeviceError: there is no display, or it has no OpenGL.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise DeviceError(f"this machine has no display; {OTHERWISE}")
    try:
        import glfw
    except ImportError as error:
        raise DeviceError(f"the viewer needs GLFW: {error}; {OTHERWISE}") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW's errors come as such; it also says by its answers that it failed
        if not glfw.init():
            raise DeviceError(f"the display cannot be used: {_glfw_error(glfw)}; {OTHERWISE}")
        glfw.window_hint(glfw.VISIBLE, False)
        window = glfw.create_window(64, 64, "", None, None)
        glfw.default_window_hints()
        if not window:
            raise DeviceError(f"the display has no OpenGL: {_glfw_error(glfw)}; {OTHERWISE}")
        glfw.destroy_window(window)


def _glfw_error(glfw: object) -> str:
    said = glfw.get_error()[1]  # type: ignore[attr-defined]
    return said.decode() if isinstance(said, bytes) else str(said or "GLFW does not say why")
