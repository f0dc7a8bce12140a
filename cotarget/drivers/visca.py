"""A pan-tilt-zoom camera that takes VISCA over IP.

`ViscaDome` is the camera of a rig, and `ViscaLink` its protocol as `PolledHead` asks for it. VISCA says neither how
many degrees a count is, nor the ranges, nor how fast an index of speed turns: `FAMILIES` has that by makers' manuals.
"""

import bisect
import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cotarget.drivers import visca_protocol as protocol
from cotarget.drivers.axes import AxisFacts, Poll
from cotarget.drivers.head_link import Pair, Requests
from cotarget.drivers.link_errors import RefusedError, ReplyError, SilentError
from cotarget.drivers.ptz import Dome, Knots, PtzLink, PtzSettings
from cotarget.drivers.visca_protocol import TRANSPORTS, CodedError, open_line
from cotarget.errors import ConfigError, DeviceError
from cotarget.rig import Clock
from cotarget.schema import model

OPTICAL = 0x4000  # the zoom's longest optical position; what is beyond is digital
# A zoom block of 25 x; that of 20 x differs by up to 7 % in between.
LENS_25X: Knots = (
    (0x0000, 1.0), (0x1781, 2.0), (0x213B, 3.0), (0x2BB3, 5.0), (0x362C, 10.0), (0x3AFA, 15.0), (0x3DF8, 20.0),
    (0x4000, 25.0),
)  # fmt: skip


@dataclass(frozen=True)
class Family:
    """Units of cameras by one maker.

    Attributes:
        step_deg: angle of a count of pan and tilt [degrees].
        pan: speeds by index, from index 0 [degrees/s].
        tilt: speeds by index, from index 0 [degrees/s].
    """

    step_deg: float
    pan: tuple[float, ...]
    tilt: tuple[float, ...]


# The manuals of the EVI-D70 and D80 have the fastest speeds alone; these are those of the EVI-D100 up to them.
EVI_SPEEDS = (0.0, 2.0, 2.4, 3.0, 3.7, 4.7, 6.1, 7.4, 9.1, 11.0, 14.0, 18.0, 22.0, 27.0, 34.0, 42.0, 52.0, 65.0, 81.0)
FAMILIES = {
    # PTZOptics, Telycam, AViPAS and others of their kind
    "ptzoptics": Family(
        1 / 14.4,
        (0.3, 1, 1.5, 2.2, 2.4, 2.6, 2.8, 3, 3.2, 3.4, 3.8, 4.5, 6, 9, 15, 19, 25, 32, 38, 45, 58, 75, 88, 105, 120),
        (0.3, 1, 1.5, 2.2, 3.6, 4.7, 6, 8, 10, 12, 15, 18, 23, 30, 39, 48, 59, 69, 80),
    ),
    "evi_d70": Family(170 / 0x08DB, (*EVI_SPEEDS, 100.0), EVI_SPEEDS),  # the BirdDog P100 too
    "evi_d80": Family(170 / 0x1E1B, (*EVI_SPEEDS, 100.0), EVI_SPEEDS),  # and D90
}
OUTSIDE_DEG = 5.0  # this far beyond the range, a position shows that the units are wrong
ROUNDING = 1e-9  # relative; of a speed after its conversion
# An axis that turns at the slowest index moves a count in less time [s].
STILL_S = 0.15
ZOOM_S = 10.0  # a slow lens takes this for its whole range [s]
# The zoom is asked for with every poll for this time after a command, and with every fourth otherwise [s].
ZOOMING_S, ZOOM_EVERY = 3.0, 4


@model
class ViscaSettings(PtzSettings):
    """A pan-tilt-zoom camera that takes VISCA over IP, such as by Sony, BirdDog or PTZOptics.

    Attributes:
        protocol: how messages are sent: UDP with Sony's header, usually at port 52381; UDP bare, usually at 1259; TCP
            bare, usually at 5678; or which of them the camera answers to.
        units: whose counts and speeds the camera has.
        lens: some zoom numbers and their magnifications, both increasing; between them the logarithm of the
            magnification is interpolated. Empty for those of a block of 25 x.
        step_deg: angle of a count of pan and tilt, or of each, where it is not that of the units [degrees].
        pan_deg: range of pan, which VISCA does not report, with positive pan to the right [degrees].
        tilt_deg: range of tilt, which VISCA does not report, with positive tilt up [degrees].
    """

    protocol: Literal["auto", "sony", "udp", "tcp"] = "auto"
    units: Literal["ptzoptics", "evi_d70", "evi_d80"] = "ptzoptics"

    @property
    def steps_deg(self) -> tuple[float, float]:
        """Step sizes of pan and tilt [degrees]."""
        pan, tilt = super().steps_deg
        own = FAMILIES[self.units].step_deg
        return pan or own, tilt or own

    @property
    def knots(self) -> Knots:
        """Zoom numbers and magnifications."""
        return self.lens or LENS_25X

    @property
    def axes(self) -> tuple[AxisFacts, AxisFacts, AxisFacts]:
        """Facts of pan, tilt and zoom."""
        family, ranges = FAMILIES[self.units], (self.pan_deg, self.tilt_deg)
        pan, tilt = (
            _axis(step, sign, limits, speeds)
            for step, sign, limits, speeds in zip(
                self.steps_deg, self.signs, ranges, (family.pan, family.tilt), strict=True
            )
        )
        lens = AxisFacts(
            unit=1.0, lowest=0, highest=OPTICAL, fastest=OPTICAL / ZOOM_S, step=1.0, slack=32, loses_steps=False
        )
        return pan, tilt, lens


def _axis(step_deg: float, sign: int, limits: tuple[float, float], speeds: Sequence[float]) -> AxisFacts:
    low, high = sorted(sign * end / step_deg for end in limits)
    return AxisFacts(
        unit=math.radians(step_deg),
        lowest=math.ceil(low - ROUNDING),
        highest=math.floor(high + ROUNDING),
        fastest=speeds[-1] / step_deg,
        slowest=speeds[1] / step_deg,
        step=1.0,
        still_s=STILL_S,
        loses_steps=False,
    )


class ViscaLink(PtzLink):
    """The protocol of a camera that takes VISCA over IP; the connection is open, and the camera was only asked.

    Raises:
        ConfigError: the units do not fit the positions that the camera reports.
        DeviceError: there is no camera, or it has no pan and tilt, or is in standby.
    """

    pause_s = 0.01

    def __init__(self, settings: ViscaSettings, clock: Clock) -> None:
        self._clock, self._family, self.axes = clock, FAMILIES[settings.units], settings.axes
        names = tuple(TRANSPORTS) if settings.protocol == "auto" else (settings.protocol,)
        self._line, version = open_line(settings.host, settings.port, names, clock)
        self.name = self._line.name
        self._zoomed, self._polls = -math.inf, 0  # time of the last command for the lens, number of polls
        self._moving_in = self._zooming_in = 0  # the camera's sockets of the last move and zoom
        with contextlib.ExitStack() as opened:
            opened.enter_context(contextlib.closing(self._line))
            self._refuse_standby()
            at, zoom = self._identify()
            self._refuse_wrong_units(settings, at)
            said = f"version {version.hex(' ')}, " if version else ""
            pan, tilt = (
                f"{sign * count * step:.1f}"
                for sign, count, step in zip(settings.signs, at, settings.steps_deg, strict=True)
            )
            self.identity = f"VISCA at {self.name}, {said}pan {pan}, tilt {tilt} degrees, zoom {zoom}"
            opened.pop_all()

    def make_ready(self) -> None:
        """Halt the camera, have it halted if the program is killed, and switch its digital zoom off."""
        super().make_ready()
        self.guard([self._line.last_stop()])
        with contextlib.suppress(RefusedError):  # a camera without it
            self._line.order(protocol.DIGITAL_ZOOM_OFF)

    def poll(self, requests: Requests) -> Sequence[Poll]:
        """Ask for pan and tilt, and for the zoom as often as it may matter."""
        self._line.hurry = requests.halt_waits
        try:
            data, t = self._line.inquire(protocol.PAN_TILT)
            polls = [Poll(axis, position, t) for axis, position in enumerate(self._decoded(data))]
            if self._clock.now() < self._zoomed + ZOOMING_S or self._polls % ZOOM_EVERY == 0:
                data, t = self._line.inquire(protocol.ZOOM)
                polls.append(Poll(2, min(protocol.number(data, signed=False), OPTICAL), t))
        except SilentError:
            if requests.halt_waits():
                return []
            raise
        self._polls += 1
        return polls

    def move(self, goals: Pair, speeds: Pair, requests: Requests) -> None:
        """Send both axes to positions, at the fastest indices that are not above the speeds."""
        family, (a, b) = self._family, goals
        pan, tilt = (
            _index(speeds_deg, speed * math.degrees(axis.unit))
            for speeds_deg, speed, axis in zip((family.pan, family.tilt), speeds, self.axes[:2], strict=True)
        )
        order = protocol.absolute((round(a), round(b)), (pan, tilt), self._widths)
        self._moving_in = self._send(order, requests, self._moving_in)

    def zoom(self, position: float, requests: Requests) -> None:
        """Send the lens to a position."""
        self._zoomed = self._clock.now()
        self._zooming_in = self._send(protocol.zoom_to(round(position)), requests, self._zooming_in)

    def halt(self, patience: float) -> None:
        """Stop pan and tilt; it is repeated until the camera has acknowledged it."""
        self._line.hurry = lambda: False
        self._line.stop(patience)

    def close(self) -> None:
        """Release the connection."""
        super().close()
        self._line.close()

    def _send(self, command: bytes, requests: Requests, before: int) -> int:
        self._line.hurry = requests.halt_waits
        try:
            return self._line.patiently(command, requests.proceed, before)
        except SilentError:
            requests.proceed()
            raise

    def _decoded(self, data: bytes) -> tuple[int, int]:
        try:
            at = protocol.pan_tilt(data)
        except ReplyError as error:
            raise DeviceError(f"the camera at {self.name} cannot be driven: {error}") from None
        self._widths = protocol.WIDTHS[len(data)]
        return at

    def _refuse_standby(self) -> None:
        with contextlib.suppress(RefusedError):
            if self._line.inquire(protocol.POWER)[0] == bytes([protocol.STANDBY]):
                raise DeviceError(
                    f"the camera at {self.name} is in standby: switch it on by its remote control or page"
                )

    def _identify(self) -> tuple[tuple[int, int], int]:
        """Ask for pan and tilt, and for the zoom."""
        asked = "its pan and tilt"
        try:
            at = self._decoded(self._line.inquire(protocol.PAN_TILT)[0])
            asked = "its zoom"
            return at, protocol.number(self._line.inquire(protocol.ZOOM)[0], signed=False)
        except CodedError as error:
            if error.code == protocol.SYNTAX:
                raise DeviceError(
                    f"the camera at {self.name} speaks VISCA but does not know {asked}: it is no pan-tilt-zoom camera; "
                    'it can be [hardware.fixed] with driver = "stream"'
                ) from None
            raise DeviceError(f"{error}; it was asked for {asked}") from None

    def _refuse_wrong_units(self, settings: ViscaSettings, at: tuple[int, int]) -> None:
        """Refuse a position that is far outside of the range."""
        for word, count, step, sign, (low, high) in zip(
            ("pan", "tilt"), at, settings.steps_deg, settings.signs, (settings.pan_deg, settings.tilt_deg), strict=True
        ):
            angle = sign * count * step
            if not low - OUTSIDE_DEG <= angle <= high + OUTSIDE_DEG:
                fits = [name for name, family in FAMILIES.items() if low <= sign * count * family.step_deg <= high]
                remedy = f'write units = "{fits[0]}"' if fits else f"check {word}_deg, {word}_sign and step_deg"
                raise ConfigError(
                    f"hardware.ptz.units: the camera at {self.name} reports {word} {count}, which is {angle:.0f} "
                    f'degrees by "{settings.units}", outside of {low:g} to {high:g}; {remedy}'
                )


def _index(speeds: Sequence[float], speed: float) -> int:
    """Return the highest index of a speed [degrees/s] not above another one; 1 at least, since 0 may not move."""
    return max(bisect.bisect_right(speeds, speed * (1 + ROUNDING)) - 1, 1)


class ViscaDome(Dome):
    """A camera that takes VISCA over IP; arguments and errors are those of `Dome`."""

    Settings = ViscaSettings
    Link = ViscaLink
