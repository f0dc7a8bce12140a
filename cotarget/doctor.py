"""Examine this machine: versions, rendering, film codec and devices, with the command that fixes what is missing."""

import importlib.metadata
import math
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cotarget.errors import (
    ConfigError,
    CotargetError,
    EmergencyStopError,
    MissingPackageError,
    install_extra,
    pip_install,
)
from cotarget.files import assets_dir

if TYPE_CHECKING:
    from cotarget.config import RigConfig

# Rendering is tried in its own process, because a broken OpenGL may crash it.
RENDER = (
    "from cotarget.sim.render.opengl import BACKEND, make_renderer, mujoco; from OpenGL import GL;"
    "m = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom size=\"1\"/></worldbody></mujoco>');"
    "r = make_renderer(m, 64, 48); r.update_scene(mujoco.MjData(m)); r.render();"
    "print(BACKEND + ': ' + GL.glGetString(GL.GL_RENDERER).decode()); r.close()"
)
SOFTWARE = ("llvmpipe", "softpipe", "swrast")  # Mesa's renderers without a GPU
SOFTWARE_MP = 1.0  # size of a simulated image above which a frame takes them a fraction of a second [million pixels]
RENDER_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Finding:
    """Result of one check: whether it is well (None: unknown), what was found, and the command that fixes it."""

    name: str
    ok: bool | None
    text: str
    fix: str = ""


def examine(config: "RigConfig | None" = None, rig: Path = Path("rig.toml")) -> list[Finding]:
    """Examine everything that cotarget needs; with a rig's configuration and file also its devices."""
    found = [
        Finding("python", True, f"{platform.python_version()} on {platform.platform()}"),
        *map(_package, needed_packages()),
        _assets(),
        rendering(config),
        _codec(),
        _serial_ports(),
        _gphoto_cameras(needed=_is_real(config)),
    ]
    if config is not None:
        found += [_emergency_stop(config, rig), *_named(config, rig), *_own_detectors(config, rig)]
        if _is_real(config):
            found += [*_board(config, rig), *_devices(config, rig)]
    return found


def _is_real(config: "RigConfig | None") -> bool:
    return config is not None and config.backend == "hardware"


def needed_packages() -> list[str]:
    """List cotarget and the packages that every installation of it needs."""
    needs = importlib.metadata.requires("cotarget") or []
    return ["cotarget", *(re.split("[<>=!~;[ ]", each)[0] for each in needs if "extra ==" not in each)]


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, "not installed", pip_install(name))


def _assets() -> Finding:
    scenes = sorted(path.stem for path in (assets_dir() / "scenes").glob("*.xml"))
    fix = "" if scenes else "install cotarget again, from a whole clone or from its wheel"
    return Finding("sim_assets", bool(scenes), f"scenes {', '.join(scenes)}" if scenes else "not found", fix)


def rendering(config: "RigConfig | None" = None) -> Finding:
    """Render a picture without a screen, in a separate process; say if the configured images are large for it."""
    try:
        tried = subprocess.run(
            [sys.executable, "-c", RENDER], capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding("rendering", False, f"no picture within {RENDER_TIMEOUT_S:.0f} s", "export MUJOCO_GL=osmesa")
    if tried.returncode == 0:
        renderer = tried.stdout.strip().splitlines()[-1]
        return Finding("rendering", True, f"without a screen by {renderer}{_slow_images(renderer, config)}")
    said = (tried.stderr.strip().splitlines() or [f"the test ended with status {tried.returncode}"])[-1]
    chosen = os.environ.get("MUJOCO_GL", "egl")
    fix = "apt-get install -y libegl1 libgl1-mesa-dri libgl1" if chosen == "egl" else "unset MUJOCO_GL"
    return Finding("rendering", False, said.split(": ", 1)[-1], fix)


def _slow_images(renderer: str, config: "RigConfig | None") -> str:
    if config is None or config.backend != "sim" or not any(name in renderer for name in SOFTWARE):
        return ""
    largest = max(math.prod(camera.size) for camera in (config.sim.fixed, config.sim.zoom)) / 1e6
    return f"; this is software, which is slow for images of {largest:.1f} MP" if largest > SOFTWARE_MP else ""


def _codec() -> Finding:
    try:
        import av
    except ImportError as error:
        return Finding("H.264", False, f"PyAV cannot be imported: {error}", pip_install("--force-reinstall", "av"))
    if "libx264" in av.codecs_available:
        return Finding("H.264", True, "PyAV encodes it")
    return Finding("H.264", False, "this PyAV cannot encode it", pip_install("--force-reinstall", "av"))


def _serial_ports() -> Finding:
    from cotarget.drivers.serial_line import ports

    try:
        found = [f"{device} ({description})" for device, description in ports()]
    except ImportError as error:
        text = f"pyserial cannot be imported: {error}"
        return Finding("serial ports", False, text, pip_install("--force-reinstall", "pyserial"))
    return Finding("serial ports", True, ", ".join(found) or "none (none is needed for the simulation)")


def _gphoto_cameras(needed: bool) -> Finding:
    from cotarget.drivers.gphoto import cameras

    note = "" if needed else " (none is needed for the simulation)"
    try:
        return Finding("gphoto2 cameras", True, (", ".join(cameras()) or "none on USB") + note)
    except CotargetError as error:
        return Finding("gphoto2 cameras", not needed, f"{error}{note}", install_extra("hardware") * needed)


def _emergency_stop(config: "RigConfig", rig: Path) -> Finding:
    """Check whether an operator has stopped the head."""
    from cotarget.safety.stop_file import refuse_if_stopped

    name, path = "emergency stop", config.safety.stop_file
    if path is None:
        return Finding(name, True, "no stop file is configured: no other shell can stop the head")
    try:
        refuse_if_stopped(path)
    except EmergencyStopError as error:
        return Finding(name, False, str(error).removeprefix(f"{name}: "), f"cotarget clear --rig {rig}")
    except ConfigError as error:
        return Finding(name, False, str(error), f"{'chmod u+w' if path.parent.is_dir() else 'mkdir -p'} {path.parent}")
    return Finding(name, True, "none")


def _named(config: "RigConfig", rig: Path) -> list[Finding]:
    """Find files that rig.toml names and that are missing, and targets of implausible sizes."""
    from cotarget.recording.format import META
    from cotarget.targeting import size_implausibility

    files = {f"sim.models.{name}": path for name, path in config.sim.models.items()}
    files |= {f"targets.{name}.template": target.template for name, target in config.targets.items() if target.template}
    if config.recording is not None:
        files["recording"] = config.recording / META
    wrong = {where: f"{path}: no such file" for where, path in files.items() if not path.is_file()}
    for name, target in config.targets.items():
        where = f"targets.{name}.size"
        wrong[where] = size_implausibility(target, name).removeprefix(f"{where}: ")
    return [Finding(where, False, text, f"correct it in {rig}") for where, text in wrong.items() if text]


def _own_detectors(config: "RigConfig", rig: Path) -> list[Finding]:
    """Import the user's detectors that targets name, and load their networks."""
    from cotarget.detection import make_network
    from cotarget.plugins import is_own, load

    found = []
    for name, target in config.targets.items():
        where = f"targets.{name}.detector"
        try:
            if is_own(target.detector):
                load(target.detector, where)
                found.append(Finding(where, True, target.detector))
            elif target.detector == "onnx":
                found.append(Finding(where, True, f"onnx: {make_network(target)}"))
        except CotargetError as error:
            found.append(Finding(where, False, str(error), f"correct it, or [targets.{name}] in {rig}"))
    return found


def _board(config: "RigConfig", rig: Path) -> list[Finding]:
    """Check whether rig.toml has the size of the board's squares, without which no real rig is calibrated."""
    from cotarget.config import check_square, read_tables

    if not rig.exists():  # a configuration that was made in Python is complete
        return []
    if "square" not in read_tables(rig).get("board", {}):
        fix = f"measure ten squares, and write one into [board] in {rig}: square = 0.025"
        return [Finding("board", False, "the size of its squares is not configured", fix)]
    board, (columns, rows) = config.board, config.board.corners
    try:
        check_square(board.square, "square")
    except ConfigError as error:
        return [Finding("board", False, str(error), f"write it in metres into [board] in {rig}")]
    text = f"{board.kind} of {columns}x{rows} inner corners, squares of {1000 * board.square:g} mm"
    return [Finding("board", True, text)]


def _position(config: "RigConfig", port: str, rig: Path) -> Finding:
    """Check whether the head's position is marked as lost."""
    from cotarget.drivers.interlock import PositionLostMarker

    try:
        PositionLostMarker(port, config.safety.stop_file).refuse()
    except CotargetError as error:
        return Finding("head's position", False, str(error), f"cotarget reset-head --rig {rig}")
    return Finding("head's position", True, "not marked as lost")


def _devices(config: "RigConfig", rig: Path) -> list[Finding]:
    """Ask each device for its identity."""
    from cotarget.drivers import board
    from cotarget.drivers.rig import board_settings, devices

    found, presenter = devices(config.hardware), board_settings(config.hardware)
    is_begun = any(getattr(config.hardware, device.role) for device in found.values())
    return [
        _position(config, found["head"].address, rig),
        *(
            _ask(device.where, device.probe, device.address, rig)
            if getattr(config.hardware, device.role) or not is_begun
            else Finding(device.where, None, "has no table; following needs it")
            for device in found.values()
        ),
        _ask("hardware.board", lambda: board.probe(presenter), presenter.presenter, rig),
    ]


def _ask(name: str, ask: Callable[[], str | None], there: str, rig: Path) -> Finding:
    try:
        said = ask()
        return Finding(name, None if said is None else True, said or "is not asked: its driver has no probe")
    except CotargetError as error:
        return Finding(name, False, str(error).removeprefix(f"{name}: "), _fix(error, name, there, rig))


def _fix(error: CotargetError, name: str, there: str, rig: Path) -> str:
    """Return the command or advice that helps with a device that does not answer as it should."""
    from cotarget.drivers.frame_buffer import LoginError
    from cotarget.drivers.link_errors import InUseError, NoPermissionError
    from cotarget.drivers.ptu_d46 import UncalibratedError

    match error:
        case MissingPackageError():
            return install_extra("hardware")
        case InUseError():
            return "end the program that has it" + (f", which 'fuser -v {there}' names" if "://" not in there else "")
        case NoPermissionError():
            return "sudo usermod -a -G dialout $USER, then log in again"
        case UncalibratedError():
            return f"cotarget reset-head --rig {rig}"
        case LoginError():
            return f"give the user in [{name}] in {rig}, and export COTARGET_PASSWORD=... or what password_env names"
    return f"look at the device, its cable, and [{name}] in {rig}"
