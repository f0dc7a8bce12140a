"""Emulate a whole rig behind its devices' protocols: one world, and servers for head, cameras, board and control.

Head and zoom camera are a PTU-D46 and a Canon PowerShot, or a dome: a protocol that moves both, and a stream.
"""

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from cotarget.config import DEFAULT_TARGETS, RigConfig, SimCamera
from cotarget.emulators.axis_241q import AXIS_FAULTS, AxisServer
from cotarget.emulators.canon_s5is import S5IS_FAULTS, S5isServer
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import UnitPorts
from cotarget.emulators.ptu_d46.unit import UnitProfile
from cotarget.emulators.serve import LOCAL, Closes, Faults, JsonLines
from cotarget.emulators.visca import UNITS, VISCA_FAULTS, ViscaCamera, ViscaModel, ViscaServer, lens_table
from cotarget.emulators.world import LiveWorld
from cotarget.errors import ConfigError, choices
from cotarget.schema import Pose, model, validate
from cotarget.sim.truth import CameraName

PREVIEW_SHARE = 2  # the viewfinder's images are smaller than stills by this factor
QUALITY = 90  # of JPEG, as the simulated cameras have by default
PAN_SIGN = -1  # positive pan turns left, as in the D46's manual
FAULTS: Mapping[str, tuple[str, ...]] = {
    "head": D46_FAULTS,
    "fixed": AXIS_FAULTS,
    "zoom": S5IS_FAULTS,
    "ptz": VISCA_FAULTS,
}
DOMES = ("visca",)  # protocols of a dome
TWO_DEVICES, DOME = ("head", "fixed", "zoom"), ("fixed", "ptz")  # the devices without a dome, and with one
COPIED = ("board", "follow", "safety", "targets")  # tables of the simulated rig's file that hold for the emulated one


@dataclasses.dataclass(frozen=True)
class Ports:
    """Address and ports to listen at; 0 for any free port."""

    host: str = LOCAL  # address of all servers
    head: int = 0  # TCP port of the head, beside its pseudo-terminal; UDP port of a dome, for messages with a header
    fixed: int = 0  # HTTP port of the video server
    zoom: int = 0  # PTP/IP port of the zoom camera; HTTP port of a dome's stream
    board: int = 0  # port of the board's holder
    control: int = 0  # port for faults and ground truth


@model
class BoardRequest:
    """What the board's holder is asked for: the board at a pose or away, or a board that swings about a pose."""

    present: Pose | None = None
    swing: Pose | None = None


class Emulation(Closes):
    """The emulated rig, from its construction until it is closed; a context manager.

    Args:
        config: of the simulated rig, in real time; see `cotarget.emulators.world.paced`.
        ports: where to listen.
        user: user name of the video server; empty if everyone may connect.
        password: of that user.
        dome: protocol of head and zoom camera in one housing, of `DOMES`; empty for a PTU-D46 and a PowerShot.
        units: of a dome, by rig.toml's name.

    Raises:
        ConfigError: these devices cannot have the simulated rig's sizes or steps.
        DeviceError: a port cannot be opened, or the machine cannot render.
    """

    def __init__(
        self,
        config: RigConfig,
        ports: Ports = Ports(),
        *,
        user: str = "",
        password: str = "",
        dome: str = "",
        units: str = "ptzoptics",
    ) -> None:
        self.dome, self._units, self._user, self._password, self._ports = dome, units, user, password, ports
        self.config = _in_units(config, units) if dome else config
        size = config.sim.zoom.size
        if not dome and (size[0] % PREVIEW_SHARE or size[1] % PREVIEW_SHARE):
            raise ConfigError(f"sim.zoom.size: {list(size)} cannot be halved for the viewfinder")
        self.faults = {device: Faults(FAULTS[device]) for device in (DOME if dome else TWO_DEVICES)}
        self._share = 1 if dome else PREVIEW_SHARE
        self.preview_size = size[0] // self._share, size[1] // self._share
        with contextlib.ExitStack() as opened:
            self.world = opened.enter_context(LiveWorld(self.config, pan_sign=1 if dome else PAN_SIGN))
            if dome:
                self._open_dome(opened)
            else:
                self._open_two_devices(opened)
            self.fixed = opened.enter_context(self._video_server("fixed", ports.fixed))
            self.board = opened.enter_context(JsonLines(self._present_board, ports.host, ports.board))
            self.control = opened.enter_context(JsonLines(self._control, ports.host, ports.control))
            self._opened = opened.pop_all()

    def _open_two_devices(self, opened: contextlib.ExitStack) -> None:
        """Open a PTU-D46 and a PowerShot."""
        world, head, ports, (lowest, highest) = (
            self.world,
            self.config.sim.head,
            self._ports,
            self.config.sim.head.pan_deg,
        )
        unit = UnitProfile.from_degrees(
            (-highest, -lowest), head.tilt_deg, head.step_deg, head.speed_deg_s, head.accel_deg_s2
        )
        firmware = D46(world.pan, world.tilt, unit, self.faults["head"], world.clock.now)
        self.head = opened.enter_context(UnitPorts(firmware, tcp=ports.head, host=ports.host))
        self.zoom = opened.enter_context(
            S5isServer(
                world.feeds["zoom"],
                world.still,
                world.lens,
                host=ports.host,
                port=ports.zoom,
                preview_size=self.preview_size,
                quality=QUALITY,
                faults=self.faults["zoom"],
            )
        )

    def _open_dome(self, opened: contextlib.ExitStack) -> None:
        """Open a dome: the protocol that moves it, and its stream."""
        world, head = self.world, self.config.sim.head
        count_deg, speeds = UNITS[self._units]
        model = ViscaModel(
            count_deg,
            speeds,
            pan=_counts(head.pan_deg, count_deg),
            tilt=_counts(head.tilt_deg, count_deg),
            highest_deg_s=head.speed_deg_s,
            acceleration_deg_s2=head.accel_deg_s2,
        )
        camera = ViscaCamera(world.pan, world.tilt, world.lens, model, self.faults["ptz"])
        ports = (self._ports.head, 0, 0)
        self.ptz = opened.enter_context(ViscaServer(camera, self.faults["ptz"], self._ports.host, ports))
        self.stream = opened.enter_context(self._video_server("zoom", self._ports.zoom))

    def _video_server(self, camera: CameraName, port: int) -> AxisServer:
        return AxisServer(
            {1: self.world.feeds[camera]},
            host=self._ports.host,
            port=port,
            user=self._user,
            password=self._password,
            quality=QUALITY,
            faults=self.faults["fixed"] if camera == "fixed" else None,
        )

    @property
    def addresses(self) -> dict[str, str]:
        """Addresses of the devices, by name."""
        two = {"head": "", "fixed": f"{self.fixed.url}/mjpg/video.mjpg", "zoom": ""}
        if self.dome:
            sony, bare, tcp = self.ptz.ports
            words = f"{self.dome} at {self.ptz.host}, UDP {sony} with Sony's header, UDP {bare}, TCP {tcp}"
            devices = {"ptz": words, "fixed": two["fixed"], "zoom": f"{self.stream.url}/mjpg/video.mjpg"}
        else:
            zoom = f"ptpip:{self.zoom.host}:{self.zoom.port}:{self.zoom.port}"
            devices = two | {"head": f"{self.head.port} and {self.head.url}", "zoom": zoom}
        return devices | {
            name: f"socket://{server.host}:{server.port}"
            for name, server in (("board", self.board), ("control", self.control))
        }

    def rig_toml(self, *, tcp: bool = False, beside: Mapping[str, Any] | None = None) -> str:
        """Write the rig.toml that connects to this emulation.

        Args:
            tcp: whether the head is reached by TCP instead of its pseudo-terminal, or instead of UDP.
            beside: further tables, such as `copied_tables` of the simulated rig's own file.
        """
        sim = self.config.sim
        login = {"user": self._user} if self._user else {}
        hardware: dict[str, Any] = {
            **(self._dome_table(tcp, login) if self.dome else self._two_tables(tcp)),
            "fixed": {
                "url": self.fixed.url,
                "size": list(sim.fixed.size),
                "resolution": "{}x{}".format(*sim.fixed.size),
                "rate_hz": sim.fixed.rate_hz,
                "latency_s": self._late(sim.fixed),
            }
            | login,
            "board": {"presenter": f"socket://{self.board.host}:{self.board.port}"},
        }
        board = dataclasses.asdict(self.config.board)
        tables = {"backend": "hardware", "hardware": hardware, **(beside or {}), "board": board}
        return tomli_w.dumps({**tables, "targets": self._targets(tables.get("targets", {}))})

    def _late(self, camera: SimCamera) -> float:
        return camera.latency_s if self.config.sim.effects.latency else 0.0

    @property
    def _delay(self) -> float:
        return self.config.sim.head.command_delay_s if self.config.sim.effects.command_delay else 0.0

    def _two_tables(self, tcp: bool) -> dict[str, Any]:
        """Describe a PTU-D46 and a PowerShot."""
        sim = self.config.sim
        return {
            "head": {
                "port": self.head.url if tcp else self.head.port,
                "step_deg": sim.head.step_deg,
                "pan_deg": list(sim.head.pan_deg),
                "tilt_deg": list(sim.head.tilt_deg),
                "pan_sign": PAN_SIGN,
                "speed_deg_s": sim.head.speed_deg_s,
                "command_delay_s": self._delay,
            },
            "zoom": {
                "port": f"ptpip:{self.zoom.host}:{self.zoom.port}:{self.zoom.port}",
                "lens": [[0, sim.zoom.focal_mm[0]], [sim.zoom.lens_steps - 1, sim.zoom.focal_mm[1]]],
                "lens_speed": sim.zoom.lens_speed,
                "size": list(self.preview_size),
                "still_size": list(sim.zoom.size),
                "pitch_mm": sim.zoom.pitch_mm * PREVIEW_SHARE,
                "rate_hz": sim.zoom.rate_hz,
                "latency_s": self._late(sim.zoom),
                "command_delay_s": self._delay,
            },
        }

    def _dome_table(self, tcp: bool, login: Mapping[str, str]) -> dict[str, Any]:
        """Describe a dome."""
        sim, (sony, _, bare_tcp) = self.config.sim, self.ptz.ports
        shortest, longest = sim.zoom.focal_mm
        wide_px = shortest / sim.zoom.pitch_mm
        return {
            "ptz": {
                "driver": self.dome,
                "host": self.ptz.host,
                "port": bare_tcp if tcp else sony,
                "protocol": "tcp" if tcp else "sony",
                "units": self._units,
                "url": f"{self.stream.url}/mjpg/video.mjpg",
                "size": list(sim.zoom.size),
                "rate_hz": sim.zoom.rate_hz,
                "latency_s": self._late(sim.zoom),
                "wide_deg": 2 * math.degrees(math.atan(sim.zoom.size[0] / 2 / wide_px)),
                "lens": lens_table(longest / shortest),
                "pan_deg": list(sim.head.pan_deg),
                "tilt_deg": list(sim.head.tilt_deg),
                "speed_deg_s": sim.head.speed_deg_s,
                "command_delay_s": self._delay,
                **login,
            }
        }

    def _targets(self, copied: Mapping[str, Any]) -> dict[str, Any]:
        """Scale the wanted sizes of targets to the viewfinder's smaller images."""
        return {
            name: {**copied.get(name, {}), "wanted_px": target.wanted_px / self._share}
            for name, target in self.config.targets.items()
            if name in copied or name in DEFAULT_TARGETS
        }

    def close(self) -> None:
        """End all servers, then the world; may be called again."""
        self._opened.close()

    def _present_board(self, request: Any) -> Any:
        """Answer a request for the board."""
        wanted = validate(BoardRequest, request, "")
        if wanted.swing is not None:
            self.world.swing(wanted.swing)
        elif "present" in request:
            self.world.present(wanted.present)
        else:
            raise ConfigError("swing: needs a pose")
        return {"ok": True}

    def _control(self, request: Any) -> Any:
        """Switch a fault on or off, or answer with ground truth."""
        if "truth" in request:
            pan, tilt = self.world.head_truth()
            now = self.world.clock.now()
            return {
                "t": self.world.clock.monotonic(now),
                "world": now,
                "pictures": {name: feed.moments for name, feed in self.world.feeds.items()},
                "pan_deg": math.degrees(pan),
                "tilt_deg": math.degrees(tilt),
                "moving": self.world.pan.moving() or self.world.tilt.moving(),
                "lens": self.world.lens.position(),
                "port": str(self.ptz.ports[0]) if self.dome else self.head.port,
            }
        self.switch(str(request["fault"]), bool(request.get("on", True)))
        return {"ok": True}

    def switch(self, fault: str, on: bool = True) -> None:
        """Switch a fault on or off by its full name, device.fault.

        Raises:
            ConfigError: there is no such device or fault.
        """
        device, name = parse_fault(fault)
        if device not in self.faults:
            raise ConfigError(f"'{fault}' is of a device that is not emulated here; there are: {choices(self.faults)}")
        self.faults[device].set(name, on)


def _counts(limits: tuple[float, float], count_deg: float) -> tuple[int, int]:
    return math.ceil(limits[0] / count_deg), math.floor(limits[1] / count_deg)


def _in_units(config: RigConfig, units: str) -> RigConfig:
    """Give the simulated head the steps of a dome's units, and no more speed than they have."""
    count_deg, speeds = UNITS[units]
    fastest = min(config.sim.head.speed_deg_s, max(map(max, speeds)))
    head = dataclasses.replace(config.sim.head, step_deg=count_deg, speed_deg_s=fastest)
    return dataclasses.replace(config, sim=dataclasses.replace(config.sim, head=head))


def parse_fault(fault: str) -> tuple[str, str]:
    """Split a fault's full name, device.fault, into device and name.

    Raises:
        ConfigError: there is no such device or fault.
    """
    device, _, name = fault.partition(".")
    if device not in FAULTS:
        raise ConfigError(f"unknown fault '{fault}'; they begin with: {choices(f'{d}.' for d in FAULTS)}")
    if name not in FAULTS[device]:
        raise ConfigError(f"unknown fault '{fault}'; those of {device} are: {choices(FAULTS[device])}")
    return device, name


def copied_tables(table: Mapping[str, Any], directory: Path) -> dict[str, Any]:
    """Copy the tables of a rig.toml that hold for any backend, with absolute paths.

    Args:
        table: the file as TOML has it.
        directory: folder of the file.
    """
    copied = {name: table[name] for name in COPIED if name in table}
    if "targets" in copied:
        copied["targets"] = {
            name: {**target, "template": str((directory / target["template"]).resolve())}
            if "template" in target
            else target
            for name, target in copied["targets"].items()
        }
    for name, key in (("safety", "stop_file"), ("follow", "calibration")):
        if isinstance(copied.get(name, {}).get(key), str):
            copied[name] = {**copied[name], key: str((directory / table[name][key]).resolve())}
    return copied
