"""A pan-tilt-zoom camera that ONVIF moves: Profile S or T.

`OnvifDome` is the camera of a rig, and `OnvifLink` its protocol as `PolledHead` asks for it. The device says its media
profiles, its coordinates with their ranges, and how it can be moved. It does not say how many degrees its coordinates
are: `pan_deg` and `tilt_deg` of rig.toml are what their ends mean.

Positions are asked for on a thread of its own, because a status may block while the device moves; every command has a
connection of its own, so that a stop waits for nothing.

Sources: ONVIF PTZ Service Specification 23.12, Media and Media2 Service Specifications, Core Specification.
"""

import contextlib
import math
import queue
import re
import statistics
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from concurrent.futures import TimeoutError as NotDoneError
from dataclasses import dataclass, replace
from functools import partial
from os import environ
from typing import Annotated, NamedTuple
from urllib.parse import urlsplit, urlunsplit
from xml.etree.ElementTree import Element
from xml.sax.saxutils import escape

from cotarget.drivers.axes import AXES, AxisFacts, Poll
from cotarget.drivers.guardian import StopOrder
from cotarget.drivers.head_link import Pair, Requests
from cotarget.drivers.link_errors import AwayError, CutError, RefusedError, SilentError
from cotarget.drivers.polled_head import UNHEARD_S
from cotarget.drivers.ptz import Dome, PtzLink, PtzSettings, lens_positions
from cotarget.drivers.soap import (
    DEVICE,
    DEVICE_PATH,
    EmptyAnswerError,
    FaultError,
    LoginFaultError,
    SoapClient,
    find,
    find_all,
    quote,
    text_at,
)
from cotarget.drivers.stream import EXAMPLE, stream_address
from cotarget.drivers.velocity import ReckonedAxis, SteeredAxis, SteppedAxis
from cotarget.errors import ConfigError, DeviceError
from cotarget.plugins import place_of
from cotarget.rig import Clock
from cotarget.schema import Check, NotNegative, Positive, model

MEDIA, MEDIA2 = "http://www.onvif.org/ver10/media/wsdl", "http://www.onvif.org/ver20/media/wsdl"
PTZ = "http://www.onvif.org/ver20/ptz/wsdl"
SPACES = "http://www.onvif.org/ver10/tptz"
STEPS_DEG, STEPS = (
    f"{SPACES}/PanTiltSpaces/{name}" for name in ("SphericalTranslationSpaceDegrees", "TranslationGenericSpace")
)
GENERIC = f"{SPACES}/PanTiltSpaces/PositionGenericSpace"
# Ports at which cameras have ONVIF, the usual one first.
PORTS = (80, 8000, 8080, 8899, 2020)
ASK_S = 5.0  # for an answer while the device is opened [s]
COMMAND_S = 1.5  # for the answer to a command, beyond what is usual for the device [s]
SLOWEST_S = 1.5  # usual for an answer: a device that takes longer cannot be stopped in time [s]
STATUS_S = 35.0  # for a status: some devices answer when a move has ended [s]
STOP_S = 0.5  # for the answer to a stop, which is then repeated, beyond what is usual for the device [s]
STEERED_S = 0.5  # the same for one that is steered by velocities, which would swing about its goal [s]
REMEDY = "close its page and other programs that ask it, and check the network"
SLOW_S = 0.1  # an answer that usually takes longer is named [s]
LOOK_S = 0.01  # period of looking for a halt during a command [s]
STATUS_PAUSE_S = 0.03  # between the answer to a status and the next question [s]
STATUS_TRIES = 3  # failed statuses in a row, after which the device has gone; one where nothing listens
RETRY_S = 0.2  # pause after a failed status [s]
RIGHTS = "moving takes the rights of an operator or administrator"
STILL_S = 0.3  # whether a device says that it moves cannot be believed; it stands after this time in one place [s]
BLIND_S = 0.5  # positions are reckoned where the device has said none for this time, beyond what is usual for it [s]
LATEST_S = 0.02  # a status that takes longer is of its end [s]
TIMEOUT_S = 1.0  # a continuous move ends by itself after this time, where the device can that [s]
WORKERS = 8  # commands that may be under way at the same time
FINE = 0.02  # velocities are sent again where they change by more, as a share of the highest
ZOOM_STEPS = 1000  # in which the range of the zoom's number is divided
# This far beyond the device's own range, a position is lost; a digital zoom goes on where that of the lens ends.
OUTSIDE_DEG, ZOOM_OUTSIDE = 5.0, 0.5
ONCE = ("RelativeMove",)  # commands that move the device twice if it gets them twice
ZOOM_SLACK = 0.01  # of that range, by which the reported number may be off


@model
class OnvifSettings(PtzSettings):
    """A pan-tilt-zoom camera that ONVIF moves.

    Attributes:
        port: port of ONVIF; 0 to try those that cameras use.
        url: address of its stream; empty for the one that the device says.
        profile: token of the media profile; empty for the first that moves.
        pan_deg: pan at the ends of the device's coordinates, with positive pan to the right [degrees].
        tilt_deg: tilt at the ends of the device's coordinates, with positive tilt up [degrees].
        speed_deg_s: speed of moves; the device turns so at its full speed [degrees/s].
        slack_deg: largest distance of the reported position from the goal where it has arrived [degrees].
        status_delay_s: by how much the positions that it reports are late, as measured [s].
        stop_delay_s: time by which a stop takes longer than a start, as measured; counts where it is steered by
            velocities [s].
        zoom_s: time that the lens takes from end to end [s].
        absolute: whether it obeys absolute moves of pan and tilt; false to steer it by velocities although it says so.
        all_axes: whether each move names pan, tilt and zoom; for a device that takes a missing one as 0.
    """

    url: Annotated[str, Check(stream_address)] = ""
    profile: str = ""
    slack_deg: NotNegative = 0.1
    status_delay_s: NotNegative = 0.0
    stop_delay_s: NotNegative = 0.0
    zoom_s: Positive = 10.0
    speed_deg_s: Positive = 100.0
    absolute: bool = True
    all_axes: bool = False


# What the device says


class Range(NamedTuple):
    """Lowest and highest number of a coordinate or a speed."""

    lowest: float
    highest: float


NOTHING = Range(0.0, 0.0)


class Media(NamedTuple):
    """A media service: its path, and the namespace of its messages, `MEDIA` or `MEDIA2`."""

    path: str
    namespace: str


class Space(NamedTuple):
    """A coordinate system: its name, and the ranges of its numbers."""

    uri: str
    ranges: tuple[Range, ...]


@dataclass(frozen=True)
class Abilities:
    """How a device can be moved, by its configuration.

    Attributes:
        spaces: by the local name of the element, such as "AbsolutePanTiltPositionSpace"; the first of each counts.
        timeout_s: shortest and longest time after which a continuous move may end by itself [s].
    """

    spaces: Mapping[str, tuple[Space, ...]]
    timeout_s: Range

    def space(self, name: str, uri: str = "") -> Space | None:
        """Return the coordinate system of a name and URI, else the first of that name."""
        known = self.spaces.get(name, ())
        return next((space for space in known if space.uri == uri), known[0] if known else None)


class Status(NamedTuple):
    """Positions in the device's coordinates; None where it says none."""

    pan: float | None
    tilt: float | None
    zoom: float | None
    t: float  # on the rig's clock [s]
    space: str = ""  # of pan and tilt


def abilities_of(root: Element | None) -> Abilities:
    """Read an answer to GetConfigurationOptions; none without one."""
    options = find(root, "Body/GetConfigurationOptionsResponse/PTZConfigurationOptions")
    shortest, longest = (seconds(text_at(options, f"PTZTimeout/{name}")) for name in ("Min", "Max"))
    return Abilities(spaces_of(find(options, "Spaces")), Range(shortest, longest))


def spaces_of(element: Element | None) -> dict[str, tuple[Space, ...]]:
    """Read the coordinate systems in an element, by the local names of theirs."""
    spaces: dict[str, tuple[Space, ...]] = {}
    for each in () if element is None else element:
        name = each.tag.rpartition("}")[2]
        spaces[name] = (*spaces.get(name, ()), space_of(each))
    return spaces


def space_of(element: Element) -> Space:
    """Read a coordinate system."""
    ranges = tuple(
        Range(low, high)
        for axis in ("XRange", "YRange")
        if (low := number_at(element, f"{axis}/Min")) is not None
        and (high := number_at(element, f"{axis}/Max")) is not None
    )
    return Space(text_at(element, "URI"), ranges)


def number_at(element: Element | None, path: str) -> float | None:
    """Return a finite number in an element; None where there is none."""
    return _finite(text_at(element, path))


def _finite(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def seconds(text: str) -> float:
    """Convert a duration of XML such as "PT1M30.5S" to seconds; 0 for what is none."""
    found = re.fullmatch(r"P(?:0+Y)?(?:0+M)?(?:(\d+)D)?(?:T(?:(\d+)H)?(?:(\d+)M)?(?:(\d+(?:\.\d+)?)S)?)?", text)
    if found is None:
        return 0.0
    return sum(float(part or 0) * unit for part, unit in zip(found.groups(), (86400, 3600, 60, 1), strict=True))


def path_of(address: str) -> str:
    """Return path and query of a service's address.

    Raises:
        ValueError: it is none.
    """
    parts = urlsplit(address)
    return urlunsplit(("", "", parts.path or DEVICE_PATH, parts.query, ""))


def status_of(root: Element, t: float) -> Status:
    """Read an answer to GetStatus."""
    position = find(root, "Body/GetStatusResponse/PTZStatus/Position")
    turned, zoomed = find(position, "PanTilt"), find(position, "Zoom")
    pan, tilt = (None if turned is None else _finite(turned.get(name)) for name in ("x", "y"))
    space = "" if turned is None else turned.get("space", "")
    return Status(pan, tilt, None if zoomed is None else _finite(zoomed.get("x")), t, space)


@dataclass(frozen=True)
class Coordinate:
    """Conversion of one axis between the device's numbers and degrees in the device's sense."""

    numbers: Range
    degrees: Range

    def to_degrees(self, number: float) -> float:
        """Convert a number to degrees."""
        return self.degrees.lowest + (number - self.numbers.lowest) * self._degrees_each

    def to_number(self, degrees: float) -> float:
        """Convert degrees to a number."""
        return self.numbers.lowest + (degrees - self.degrees.lowest) / self._degrees_each

    def way(self, degrees: float) -> float:
        """Convert an angle between two positions to a difference of numbers."""
        return degrees / self._degrees_each

    @property
    def _degrees_each(self) -> float:
        return (self.degrees.highest - self.degrees.lowest) / (self.numbers.highest - self.numbers.lowest)


# Messages


def vector(pan: float | None, tilt: float | None, zoom: float | None, spaces: tuple[str, str] = ("", "")) -> str:
    """Write positions or speeds as XML; axes that are None are left out."""
    named = [f' space="{uri}"' if uri else "" for uri in spaces]
    turned = "" if pan is None or tilt is None else f'<t:PanTilt x="{pan:.6f}" y="{tilt:.6f}"{named[0]}/>'
    return turned + ("" if zoom is None else f'<t:Zoom x="{zoom:.6f}"{named[1]}/>')


def speeds_in(space: Space | None, pan: float, tilt: float) -> str:
    """Write shares of the highest speeds of pan and tilt as XML, in the numbers of a space; as they are without one."""
    uri, ranges = space or Space("", ())
    ends = ranges or (Range(-1.0, 1.0),)  # speeds without direction have one range for both
    fastest = [max(-end.lowest, end.highest) for end in (ends[0], ends[-1])]
    return vector(pan * fastest[0], tilt * fastest[1], None, (uri, ""))


class OnvifDevice:
    """The device's services, as far as they move it and show it.

    Args:
        settings: address, user and profile.
        clock: the rig's clock.

    Attributes:
        name: of the device in messages.
        model: maker, model and firmware.
        url: address of its stream.
        configuration: the PTZ configuration of its profile.
        abilities: how it can be moved.
        answer_s: median time that it took for an answer while it was opened [s].

    Raises:
        ConfigError: it has no such profile.
        DeviceError: there is no such device, it refuses the user, it answers too slowly, or it cannot be moved.
    """

    def __init__(self, settings: OnvifSettings, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        password = settings.password or environ.get(settings.password_env, "")
        self._remedy = f"check hardware.ptz.user and the password, which may be in {settings.password_env}"
        self._took_s = list[float]()
        self.soap = self._connect(settings, password)
        with contextlib.ExitStack() as opened:
            opened.callback(self.soap.close)
            self.name = self.soap.name
            said = find(self._ask(DEVICE_PATH, DEVICE, "GetDeviceInformation"), "Body/GetDeviceInformationResponse")
            names = (text_at(said, name) for name in ("Manufacturer", "Model", "FirmwareVersion"))
            self.model = quote(" ".join(filter(None, names))) or "a device"
            media, self._ptz = self._services()
            self._refuse_slow()
            self.profile, self.configuration = self._find_profile(media)
            token = f"<ConfigurationToken>{escape(self.configuration.get('token', ''))}</ConfigurationToken>"
            found = abilities_of(self._ask_if_able(self._ptz, PTZ, "GetConfigurationOptions", token))
            self.abilities = replace(found, spaces=self._node_spaces() | dict(found.spaces))
            self.url = settings.url or self._stream_address(media)
            self.answer_s = statistics.median(self._took_s)
            opened.pop_all()

    def status(self) -> Status:
        """Ask for the positions."""
        begin = self._clock.now()
        try:
            root = self.soap.call(self._ptz, PTZ, "GetStatus", self._token, STATUS_S)
        except LoginFaultError:
            raise
        except FaultError:  # some have no status
            return Status(None, None, None, self._clock.now())
        now = self._clock.now()
        return status_of(root, now - min((now - begin) / 2, LATEST_S) - self._settings.status_delay_s)

    def command(self, message: str, inner: str, timeout: float) -> None:
        """Send a command; raises as `SoapClient.call` does. Some devices answer with success alone."""
        with contextlib.suppress(EmptyAnswerError):
            self.soap.call(self._ptz, PTZ, message, self._token + inner, timeout, once=message in ONCE)

    def order(self, message: str, inner: str) -> StopOrder:
        """Write a command for a `Guardian`; the login goes with it only where the device asks for HTTP digest."""
        host, _, port = self._address.rpartition(":")
        signed = self.soap.signed(self._ptz, PTZ, message, self._token + inner)
        login = self.soap.login if b"\nauthorization: " in signed else ()
        return StopOrder(False, host.strip("[]"), int(port), [signed.decode("latin-1")], login)

    @property
    def _token(self) -> str:
        return f"<ProfileToken>{escape(self.profile)}</ProfileToken>"

    def _ask(self, path: str, namespace: str, message: str, inner: str = "") -> Element:
        """Ask while the device is opened; remember how long its answer took."""
        begin = self._clock.now()
        try:
            return self.soap.call(path, namespace, message, inner, ASK_S)
        finally:
            self._took_s.append(self._clock.now() - begin)

    def _refuse_slow(self) -> None:
        """Refuse a device by the shortest time of its first answers, since one alone may be late."""
        if (took_s := min(self._took_s)) > SLOWEST_S:
            raise DeviceError(
                f"{self.name} ({self.model}) takes {took_s:.1f} s for an answer, too long for a head to be stopped: "
                f"{SLOWEST_S:g} s is the most; {REMEDY}"
            )

    def _ask_if_able(self, path: str, namespace: str, message: str, inner: str = "") -> Element | None:
        """Ask what some devices cannot answer; None for a fault that is not about the user."""
        try:
            return self._ask(path, namespace, message, inner)
        except LoginFaultError:
            raise
        except FaultError:
            return None

    def _connect(self, settings: OnvifSettings, password: str) -> SoapClient:
        """Find the port where the device answers; the time can be asked for without a user on most devices."""
        tried, errors = ([settings.port] if settings.port else list(PORTS)), list[DeviceError]()
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        for port in tried:
            self._address = f"{host}:{port}"
            soap = SoapClient(self._address, settings.user, password, self._remedy)
            try:
                soap.call(DEVICE_PATH, DEVICE, "GetSystemDateAndTime", timeout=ASK_S)
            except FaultError:  # it is the device: it wants a user even for its time, or does not say it
                return soap
            except DeviceError as error:
                soap.close()
                errors.append(error)
                continue
            return soap
        if len(tried) == 1:
            raise errors[0]
        said = next((error for error in errors if "cannot be reached" not in str(error)), errors[0])
        ports = ", ".join(map(str, tried))
        raise DeviceError(f"{said}; ports {ports} were tried, and hardware.ptz.port is for another one")

    def _services(self) -> tuple[Media, str]:
        """Return the media service, and the path of the PTZ service."""
        where = self._capabilities()
        if not {MEDIA, PTZ} <= where.keys():  # newer devices have GetServices alone, and list there what is new
            where |= self._listed_services()
        ptz = where.get(PTZ, "")
        if not ptz:
            raise DeviceError(
                f"{self.name} ({self.model}) has no pan-tilt-zoom service: it can be [hardware.fixed] with "
                'driver = "stream"'
            )
        namespace = MEDIA2 if MEDIA2 in where and MEDIA not in where else MEDIA
        # Behind a router or a proxy a device gives an address that leads nowhere from here.
        try:
            return Media(path_of(where.get(namespace, "")), namespace), path_of(ptz)
        except ValueError as error:
            raise DeviceError(
                f"{self.name} ({self.model}) names addresses of services that are none: {error}"
            ) from None

    def _capabilities(self) -> dict[str, str]:
        """Return the addresses of services by GetCapabilities, which some devices lack."""
        root = self._ask_if_able(DEVICE_PATH, DEVICE, "GetCapabilities", "<Category>All</Category>")
        found = find(root, "Body/GetCapabilitiesResponse/Capabilities")
        said = {MEDIA: text_at(found, "Media/XAddr"), PTZ: text_at(found, "PTZ/XAddr")}
        return {namespace: address for namespace, address in said.items() if address}

    def _listed_services(self) -> dict[str, str]:
        """Return the addresses of services by GetServices, which older devices lack."""
        root = self._ask_if_able(DEVICE_PATH, DEVICE, "GetServices", "<IncludeCapability>false</IncludeCapability>")
        known = find_all(root, "Body/GetServicesResponse/Service")
        return {text_at(each, "Namespace"): text_at(each, "XAddr") for each in known}

    def _find_profile(self, media: Media) -> tuple[str, Element]:
        """Return the token of the media profile, and its PTZ configuration."""
        inner, path = (
            ("", "PTZConfiguration") if media.namespace == MEDIA else ("<Type>PTZ</Type>", "Configurations/PTZ")
        )
        profiles = find_all(self._ask(*media, "GetProfiles", inner), "Body/GetProfilesResponse/Profiles")
        moving = {
            profile.get("token", ""): configuration
            for profile in profiles
            if (configuration := find(profile, path)) is not None
        }
        names = [quote(profile.get("token", "")) for profile in profiles]
        if not moving:
            raise DeviceError(
                f"{self.name} ({self.model}) has no media profile that moves, only {', '.join(names) or 'none'}: add "
                "pan-tilt-zoom to one in the camera's page"
            )
        wanted = self._settings.profile or next(iter(moving))
        if wanted not in moving:
            raise ConfigError(
                f"hardware.ptz.profile: {self.name} has no '{wanted}' that moves; valid here: {', '.join(moving)}"
            )
        return wanted, moving[wanted]

    def _node_spaces(self) -> dict[str, tuple[Space, ...]]:
        """Return the coordinate systems of the configuration's node, which has those that some configurations lack."""
        nodes = find_all(self._ask_if_able(self._ptz, PTZ, "GetNodes"), "Body/GetNodesResponse/PTZNode")
        wanted = text_at(self.configuration, "NodeToken")
        node = next((node for node in nodes if node.get("token") == wanted), None)
        return spaces_of(find(node, "SupportedPTZSpaces"))

    def _stream_address(self, media: Media) -> str:
        """Return the address of the stream, at the host that the user has given; empty where the device says none."""
        setup = "<t:Stream>RTP-Unicast</t:Stream><t:Transport><t:Protocol>RTSP</t:Protocol></t:Transport>"
        inner, path = f"<StreamSetup>{setup}</StreamSetup>", "MediaUri/Uri"
        if media.namespace == MEDIA2:
            inner, path = "<Protocol>RTSP</Protocol>", "Uri"
        try:
            root = self._ask(*media, "GetStreamUri", inner + self._token)
        except FaultError:
            return ""
        said = text_at(root, f"Body/GetStreamUriResponse/{path}")
        host = f"[{self._settings.host}]" if ":" in self._settings.host else self._settings.host
        try:
            parts = urlsplit(said)
            where = parts.netloc.rpartition("@")[2].rpartition(":")
            port = f":{where[2]}" if where[1] and where[2].isdigit() else ""
            return stream_address(parts._replace(netloc=f"{host}{port}").geturl()) if parts.netloc else ""
        except ValueError as error:
            raise ConfigError(
                f"hardware.ptz.url: the address that {self.name} names, {quote(said.rpartition('@')[2])}, {error}; "
                f'write url = "{EXAMPLE}"'
            ) from None


# The link


class StatusReader:
    """Ask for the positions on a thread of its own, because a status may block for as long as the device moves."""

    def __init__(self, ask: Callable[[], Status], first: Status) -> None:
        self._ask = ask
        self._newest = first
        self._taken: Status | None = None
        self._error: DeviceError | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="onvif status", daemon=True)
        self._thread.start()

    def take(self) -> Status | None:
        """Return the newest positions; None where there are none since the last call.

        Raises:
            DeviceError: the device has gone, or the thread has ended by a mistake in the driver.
        """
        if self._error is not None:
            raise self._error
        newest = self._newest
        if newest is self._taken:
            return None
        self._taken = newest
        return newest

    def close(self) -> None:
        """Let the thread end, without waiting for a status that blocks."""
        self._closing.set()

    def _run(self) -> None:
        failed = 0
        while not self._closing.wait(STATUS_PAUSE_S if not failed else RETRY_S):
            try:
                self._newest, failed = self._ask(), 0
            except DeviceError as error:
                failed += 1
                # One that starts anew may come back with other positions.
                if failed == STATUS_TRIES or isinstance(error, AwayError):
                    self._error = error
                    return
            except Exception as error:  # without its thread the head would look healthy
                self._error = DeviceError(f"the driver of the dome failed: {error!r} ({place_of(error)})")
                return


class Workers:
    """Run functions on daemon threads, also at the end of the program, when an executor takes none any more."""

    def __init__(self) -> None:
        self._calls = queue.SimpleQueue[tuple[Future[None], Callable[[], None]] | None]()
        for _ in range(WORKERS):  # from the start, because no thread starts at the end of the program
            threading.Thread(target=self._run, name="onvif command", daemon=True).start()

    def submit(self, act: Callable[[], None]) -> Future[None]:
        """Run a function; the future has its error."""
        done = Future[None]()
        self._calls.put((done, act))
        return done

    def close(self) -> None:
        """Let the threads end, each after the function that it runs."""
        for _ in range(WORKERS):
            self._calls.put(None)

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            done, act = call
            try:
                act()
            except BaseException as error:
                done.set_exception(error)
            else:
                done.set_result(None)


class OnvifLink(PtzLink):
    """The protocol of a camera that ONVIF moves; the camera was only asked.

    Pan and tilt go to positions by absolute moves. Where the device has none, they are steered there by velocities, and
    where it has no velocities either, they go by relative moves, here steps. Positions that the device does not say are
    reckoned from the commands.

    Raises:
        ConfigError: it has no such profile.
        DeviceError: there is no such camera, it refuses the user, or it cannot be moved to positions.
    """

    pause_s = 0.01

    def __init__(self, settings: OnvifSettings, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self._device = device = OnvifDevice(settings, clock)
        self.name, self.url = device.name, device.url
        self._who = f"{self.name} ({device.model})"
        with contextlib.ExitStack() as opened:
            opened.callback(device.soap.close)
            status = device.status()
            self._way = self._refuse_unable(status)
            self._coordinates = self._find_coordinates(status)
            self._refuse_lost(status)
            self.axes = self._find_axes()
            self._reckoned = [ReckonedAxis(facts, settings.command_delay_s) for facts in self.axes]
            delays = settings.command_delay_s, settings.stop_delay_s, device.answer_s
            self._steered = [SteeredAxis(facts, *delays) for facts in self.axes[:2]]
            self._stepped, self._speeds = (SteppedAxis(), SteppedAxis()), (0.0, 0.0)
            self._renewed, self._timeout_s = -math.inf, self._find_timeout()
            self._seen, self._heard = status, clock.now()
            self._said = dict[int, float]()  # when the device said the position of each axis last
            self._due = -math.inf  # when the newest move or zoom should have ended
            self._blocks = False  # whether a status has been late before
            self.identity = self._describe(status)
            self._goals: tuple[float | None, float | None, float | None] = self._positions(status)
            self._workers = Workers()
            self.answer_s = 2 * device.answer_s  # one answer takes longer than another
            self._sent = Future[None]()  # of the newest command
            self._sent.set_result(None)
            self._reader = StatusReader(device.status, status)
            opened.pop_all()

    def poll(self, requests: Requests) -> Sequence[Poll]:
        """Take the newest positions, and reckon those that the device does not say; steer an axis on its way."""
        status, now = self._reader.take(), self._clock.now()
        if status is not None and self._way != "positions" and (status.pan is None or status.tilt is None):
            status = None  # without a position nothing is steered
        if status is not None:
            self._refuse_lost(status)
            self._blocks |= now - self._heard > BLIND_S + self.answer_s
            self._heard, self._seen = now, status
        elif now - self._heard < BLIND_S + self.answer_s:
            return []
        polls = self._polls(status, now)
        try:
            if self._way == "velocities":
                self._steer(requests, is_blind=status is None)
            elif self._way == "steps" and status is not None and status.t > self._due + STILL_S:
                self._step_on(requests)
        except RefusedError as error:  # such as "busy": it ends the move
            self._stop(now + STOP_S + self.answer_s)
            raise CutError(str(error)) from None
        return polls

    def move(self, goals: Pair, speeds: Pair, requests: Requests) -> None:
        """Send pan and tilt to positions by an absolute move, or begin to steer them there."""
        self._goals, now = (*goals, self._goals[2]), self._clock.now()
        if self._way == "velocities":
            for axis, goal, speed in zip(self._steered, goals, speeds, strict=True):
                axis.aim(goal, speed, now)
            self._steer(requests)
            return
        self._speeds = speeds
        if self._way == "steps":
            self._step(goals, requests)
        else:
            zoom = self._goal_or_place(2, now) if self._settings.all_axes else None
            self._absolute(goals, zoom, self._shares(), requests)
        self._reckon(goals, now)

    def zoom(self, position: float, requests: Requests) -> None:
        """Send the lens to a position."""
        self._goals, now = (*self._goals[:2], position), self._clock.now()
        all_axes = self._settings.all_axes and self._way == "positions"
        both = (self._goal_or_place(0, now), self._goal_or_place(1, now)) if all_axes else None
        self._absolute(both, position, None, requests)
        self._reckoned[2].command(position, self.axes[2].fastest, now)
        self._due = max(reckoned.arrives for reckoned in self._reckoned)

    def halt(self, patience: float) -> None:
        """Stop pan and tilt; once more when a command that was given up is answered, since it may move them later."""
        deadline = self._clock.now() + max(patience, STOP_S) + self.answer_s
        self._goals = (None, None, self._goals[2])
        self._stop(deadline)
        if not self._sent.done():
            wait([self._sent], max(deadline - self._clock.now(), 0.0))
            self._stop(deadline)

    def close(self) -> None:
        """Release the connections; never raises."""
        super().close()
        self._reader.close()
        self._workers.close()
        self._device.soap.close()

    # What the device is

    def _refuse_unable(self, status: Status) -> str:
        """Refuse a device that can be neither sent nor led to positions; return by what it is moved."""
        abilities, who = self._device.abilities, self._who
        if not abilities.space("AbsoluteZoomPositionSpace") and abilities.spaces:
            raise DeviceError(f"{who} has no zoom that goes to positions: it is not driven")
        if abilities.space("AbsolutePanTiltPositionSpace") and self._settings.absolute:
            return "positions"
        by = "velocities" if abilities.space("ContinuousPanTiltVelocitySpace") else "steps"
        if by == "velocities" and self._device.answer_s > STEERED_S:
            raise DeviceError(
                f"{who} takes {self._device.answer_s:.1f} s for an answer, too long to be steered by velocities: "
                f"{STEERED_S:g} s is the most; {REMEDY}"
            )
        if by == "steps" and self._steps_space() is None:
            by = "steps in parts of its picture" if abilities.space("RelativePanTiltTranslationSpace") else "presets"
            raise DeviceError(f"{who} has neither absolute moves nor velocities, only {by}: it is not driven")
        if status.pan is None or status.tilt is None:
            raise DeviceError(f"{who} can only be moved by {by}, and does not say where it is: it is not driven")
        return by

    def _steps_space(self) -> Space | None:
        """Return the space of relative moves, in degrees if there is such a one; None without a known one."""
        known = {space.uri: space for space in self._device.abilities.spaces.get("RelativePanTiltTranslationSpace", ())}
        return known.get(STEPS_DEG) or known.get(STEPS)

    def _find_timeout(self) -> float | None:
        """Return the timeout of continuous moves [s]; None where the device has none of its own choice."""
        shortest, longest = self._device.abilities.timeout_s
        return min(max(TIMEOUT_S, shortest), longest) if longest > 0 else None

    def _find_coordinates(self, status: Status) -> tuple[Coordinate, Coordinate, Coordinate]:
        """Find the coordinate systems of the moves, which have to be those of the status."""
        settings, abilities = self._settings, self._device.abilities
        turned = abilities.space("AbsolutePanTiltPositionSpace", status.space) or self._limits_space(status)
        zoomed = abilities.space("AbsoluteZoomPositionSpace")
        assert zoomed is not None
        ranges = (*(*turned.ranges, NOTHING, NOTHING)[:2], (*zoomed.ranges, NOTHING)[0])
        for word, given in zip(("pan", "tilt", "zoom"), ranges, strict=True):
            if given == NOTHING:
                raise DeviceError(f"{self._who} does not say the ends of {word}: it is not driven")
            if not given.lowest < given.highest:
                raise DeviceError(
                    f"{self._who} says that {word} goes from {given.lowest:g} to {given.highest:g}: it is not driven"
                )
        self._uris = (turned.uri, zoomed.uri)
        own_degrees = turned.uri.endswith("SphericalPositionSpaceDegrees")
        found = []
        limits = (settings.pan_deg, settings.tilt_deg)
        for sign, degrees, numbers in zip(settings.signs, limits, ranges[:2], strict=True):
            ends = Range(*sorted(sign * end for end in degrees))
            found.append(Coordinate(numbers, numbers if own_degrees else ends))
        return found[0], found[1], Coordinate(ranges[2], ranges[2])

    def _refuse_lost(self, status: Status) -> None:
        """Refuse a position outside of the device's own range: it is lost, or in other numbers.

        To steer by it would lead to an end, and a move from it would not be over.
        """
        pan, tilt, zoom = self._coordinates
        beyond = pan.way(OUTSIDE_DEG), tilt.way(OUTSIDE_DEG), ZOOM_OUTSIDE * (zoom.numbers[1] - zoom.numbers[0])
        for word, at, coordinate, most in zip(AXES, status[:3], self._coordinates, beyond, strict=True):
            lowest, highest = coordinate.numbers
            if at is not None and not lowest - most <= at <= highest + most:
                raise DeviceError(
                    f"{self._who} says that {word} is at {at:.4g}, outside of its own range from {lowest:g} to "
                    f"{highest:g}: its position is lost; switch it off and on, so that it finds its limits"
                )

    def _limits_space(self, status: Status) -> Space:
        """Return the coordinates of the status of a device without absolute moves: those of its limits.

        Limits are optional; the generic space of the PTZ Service Specification goes from -1 to 1.
        """
        space = find(self._device.configuration, "PanTiltLimits/Range")
        if space is not None:
            return space_of(space)
        return Space(GENERIC, (Range(-1.0, 1.0),) * 2) if status.space in ("", GENERIC) else Space(status.space, ())

    def _find_axes(self) -> tuple[AxisFacts, AxisFacts, AxisFacts]:
        settings = self._settings
        pan, tilt = (
            AxisFacts(
                unit=math.radians(1.0),
                lowest=coordinate.degrees.lowest,
                highest=coordinate.degrees.highest,
                fastest=settings.speed_deg_s,
                step=step,
                slack=settings.slack_deg,
                still_s=STILL_S,
                loses_steps=False,
            )
            for coordinate, step in zip(self._coordinates[:2], settings.steps_deg, strict=True)
        )
        lowest, highest = self._coordinates[2].numbers
        width = highest - lowest
        lens = AxisFacts(
            unit=1.0,
            lowest=lowest,
            highest=highest,
            fastest=width / settings.zoom_s,
            step=width / ZOOM_STEPS,
            slack=ZOOM_SLACK * width,
            still_s=STILL_S,
            loses_steps=False,
        )
        return pan, tilt, lens

    def _describe(self, status: Status) -> str:
        """Describe the device in one line."""
        positions = zip(("pan", "tilt", "zoom"), self._positions(status), ("degrees", "degrees", ""), strict=True)
        where = [
            f"{word} {at:.1f} {unit}" if unit else f"{word} {at:g}" for word, at, unit in positions if at is not None
        ]
        missing = [word for word, number in zip(("pan", "tilt", "zoom"), status[:3], strict=True) if number is None]
        if missing:
            where.append(f"no position of {' and '.join(missing)}, which is reckoned from the commands")
        off = self._device.soap.clock_off_s
        clock = [f"its clock {off:+.0f} s off"] if abs(off) > 1.0 else []
        slow = [f"answers after {self._device.answer_s:.1f} s"] if self._device.answer_s > SLOW_S else []
        way = {"velocities": ["steered by velocities"], "steps": ["moved by relative moves"]}.get(self._way, [])
        address = self.name.removeprefix("the device at ")
        parts = [
            f"{self._device.model} at {address}",
            f"profile {quote(self._device.profile)}",
            *clock,
            *slow,
            *way,
            *where,
        ]
        return ", ".join(parts)

    def _positions(self, status: Status) -> tuple[float | None, float | None, float | None]:
        """Convert positions to degrees in the device's sense, and to the zoom's number; None where there are none."""
        pan, tilt, zoom = (
            None if number is None else coordinate.to_degrees(number)
            for number, coordinate in zip(status[:3], self._coordinates, strict=True)
        )
        return pan, tilt, zoom

    def _polls(self, answer: Status | None, now: float) -> list[Poll]:
        """Make polls of the positions that were said, and of those that are reckoned."""
        polls = []
        status = answer or Status(None, None, None, now)
        for i, (position, reckoned) in enumerate(zip(self._positions(status), self._reckoned, strict=True)):
            if position is None:
                self._refuse_silence(i, now)
                if answer is not None and i in self._said and now > reckoned.arrives:
                    continue  # it says its position when it stands, which may be later than reckoned
                here, sigma = reckoned.at(now)
                polls.append(Poll(i, here, now, sigma=sigma))
            else:
                self._said[i] = now
                reckoned.correct(position, status.t)
                polls.append(Poll(i, position, status.t))
        return polls

    def _refuse_silence(self, axis: int, now: float) -> None:
        """Raise where an axis says no position any more, though it should stand, and no status was late before."""
        if now - max(self._said.get(axis, now), self._due) > UNHEARD_S and not self._blocks:
            raise SilentError(f"{self.name} has said no position of {AXES[axis]} for {UNHEARD_S:g} s")

    # Commands

    def _goal_or_place(self, axis: int, now: float) -> float:
        """Return an axis's goal; where it has none, as after a halt, the position where it stands."""
        place = self._positions(self._seen)[axis]
        goal = self._goals[axis] if self._goals[axis] is not None else place
        return self._reckoned[axis].at(now)[0] if goal is None else goal

    @property
    def _fastest_deg_s(self) -> float:
        """Speed at which the device turns at full speed, at the zoom of now [degrees/s]."""
        settings, number = self._settings, self._positions(self._seen)[2]
        if not settings.zoomed_speeds:
            return settings.speed_deg_s
        if number is None:
            number, _ = self._reckoned[2].at(self._clock.now())
        return settings.fastest_deg_s(lens_positions(settings, self.axes[2]).focal_at(number) / settings.wide_px)

    def _steer(self, requests: Requests, is_blind: bool = False) -> None:
        """Send the velocities that lead to the goals, where they change, or before the device ends them by itself.

        Where the device does not say any more where it is, they are 0 until it does.
        """
        now = self._clock.now()
        pan, tilt, _ = self._positions(self._seen)
        assert pan is not None
        assert tilt is not None
        panned, tilted = self._steered
        wanted = [panned.wanted(pan, self._seen.t, now, alone=not tilted.velocity)]
        wanted.append(tilted.wanted(tilt, self._seen.t, now, alone=not wanted[0]))
        if is_blind:
            wanted = [0.0, 0.0]
        fastest = self._fastest_deg_s
        wanted = [min(max(speed, -fastest), fastest) for speed in wanted]
        same = all(
            abs(speed - axis.velocity) <= FINE * fastest and (speed == 0) == (axis.velocity == 0)
            for speed, axis in zip(wanted, self._steered, strict=True)
        )
        due = any(wanted) and now - self._renewed > (self._timeout_s or TIMEOUT_S) / 2
        if same and not due:
            return
        self.guard([self._device.order(*order) for order in self._stops] if any(wanted) else [])
        velocity = self._velocity(wanted[0] / fastest, wanted[1] / fastest)
        timeout = f"<Timeout>PT{self._timeout_s:g}S</Timeout>" if self._timeout_s else ""
        try:
            self._send("ContinuousMove", velocity + timeout, requests)
        except RefusedError:
            if not timeout:
                raise
            self._send("ContinuousMove", velocity, requests)
            self._timeout_s = None  # some refuse a timeout though they say its range
        self._renewed = now
        for axis, speed in zip(self._steered, wanted, strict=True):
            axis.send(speed, now, alone=not any(wanted))

    def _velocity(self, pan: float, tilt: float) -> str:
        """Write velocities as shares of the highest; without a zoom, since one of 0 would stop the lens."""
        space = self._device.abilities.space("ContinuousPanTiltVelocitySpace")
        return f"<Velocity>{speeds_in(space, pan, tilt)}</Velocity>"

    @property
    def _stops(self) -> list[tuple[str, str]]:
        """What stops it: a stop, and velocities of zero, since devices may ignore one of them."""
        orders = [("Stop", "<PanTilt>true</PanTilt><Zoom>false</Zoom>")]
        if self._device.abilities.space("ContinuousPanTiltVelocitySpace"):
            orders.append(("ContinuousMove", self._velocity(0.0, 0.0)))
        return orders

    def _stop(self, deadline: float) -> None:
        """Stop; repeat each order until it is answered."""
        orders, limit_s = self._stops, STOP_S + self.answer_s
        faults, count = list[BaseException](), len(orders)
        while orders:
            answers = [self._workers.submit(partial(self._device.command, *order, limit_s)) for order in orders]
            wait(answers, limit_s + LOOK_S)
            errors = [answer.exception() if answer.done() else NotDoneError("no whole answer") for answer in answers]
            faults += [error for error in errors if isinstance(error, FaultError)]
            silent = [error for error in errors if error is not None and not isinstance(error, FaultError)]
            if silent and self._clock.now() > deadline:
                raise DeviceError(f"{self.name} does not stop: {silent[0]}") from silent[0]
            orders = [order for order, error in zip(orders, errors, strict=True) if error in silent]
            if silent:
                self._clock.sleep_until(self._clock.now() + LOOK_S)  # a refused connection takes no time
        if len(faults) == count:
            why = f"; {RIGHTS}" if isinstance(faults[0], LoginFaultError) else ""
            raise DeviceError(f"{self.name} does not stop: {faults[0]}{why}") from faults[0]
        if self._way == "velocities":
            self.guard([])
        self._due = now = self._clock.now()
        for steered in self._steered:
            steered.stop(now)
        for reckoned in self._reckoned[:2]:
            reckoned.halt(now)

    def _shares(self) -> Pair:
        """Return the speeds of the newest move as shares of the highest."""
        pan, tilt = (min(speed / self._fastest_deg_s, 1.0) for speed in self._speeds)
        return pan, tilt

    def _reckon(self, goals: Pair, now: float) -> None:
        """Reckon where a move of now leads."""
        for reckoned, goal, speed in zip(self._reckoned[:2], goals, self._speeds, strict=True):
            reckoned.command(goal, speed, now)
        self._due = max(reckoned.arrives for reckoned in self._reckoned)

    def _step(self, goals: Pair, requests: Requests) -> None:
        """Send pan and tilt to positions by a relative move from where they are."""
        now, space = self._clock.now(), self._steps_space()
        assert space is not None
        steps = []
        for i, (stepped, reckoned) in enumerate(zip(self._stepped, self._reckoned, strict=False)):
            way = stepped.toward(goals[i], reckoned.at(now)[0], rests=now > self._due + STILL_S)
            if space.uri == STEPS:  # the largest number is from one end to the other
                degrees, numbers = self._coordinates[i].degrees, space.ranges[i]
                way *= numbers.highest / (degrees.highest - degrees.lowest)
                way = min(max(way, numbers.lowest), numbers.highest)
            steps.append(way)
        inner = f"<Translation>{vector(steps[0], steps[1], None, (space.uri, ''))}</Translation>"
        inner += f"<Speed>{speeds_in(self._device.abilities.space('PanTiltSpeedSpace'), *self._shares())}</Speed>"
        self._send("RelativeMove", inner, requests)

    def _step_on(self, requests: Requests) -> None:
        """Send pan and tilt on where a step has ended off the goal."""
        pan, tilt, _ = self._positions(self._seen)
        goals = self._goals[:2]
        assert pan is not None
        assert tilt is not None
        for stepped, at in zip(self._stepped, (pan, tilt), strict=True):
            stepped.rest(at)
        if goals[0] is None or goals[1] is None:
            return
        if max(abs(goals[0] - pan), abs(goals[1] - tilt)) > self._settings.slack_deg:
            self._step((goals[0], goals[1]), requests)
            self._reckon((goals[0], goals[1]), self._clock.now())

    def _absolute(self, goals: Pair | None, zoom: float | None, speeds: Pair | None, requests: Requests) -> None:
        pan, tilt = (None, None) if goals is None else map(Coordinate.to_number, self._coordinates[:2], goals)
        inner = f"<Position>{vector(pan, tilt, zoom, self._uris)}</Position>"
        if speeds is not None and goals is not None:
            inner += f"<Speed>{speeds_in(self._device.abilities.space('PanTiltSpeedSpace'), *speeds)}</Speed>"
        self._send("AbsoluteMove", inner, requests)

    def _send(self, message: str, inner: str, requests: Requests) -> None:
        """Send a command; give up waiting for its answer where a halt waits."""
        self._sent = self._workers.submit(partial(self._device.command, message, inner, COMMAND_S + self.answer_s))
        while True:
            try:
                self._sent.result(timeout=LOOK_S)
            except NotDoneError:
                if requests.halt_waits():
                    requests.proceed()
            except LoginFaultError as error:
                raise RefusedError(f"{error}; {RIGHTS}") from None
            except FaultError as error:
                raise RefusedError(str(error)) from None
            else:
                return


class OnvifDome(Dome):
    """A camera that ONVIF moves; arguments and errors are those of `Dome`."""

    Settings = OnvifSettings
    Link = OnvifLink
