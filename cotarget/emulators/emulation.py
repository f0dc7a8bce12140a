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
from cotarget.emulators.onvif import BLOCK as ONVIF_BLOCK
from cotarget.emulators.onvif import ONVIF_FAULTS, ONVIF_PROFILES, OnvifCamera, OnvifModel, OnvifServer
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import UnitPorts
from cotarget.emulators.ptu_d46.unit import UnitProfile
from cotarget.emulators.rtsp import RTSP_FAULTS, EncodedStream, Encoder, RtspServer
from cotarget.emulators.serve import LOCAL, Closes, Faults, JsonLines
from cotarget.emulators.visca import BLOCK as VISCA_BLOCK
from cotarget.emulators.visca import UNITS, VISCA_FAULTS, ViscaCamera, ViscaModel, ViscaServer
from cotarget.emulators.world import LiveWorld
from cotarget.errors import ConfigError, choices
from cotarget.schema import Pose, model, validate
from cotarget.sim.truth import CameraName

PREVIEW_SHARE = 2  # the viewfinder's images are smaller than stills by this factor
QUALITY = 90  # of JPEG, as the simulated cameras have by default
PAN_SIGN = -1  # positive pan turns left, as in the D46's manual
FAULTS: Mapping[str, tuple[str, ...]] = {"head": D46_FAULTS, "fixed": AXIS_FAULTS, "zoom": S5IS_FAULTS}
# Faults by the protocol of the fixed camera, the default first, and by that of a dome.
FIXED: Mapping[str, tuple[str, ...]] = {"axis": AXIS_FAULTS, "rtsp": RTSP_FAULTS}
DOMES: Mapping[str, tuple[str, ...]] = {"onvif": (*ONVIF_PROFILES, *ONVIF_FAULTS), "visca": VISCA_FAULTS}
ENCODING_S = 0.005  # to encode a picture of 640x480 and to decode it [s]
DOME_STEP_DEG = 0.01  # of a dome whose protocol has no steps [degrees]
DOME_LENS_STEPS = 4097  # positions of a dome's lens
COPIED = ("board", "follow", "safety", "targets")  # tables of the simulated rig's file that hold for the emulated one


@dataclasses.dataclass(frozen=True)
class Ports:
    """Address and ports to listen at; 0 for any free port."""

    host: str = LOCAL  # address of all servers
    # TCP port of the head, beside its pseudo-terminal; HTTP port of an ONVIF dome; UDP port of VISCA with a header
    head: int = 0
    fixed: int = 0  # port of the fixed camera
    zoom: int = 0  # PTP/IP port of the zoom camera; RTSP port of a dome's stream
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
        user: user name of cameras and dome; empty if everyone may connect.
        password: of that user.
        fixed: protocol of the fixed camera, of `FIXED`.
        dome: protocol of head and zoom camera in one housing, of `DOMES`; empty for a PTU-D46 and a PowerShot.
        units: of a VISCA dome, by rig.toml's name.

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
        fixed: str = "axis",
        dome: str = "",
        units: str = "ptzoptics",
    ) -> None:
        self.dome, self._units, self._user, self._password, self._ports = dome, units, user, password, ports
        self.config, self._fixed = _as_dome(config, dome, units) if dome else config, fixed
        size = config.sim.zoom.size
        if not dome and (size[0] % PREVIEW_SHARE or size[1] % PREVIEW_SHARE):
            raise ConfigError(f"sim.zoom.size: {list(size)} cannot be halved for the viewfinder")
        encoded = [("fixed", config.sim.fixed.size)] * (fixed == "rtsp") + [("zoom", size)] * bool(dome)
        for name, sides in encoded:
            if any(side % 2 for side in sides):
                raise ConfigError(f"sim.{name}.size: {list(sides)} is odd, and H.264 takes even sizes")
        self.faults = {device: Faults(names) for device, names in faults_of(fixed, dome).items()}
        self._share = 1 if dome else PREVIEW_SHARE
        self.preview_size = size[0] // self._share, size[1] // self._share
        with contextlib.ExitStack() as opened:
            self.world = opened.enter_context(LiveWorld(self.config, pan_sign=1 if dome else PAN_SIGN))
            self.fixed = self._open_camera(opened, "fixed", ports.fixed)
            if dome:
                self._open_dome(opened)
            else:
                self._open_two_devices(opened)
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
        """Open a dome: its stream, and the protocol that moves it."""
        self.stream = self._open_camera(opened, "zoom", self._ports.zoom)
        self.ptz: OnvifServer | ViscaServer = self._onvif() if self.dome == "onvif" else self._visca()
        opened.enter_context(self.ptz)

    def _visca(self) -> ViscaServer:
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
        return ViscaServer(camera, self.faults["ptz"], self._ports.host, (self._ports.head, 0, 0))

    def _onvif(self) -> OnvifServer:
        world, sim, faults = self.world, self.config.sim, self.faults["ptz"]
        model = OnvifModel(
            sim.head.pan_deg,
            sim.head.tilt_deg,
            sim.head.step_deg,
            sim.head.speed_deg_s,
            sim.head.accel_deg_s2,
            self.stream.url,
            sim.zoom.size,
        )
        camera = OnvifCamera(world.pan, world.tilt, world.lens, model, faults)
        return OnvifServer(
            camera,
            host=self._ports.host,
            port=self._ports.head,
            user=self._user,
            password=self._password,
            faults=faults,
        )

    def _open_camera(self, opened: contextlib.ExitStack, camera: CameraName, port: int) -> AxisServer | RtspServer:
        """Serve the pictures of the fixed camera by its protocol, or those of a dome by RTSP."""
        feed, host, user, password = self.world.feeds[camera], self._ports.host, self._user, self._password
        faults = self.faults["fixed" if camera == "fixed" else "picture"]
        if camera == "fixed" and self._fixed == "axis":
            server = AxisServer(
                {1: feed}, host=host, port=port, user=user, password=password, quality=QUALITY, faults=faults
            )
            return opened.enter_context(server)
        stream = EncodedStream()
        rate_hz = self.config.sim.fixed.rate_hz if camera == "fixed" else self.config.sim.zoom.rate_hz
        opened.enter_context(Encoder(feed, stream, rate_hz, faults=faults))
        return opened.enter_context(
            RtspServer(stream, host=host, port=port, user=user, password=password, faults=faults)
        )

    @property
    def addresses(self) -> dict[str, str]:
        """Addresses of the devices, by name."""
        fixed = self.fixed.url + ("/mjpg/video.mjpg" if isinstance(self.fixed, AxisServer) else "")
        if self.dome:
            devices = {"ptz": self._dome_address, "fixed": fixed, "zoom": self.stream.url}
        else:
            zoom = f"ptpip:{self.zoom.host}:{self.zoom.port}:{self.zoom.port}"
            devices = {"head": f"{self.head.port} and {self.head.url}", "fixed": fixed, "zoom": zoom}
        return devices | {
            name: f"socket://{server.host}:{server.port}"
            for name, server in (("board", self.board), ("control", self.control))
        }

    @property
    def _dome_address(self) -> str:
        if isinstance(self.ptz, OnvifServer):
            return self.ptz.url
        sony, bare, tcp = self.ptz.ports
        return f"{self.dome} at {self.ptz.host}, UDP {sony} with Sony's header, UDP {bare}, TCP {tcp}"

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
                "rate_hz": sim.fixed.rate_hz,
                **self._own_of_fixed(),
                **login,
            },
            "board": {"presenter": f"socket://{self.board.host}:{self.board.port}"},
        }
        board = dataclasses.asdict(self.config.board)
        tables = {"backend": "hardware", "hardware": hardware, **(beside or {}), "board": board}
        return tomli_w.dumps({**tables, "targets": self._targets(tables.get("targets", {}))})

    def _own_of_fixed(self) -> dict[str, Any]:
        """Describe what the fixed camera's table has by its protocol."""
        fixed = self.config.sim.fixed
        if self._fixed == "rtsp":
            return {"driver": "stream", "latency_s": self._late_by_rtsp(fixed)}
        return {"resolution": "{}x{}".format(*fixed.size), "latency_s": self._late(fixed)}

    def _late_by_rtsp(self, camera: SimCamera) -> float:
        """Return the latency of a picture by RTSP [s]; a parser gives a picture when the next one begins."""
        return self._late(camera) + 1 / camera.rate_hz + ENCODING_S

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
        sim = self.config.sim
        shortest, longest = sim.zoom.focal_mm
        wide_px = shortest / sim.zoom.pitch_mm
        if isinstance(self.ptz, OnvifServer):
            own: dict[str, Any] = {"port": self.ptz.port, "lens": ONVIF_BLOCK.lens_table(longest / shortest)}
        else:
            sony, _, bare_tcp = self.ptz.ports
            own = {
                "port": bare_tcp if tcp else sony,
                "protocol": "tcp" if tcp else "sony",
                "units": self._units,
                "url": self.stream.url,
                "lens": VISCA_BLOCK.lens_table(longest / shortest),
            }
        return {
            "ptz": {
                "driver": self.dome,
                "host": self.ptz.host,
                **own,
                "size": list(sim.zoom.size),
                "rate_hz": sim.zoom.rate_hz,
                "latency_s": self._late_by_rtsp(sim.zoom),
                "wide_deg": 2 * math.degrees(math.atan(sim.zoom.size[0] / 2 / wide_px)),
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
                "port": self._dome_address if self.dome else self.head.port,
            }
        self.switch(str(request["fault"]), bool(request.get("on", True)))
        return {"ok": True}

    def switch(self, fault: str, on: bool = True) -> None:
        """Switch a fault on or off by its full name, device.fault.

        Raises:
            ConfigError: there is no such device or fault.
        """
        device, name = parse_fault(fault, faults_of(self._fixed, self.dome))
        self.faults[device].set(name, on)


def _counts(limits: tuple[float, float], count_deg: float) -> tuple[int, int]:
    return math.ceil(limits[0] / count_deg), math.floor(limits[1] / count_deg)


def _as_dome(config: RigConfig, dome: str, units: str) -> RigConfig:
    """Give the simulated rig the steps of a dome: no more speed than its units have, and a fine lens."""
    sim, step_deg, fastest = config.sim, DOME_STEP_DEG, config.sim.head.speed_deg_s
    if dome == "visca":
        step_deg, speeds = UNITS[units]
        fastest = min(fastest, float(max(map(max, speeds))))
    head = dataclasses.replace(sim.head, step_deg=step_deg, speed_deg_s=fastest)
    finer = (DOME_LENS_STEPS - 1) / (sim.zoom.lens_steps - 1)
    zoom = dataclasses.replace(sim.zoom, lens_steps=DOME_LENS_STEPS, lens_speed=finer * sim.zoom.lens_speed)
    return dataclasses.replace(config, sim=dataclasses.replace(sim, head=head, zoom=zoom))


def faults_of(fixed: str = "axis", dome: str = "") -> dict[str, tuple[str, ...]]:
    """List the faults of each device.

    Args:
        fixed: protocol of the fixed camera, of `FIXED`.
        dome: protocol of a dome, of `DOMES`; empty without one.
    """
    if dome:
        return {"fixed": FIXED[fixed], "ptz": DOMES[dome], "picture": RTSP_FAULTS}
    return {**FAULTS, "fixed": FIXED[fixed]}


def parse_fault(fault: str, known: Mapping[str, tuple[str, ...]] = FAULTS) -> tuple[str, str]:
    """Split a fault's full name, device.fault, into device and name.

    Args:
        fault: the full name.
        known: faults of each device.

    Raises:
        ConfigError: there is no such device or fault.
    """
    device, _, name = fault.partition(".")
    if device not in known:
        raise ConfigError(f"unknown fault '{fault}'; they begin with: {choices(f'{d}.' for d in known)}")
    if name not in known[device]:
        raise ConfigError(f"unknown fault '{fault}'; those of {device} are: {choices(known[device])}")
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
