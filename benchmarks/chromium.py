"""Headless Chromium by its DevTools protocol, for tests and benchmarks: a page, its pictures, mouse, touch and keys."""

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
DEADLINE_S = 30.0
FLAGS = (
    "--headless=new", "--remote-debugging-port=0", "--disable-gpu", "--no-first-run", "--disable-extensions",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--mute-audio",
)  # fmt: skip
KEY_CODES = {" ": 32, "Enter": 13, "Tab": 9, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
NAVIGATED = "Inspected target navigated or closed"  # of the protocol's error
Found = TypeVar("Found")
Point = Sequence[float]


def find() -> str | None:
    """Find the path of Chromium; None where it is not installed."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class NavigatedError(AssertionError):
    """The page was left before it had answered."""


class Browser:
    """One tab of a browser of its own; a context manager.

    Args:
        folder: for its profile.

    Attributes:
        events: events of the protocol so far.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._open = folder, contextlib.ExitStack()
        self._numbers = itertools.count(1)
        self._session: str | None = None
        self.events: list[dict[str, Any]] = []

    def __enter__(self) -> "Browser":
        """Start the browser."""
        with self._open:
            self._start(self._folder)
            self._open = self._open.pop_all()
        return self

    def _start(self, folder: Path) -> None:
        root = ["--no-sandbox"] if os.geteuid() == 0 else []
        command = [str(find()), *FLAGS, *root, f"--user-data-dir={folder / 'profile'}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._open.callback(self._end)
        port_file = folder / "profile" / "DevToolsActivePort"
        until(port_file.exists)
        until(lambda: len(port_file.read_text().split()) == 2)
        number, path = port_file.read_text().split()
        self._socket = self._open.enter_context(connect(f"ws://127.0.0.1:{number}{path}", max_size=None))
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def __exit__(self, *_: object) -> None:
        """End the browser."""
        self._open.close()

    def _end(self) -> None:
        self._process.terminate()
        self._process.wait(DEADLINE_S)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol; events that come meanwhile are kept."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": params}
        self._socket.send(json.dumps(message | ({"sessionId": self._session} if self._session else {})))
        while True:
            answer: dict[str, Any] = json.loads(self._socket.recv(DEADLINE_S))
            if answer.get("id") == number:
                if NAVIGATED in str(answer.get("error")):
                    raise NavigatedError(answer)
                assert "error" not in answer, answer
                result: dict[str, Any] = answer["result"]
                return result
            self.events.append(answer)

    def open(self, address: str) -> None:
        """Open an address."""
        self.call("Page.navigate", url=address)

    def js(self, text: str) -> Any:
        """Return the value of an expression."""
        answer = self.call("Runtime.evaluate", expression=text, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self, name: str) -> str:
        """Return the text of an element; empty where the page has none yet, or is left meanwhile."""
        try:
            found: str = self.js(f"document.getElementById('{name}')?.textContent ?? ''")
        except NavigatedError:
            return ""
        return found

    def center(self, name: str, at: Point = (0.5, 0.5)) -> Point:
        """Return the place of an element's point, by parts of its size."""
        place: Point = self.js(
            f"(() => {{ const e = document.getElementById('{name}'); "
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
            f"return [b.left + {at[0]} * b.width, b.top + {at[1]} * b.height]; }})()"
        )
        return place

    def mouse(self, kind: str, at: Point, **more: Any) -> None:
        """Let the mouse do something."""
        self.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **more)

    def click(self, name: str, at: Point = (0.5, 0.5)) -> None:
        """Click an element."""
        x_y = self.center(name, at)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x_y, button="left", clickCount=1)

    def key(self, key: str, *kinds: str, code: str | None = None, text: str | None = None, modifiers: int = 0) -> None:
        """Press and release a key, or only one of both; modifiers are Alt 1, Ctrl 2, Meta 4 and Shift 8."""
        for kind in kinds or ("keyDown", "keyUp"):
            more: dict[str, Any] = {"text": text} if text and kind == "keyDown" else {}
            more |= {"code": code or key, "windowsVirtualKeyCode": KEY_CODES.get(key, ord(key[0].upper()))}
            self.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers, **more)

    def touch(self, kind: str, *points: Point) -> None:
        """Touch the screen."""
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])

    def picture(self, path: Path) -> None:
        """Write what is shown as a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def size(self, width: int, height: int, *, scale: float = 1, mobile: bool = False) -> None:
        """Set the size of the window [px]."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=mobile
        )

    def prefers(self, **features: str) -> None:
        """Set media features, such as prefers_color_scheme="dark"."""
        table = [{"name": name.replace("_", "-"), "value": value} for name, value in features.items()]
        self.call("Emulation.setEmulatedMedia", features=table)


def until(there: Callable[[], Found], seconds: float = DEADLINE_S) -> Found:
    """Wait until something is so, and return it."""
    end = time.monotonic() + seconds
    while True:
        found = there()
        if found:
            return found
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.02)
