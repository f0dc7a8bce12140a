"""View of a simulated world in a web browser, by MuJoCo's web viewer (its manual: studio/web_viewers).

The browser renders the scene; it receives the model, then the state and the cameras' pictures. MuJoCo's viewer listens
on all network interfaces, without access control. Here it gets a socket that only this machine reaches.
"""

import contextlib
import io
import logging
import queue
import socket
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np

from cotarget.errors import DeviceError, pip_install
from cotarget.sim.render.opengl import mujoco
from cotarget.sim.truth import Truth
from cotarget.sim.viewer.scene import Snapshot, WorldCopy, line_geoms

try:
    from mujoco.studio import launch_thread, messages, viewer_protocol, web_viewer
    from mujoco.studio.dear_imgui import dear_imgui as imgui
    from mujoco.studio.web import web_server
except ImportError as error:
    raise DeviceError(
        f"the installed MuJoCo {mujoco.__version__} has no web viewer ({error}): {pip_install('-U', 'mujoco')}"
    ) from None


HOST = "127.0.0.1"
TITLE = "cotarget"
START_S = 20.0  # timeout of the viewer's start [s]
PICTURE_PX = 400  # width of a camera's picture on the page
MARGIN_PX = 12
TITLE_PX = 30  # height of a window's title bar
AFTER_ALL = messages.Priority.INTERNAL - 1  # priority of a handler that runs after the viewer's own
NAMES = {"fixed": "fixed camera", "zoom": "zoom camera"}


class BrowserWindow:
    """MuJoCo's web viewer, with the frusta in the scene and the pictures of both cameras in separate windows."""

    def __init__(self, truth: Truth, listener: socket.socket) -> None:
        """Start serving the page.

        Args:
            truth: ground truth of the world that is shown.
            listener: socket to serve on; closed with the window.

        Raises:
            DeviceError: the viewer does not start.
        """
        logging.getLogger("WebServer").setLevel(logging.WARNING)  # connections are not logged
        self.where = f"http://{HOST}:{listener.getsockname()[1]}/"
        self._copy = WorldCopy(truth)
        self._overlay = Overlay(self._copy.aim)
        started: queue.Queue[Exception | None] = queue.Queue()

        def serve(endpoint: Any) -> None:
            try:
                viewer = self._viewer(endpoint, listener)
            except Exception as error:
                listener.close()
                started.put(error)
                return
            started.put(None)
            viewer_protocol.run_viewer_loop(viewer)

        with contextlib.redirect_stdout(io.StringIO()):  # hide the viewer's banner; the command prints the address
            self._handle = launch_thread.launch_thread(serve)
            try:
                if (failed := started.get(timeout=START_S)) is not None:
                    raise DeviceError(f"MuJoCo's web viewer does not start: {failed}")
                self._handle.set_model(self._copy.model, data=self._copy.data)
                self._overlay.ready.get(timeout=START_S)
            except BaseException as error:
                with contextlib.suppress(Exception):  # the first error is the one to report
                    self.close()
                listener.close()
                if isinstance(error, queue.Empty):
                    raise DeviceError(f"MuJoCo's web viewer does not start within {START_S:g} s; try again") from None
                raise

    def _viewer(self, endpoint: Any, listener: socket.socket) -> Any:
        """Open MuJoCo's web viewer on our socket; called on the viewer's thread."""
        config = viewer_protocol.ViewerConfig(title=TITLE, gfx="web")
        with _bound_to(listener):
            viewer = web_viewer.WebViewer(config, endpoint, plugins=[self._overlay])
        if viewer._http_sock is not listener:  # another version of the viewer may have opened a public socket
            viewer.close()
            raise DeviceError(f"that of MuJoCo {mujoco.__version__} cannot be kept to this machine")
        self._overlay.viewer = viewer
        return viewer

    def is_open(self) -> bool:
        """Check that the page is served."""
        return bool(self._handle.is_running())

    def show(self, sight: Snapshot) -> None:
        """Show a snapshot."""
        self._copy.move_to(sight.t)
        self._overlay.sight = sight
        self._handle.sync()

    def close(self) -> None:
        """Stop serving the page; safe to call more than once."""
        self._handle.close()


class Overlay:
    """Lines in MuJoCo's scene and windows with pictures, drawn on the viewer's thread.

    Attributes:
        sight: snapshot to show; any thread may set it.
        viewer: MuJoCo's viewer, once it is open.
        ready: gets an item when the viewer has loaded the model.
    """

    def __init__(self, aim: Callable[[Any, Any], None]) -> None:
        """Prepare an overlay without a snapshot.

        Args:
            aim: sets the first view of a camera, and which geoms are shown.
        """
        self.sight: Snapshot | None = None
        self.viewer: Any = None
        self.ready: queue.Queue[None] = queue.Queue()
        self._aim = aim
        self._uploaded: Snapshot | None = None
        self._textures: dict[str, tuple[int, int, int]] = {}

    @messages.handler(priority=AFTER_ALL)  # type: ignore[untyped-decorator]
    def on_model(self, _: messages.PostModelEvent) -> None:
        """Set the first view of a new model."""
        self._aim(self.viewer.camera, self.viewer.vis_options)
        self.ready.put(None)

    @messages.handler  # type: ignore[untyped-decorator]
    def on_update(self, _: messages.UpdateEvent) -> None:
        """Draw the frusta, and send new pictures."""
        sight = self.sight
        if sight is None:
            return
        self.viewer.extra_geoms[:] = [mujoco.MjvGeom() for _ in range(sum(map(len, sight.lines.values())))]
        line_geoms(sight, iter(self.viewer.extra_geoms))
        if sight is not self._uploaded:
            for name, picture in sight.pictures.items():
                self._upload(name, picture)
            self._uploaded = sight

    @messages.handler  # type: ignore[untyped-decorator]
    def on_gui(self, _: messages.BuildGuiEvent) -> None:
        """Lay out the pictures, one below the other."""
        top = float(MARGIN_PX)
        for name, (texture, width, height) in self._textures.items():
            imgui.SetNextWindowPos(imgui.Vec2(MARGIN_PX, top), imgui.Cond.FirstUseEver)
            imgui.Begin(NAMES[name], flags=imgui.WindowFlags.AlwaysAutoResize)
            imgui.Image(texture, imgui.Vec2(width, height))
            if name == "zoom" and self.sight is not None:
                imgui.TextUnformatted(self.sight.caption)
            imgui.End()
            top += height + TITLE_PX + MARGIN_PX

    def _upload(self, name: str, picture: Any) -> None:
        """Send a camera's picture to the browser."""
        high, wide = picture.shape[:2]
        size = PICTURE_PX, max(round(PICTURE_PX * high / wide), 1)
        small = cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGBA)
        texture = self._textures.get(name, (0,))[0]
        texture = self.viewer.upload_image(texture, np.ascontiguousarray(small).tobytes(), *size, 4)
        self._textures[name] = (texture, *size)


def listen(port: int) -> socket.socket:
    """Open a socket that only this machine reaches.

    Args:
        port: port number; 0 for any free one.

    Raises:
        DeviceError: the port is in use or not permitted.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
        listener.listen()  # listen now, before another program can take the port
    except OSError as error:
        listener.close()
        raise DeviceError(f"--port {port}: {error.strerror}; give another one, or 0 for any that is free") from None
    return listener


@contextlib.contextmanager
def _bound_to(listener: socket.socket) -> Iterator[None]:
    """Make MuJoCo's web viewer use our socket, for which it has no option."""
    own = web_server.bind_public_socket
    web_server.bind_public_socket = lambda *_: listener
    try:
        yield
    finally:
        web_server.bind_public_socket = own
