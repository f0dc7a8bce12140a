"""Headless Chromium, driven by its DevTools protocol: a page, its pictures, mouse, touch and keys."""

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import time
from pathlib import Path

from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome")
DEADLINE_S = 30.0
FLAGS = (
    "--headless=new", "--remote-debugging-port=0", "--disable-gpu", "--no-first-run", "--disable-extensions",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--mute-audio",
)  # fmt: skip


def find():
    """The path of Chromium; None where it is not installed."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One tab of a browser of its own; a context manager."""

    def __init__(self, folder: Path):
        self._folder, self._open = folder, contextlib.ExitStack()
        self._numbers, self.events, self._session = itertools.count(1), [], None

    def __enter__(self):
        with self._open:
            self._start(self._folder)
            self._open = self._open.pop_all()
        return self

    def _start(self, folder):
        root = ["--no-sandbox"] if os.geteuid() == 0 else []
        command = [find(), *FLAGS, *root, f"--user-data-dir={folder / 'profile'}", "about:blank"]
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

    def __exit__(self, *_):
        self._open.close()

    def _end(self):
        self._process.terminate()
        self._process.wait(DEADLINE_S)

    def call(self, method, **params):
        """Call a method of the protocol; events that come meanwhile are kept."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": params}
        self._socket.send(json.dumps(message | ({"sessionId": self._session} if self._session else {})))
        while True:
            answer = json.loads(self._socket.recv(DEADLINE_S))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def open(self, address):
        self.call("Page.navigate", url=address)

    def js(self, text):
        """The value of an expression."""
        answer = self.call("Runtime.evaluate", expression=text, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self, name):
        """The text of an element; empty where the page has none yet."""
        return self.js(f"document.getElementById('{name}')?.textContent ?? ''")

    def center(self, name, at=(0.5, 0.5)):
        """The place of an element's point, by parts of its size."""
        return self.js(
            f"(() => {{ const e = document.getElementById('{name}'); "
            "e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
            f"return [b.left + {at[0]} * b.width, b.top + {at[1]} * b.height]; }})()"
        )

    def mouse(self, kind, at, **more):
        self.call("Input.dispatchMouseEvent", type=kind, x=at[0], y=at[1], **more)

    def click(self, name, at=(0.5, 0.5)):
        x_y = self.center(name, at)
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x_y, button="left", clickCount=1)

    def key(self, key, *kinds, code=None, text=None):
        """Press and release a key, or only one of both."""
        codes = {" ": 32, "Enter": 13, "Tab": 9, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}
        for kind in kinds or ("keyDown", "keyUp"):
            more = {"text": text} if text and kind == "keyDown" else {}
            number = codes.get(key, ord(key[0].upper()))
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, code=code or key, windowsVirtualKeyCode=number, **more
            )

    def touch(self, kind, *points):
        self.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])

    def picture(self, path: Path):
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def size(self, width, height, *, scale=1, mobile=False):
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=mobile
        )

    def prefers(self, **features):
        """Set media features, such as prefers_color_scheme="dark"."""
        table = [{"name": name.replace("_", "-"), "value": value} for name, value in features.items()]
        self.call("Emulation.setEmulatedMedia", features=table)


def until(there, seconds=DEADLINE_S):
    """Wait until something is so; what it is."""
    end = time.monotonic() + seconds
    while True:
        found = there()
        if found:
            return found
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.02)
