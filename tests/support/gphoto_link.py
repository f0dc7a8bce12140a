"""A camera that fails on command, in place of libgphoto2 under the driver of the zoom camera."""

import math
import threading

import cv2
import numpy as np

from cotarget.drivers.gphoto import LinkError, Setting
from cotarget.drivers.gphoto_camera import GphotoSettings
from tests.support.simulated_clock import SimClock

SIZE, STILL_SIZE = (32, 24), (64, 48)
CONFIG = GphotoSettings(port="usb:", size=SIZE, still_size=STILL_SIZE, latency_s=0.1)
PITCH_MM = 0.01794  # the driver's default
PERIOD = 1 / 10  # of the viewfinder [s]
CALL_S = 0.002  # that a call takes [s]


def jpeg(size, grey):
    return cv2.imencode(".jpg", np.full((size[1], size[0], 3), grey, np.uint8))[1].tobytes()


class FakeLink:
    """A link to a camera with a lens from 0 to 134 that shows only when it shoots, as PowerShots do.

    ``fail`` holds, by call, results to fail with: one after the other, and the last one for ever if it is a list's
    Ellipsis. ``take`` is what a call takes [s], ``ignore`` lets commands to the lens have no effect.
    """

    def __init__(self, clock):
        self.clock, self.log, self.fail, self.take = clock, [], {}, {}
        self.connected, self.ignore, self.frozen, self.threads = False, 0, None, set()
        self.choices = {"iso": ("Auto", "80", "100"), "capturetarget": ("Internal RAM", "Memory card")}
        self.values = {"capture": 0.0, "zoom": 0.0, "iso": "Auto", "capturetarget": "Memory card", "owner": "nobody"}
        self.values["datetime"] = 1e9
        self.readonly, self.hidden = set(), {"zoom", "iso"}
        self.range = (0.0, 134.0, 1.0)
        self.preview_size, self.still_size, self.still = SIZE, STILL_SIZE, None

    def _do(self, name, *what):
        self.threads.add(threading.get_ident())
        self.log.append((name, *what))
        if isinstance(self.clock, SimClock):
            self.clock.t += self.take.get(name, CALL_S)
        if queue := self.fail.get(name):
            code = queue[0]
            if queue[1:] != [...]:
                queue.pop(0)
            if code is not None:
                raise LinkError(code, "what gphoto2 calls it")
        assert self.connected or name in ("open", "close"), f"{name} without a connection"

    def open(self):
        self._do("open")
        self.connected = True
        return "Fake S5"

    def close(self):
        self._do("close")
        self.connected = False

    def names(self):
        shooting = self.values.get("capture", 1.0)
        return [name for name in self.values if shooting or name not in self.hidden]

    def get(self, name):
        self._do("get", name)
        value, readonly = self.values[name], name in self.readonly
        if name in self.choices:
            return Setting("choice", value, choices=self.choices[name], readonly=readonly)
        if name == "zoom":
            return Setting("range", value, *self.range, readonly=readonly)
        if name == "datetime":  # the camera's clock goes on
            return Setting("date", value + 1.0, readonly=readonly)
        if name == "capture":
            return Setting("switch", value, choices=("0", "1"), readonly=readonly)
        return Setting("text", value, readonly=readonly)

    def put(self, name, value):
        self._do("put", name, value)
        if name == "zoom" and self.ignore:
            self.ignore -= 1
            return
        self.values[name] = float(value) if name == "datetime" else value

    def preview(self):
        self._do("preview")
        index = math.floor(self.clock.now() / PERIOD)
        return jpeg(self.preview_size, 10 + index % 200) if self.frozen is None else self.frozen

    def shoot(self):
        self._do("shoot")
        return "/", "capt0000.jpg"

    def fetch(self, still):
        self._do("fetch", *still)
        return jpeg(self.still_size, 200) if self.still is None else self.still

    def commands(self, name):
        return [entry[2] for entry in self.log if entry[:2] == ("put", name)]
