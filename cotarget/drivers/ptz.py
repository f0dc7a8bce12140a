"""A pan-tilt-zoom camera in one housing: what all domes share, whatever protocol moves them.

A protocol is a `PtzLink`: a `HeadLink` with the zoom as its third axis. Its constructor takes the settings and the
rig's clock, connects, and identifies the device without changing anything. `Dome` makes zoom camera, lens and head of
it and of the device's stream, with one connection to the head, one lock and one guard. A driver is four lines:

    class ViscaDome(Dome):
        Settings = ViscaSettings  # a PtzSettings
        Link = ViscaLink  # a PtzLink

The link's calls, by what they do: `poll` is the status (positions of pan, tilt and zoom, each with its time); `move`
sends pan and tilt to positions at speeds, and `renew` goes on with velocities where the device has no positions; `zoom`
sends the lens; `halt` stops, and returns when that is acknowledged; `close` releases the connection. `axes` holds the
units, ranges, steps and speeds of pan, tilt and zoom, in the device's own numbers; the zoom's step is above zero.
"""

import contextlib
import itertools
import logging
import math
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Interval, Lt

from cotarget.config import SafetyConfig
from cotarget.drivers.axes import AxisFacts
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.guardian import Guardian, StopOrder
from cotarget.drivers.head_link import HeadLink
from cotarget.drivers.lens import LensPositions
from cotarget.drivers.polled_head import (
    LOOP_HALT_S,
    NOTHING_SAID,
    PolledHead,
    PolledHeadSettings,
    PolledLens,
    braking_s,
)
from cotarget.drivers.stream import EXAMPLE, StreamCamera, StreamSettings, stream_address
from cotarget.errors import ConfigError
from cotarget.rig import Clock, Frame, UnitSpec, ZoomSpec, ZoomState
from cotarget.schema import Check, Limits, Needed, NotNegative, Positive, Size, model

log = logging.getLogger(__name__)

Knots = tuple[tuple[float, float], ...]  # (zoom number, magnification)
USUAL_KNOTS: Knots = ((0.0, 1.0), (1.0, 20.0))  # at the ends of a device's own range


def _host(host: str) -> str:
    """Check the address of a device.

    Raises:
        ValueError: there is more in it.
    """
    if "@" in host:
        raise ValueError("has a user or a password in it; write user = and give the password in COTARGET_PASSWORD")
    _, is_url, rest = host.rpartition("://")
    name, _, port = rest.partition("/")[0].partition(":")
    if is_url or (port.isdigit() and name):
        also = f" and port = {port}" if port else ""
        raise ValueError(f"'{host}' is more than an address; write host = \"{name}\"{also}")
    if any(sign in host for sign in "/[] "):
        raise ValueError(f"'{host}' is no address, such as 192.168.0.88")
    return host


def _knots(lens: Knots) -> Knots:
    if lens and (len(lens) < 2 or any(b[0] <= a[0] or b[1] <= a[1] for a, b in itertools.pairwise(lens))):
        raise ValueError("needs two or more [number, magnification], both of them increasing")
    return lens


def _zoomed(speeds: Knots) -> Knots:
    if any(b[0] <= a[0] or b[1] > a[1] for a, b in itertools.pairwise(speeds)):
        raise ValueError("needs [magnification, degrees/s], with increasing magnifications and no speed above the last")
    return speeds


@model
class PtzSettings(PolledHeadSettings):
    """A camera with pan, tilt and zoom behind one address.

    Attributes:
        host: address of the device, without a port.
        port: port of the protocol that moves it; 0 for the protocol's own.
        url: address of its stream, as of a fixed camera with driver "stream".
        user: user name; empty where the device asks for none.
        password: password; empty where an environment variable holds it.
        password_env: name of that variable.
        transport: how RTSP brings the pictures; UDP loses some on a busy network.
        size: image size that is expected [px].
        rate_hz: frames per second.
        latency_s: time from light to a frame's arrival, as measured [s].
        wide_deg: horizontal field of view at the shortest focal length [degrees].
        lens: some zoom numbers and their magnifications, both increasing; between them the logarithm of the
            magnification is interpolated. Empty for the protocol's own table.
        step_deg: step size of pan and tilt, or of each; 0 for what the protocol or the device says [degrees].
        zoomed_speeds: some magnifications, increasing, and the highest speed of pan and tilt from there on, of a dome
            that turns the slower the longer its lens [degrees/s]; empty for others.
        command_delay_s: time from a command to the start of motion of head and lens, as measured [s].
    """

    host: Annotated[str, Needed("192.168.0.88"), Check(_host)] = ""
    port: Annotated[int, Interval(ge=0, le=65535)] = 0
    url: Annotated[str, Needed(EXAMPLE), Check(stream_address)] = ""
    user: str = ""
    password: str = ""
    password_env: str = "COTARGET_PASSWORD"
    transport: Literal["tcp", "udp"] = "tcp"
    size: Size = (1920, 1080)
    rate_hz: Positive = 25.0
    latency_s: NotNegative = 0.3
    wide_deg: Annotated[Positive, Lt(180.0)] = 60.0
    lens: Annotated[tuple[Annotated[tuple[float, Positive], "[number, magnification]"], ...], Check(_knots)] = ()
    step_deg: NotNegative | Annotated[tuple[NotNegative, NotNegative], "[pan, tilt]"] = 0.0
    pan_deg: Limits = (-170.0, 170.0)
    tilt_deg: Limits = (-30.0, 90.0)
    speed_deg_s: Positive = 80.0
    command_delay_s: NotNegative = 0.1
    zoomed_speeds: Annotated[
        tuple[Annotated[tuple[Positive, Positive], "[magnification, degrees/s]"], ...], Check(_zoomed)
    ] = ()

    @property
    def address(self) -> str:
        """Address of the device, with its port where one is set."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}" if self.port else host

    @property
    def knots(self) -> Knots:
        """Zoom numbers and magnifications; a protocol with a table of its own gives that where `lens` is empty."""
        return self.lens or USUAL_KNOTS

    @property
    def wide_px(self) -> float:
        """Nominal focal length at magnification 1 [px]."""
        return self.size[0] / 2 / math.tan(math.radians(self.wide_deg) / 2)

    @property
    def spec(self) -> UnitSpec:  # type: ignore[override]
        """Describe zoom camera and head."""
        (_, least), *_, (_, most) = self.knots
        focal_range = (least * self.wide_px, most * self.wide_px)
        zoom = ZoomSpec(self.size, self.rate_hz, self.latency_s, focal_range, self.size, self.command_delay_s)
        speeds = tuple((times * self.wide_px, math.radians(speed)) for times, speed in self.zoomed_speeds)
        return UnitSpec(zoom, replace(super().spec, zoomed_speeds=speeds))

    def fastest_deg_s(self, magnification: float) -> float:
        """Return the highest speed of pan and tilt at a magnification [degrees/s]."""
        slower = [speed for times, speed in self.zoomed_speeds if times <= magnification]
        return min(self.speed_deg_s, *slower[-1:], math.inf)

    def stream(self, url: str = "") -> StreamSettings:
        """Make the settings of its stream; ``url`` where the device says it and the file does not."""
        same = ("user", "password", "password_env", "transport", "size", "rate_hz", "latency_s")
        return StreamSettings(url=self.url or url, **{name: getattr(self, name) for name in same})


class PtzLink(HeadLink):
    """The protocol of a pan-tilt-zoom device, connected and identified; the device was not changed yet.

    Attributes:
        identity: the device in one line, for `cotarget doctor`.
        url: address of the stream, as the device says it; empty where it cannot.
    """

    axes: tuple[AxisFacts, AxisFacts, AxisFacts]
    identity: str = ""
    url: str = ""
    _guardian: Guardian | None = None

    def make_ready(self) -> None:
        """Halt the device and set it up for moves; by default only the halt."""
        self.halt(LOOP_HALT_S + braking_s(self.axes))

    def guard(self, orders: list[StopOrder]) -> None:
        """Have a process of its own send orders if this program is killed; none for a device that then stands."""
        try:
            if self._guardian is None:
                self._guardian = Guardian()
            self._guardian.hold(orders)
        except OSError as error:
            log.warning("%s: nothing stops it if this program is killed: %s", self.name, error)

    def close(self) -> None:
        """End the process of `guard`; a subclass releases its connection too."""
        if self._guardian is not None:
            self._guardian.close()


class DomeCamera:
    """The stream of a dome, and its lens."""

    def __init__(self, stream: StreamCamera, lens: PolledLens, clock: Clock) -> None:
        self._stream, self._lens, self._clock = stream, lens, clock

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frames [px]."""
        return self._stream.size

    still_size = size  # a still is a frame of the stream

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px]."""
        return self._lens.focal_range

    def read(self, newer_than: float | None = None, timeout: float = 1.0) -> Frame:
        """Wait for a frame, see `FrameBuffer.read`."""
        return self._stream.read(newer_than, timeout)

    def capture(self) -> Frame:
        """Read the next frame."""
        return self._stream.read(newer_than=self._clock.now())

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving, see `PolledLens.zoom`."""
        return self._lens.zoom(focal_px)

    def state(self) -> ZoomState:
        """Return the lens's state, see `PolledLens.state`."""
        return self._lens.state()

    def number(self, focal_px: float) -> float:
        """Return the device's number of the lens position nearest to a nominal focal length [px]."""
        return self._lens.number(focal_px)

    def describe(self) -> str:
        """Describe the stream in one line, see `StreamReader.describe`."""
        return self._stream.describe()


class Dome:
    """A pan-tilt-zoom camera that is open; the head stands. Close it after use.

    Args:
        config: addresses of device and stream, and what they are expected to be.
        clock: the rig's clock.
        safety: speed cap and stop file.

    Attributes:
        head: the head, a `PolledHead`.
        zoom: the zoom camera.

    Raises:
        ConfigError: the device differs from the configuration.
        DeviceError: there is no such device, it cannot be moved, or its stream brings no picture.
    """

    Settings: ClassVar[type[PtzSettings]]
    Link: ClassVar[type[Any]]  # a PtzLink, made of settings and clock

    @classmethod
    def probe(cls, settings: PtzSettings) -> str:
        """Describe device and stream in one line; nothing is changed. Raises as the constructor does."""
        with contextlib.closing(cls.Link(settings, MonotonicClock())) as link:
            return f"{link.identity}; {StreamCamera.probe(_with_address(settings.stream(link.url)))}"

    def __init__(self, config: PtzSettings, clock: Clock, safety: SafetyConfig = NOTHING_SAID) -> None:
        links = list[PtzLink]()

        def open_link() -> PtzLink:
            links.append(type(self).Link(config, clock))
            with contextlib.ExitStack() as opened:
                opened.enter_context(contextlib.closing(links[0]))
                links[0].make_ready()
                opened.pop_all()
            return links[0]

        self.head = PolledHead(open_link, config, clock, safety)
        try:
            lens = self.head.lens(lens_positions(config, links[0].axes[2]))
            self._stream = StreamCamera(_with_address(config.stream(links[0].url)), clock)
        except BaseException:
            self.head.close()
            raise
        self.zoom = DomeCamera(self._stream, lens, clock)

    def close(self) -> None:
        """Halt the head, then release both; never raises, and may be called again."""
        self.head.close()
        self._stream.close()


def lens_positions(config: PtzSettings, axis: AxisFacts) -> LensPositions:
    """Make the focal lengths of a lens's numbers, those within the axis and the table.

    Raises:
        ConfigError: fewer than two positions are within both.
    """
    table = config.knots
    if table == USUAL_KNOTS and not config.lens:
        table = tuple((end, times) for end, (_, times) in zip((axis.lowest, axis.highest), USUAL_KNOTS, strict=True))
    lowest, highest = max(axis.lowest, table[0][0]), min(axis.highest, table[-1][0])
    count = round((highest - lowest) / axis.step) + 1
    if count < 2:
        raise ConfigError(
            f"hardware.ptz.lens: goes from {table[0][0]:g} to {table[-1][0]:g}, but the zoom of the device at "
            f"{config.address} from {axis.lowest:g} to {axis.highest:g}; write numbers of that range"
        )
    knots = tuple((number, magnification * config.wide_px) for number, magnification in table)
    return LensPositions(knots, np.linspace(lowest, highest, count).tolist())


def _with_address(stream: StreamSettings) -> StreamSettings:
    if not stream.url:
        raise ConfigError(f'hardware.ptz.url: is missing, and the device names no stream; write url = "{EXAMPLE}"')
    return stream
