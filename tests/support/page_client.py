"""A page's server with a session that only notes what it is asked, and browsers that are sockets."""

import contextlib
import json
import socket
import struct
import time
from types import SimpleNamespace

import numpy as np
from websockets.sync.client import connect

from cotarget.config import RigConfig
from cotarget.errors import ConfigError
from cotarget.operate.session import ControlError
from cotarget.page.server import LOOPBACK, Page, listen
from cotarget.pipeline import State, Step
from cotarget.rig import Frame, PanTiltState, ZoomState
from cotarget.sim.devices import rig_spec

DEADLINE_S = 10.0
SPEC = rig_spec(RigConfig())


class NotingSession:
    """Notes every order; refuses those of whoever has not control."""

    def __init__(self):
        self.control, self.stopped, self.noted = None, None, []
        self.recording = self.notice = ""
        self.left_alone = lambda: self.noted.append(("left alone",))

    def _note(self, what, *args, by):
        if by != self.control:
            raise ControlError("take control first")
        self.noted.append((what, *args))

    def follow(self, head, target=None, *, by):
        if isinstance(target, tuple) and target[0] > 639.5:
            raise ConfigError("this place is not in the fixed camera's picture")
        self._note("follow", head, target, by=by)

    def stand(self, head, *, by):
        self._note("stand", head, by=by)

    def home(self, head, *, by):
        self._note("home", head, by=by)

    def manual(self, head, rates, *, by):
        self._note("manual", head, rates, by=by)

    def zoom(self, head, factor, *, by):
        self._note("zoom", head, factor, by=by)

    def record(self, on, *, by):
        self._note("record", on, by=by)

    def clear(self, *, by):
        self._note("clear", by=by)

    def stop(self, reason):
        self.stopped = reason
        self.noted.append(("stop", reason))

    def take(self, who):
        self.control = who

    def leave(self, who):
        if self.control == who:
            self.control = None
            self.noted.append(("leave", who))


def step(index=0, **more):
    """A step without a target, whose pictures are as bright as its number."""
    image = np.full((480, 640, 3), index % 250, np.uint8)
    frame = Frame(image, index / 25)
    table = {"reason": "", "state": State.STANDING, "estimate": None, "tracks": (), "target": None, "aim": None} | more
    return Step(
        index=index, t=index / 25 + 0.06, fixed=frame, zoom=frame, mask=None, detections=(),
        commanded=(0.0, 0.0, 700.0), head=PanTiltState(0.1, 0.0, False, 0.0), lens=ZoomState(700.0, False, 0.0),
        **table,
    )  # fmt: skip


@contextlib.contextmanager
def served(session=None):
    """A page on any free port: session, page and port."""
    listener = listen(LOOPBACK, 0)
    session = session or NotingSession()
    with Page(session, listener) as page:
        yield SimpleNamespace(session=session, page=page, port=listener.getsockname()[1])


@contextlib.contextmanager
def browser(at, token=None, who="a", hello=True):
    """A socket that has said hello."""
    origin = f"http://{LOOPBACK}:{at.port}"
    address, end_s = f"ws://{LOOPBACK}:{at.port}/socket", 0.5  # one that reads nothing does not end by itself
    with connect(address, origin=origin, compression=None, max_size=None, close_timeout=end_s) as socket:
        if hello:
            say(socket, do="hello", token=token or at.page.token, who=who)
        yield socket


def say(socket, **message):
    socket.send(json.dumps(message))


def status(socket, there=lambda message: True):
    """The next status of which something is so."""
    end = time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        data = socket.recv(DEADLINE_S)
        if isinstance(data, str) and "tick" in (message := json.loads(data)) and there(message):
            return message
    raise AssertionError("no such status came")


def sentence(socket):
    """The next sentence that the server says."""
    while True:
        data = socket.recv(DEADLINE_S)
        if isinstance(data, str) and "say" in (message := json.loads(data)):
            return message["say"]


def picture(socket, seconds=DEADLINE_S):
    """The next picture: its table and its JPEGs; None if none comes."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        try:
            data = socket.recv(left)
        except TimeoutError:
            break
        if isinstance(data, bytes):
            size = struct.unpack(">I", data[:4])[0]
            table, at, jpegs = json.loads(data[4 : 4 + size]), 4 + size, {}
            for name, camera in table["cameras"].items():
                jpegs[name] = data[at : at + camera["bytes"]]
                at += camera["bytes"]
            assert at == len(data)
            return table, jpegs
    return None


def until(there, seconds=DEADLINE_S):
    end = time.monotonic() + seconds
    while not there():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.01)


def ask(at, *lines):
    """The whole answer to a raw request."""
    with socket.create_connection((LOOPBACK, at.port), DEADLINE_S) as raw:
        raw.sendall("".join(f"{line}\r\n" for line in (*lines, "")).encode())
        raw.settimeout(DEADLINE_S)
        data = b""
        with contextlib.suppress(TimeoutError, ConnectionResetError):
            while part := raw.recv(65536):
                data += part
                if data.startswith(b"HTTP/1.1 101"):
                    break
    return data.decode("utf-8", "replace")


UPGRADE = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==",
           "Sec-WebSocket-Version: 13")  # fmt: skip
