"""An emulated pan-tilt-zoom camera that ONVIF moves, in front of two axes and a lens: SOAP 1.2 over HTTP.

`OnvifCamera` is the firmware: it carries out a message and answers it. `OnvifServer` is its network, with the user's
token of WS-Security and HTTP digest authentication. What devices in the field do otherwise than the standard are named
profiles (`ONVIF_PROFILES`), what goes wrong on the way are faults (`ONVIF_FAULTS`); both can be switched at any time.

Sources: ONVIF Core, Media and PTZ Service Specifications; WS-Security UsernameToken Profile 1.0.
"""

import base64
import contextlib
import hashlib
import math
import re
import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler
from typing import Any
from xml.etree.ElementTree import Element, ParseError, fromstring

from cotarget.emulators.authentication import Authenticator
from cotarget.emulators.plant import AxisPlant, LensPlant
from cotarget.emulators.serve import LOCAL, Faults, TcpServer
from cotarget.emulators.zoom_block import ZoomBlock

ONVIF_PROFILES = (
    # Moves
    "absolute-ignored",  # an absolute move is answered, and nothing moves
    "no-absolute",  # pan and tilt have no absolute moves
    "continuous-only",  # pan and tilt have velocities alone
    "relative-only",  # pan and tilt have relative moves alone
    "relative-degrees",  # relative moves have a space in degrees, too
    "presets-only",
    "slow-stop",  # after a stop it turns on for 0.4 s
    "slower-stop",  # for 1.1 s
    "capped-by-zoom",  # the longer the lens, the slower the head
    "timeout-fault",  # a continuous move with a timeout is refused
    "timeout-ignored",
    "timeout-clamped",  # the timeout is 10 s at most
    "stop-fault",
    "stop-ignored",  # a stop is answered, and only a velocity of zero stops
    "missing-is-zero",  # an axis that a move does not name goes to 0
    "pan-alone-ignored",  # a move of one axis alone does nothing
    "signs-only",  # a velocity has the highest speed
    "lowest-speed",  # a velocity turns it by 1.5 degrees/s at least
    "rounded",  # positions are multiples of 0.01 of -1 to 1
    # Status
    "no-status",  # without positions
    "zoom-status",  # with the zoom's alone
    "stale-status",  # of half a second ago
    "blocking-status",  # it answers when the move has ended
    "always-moving",
    "boolean-status",  # MoveStatus is true or false
    "position-lost",  # the status has a pan outside of its range
    # Coordinates
    "pan-reversed",
    "tilt-reversed",
    "wide-ranges",  # 0 to 360 and 0 to 180 in place of -1 to 1
    "degrees",  # in the space of degrees
    "endless-pan",  # its numbers are a whole turn from its lowest position on; it goes the shorter way
    "no-zoom",  # the zoom's lowest number is its highest
    # Users, clocks, addresses
    "clock-20s",  # it is ahead by so much, and takes tokens within 5 s
    "clock-10h",  # it is behind by so much
    "time-needs-user",
    "http-digest",  # it knows no tokens
    "needs-administrator",  # the user may look but not move
    "behind-nat",  # its answers have an address that leads nowhere
    "media2-only",  # it has the media service of Profile T alone
)
ONVIF_FAULTS = (
    "silence",  # it takes requests and answers none
    "slow-answers",  # each takes 0.3 s
    "half-answers",  # the connection closes in the middle of an answer
    "garbage",  # answers are noise
    "endless",  # an answer does not end
    "bomb",  # answers declare entities that grow
    "not-soap",  # a page with status 200
    "unauthorized",  # any user is refused
    "no-ptz",  # a camera that does not move
    "refuse",  # connections are closed at once
)
ENVELOPE = "http://www.w3.org/2003/05/soap-envelope"
TDS, TRT = "http://www.onvif.org/ver10/device/wsdl", "http://www.onvif.org/ver10/media/wsdl"
TR2 = "http://www.onvif.org/ver20/media/wsdl"
TPTZ, TT = "http://www.onvif.org/ver20/ptz/wsdl", "http://www.onvif.org/ver10/schema"
TER = "http://www.onvif.org/ver10/error"
PAN_TILT, ZOOM = "http://www.onvif.org/ver10/tptz/PanTiltSpaces", "http://www.onvif.org/ver10/tptz/ZoomSpaces"
RELATIVE_DEGREES = f"{PAN_TILT}/SphericalTranslationSpaceDegrees"
DIGEST = "PasswordDigest"
NAMESPACES = {"tds": TDS, "trt": TRT, "tr2": TR2, "tptz": TPTZ}
SERVICES = {"device": TDS, "media": TRT, "media2": TR2, "ptz": TPTZ}
TOKEN, CONFIGURATION, NODE = "profile_1", "ptz_1", "node_1"


class SoapFault(Exception):  # noqa: N818 - SOAP's word
    """A message is refused.

    Args:
        reason: text for people.
        codes: subcodes, each inside of the one before.
        code: "Sender" or "Receiver".
    """

    def __init__(self, reason: str, *codes: str, code: str = "Sender") -> None:
        super().__init__(reason)
        self.reason, self.code, self.codes = reason, code, codes


# The device

STOPS_LATE_S = {"slow-stop": 0.4, "slower-stop": 1.1}
STALE_S = 0.5
BLOCKS_S = 30.0  # longest time that a status blocks [s]
LONGEST_TIMEOUT_S = {True: 10.0, False: 600.0}  # by whether it is clamped
DEFAULT_TIMEOUT_S = 5.0
LOWEST_DEG_S = 1.5
TURN_DEG = 360.0
LOST = 0.55  # by which the number of a lost position is too large, as a share of the range: 557.4 of 360 degrees
# Highest speed by the share of the zoom's range in its logarithm, of domes that limit it [degrees/s].
CAPS = ((0.2, math.inf), (0.4, 30.0), (0.6, 7.85), (0.8, 4.5), (1.0, 1.5))
# Numbers and magnifications of a zoom block of 25 x, as shares of the range.
BLOCK = ZoomBlock((
    (0.0, 1.0), (0.367, 2.0), (0.519, 3.0), (0.683, 5.0), (0.847, 10.0), (0.921, 15.0), (0.968, 20.0), (1.0, 25.0)
))  # fmt: skip


@dataclass(frozen=True)
class OnvifModel:
    """A model of camera.

    Attributes:
        pan_deg: lowest and highest position.
        tilt_deg: lowest and highest position.
        step_deg: of the axes.
        speed_deg_s: highest speed.
        acceleration_deg_s2: of both axes.
        stream: address of its stream.
        size: of its pictures [px].
    """

    pan_deg: tuple[float, float]
    tilt_deg: tuple[float, float]
    step_deg: float
    speed_deg_s: float
    acceleration_deg_s2: float
    stream: str
    size: tuple[int, int]


@dataclass
class Timed:
    """What is to happen later, and can be called off."""

    timer: threading.Timer | None = None

    def after(self, seconds: float, act: Callable[[], None]) -> None:
        """Call it off, and plan another."""
        self.off()
        self.timer = threading.Timer(seconds, act)
        self.timer.daemon = True
        self.timer.start()

    def off(self) -> None:
        """Call it off."""
        if self.timer is not None:
            self.timer.cancel()
            self.timer = None

    @property
    def is_planned(self) -> bool:
        """Whether it is still to happen."""
        return self.timer is not None and self.timer.is_alive()


class OnvifCamera:
    """Firmware of the camera.

    Args:
        pan: axis, in steps.
        tilt: axis, in steps.
        lens: the lens.
        model: ranges and speeds.
        faults: profiles and faults that are on.
    """

    def __init__(self, pan: AxisPlant, tilt: AxisPlant, lens: LensPlant, model: OnvifModel, faults: Faults) -> None:
        self._axes, self._lens, self.model, self._faults = (pan, tilt), lens, model, faults
        self._stop, self._end = Timed(), Timed()
        self._lock = threading.RLock()
        self._seen: list[tuple[float, tuple[float, float, float]]] = []
        self.presets: dict[str, tuple[float, float, float]] = {}

    def close(self) -> None:
        """Call off what is to happen later."""
        self._stop.off()
        self._end.off()

    @property
    def clock_off_s(self) -> float:
        """By how much the camera's clock is ahead [s]."""
        return 20.0 * ("clock-20s" in self._faults) - 36000.0 * ("clock-10h" in self._faults)

    def now(self) -> datetime:
        """Return the time by the camera's clock."""
        return datetime.now(UTC) + timedelta(seconds=self.clock_off_s)

    # Coordinates

    def numbers(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Ranges of the numbers of pan and tilt."""
        if "degrees" in self._faults:
            return self.ranges_deg
        return ((0.0, 360.0), (0.0, 180.0)) if "wide-ranges" in self._faults else ((-1.0, 1.0), (-1.0, 1.0))

    @property
    def ranges_deg(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lowest and highest position of pan and tilt."""
        low, high = self.model.pan_deg
        return (low, low + TURN_DEG if "endless-pan" in self._faults else high), self.model.tilt_deg

    @property
    def space(self) -> str:
        """URI of the coordinates of pan and tilt."""
        name = "SphericalPositionSpaceDegrees" if "degrees" in self._faults else "PositionGenericSpace"
        return f"{PAN_TILT}/{name}"

    def zoom_numbers(self) -> tuple[float, float]:
        """Range of the zoom's number."""
        return (1.0, 1.0) if "no-zoom" in self._faults else (0.0, 1.0)

    def position(self) -> tuple[float, float, float]:
        """Return pan, tilt and zoom in the device's numbers."""
        found = []
        reversed_ = ("pan-reversed" in self._faults, "tilt-reversed" in self._faults)
        lost = LOST if "position-lost" in self._faults else 0.0
        for axis, (low, high), (a, b), backward in zip(
            self._axes, self.ranges_deg, self.numbers(), reversed_, strict=True
        ):
            share = (axis.position() * self.model.step_deg - low) / (high - low)
            share = share % 1.0 if "endless-pan" in self._faults and axis is self._axes[0] else share
            number = a + (b - a) * (1.0 - share if backward else share)
            width = (b - a) / 2
            found.append(round(number / width, 2) * width if "rounded" in self._faults else number)
        share = BLOCK.number(self._lens.position() / self._lens.last)
        (a, b), _ = self.numbers()
        return found[0] + lost * (b - a), found[1], share

    def moving(self) -> bool:
        """Return whether pan or tilt moves."""
        return any(axis.moving() for axis in self._axes)

    # Motion

    def go(self, goals: Sequence[float | None], zoom: float | None, speeds: Sequence[float] | None) -> None:
        """Go to positions in the device's numbers.

        Raises:
            SoapFault: a position is outside of its range.
        """
        with self._lock:
            if "missing-is-zero" in self._faults:
                goals, zoom = [0.0 if goal is None else goal for goal in goals], zoom or 0.0
            for goal, (low, high) in zip(goals, self.numbers(), strict=True):
                if goal is not None and not low - 1e-6 <= goal <= high + 1e-6:
                    raise SoapFault("Requested position out of bounds", "InvalidArgVal", "InvalidPosition")
            if zoom is not None:
                self._lens.command(round(BLOCK.share(zoom) * self._lens.last))
            if goals[0] is None or goals[1] is None:
                return
            if "pan-alone-ignored" in self._faults and not self._both_change(goals[0], goals[1]):
                return
            self._stop.off()
            self._end.off()
            fastest = self.highest_speed()
            shares = [1.0, 1.0] if speeds is None else [min(abs(share), 1.0) or 1.0 for share in speeds]
            for i, (axis, goal, share) in enumerate(zip(self._axes, goals, shares, strict=True)):
                axis.command(self._steps(i, goal or 0.0), share * fastest / self.model.step_deg, self._acceleration)

    def _both_change(self, pan: float, tilt: float) -> bool:
        at = self.position()
        return abs(pan - at[0]) > 1e-3 and abs(tilt - at[1]) > 1e-3

    def _steps(self, i: int, number: float) -> int:
        """Convert a number to the position of an axis [steps]; of those of an endless one, to the nearest."""
        low, high = self.ranges_deg[i]
        a, b = self.numbers()[i]
        if "rounded" in self._faults:
            number = round(number / ((b - a) / 2), 2) * (b - a) / 2
        share = (number - a) / (b - a)
        if ("pan-reversed", "tilt-reversed")[i] in self._faults:
            share = 1.0 - share
        goal_deg = low + share * (high - low)
        if i == 0 and "endless-pan" in self._faults:
            goal_deg += TURN_DEG * round((self._axes[0].position() * self.model.step_deg - goal_deg) / TURN_DEG)
        return round(goal_deg / self.model.step_deg)

    def drive(self, pan: float | None, tilt: float | None, zoom: float | None, timeout_s: float | None) -> None:
        """Turn at velocities, as shares of the highest; one of zero stops."""
        with self._lock:
            if zoom is not None:
                self._lens.command(self._lens.position() if zoom == 0 else self._lens.last if zoom > 0 else 0)
            if pan is None or tilt is None:
                return
            self._end.off()
            if pan == tilt == 0:
                self.halt()
                return
            if "pan-alone-ignored" in self._faults and 0 in (pan, tilt):
                return
            self._stop.off()
            fastest = self.highest_speed()
            for i, (axis, share) in enumerate(zip(self._axes, (pan, tilt), strict=True)):
                if share == 0:
                    axis.halt(self._acceleration)
                    continue
                low, high = self.ranges_deg[i]
                if i == 0 and "endless-pan" in self._faults:
                    low, high = (round(axis.position() * self.model.step_deg) + side * TURN_DEG for side in (-1, 1))
                backward = ("pan-reversed", "tilt-reversed")[i] in self._faults
                end = high if (share > 0) != backward else low
                speed = fastest if "signs-only" in self._faults else min(abs(share), 1.0) * fastest
                if "lowest-speed" in self._faults:
                    speed = max(speed, LOWEST_DEG_S)
                axis.command(round(end / self.model.step_deg), speed / self.model.step_deg, self._acceleration)
            if "timeout-ignored" not in self._faults:
                longest = LONGEST_TIMEOUT_S["timeout-clamped" in self._faults]
                self._end.after(min(timeout_s or DEFAULT_TIMEOUT_S, longest), self.halt)

    def highest_speed(self) -> float:
        """Return the highest speed at the zoom of now [degrees/s]."""
        if "capped-by-zoom" not in self._faults:
            return self.model.speed_deg_s
        share = self._lens.position() / self._lens.last
        return min(self.model.speed_deg_s, next(cap for end, cap in CAPS if share <= end))

    def halt(self) -> None:
        """Begin to brake, after the time that the device takes for it; a stop under way is not begun anew."""
        late = max((s for name, s in STOPS_LATE_S.items() if name in self._faults), default=0.0)
        with self._lock:  # clients stop it twice at the same time
            if not late:
                self._brake()
            elif not self._stop.is_planned:
                self._stop.after(late, self._brake)

    def _brake(self) -> None:
        with self._lock:
            for axis in self._axes:
                axis.halt(self._acceleration)

    @property
    def _acceleration(self) -> float:
        return self.model.acceleration_deg_s2 / self.model.step_deg

    def seen(self) -> tuple[float, float, float]:
        """Return the position that a status shows."""
        now = time.monotonic()
        self._seen = [*self._seen[-200:], (now, self.position())]
        if "stale-status" not in self._faults:
            return self._seen[-1][1]
        return next((at for t, at in reversed(self._seen) if t <= now - STALE_S), self._seen[0][1])


# Messages


@dataclass(frozen=True)
class Message:
    """A message of a client.

    Attributes:
        service: namespace of the service.
        name: of the message.
        body: its element.
        base: address of the device as the client has it, without a path.
    """

    service: str
    name: str
    body: Element
    base: str

    def text(self, path: str) -> str:
        """Return the text at a path of local names; empty where there is none."""
        found = self.body.find("/".join(f"{{*}}{name}" for name in path.split("/")))
        return "" if found is None or found.text is None else found.text.strip()

    def vector(self, path: str) -> tuple[float | None, float | None, float | None]:
        """Return pan, tilt and zoom of a vector.

        Raises:
            SoapFault: a component is no number.
        """
        turned, zoomed = (self.body.find(f"{{*}}{path}/{{*}}{name}") for name in ("PanTilt", "Zoom"))
        try:
            pan, tilt = (None if turned is None else float(turned.get(name, "")) for name in ("x", "y"))
            zoom = None if zoomed is None else float(zoomed.get("x", ""))
        except ValueError:
            raise SoapFault("not a number", "InvalidArgVal") from None
        if not all(number is None or math.isfinite(number) for number in (pan, tilt, zoom)):
            raise SoapFault("not a number", "InvalidArgVal")
        return pan, tilt, zoom


Answer = Callable[[OnvifCamera, Faults, Message], str]
ANSWERS: dict[tuple[str, str], Answer] = {}
MOVES = ("AbsoluteMove", "RelativeMove", "ContinuousMove", "Stop", "GotoPreset", "SetPreset")
DURATION = re.compile(r"PT(?:(\d+)M)?(?:(\d+(?:\.\d+)?)S)?")


def answers(prefix: str, name: str) -> Callable[[Answer], Answer]:
    """Register what answers a message of a service."""

    def register(answer: Answer) -> Answer:
        ANSWERS[NAMESPACES[prefix], name] = answer
        return answer

    return register


@answers("tds", "GetSystemDateAndTime")
def _time(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    now = camera.now()
    clock = "".join(f"<tt:{name}>{getattr(now, name.lower())}</tt:{name}>" for name in ("Hour", "Minute", "Second"))
    date = "".join(f"<tt:{name}>{getattr(now, name.lower())}</tt:{name}>" for name in ("Year", "Month", "Day"))
    return (
        "<tds:SystemDateAndTime><tt:DateTimeType>Manual</tt:DateTimeType><tt:DaylightSavings>false</tt:DaylightSavings>"
        f"<tt:TimeZone><tt:TZ>UTC0</tt:TZ></tt:TimeZone><tt:UTCDateTime><tt:Time>{clock}</tt:Time>"
        f"<tt:Date>{date}</tt:Date></tt:UTCDateTime></tds:SystemDateAndTime>"
    )


@answers("tds", "GetDeviceInformation")
def _information(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    said = {
        "Manufacturer": "cotarget", "Model": "Emulated dome", "FirmwareVersion": "1.0", "SerialNumber": "1",
        "HardwareId": "1",
    }  # fmt: skip
    return "".join(f"<tds:{name}>{value}</tds:{name}>" for name, value in said.items())


def _address(message: Message, faults: Faults, service: str) -> str:
    base = "http://10.255.255.1:8080" if "behind-nat" in faults else message.base
    return f"{base}/onvif/{service}_service"


@answers("tds", "GetCapabilities")
def _capabilities(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    where = {name: f"<tt:XAddr>{_address(message, faults, name)}</tt:XAddr>" for name in _services_of(faults)}
    shows = "<tt:StreamingCapabilities><tt:RTP_RTSP_TCP>true</tt:RTP_RTSP_TCP></tt:StreamingCapabilities>"
    media = f"<tt:Media>{where['media']}{shows}</tt:Media>" if "media" in where else ""
    moves = f"<tt:PTZ>{where['ptz']}</tt:PTZ>" if "ptz" in where else ""
    return f"<tds:Capabilities><tt:Device>{where['device']}</tt:Device>{media}{moves}</tds:Capabilities>"


def _services_of(faults: Faults) -> list[str]:
    """List the services that it has."""
    lacks = {"media" if "media2-only" in faults else "media2", *(["ptz"] if "no-ptz" in faults else [])}
    return [name for name in SERVICES if name not in lacks]


@answers("tds", "GetServices")
def _services(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    return "".join(
        f"<tds:Service><tds:Namespace>{SERVICES[name]}</tds:Namespace>"
        f"<tds:XAddr>{_address(message, faults, name)}</tds:XAddr>"
        "<tds:Version><tt:Major>2</tt:Major><tt:Minor>60</tt:Minor></tds:Version></tds:Service>"
        for name in _services_of(faults)
    )


def _range(name: str, ends: tuple[float, float]) -> str:
    return f"<tt:{name}><tt:Min>{ends[0]:g}</tt:Min><tt:Max>{ends[1]:g}</tt:Max></tt:{name}>"


def _space(name: str, uri: str, *ranges: tuple[float, float]) -> str:
    said = "".join(_range(axis, ends) for axis, ends in zip(("XRange", "YRange"), ranges, strict=False))
    return f"<tt:{name}><tt:URI>{uri}</tt:URI>{said}</tt:{name}>"


def _spaces(camera: OnvifCamera, faults: Faults) -> str:
    if "presets-only" in faults:
        return ""
    unit, share = (-1.0, 1.0), (0.0, 1.0)
    absolute = _space("AbsolutePanTiltPositionSpace", camera.space, *camera.numbers())
    zoom = _space("AbsoluteZoomPositionSpace", f"{ZOOM}/PositionGenericSpace", camera.zoom_numbers())
    relative = _space("RelativePanTiltTranslationSpace", f"{PAN_TILT}/TranslationGenericSpace", unit, unit)
    velocity = _space("ContinuousPanTiltVelocitySpace", f"{PAN_TILT}/VelocityGenericSpace", unit, unit)
    if "relative-degrees" in faults:
        relative += _space("RelativePanTiltTranslationSpace", RELATIVE_DEGREES, (-360.0, 360.0), (-180.0, 180.0))
    if any(name in faults for name in ("no-absolute", "continuous-only", "relative-only")):
        absolute = ""
    if "continuous-only" in faults:
        relative = ""
    if "relative-only" in faults:
        velocity = ""
    return (
        absolute
        + zoom
        + relative
        + velocity
        + _space("ContinuousZoomVelocitySpace", f"{ZOOM}/VelocityGenericSpace", unit)
        + _space("PanTiltSpeedSpace", f"{PAN_TILT}/GenericSpeedSpace", share)
        + _space("ZoomSpeedSpace", f"{ZOOM}/ZoomGenericSpeedSpace", share)
    )


def _configuration(camera: OnvifCamera, faults: Faults, tag: str) -> str:
    limits = _space("Range", camera.space, *camera.numbers())
    zoom = _space("Range", f"{ZOOM}/PositionGenericSpace", camera.zoom_numbers())
    return (
        f'<{tag} token="{CONFIGURATION}"><tt:Name>ptz</tt:Name><tt:UseCount>1</tt:UseCount>'
        f"<tt:NodeToken>{NODE}</tt:NodeToken>"
        f"<tt:DefaultContinuousPanTiltVelocitySpace>{PAN_TILT}/VelocityGenericSpace"
        "</tt:DefaultContinuousPanTiltVelocitySpace>"
        f"<tt:DefaultPTZTimeout>PT{DEFAULT_TIMEOUT_S:g}S</tt:DefaultPTZTimeout>"
        f"<tt:PanTiltLimits>{limits}</tt:PanTiltLimits><tt:ZoomLimits>{zoom}</tt:ZoomLimits></{tag}>"
    )


@answers("trt", "GetProfiles")
def _profiles(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    width, height = camera.model.size
    moves = "" if "no-ptz" in faults else _configuration(camera, faults, "tt:PTZConfiguration")
    return (
        f'<trt:Profiles token="{TOKEN}" fixed="true"><tt:Name>main</tt:Name>'
        '<tt:VideoSourceConfiguration token="source"><tt:Name>source</tt:Name><tt:UseCount>1</tt:UseCount>'
        f'<tt:SourceToken>source</tt:SourceToken><tt:Bounds x="0" y="0" width="{width}" height="{height}"/>'
        '</tt:VideoSourceConfiguration><tt:VideoEncoderConfiguration token="encoder"><tt:Name>encoder</tt:Name>'
        f"<tt:UseCount>1</tt:UseCount><tt:Encoding>H264</tt:Encoding><tt:Resolution><tt:Width>{width}</tt:Width>"
        f"<tt:Height>{height}</tt:Height></tt:Resolution><tt:Quality>5</tt:Quality>"
        "<tt:Multicast><tt:Address><tt:Type>IPv4</tt:Type><tt:IPv4Address>0.0.0.0</tt:IPv4Address></tt:Address>"
        "<tt:Port>0</tt:Port><tt:TTL>0</tt:TTL><tt:AutoStart>false</tt:AutoStart></tt:Multicast>"
        f"<tt:SessionTimeout>PT60S</tt:SessionTimeout></tt:VideoEncoderConfiguration>{moves}</trt:Profiles>"
    )


@answers("trt", "GetStreamUri")
def _stream(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_other_profile(message)
    return (
        f"<trt:MediaUri><tt:Uri>{_stream_address(camera, faults)}</tt:Uri>"
        "<tt:InvalidAfterConnect>false</tt:InvalidAfterConnect><tt:InvalidAfterReboot>false</tt:InvalidAfterReboot>"
        "<tt:Timeout>PT0S</tt:Timeout></trt:MediaUri>"
    )


def _stream_address(camera: OnvifCamera, faults: Faults) -> str:
    return re.sub(r"//[^/:]+", "//10.255.255.1", camera.model.stream) if "behind-nat" in faults else camera.model.stream


@answers("tr2", "GetProfiles")
def _profiles_2(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    """List the profile; it has the configurations of the types that were asked for."""
    asked = {(each.text or "").strip() for each in message.body.findall("{*}Type")}
    moves = {"PTZ", "All"} & asked and "no-ptz" not in faults
    configuration = _configuration(camera, faults, "tr2:PTZ") if moves else ""
    return (
        f'<tr2:Profiles token="{TOKEN}" fixed="true"><tr2:Name>main</tr2:Name>'
        f"<tr2:Configurations>{configuration}</tr2:Configurations></tr2:Profiles>"
    )


@answers("tr2", "GetStreamUri")
def _stream_2(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_other_profile(message)
    if message.text("Protocol") not in ("RtspUnicast", "RtspMulticast", "RTSP", "RtspOverHttp"):
        raise SoapFault("no such protocol", "InvalidArgVal", "InvalidStreamSetup")
    return f"<tr2:Uri>{_stream_address(camera, faults)}</tr2:Uri>"


@answers("tptz", "GetConfigurations")
def _configurations(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    return _configuration(camera, faults, "tptz:PTZConfiguration")


@answers("tptz", "GetConfigurationOptions")
def _options(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    if message.text("ConfigurationToken") != CONFIGURATION:
        raise SoapFault("no such configuration", "InvalidArgVal", "NoConfig")
    longest = LONGEST_TIMEOUT_S["timeout-clamped" in faults]
    return (
        f"<tptz:PTZConfigurationOptions><tt:Spaces>{_spaces(camera, faults)}</tt:Spaces><tt:PTZTimeout>"
        f"<tt:Min>PT1S</tt:Min><tt:Max>PT{longest:g}S</tt:Max></tt:PTZTimeout></tptz:PTZConfigurationOptions>"
    )


@answers("tptz", "GetNodes")
def _nodes(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    return (
        f'<tptz:PTZNode token="{NODE}"><tt:Name>dome</tt:Name><tt:SupportedPTZSpaces>{_spaces(camera, faults)}'
        "</tt:SupportedPTZSpaces><tt:MaximumNumberOfPresets>100</tt:MaximumNumberOfPresets>"
        "<tt:HomeSupported>false</tt:HomeSupported></tptz:PTZNode>"
    )


@answers("tptz", "GetStatus")
def _status(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_other_profile(message)
    if "blocking-status" in faults:
        end = time.monotonic() + BLOCKS_S
        while camera.moving() and time.monotonic() < end:
            time.sleep(0.02)
    pan, tilt, zoom = camera.seen()
    turned = f'<tt:PanTilt x="{pan:.6f}" y="{tilt:.6f}" space="{camera.space}"/>'
    zoomed = f'<tt:Zoom x="{zoom:.6f}" space="{ZOOM}/PositionGenericSpace"/>'
    if "no-status" in faults:
        turned = zoomed = ""
    if "zoom-status" in faults:
        turned = ""
    moves = camera.moving() or "always-moving" in faults
    word = str(moves).lower() if "boolean-status" in faults else "MOVING" if moves else "IDLE"
    return (
        f"<tptz:PTZStatus><tt:Position>{turned}{zoomed}</tt:Position><tt:MoveStatus><tt:PanTilt>{word}</tt:PanTilt>"
        f"<tt:Zoom>IDLE</tt:Zoom></tt:MoveStatus><tt:UtcTime>{camera.now():%Y-%m-%dT%H:%M:%SZ}</tt:UtcTime>"
        "</tptz:PTZStatus>"
    )


def _refuse_other_profile(message: Message) -> None:
    if message.text("ProfileToken") != TOKEN:
        raise SoapFault("Profile token does not exist", "InvalidArgVal", "NoProfile")


def _refuse_unable(message: Message, faults: Faults, *without: str) -> None:
    _refuse_other_profile(message)
    if any(name in faults for name in without):
        raise SoapFault("Optional action not implemented", "ActionNotSupported", code="Receiver")


@answers("tptz", "AbsoluteMove")
def _absolute(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    pan, tilt, zoom = message.vector("Position")
    without = ("no-absolute", "continuous-only", "relative-only") if pan is not None else ()
    _refuse_unable(message, faults, "presets-only", *without)
    speed = message.vector("Speed")[:2]
    if "absolute-ignored" not in faults:
        speeds = None if speed[0] is None or speed[1] is None else (speed[0], speed[1])
        camera.go((pan, tilt), zoom, speeds)
    return ""


@answers("tptz", "RelativeMove")
def _relative(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_unable(message, faults, "continuous-only", "presets-only")
    pan, tilt, zoom = message.vector("Translation")
    at, numbers = camera.position(), camera.numbers()
    turned = message.body.find("{*}Translation/{*}PanTilt")
    in_degrees = turned is not None and turned.get("space") == RELATIVE_DEGREES
    if in_degrees and "relative-degrees" not in faults:
        raise SoapFault("no such space", "InvalidArgVal", "SpaceNotSupported")
    goals = []
    for way, here, (low, high), ends in zip((pan, tilt), at[:2], numbers, camera.ranges_deg, strict=True):
        width = ends[1] - ends[0] if in_degrees else 2.0
        goals.append(None if way is None else min(max(here + way * (high - low) / width, low), high))
    camera.go(goals, None if zoom is None else min(max(at[2] + zoom, 0.0), 1.0), None)
    return ""


@answers("tptz", "ContinuousMove")
def _continuous(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_unable(message, faults, "presets-only", *["relative-only"] * (message.vector("Velocity")[0] is not None))
    said = message.text("Timeout")
    if said and "timeout-fault" in faults:
        raise SoapFault("Timeout is not supported", "InvalidArgVal", "TimeoutNotSupported")
    found = DURATION.fullmatch(said)
    timeout_s = 60 * float(found[1] or 0) + float(found[2] or 0) if found else None
    camera.drive(*message.vector("Velocity"), timeout_s)
    return ""


@answers("tptz", "Stop")
def _halt(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_other_profile(message)
    if "stop-fault" in faults:
        raise SoapFault("Optional action not implemented", "ActionNotSupported", code="Receiver")
    if "stop-ignored" not in faults:
        if message.text("PanTilt") != "false":
            camera.halt()
        if message.text("Zoom") != "false":
            camera.drive(None, None, 0.0, None)
    return ""


@answers("tptz", "SetPreset")
def _set_preset(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_other_profile(message)
    token = message.text("PresetToken") or f"preset_{len(camera.presets) + 1}"
    camera.presets[token] = camera.position()
    return f"<tptz:PresetToken>{token}</tptz:PresetToken>"


@answers("tptz", "GetPresets")
def _presets(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_other_profile(message)
    return "".join(f'<tptz:Preset token="{token}"><tt:Name>{token}</tt:Name></tptz:Preset>' for token in camera.presets)


@answers("tptz", "GotoPreset")
def _go_to_preset(camera: OnvifCamera, faults: Faults, message: Message) -> str:
    _refuse_other_profile(message)
    if message.text("PresetToken") not in camera.presets:
        raise SoapFault("no such preset", "InvalidArgVal", "NoToken")
    pan, tilt, zoom = camera.presets[message.text("PresetToken")]
    camera.go((pan, tilt), zoom, None)
    return ""


# Users


class Tokens:
    """Check the security headers of messages.

    Args:
        user: user name; empty if everyone may connect.
        password: of that user.
        camera: whose clock counts.
        faults: profiles that are on.
    """

    def __init__(self, user: str, password: str, camera: OnvifCamera, faults: Faults) -> None:
        self._user, self._password, self._camera, self._faults = user, password, camera, faults

    def allows(self, envelope: Element) -> bool:
        """Return whether a message is the user's, by digest or by a password in clear, and of about now."""
        if not self._user:
            return True
        token = envelope.find("{*}Header/{*}Security/{*}UsernameToken")
        if token is None:
            return False
        found = {each.tag.rpartition("}")[2]: each for each in token}
        said = {name: (each.text or "").strip() for name, each in found.items()}
        if said.get("Username") != self._user or "Password" not in said:
            return False
        if not found["Password"].get("Type", "").endswith(DIGEST):
            return said["Password"] == self._password
        try:
            nonce, created = base64.b64decode(said["Nonce"]), datetime.fromisoformat(said["Created"])
        except (KeyError, ValueError):
            return False
        window_s = 5.0 if "clock-20s" in self._faults else 300.0
        created = created if created.tzinfo else created.replace(tzinfo=UTC)
        if abs((created - self._camera.now()).total_seconds()) > window_s:
            return False
        wanted = hashlib.sha1(
            nonce + said["Created"].encode() + self._password.encode(), usedforsecurity=False
        ).digest()
        return said["Password"] == base64.b64encode(wanted).decode()


# The server

CLIENT_S = 30.0  # a client that sends nothing for this time has gone [s]
LONGEST_REQUEST = 1 << 18  # [bytes]
SLOW_S = 0.3
SILENT_S = 60.0
RESET = struct.pack("ii", 1, 0)  # SO_LINGER on, 0 s: closing sends a reset
GROWING = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "ha"}">' for i in range(10))
BOMB = f'<?xml version="1.0"?><!DOCTYPE b [{GROWING}]><b>&e9;</b>'
XMLNS = f'xmlns:s="{ENVELOPE}" xmlns:tt="{TT}" xmlns:ter="{TER}" ' + " ".join(
    f'xmlns:{prefix}="{uri}"' for prefix, uri in NAMESPACES.items()
)


def envelope(body: str) -> str:
    """Write an envelope."""
    return f'<?xml version="1.0" encoding="UTF-8"?><s:Envelope {XMLNS}><s:Body>{body}</s:Body></s:Envelope>'


def fault_body(fault: SoapFault) -> str:
    """Write a fault."""
    inner = ""
    for code in reversed(fault.codes):
        inner = f"<s:Subcode><s:Value>ter:{code}</s:Value>{inner}</s:Subcode>"
    return (
        f"<s:Fault><s:Code><s:Value>s:{fault.code}</s:Value>{inner}</s:Code><s:Reason>"
        f'<s:Text xml:lang="en">{fault.reason}</s:Text></s:Reason></s:Fault>'
    )


@dataclass
class Counts:
    """What was asked: messages by name, and the users' tokens that were refused."""

    messages: list[str] = field(default_factory=list)
    refused: int = 0


class OnvifServer(TcpServer):
    """The camera's HTTP server, which runs from its construction until it is closed; a context manager.

    Args:
        camera: the firmware.
        host: address to listen at.
        port: to listen at; 0 for any free port.
        user: user name; empty if everyone may connect.
        password: of that user.
        faults: profiles and faults; may be switched on and off at any time.
    """

    def __init__(
        self,
        camera: OnvifCamera,
        *,
        host: str = LOCAL,
        port: int = 0,
        user: str = "",
        password: str = "",
        faults: Faults,
    ) -> None:
        self.camera, self.faults, self.counts = camera, faults, Counts()
        self.tokens = Tokens(user, password, camera, faults)
        self.guard = Authenticator(user, password, "digest", "camera", secrets.token_hex(16))
        super().__init__(self._serve_client, host, port)

    @property
    def url(self) -> str:
        """Address of the device, without a path."""
        return f"http://[{self.host}]:{self.port}" if ":" in self.host else f"http://{self.host}:{self.port}"

    def close(self) -> None:
        """End the server and what the camera has planned; may be called again."""
        super().close()
        self.camera.close()

    def _serve_client(self, connection: socket.socket) -> None:
        if "refuse" in self.faults:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            return
        connection.settimeout(CLIENT_S)
        Request(connection, self)

    def answer(self, data: bytes) -> tuple[int, str]:
        """Answer an envelope: status of HTTP, and body of the answer."""
        try:
            message, root = self._parse(data)
            self.counts.messages.append(message.name)
            self._refuse_user(message, root)
            answer = ANSWERS.get((message.service, message.name))
            if answer is None or message.service not in {SERVICES[name] for name in _services_of(self.faults)}:
                raise SoapFault("Optional action not implemented", "ActionNotSupported", code="Receiver")
            said = answer(self.camera, self.faults, message)
        except SoapFault as fault:
            refused = "NotAuthorized" in fault.codes
            self.counts.refused += refused
            return 400 if fault.code == "Sender" else 500, fault_body(fault)
        prefix = next(prefix for prefix, uri in NAMESPACES.items() if uri == message.service)
        return 200, f"<{prefix}:{message.name}Response>{said}</{prefix}:{message.name}Response>"

    def _parse(self, data: bytes) -> tuple[Message, Element]:
        try:
            if b"<!" in data:
                raise SoapFault("no document types", "WellFormed")
            root = fromstring(data)
        except (ParseError, LookupError, ValueError):
            raise SoapFault("Well-formed XML expected", "WellFormed") from None
        body = root.find("{*}Body")
        if body is None or len(body) != 1:
            raise SoapFault("no body with one message", "WellFormed")
        namespace, _, name = body[0].tag.lstrip("{").rpartition("}")
        return Message(namespace, name, body[0], self.url), root

    def _refuse_user(self, message: Message, root: Element) -> None:
        if message.name == "GetSystemDateAndTime" and not {"time-needs-user", "unauthorized"} & self._on():
            return
        signed = "http-digest" in self.faults or self.tokens.allows(root)
        if "unauthorized" in self.faults or not signed:
            raise SoapFault("Sender not Authorized", "NotAuthorized")
        if message.name in MOVES and "needs-administrator" in self.faults:
            raise SoapFault("Sender not Authorized", "NotAuthorized")

    def _on(self) -> set[str]:
        return {name for name in ("time-needs-user", "unauthorized") if name in self.faults}


class Request(BaseHTTPRequestHandler):
    """The requests of one connection, answered on construction."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "camera", ""

    def __init__(self, connection: socket.socket, device: OnvifServer) -> None:
        self.device, self.faults = device, device.faults
        super().__init__(connection, None, device)  # type: ignore[arg-type]

    def do_POST(self) -> None:
        """Answer an envelope."""
        length = self.headers.get("Content-Length", "0")
        if not re.fullmatch("[0-9]{1,7}", length) or int(length) > LONGEST_REQUEST:
            self._send(413, "")
            self.close_connection = True
            return
        data = self.rfile.read(int(length))
        if "http-digest" in self.faults and not self.device.guard.allows("POST", self.path, self.headers):
            self._send(401, "", self.device.guard.challenge.partition(": ")[2])
            return
        if self._spoil():
            return
        status, body = self.device.answer(data)
        self._send(status, envelope(body))

    def _spoil(self) -> bool:
        """Answer as the faults say; return whether that was the answer."""
        faults = self.faults
        if "slow-answers" in faults:
            self.device.closing.wait(SLOW_S)
        if "silence" in faults:
            self.device.closing.wait(SILENT_S)
            self.close_connection = True
            return True
        if "garbage" in faults:
            self._send(200, "\x00\x01<<>&garbage")
        elif "bomb" in faults:
            self._send(200, BOMB)
        elif "not-soap" in faults:
            self._send(200, "<html><body>Welcome</body></html>")
        elif "half-answers" in faults:
            self.wfile.write(
                b"HTTP/1.1 200 OK\r\nContent-Type: application/soap+xml\r\nContent-Length: 500\r\n\r\n<?xml"
            )
            self.close_connection = True
        elif "endless" in faults:
            self._send_without_end()
        else:
            return False
        return True

    def _send_without_end(self) -> None:
        self.wfile.write(b"HTTP/1.1 200 OK\r\nContent-Type: application/soap+xml\r\n\r\n")
        self.close_connection = True
        with contextlib.suppress(OSError):
            while not self.device.closing.wait(0.001):
                self.wfile.write(b"<a>" * 1000)

    def _send(self, status: int, body: str, challenge: str = "") -> None:
        data = body.encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/soap+xml; charset=utf-8")
        self.send_header("Content-Length", str(len(data)))
        if challenge:
            self.send_header("WWW-Authenticate", challenge)
        self.end_headers()
        self.wfile.write(data)

    def date_time_string(self, timestamp: float | None = None) -> str:
        """Return the header Date, by the camera's clock."""
        return f"{self.device.camera.now():%a, %d %b %Y %H:%M:%S GMT}"

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""
