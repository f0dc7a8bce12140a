"""The [hardware] tables of rig.toml as frozen dataclasses: where the devices are and what is expected of them.

Values keep the units of the file: metres and degrees, millimetres where a name says so. Defaults are a PTU-D46-17.5 as
it leaves the factory, an Axis 241Q, and a Canon PowerShot S5 IS.
"""

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal
from urllib.parse import urlsplit

from cotarget.errors import ConfigError
from cotarget.simconfig import Limits, Size

BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
SOCKET = re.compile(r"socket://(\[[0-9A-Fa-f:.]+\]|[^:/\s]+):(\d+)/?")
# Positions of the S5 IS's lens and their focal lengths [mm], as measured by the CHDK project.
S5_IS_LENS = ((0, 6.0), (11, 6.4), (41, 12.1), (64, 21.3), (86, 41.6), (105, 61.4), (128, 72.0))


@dataclass(frozen=True)
class HardwareHead:
    """A Directed Perception PTU-D46.

    Attributes:
        port: serial port such as "/dev/ttyUSB0", or "socket://host:port".
        baud: of the serial line.
        step_deg: resolution that the unit is expected to report [degrees].
        pan_deg: lowest and highest pan that it is expected to report, in this file's sense of pan [degrees].
        tilt_deg: the same of tilt [degrees].
        pan_sign: 1 where the unit's positive pan turns right, -1 where it turns left, as the D46's manual has it.
        tilt_sign: 1 where the unit's positive tilt goes up, -1 where it goes down.
        speed_deg_s: speed of moves, as far as the unit allows [degrees/s].
        command_delay_s: from a command to the start of motion, as measured [s].
    """

    port: str = ""
    baud: int = 9600
    step_deg: float = 0.0514286
    pan_deg: Limits = (-158.9, 158.9)
    tilt_deg: Limits = (-46.6, 31.1)
    pan_sign: Literal[1, -1] = -1
    tilt_sign: Literal[1, -1] = 1
    speed_deg_s: float = 149.0
    command_delay_s: float = 0.04


@dataclass(frozen=True)
class HardwareFixed:
    """The wide camera, on an Axis video server or network camera.

    Attributes:
        url: of the server, such as "http://192.168.0.90".
        camera: its number on the server, from 1.
        user: empty where none is asked for.
        password: empty where the environment variable COTARGET_PASSWORD holds it.
        size: (width, height) that is expected [px].
        resolution: as the server calls it, such as "4CIF"; empty for its default.
        rate_hz: frames a second asked for.
        compression: 0 to 100; less is finer.
        latency_s: from light to a frame's first byte, as measured [s].
    """

    url: str = ""
    camera: int = 1
    user: str = ""
    password: str = ""
    size: Size = (704, 576)
    resolution: str = "4CIF"
    rate_hz: float = 25.0
    compression: int = 30
    latency_s: float = 0.1


@dataclass(frozen=True)
class HardwareZoom:
    """The zoom camera, by gphoto2.

    Attributes:
        port: "usb:", "usb:BUS,DEVICE" or "ptpip:host:port:port", as gphoto2 writes them.
        model: as gphoto2 calls it; empty for the one that it finds there.
        settings: what else to set when it is opened, by gphoto2's names.
        zoom_key: gphoto2's name of the setting that moves the lens.
        lens: (position, focal length [mm]) of some positions, from the shortest to the longest; between them the
            logarithm of the focal length is interpolated.
        lens_speed: positions a second, to tell when the lens stands; the camera does not.
        size: (width, height) of the frames of the viewfinder [px].
        still_size: the same of full stills [px].
        pitch_mm: size of a pixel of the viewfinder's frames [mm].
        rate_hz: frames of the viewfinder a second, at most.
        latency_s: from light to a frame, as measured [s].
        command_delay_s: from a command to the start of the lens's motion [s].
    """

    port: str = ""
    model: str = ""
    settings: Mapping[str, str] = field(default_factory=dict)
    zoom_key: str = "zoom"
    lens: tuple[Annotated[tuple[int, float], "[position, mm]"], ...] = S5_IS_LENS
    lens_speed: float = 60.0
    size: Size = (320, 240)
    still_size: Size = (3264, 2448)
    pitch_mm: float = 0.01794
    rate_hz: float = 15.0
    latency_s: float = 0.1
    command_delay_s: float = 0.05


@dataclass(frozen=True)
class HardwareBoard:
    """Who holds the calibration board: "person", or a program at "socket://host:port"."""

    presenter: str = "person"


@dataclass(frozen=True)
class HardwareConfig:
    """The real devices."""

    head: HardwareHead = HardwareHead()
    fixed: HardwareFixed = HardwareFixed()
    zoom: HardwareZoom = field(default_factory=HardwareZoom)
    board: HardwareBoard = HardwareBoard()


def socket_address(url: str) -> tuple[str, int] | None:
    """Host and port of "socket://host:port"; None for anything else."""
    match = SOCKET.fullmatch(url)
    return None if match is None else (match[1].strip("[]"), int(match[2]))


def check_hardware(hardware: HardwareConfig) -> None:
    """Refuse values of the right type that make no sense; devices that are not named are no mistake yet.

    Raises:
        ConfigError: with the key.
    """
    head, fixed, zoom = hardware.head, hardware.fixed, hardware.zoom
    if head.baud not in BAUDS:
        raise ConfigError(f"hardware.head.baud: {head.baud} is not one of: {', '.join(map(str, BAUDS))}")
    for name, limits in (("pan_deg", head.pan_deg), ("tilt_deg", head.tilt_deg)):
        if limits[0] >= limits[1]:
            raise ConfigError(f"hardware.head.{name}: {list(limits)} is not [lowest, highest]")
    if fixed.url and not _is_web_address(fixed.url):
        raise ConfigError(f"hardware.fixed.url: '{fixed.url}' is not like http://192.168.0.90")
    if not 0 <= fixed.compression <= 100:
        raise ConfigError(f"hardware.fixed.compression: {fixed.compression} is not within 0 to 100")
    if len(zoom.lens) < 2 or any(b[0] <= a[0] or b[1] <= a[1] for a, b in itertools.pairwise(zoom.lens)):
        raise ConfigError("hardware.zoom.lens: needs two or more [position, mm], both of them increasing")
    presenter = hardware.board.presenter
    if presenter != "person" and socket_address(presenter) is None:
        raise ConfigError(f"hardware.board.presenter: '{presenter}' is neither person nor like socket://host:port")
    positive: dict[str, tuple[float, ...]] = {
        "head.step_deg": (head.step_deg,),
        "head.speed_deg_s": (head.speed_deg_s,),
        "fixed.camera": (fixed.camera,),
        "fixed.size": fixed.size,
        "fixed.rate_hz": (fixed.rate_hz,),
        "zoom.size": zoom.size,
        "zoom.still_size": zoom.still_size,
        "zoom.lens": (zoom.lens[0][1],),
        "zoom.lens_speed": (zoom.lens_speed,),
        "zoom.pitch_mm": (zoom.pitch_mm,),
        "zoom.rate_hz": (zoom.rate_hz,),
    }
    not_negative = {
        "head.command_delay_s": head.command_delay_s,
        "fixed.latency_s": fixed.latency_s,
        "zoom.latency_s": zoom.latency_s,
        "zoom.command_delay_s": zoom.command_delay_s,
    }
    for where, values in positive.items():
        if min(values) <= 0:
            raise ConfigError(f"hardware.{where}: {min(values):g} is not greater than zero")
    for where, value in not_negative.items():
        if value < 0:
            raise ConfigError(f"hardware.{where}: {value:g} is negative")


def _is_web_address(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # an address in brackets that is none, a port that is no number
        return False
