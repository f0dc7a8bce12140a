"""An emulated ONVIF dome with axes, a lens and pictures of its own behind it."""

import contextlib
import time
from types import SimpleNamespace

from cotarget.drivers.onvif import OnvifSettings
from cotarget.emulators.onvif import ONVIF_FAULTS, ONVIF_PROFILES, OnvifCamera, OnvifModel, OnvifServer
from cotarget.emulators.rtsp import RTSP_FAULTS, EncodedStream, Encoder, RtspServer
from cotarget.emulators.serve import Faults
from cotarget.emulators.world import EmulatedAxis
from cotarget.sim.motion import Axis
from tests.support.emulated_camera import Film, LensModel, plain
from tests.support.plants import FEED_SIZE, PASSWORD, USER

RATE_HZ, STEP_DEG = 25.0, 0.01
GROUP_S = 0.2  # a client that joins waits for a key frame
PAN_DEG, TILT_DEG, SPEED_DEG_S = (-150.0, 170.0), (-30.0, 90.0), 100.0


class Plant(EmulatedAxis):
    """An axis in steps of 0.01 degree, without delay."""

    def __init__(self):
        super().__init__(Axis(1e9, 1.0), SimpleNamespace(now=time.monotonic), 1.0, 0.0)

    def degrees(self):
        return self.position() * STEP_DEG


class OnvifUnit:
    """A dome behind SOAP and RTSP; a context manager.

    Attributes:
        pan: axis.
        tilt: axis.
        lens: the lens.
        faults: of the dome's protocol.
        settings: of the driver that connects to it.
    """

    def __init__(self, *profiles, login=True, host="127.0.0.1"):
        self.pan, self.tilt, self.lens = Plant(), Plant(), LensModel()
        self.faults = Faults((*ONVIF_PROFILES, *ONVIF_FAULTS))
        for profile in profiles:
            self.faults.set(profile)
        self._user = {"user": USER, "password": PASSWORD} if login else {}
        self._opened = contextlib.ExitStack()
        with contextlib.ExitStack() as opened:
            film = opened.enter_context(Film(lambda index: plain(FEED_SIZE, index % 200), 1 / RATE_HZ))
            stream, faults = EncodedStream(), Faults(RTSP_FAULTS)
            opened.enter_context(
                contextlib.closing(Encoder(film.feed, stream, RATE_HZ, group_s=GROUP_S, faults=faults))
            )
            self.stream = opened.enter_context(RtspServer(stream, host=host, faults=faults, **self._user))
            model = OnvifModel(PAN_DEG, TILT_DEG, STEP_DEG, SPEED_DEG_S, 400.0, self.stream.url, FEED_SIZE)
            self.camera = OnvifCamera(self.pan, self.tilt, self.lens, model, self.faults)
            self._host = host
            opened.callback(lambda: self.server.close())
            self.listen()
            self._opened = opened.pop_all()
        self.settings = OnvifSettings(
            host=self.server.host,
            port=self.server.port,
            size=FEED_SIZE,
            rate_hz=RATE_HZ,
            pan_deg=PAN_DEG,
            tilt_deg=TILT_DEG,
            speed_deg_s=SPEED_DEG_S,
            command_delay_s=0.05,
            lens=((0.0, 1.0), (1.0, 10.0)),
            **self._user,
        )

    def listen(self, port=0):
        """Open the server at a port, after the last one was closed."""
        self.server = OnvifServer(self.camera, host=self._host, port=port, faults=self.faults, **self._user)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._opened.close()

    @property
    def moves(self):
        """Messages of a kind that moves, in order."""
        moving = ("AbsoluteMove", "RelativeMove", "ContinuousMove", "GotoPreset")
        return [name for name in self.server.counts.messages if name in moving]

    def turning(self):
        return self.pan.moving() or self.tilt.moving()
