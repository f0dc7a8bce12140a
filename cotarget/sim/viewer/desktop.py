"""View of a simulated world in MuJoCo's desktop viewer, on a machine with a display."""

import os
import sys
import warnings

import cv2
import numpy as np

from cotarget.errors import DeviceError
from cotarget.rig import Image
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.truth import Truth
from cotarget.sim.viewer.scene import Snapshot, WorldCopy, line_geoms

OTHERWISE = "--browser shows the scene in a web browser instead"
PICTURE_SHARE = 0.3  # width of each camera's picture over the window's
MARGIN_PX = 8


class DesktopWindow:
    """MuJoCo's passive viewer, with the frusta in the scene and the pictures of both cameras at the right."""

    def __init__(self, truth: Truth) -> None:
        """Open the window; call `check_display` before the world is made.

        Args:
            truth: ground truth of the world that is shown.

        Raises:
            DeviceError: the viewer does not open.
        """
        import mujoco.viewer  # needs GLFW

        self._copy = WorldCopy(truth)
        try:
            self._handle = mujoco.viewer.launch_passive(
                self._copy.model, self._copy.data, show_left_ui=False, show_right_ui=False
            )
        except RuntimeError as error:  # on macOS the viewer needs its own launcher
            raise DeviceError(f"the viewer does not open: {error}; {OTHERWISE}") from None
        with self._handle.lock():
            self._copy.aim(self._handle.cam, self._handle.opt)

    where = "the viewer's window"

    def is_open(self) -> bool:
        """Check that the window is open."""
        return bool(self._handle.is_running())

    def show(self, sight: Snapshot) -> None:
        """Show a snapshot."""
        handle = self._handle
        with handle.lock():
            self._copy.move_to(sight.t)
            handle.user_scn.ngeom = line_geoms(sight, iter(handle.user_scn.geoms))
        handle.set_texts((None, None, sight.caption, None))
        whole = handle.viewport
        if whole is not None and whole.width > 0:
            handle.set_images(placed_pictures(list(sight.pictures.values()), whole.width, whole.height))
        handle.sync()

    def close(self) -> None:
        """Close the window; safe to call more than once."""
        self._handle.close()


def placed_pictures(pictures: list[Image], width: int, height: int) -> "list[tuple[mujoco.MjrRect, Image]]":
    """Place pictures in RGB one below the other at a window's right, scaled to fit."""
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
    """Refuse a machine on which the viewer would wait for ever; call it before anything is rendered.

    A GLFW window that is opened and closed later leaves Mesa with a context that no thread can use.

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
        warnings.simplefilter("ignore")  # GLFW's errors are raised as warnings; its return values report them too
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
