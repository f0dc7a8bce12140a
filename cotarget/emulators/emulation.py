"""Emulate a whole rig behind its devices' protocols: one world, and servers for head, cameras, board and control."""

import contextlib
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from cotarget.config import DEFAULT_TARGETS, RigConfig
from cotarget.emulators.axis_241q import AXIS_FAULTS, AxisServer
from cotarget.emulators.canon_s5is import S5IS_FAULTS, S5isServer
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import UnitPorts
from cotarget.emulators.ptu_d46.unit import UnitProfile
from cotarget.emulators.rtsp import RTSP_FAULTS, EncodedStream, Encoder, RtspServer
from cotarget.emulators.serve import LOCAL, Closes, Faults, JsonLines
from cotarget.emulators.world import LiveWorld
from cotarget.errors import ConfigError, choices
from cotarget.schema import Pose, model, validate

PREVIEW_SHARE = 2  # the viewfinder's images are smaller than stills by this factor
QUALITY = 90  # of JPEG, as the simulated cameras have by default
ENCODING_S = 0.005  # to encode a picture of 640x480 and to decode it [s]
PAN_SIGN = -1  # positive pan turns left, as in the D46's manual
# Faults by the protocol of the fixed camera, the default first.
FIXED: Mapping[str, tuple[str, ...]] = {"axis": AXIS_FAULTS, "rtsp": RTSP_FAULTS}
FAULTS: Mapping[str, tuple[str, ...]] = {"head": D46_FAULTS, "fixed": AXIS_FAULTS, "zoom": S5IS_FAULTS}
COPIED = ("board", "follow", "safety", "targets")  # tables of the simulated rig's file that hold for the emulated one


@dataclasses.dataclass(frozen=True)
class Ports:
    """Address and ports to listen at; 0 for any free port."""

    host: str = LOCAL  # address of all servers
    head: int = 0  # TCP port of the head, beside its pseudo-terminal
    fixed: int = 0  # port of the fixed camera
    zoom: int = 0  # PTP/IP port of the zoom camera
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
        user: user name of the fixed camera; empty if everyone may connect.
        password: of that user.
        fixed: protocol of the fixed camera, of `FIXED`.

    Raises:
        ConfigError: these devices cannot have the simulated rig's sizes or steps.
        DeviceError: a port cannot be opened, or the machine cannot render.
    """

    def __init__(
        self, config: RigConfig, ports: Ports = Ports(), *, user: str = "", password: str = "", fixed: str = "axis"
    ) -> None:
        sim = config.sim
        if sim.zoom.size[0] % PREVIEW_SHARE or sim.zoom.size[1] % PREVIEW_SHARE:
            raise ConfigError(f"sim.zoom.size: {list(sim.zoom.size)} cannot be halved for the viewfinder")
        if fixed == "rtsp" and any(side % 2 for side in sim.fixed.size):
            raise ConfigError(f"sim.fixed.size: {list(sim.fixed.size)} is odd, and H.264 takes even sizes")
        self.config, self._user, self._fixed = config, user, fixed
        self.faults = {device: Faults(names) for device, names in faults_of(fixed).items()}
        head, (lowest, highest) = sim.head, sim.head.pan_deg
        unit = UnitProfile.from_degrees(
            (-highest, -lowest), head.tilt_deg, head.step_deg, head.speed_deg_s, head.accel_deg_s2
        )
        self.preview_size = sim.zoom.size[0] // PREVIEW_SHARE, sim.zoom.size[1] // PREVIEW_SHARE
        with contextlib.ExitStack() as opened:
            world = self.world = opened.enter_context(LiveWorld(config, pan_sign=PAN_SIGN))
            firmware = D46(world.pan, world.tilt, unit, self.faults["head"], world.clock.now)
            self.head = opened.enter_context(UnitPorts(firmware, tcp=ports.head, host=ports.host))
            self.fixed = self._open_fixed(opened, ports, password)
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
            self.board = opened.enter_context(JsonLines(self._present_board, ports.host, ports.board))
            self.control = opened.enter_context(JsonLines(self._control, ports.host, ports.control))
            self._opened = opened.pop_all()

    def _open_fixed(self, opened: contextlib.ExitStack, ports: Ports, password: str) -> AxisServer | RtspServer:
        """Serve the fixed camera by its protocol."""
        feed, faults, user = self.world.feeds["fixed"], self.faults["fixed"], self._user
        host, port = ports.host, ports.fixed
        if self._fixed == "axis":
            server = AxisServer(
                {1: feed}, host=host, port=port, user=user, password=password, quality=QUALITY, faults=faults
            )
            return opened.enter_context(server)
        stream = EncodedStream()
        opened.enter_context(Encoder(feed, stream, self.config.sim.fixed.rate_hz, faults=faults))
        return opened.enter_context(
            RtspServer(stream, host=host, port=port, user=user, password=password, faults=faults)
        )

    def rig_toml(self, *, tcp: bool = False, beside: Mapping[str, Any] | None = None) -> str:
        """Write the rig.toml that connects to this emulation.

        Args:
            tcp: whether the head is reached by TCP instead of its pseudo-terminal.
            beside: further tables, such as `copied_tables` of the simulated rig's own file.
        """
        sim = self.config.sim
        late = sim.effects.latency
        delay = sim.head.command_delay_s if sim.effects.command_delay else 0.0
        last = sim.zoom.lens_steps - 1
        hardware: dict[str, Any] = {
            "head": {
                "port": self.head.url if tcp else self.head.port,
                "step_deg": sim.head.step_deg,
                "pan_deg": list(sim.head.pan_deg),
                "tilt_deg": list(sim.head.tilt_deg),
                "pan_sign": PAN_SIGN,
                "speed_deg_s": sim.head.speed_deg_s,
                "command_delay_s": delay,
            },
            "fixed": self._fixed_table(),
            "zoom": {
                "port": f"ptpip:{self.zoom.host}:{self.zoom.port}:{self.zoom.port}",
                "lens": [[0, sim.zoom.focal_mm[0]], [last, sim.zoom.focal_mm[1]]],
                "lens_speed": sim.zoom.lens_speed,
                "size": list(self.preview_size),
                "still_size": list(sim.zoom.size),
                "pitch_mm": sim.zoom.pitch_mm * PREVIEW_SHARE,
                "rate_hz": sim.zoom.rate_hz,
                "latency_s": sim.zoom.latency_s if late else 0.0,
                "command_delay_s": delay,
            },
            "board": {"presenter": f"socket://{self.board.host}:{self.board.port}"},
        }
        board = dataclasses.asdict(self.config.board)
        tables = {"backend": "hardware", "hardware": hardware, **(beside or {}), "board": board}
        return tomli_w.dumps({**tables, "targets": self._targets(tables.get("targets", {}))})

    def _fixed_table(self) -> dict[str, Any]:
        """Write the fixed camera's table of rig.toml."""
        fixed = self.config.sim.fixed
        latency_s = fixed.latency_s if self.config.sim.effects.latency else 0.0
        if self._fixed == "rtsp":
            # A parser gives a picture when the next one begins.
            own = {"driver": "stream", "latency_s": latency_s + 1 / fixed.rate_hz + ENCODING_S}
        else:
            own = {"resolution": "{}x{}".format(*fixed.size), "latency_s": latency_s}
        user = {"user": self._user} if self._user else {}
        return {"url": self.fixed.url, "size": list(fixed.size), "rate_hz": fixed.rate_hz, **own, **user}

    def _targets(self, copied: Mapping[str, Any]) -> dict[str, Any]:
        """Scale the wanted sizes of targets to the viewfinder's smaller images."""
        return {
            name: {**copied.get(name, {}), "wanted_px": target.wanted_px / PREVIEW_SHARE}
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
                "port": self.head.port,
            }
        self.switch(str(request["fault"]), bool(request.get("on", True)))
        return {"ok": True}

    def switch(self, fault: str, on: bool = True) -> None:
        """Switch a fault on or off by its full name, device.fault.

        Raises:
            ConfigError: there is no such device or fault.
        """
        device, name = parse_fault(fault, faults_of(self._fixed))
        self.faults[device].set(name, on)


def faults_of(fixed: str) -> dict[str, tuple[str, ...]]:
    """List the faults of each device, where the fixed camera has a protocol of `FIXED`."""
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
