"""Commands that operate a rig: aim, point, latency, stop, clear, reset-head; and emulate."""

import argparse
import math
import os
import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import (
    check_board_size,
    check_outputs,
    check_within,
    load_plausible,
    open_named,
    previous_kept,
    print_json,
    rig_files,
)
from cotarget.errors import CalibrationError, ConfigError, DeviceError, naming

if TYPE_CHECKING:
    from cotarget.calibration import Calibration
    from cotarget.config import RigConfig, TargetProfile
    from cotarget.drivers.rig import Device
    from cotarget.targeting import Aim, WantedSize


LEAST_SEEN_PX = 1.0  # size of a target in the fixed image that no detector finds; it was given in millimetres
SMALL_PX = 10.0  # smaller sizes are printed with two digits, others as whole pixels


def aim_command(options: argparse.Namespace) -> None:
    """Run `cotarget aim`: print pan, tilt and focal length for one pixel of the fixed camera."""
    import numpy as np

    from cotarget.backends import describe, load_config
    from cotarget.config import RigConfig
    from cotarget.targeting import Reach, WantedSize, aim, error_budget, point_at

    config = RigConfig() if options.rig is None else load_config(options.rig)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; give the rig.toml of the rig that was recorded")
    spec = describe(config)
    calibration = load_plausible(options.calibration, None if options.rig is None else spec, insist=options.insist)
    if options.rig is not None:
        calibration = calibration.for_streams(spec.fixed.size, spec.zoom.size)
    target = _target(options, config, calibration)
    pixel, size = np.array(options.pixel), calibration.fixed.size
    if not (np.all(pixel >= -0.5) and np.all(pixel <= np.array(size) - 0.5)):
        raise ConfigError(
            f"--pixel: ({pixel[0]:g}, {pixel[1]:g}) is not in the fixed camera's {size[0]}x{size[1]} image"
        )
    depth = options.depth if target is None or options.size_px is None else _depth(options, target, calibration)
    pitch_mm = calibration.pitch_mm or spec.zoom.pitch_mm
    shortest, longest = spec.zoom.focal_range
    if options.rig is None:  # without a rig.toml, the calibration gives the shortest focal length
        shortest = calibration.zoom_head.lens.nominal_px[0]
    limits = spec.head.limits
    reach = Reach(limits.pan, limits.tilt, (shortest, max(shortest, longest)), step=limits.step)
    wanted, nominal = None, None
    if target is not None and options.focal_mm is None:
        wanted = WantedSize(target.size, options.wanted_px or target.wanted_px, target.is_vertical())
    if options.focal_mm is not None:
        bounds = reach.focal_px[0] * pitch_mm, reach.focal_px[1] * pitch_mm
        check_within("--focal-mm", options.focal_mm, bounds, "the lens's {} mm")
        nominal = options.focal_mm / pitch_mm
    point = point_at(calibration, pixel, depth)
    found = aim(calibration, point, reach, wanted_size=wanted, nominal_px=nominal, method=options.ik)
    # The error budget holds for the exact inverse; the shortcut's additional error is not modelled.
    budget = error_budget(calibration, pixel, found, reach, size_px=options.size_px) if options.ik == "exact" else None
    is_calibrated = _check_focal_length(calibration, found, pitch_mm)
    targets = config.targets if target is None else {options.target: target}
    is_plausible = _check_depth(options, calibration, found, targets)
    if wanted is not None and found.limited:
        _check_shown_size(calibration, found, wanted, options.target)
    print_json(
        {
            "pan_deg": math.degrees(found.pan),
            "tilt_deg": math.degrees(found.tilt),
            "focal_px": found.focal_px,
            "focal_mm": found.nominal_px * pitch_mm,
            "focal_limited": found.limited,
            "focal_calibrated": is_calibrated,
            "depth_m": found.depth,
            "depth_plausible": is_plausible,
            "range_m": found.range,
            "predicted_error_deg": budget and {name: math.degrees(part) for name, part in budget.items()},
            "predicted_error_px": budget and math.tan(budget["total"]) * found.focal_px,
        }
    )


def _check_focal_length(calibration: "Calibration", found: "Aim", pitch_mm: float) -> bool:
    """Whether an aim's focal length is among those calibrated; warn if not."""
    from cotarget.calibration.zoom_samples import SAME_FOCAL

    nominal_px = calibration.zoom_head.lens.nominal_px
    shortest, longest = nominal_px[0], nominal_px[-1]
    if shortest * (1 - SAME_FOCAL) <= found.nominal_px <= longest * (1 + SAME_FOCAL):
        return True
    _warn(
        f"{found.nominal_px * pitch_mm:.1f} mm is outside the calibrated focal lengths, {shortest * pitch_mm:.1f} to "
        f"{longest * pitch_mm:.1f} mm: the aim is extrapolated"
    )
    return False


def _check_depth(
    options: argparse.Namespace, calibration: "Calibration", found: "Aim", targets: Mapping[str, "TargetProfile"]
) -> bool:
    """Whether one of the targets fits into the fixed view at an aim's depth, and is seen there; warn if none does.

    Raises:
        ConfigError: the depth of --depth is so large that the fixed camera shows none of the targets.
    """
    (width, height), (fx, fy) = calibration.fixed.size, calibration.fixed.lens.focal_px
    nearest, name = min(
        (target.size * (fy / height if target.is_vertical() else fx / width), name) for name, target in targets.items()
    )
    if found.depth < nearest:
        _warn(f"the {name} fits into the fixed view only from {nearest:.2g} m on; is {found.depth:g} m meant?")
        return False
    largest_px, name = max((fx * target.size / found.depth, name) for name, target in targets.items())
    if largest_px >= LEAST_SEEN_PX:
        return True
    if options.depth is not None and not options.insist:
        raise ConfigError(
            f"--depth: at {options.depth:g} m the {name} is {largest_px:.2g} px large in the fixed image; is "
            f"{options.depth / 1000:g} m meant? --insist aims there all the same"
        )
    return False


def _check_shown_size(calibration: "Calibration", found: "Aim", wanted: "WantedSize", name: str) -> None:
    """Warn if the lens shows the target at another size than wanted, in whole pixels or two digits."""
    focal = calibration.zoom_head.lens.at(found.nominal_px).focal_px[int(wanted.vertical)]
    shown_px, wanted_px = _pixels(focal * wanted.size / found.range), _pixels(wanted.wanted_px)
    if shown_px != wanted_px:
        _warn(f"the lens shows the {name} {shown_px} px large there, and not {wanted_px}")


def _target(options: argparse.Namespace, config: "RigConfig", calibration: "Calibration") -> "TargetProfile | None":
    """Look up the target of --target, and check the options that need it."""
    from cotarget.targeting import size_implausibility

    if options.target is None:
        if options.size_px is not None:
            raise ConfigError("--size-px needs --target NAME, whose true size gives the depth")
        if options.wanted_px is not None:
            raise ConfigError("--wanted-px needs --target NAME, whose true size gives the focal length")
        return None
    with naming("--target"):
        target = config.target(options.target)
    if not options.insist and (text := size_implausibility(target, options.target)):
        raise ConfigError(f"{options.rig}: {text}; --insist takes it all the same")
    where, wanted_px, size = "--wanted-px", options.wanted_px, calibration.zoom_head.lens.size
    if wanted_px is None and options.focal_mm is None and not options.insist:
        where, wanted_px = f"--wanted-px: missing, and targets.{options.target}.wanted_px", target.wanted_px
    if wanted_px is not None and wanted_px > size[int(target.is_vertical())]:
        raise ConfigError(f"{where}: {wanted_px:g} px do not fit into the zoom camera's {size[0]}x{size[1]} image")
    return target


def _depth(options: argparse.Namespace, target: "TargetProfile", calibration: "Calibration") -> float:
    """Compute the depth at which the target has the size of --size-px [m]."""
    import numpy as np

    from cotarget.targeting import depth_of

    depth = depth_of(calibration, target, options.size_px, np.array(options.pixel))
    if not math.isfinite(depth):
        width, height = calibration.fixed.size
        raise ConfigError(
            f"--size-px: {options.size_px:g} px is no size that a {options.target} of {target.size:g} m has in the "
            f"fixed camera's {width}x{height} image"
        )
    return depth


def _warn(text: str) -> None:
    print(f"cotarget aim: {text}", file=sys.stderr)


def _pixels(size: float) -> str:
    return f"{size:.2g}" if size < SMALL_PX else f"{size:.0f}"


# Emulation of a simulated rig behind the devices' protocols

# One thread for Mesa's software renderer leaves a core to the client. Mesa reads the variable when OpenGL starts.
RENDER_THREADS = ("LP_NUM_THREADS", "1")
POLL_S = 0.2
# Python's switch interval [s]. With the default of 5 ms, a line that is paced by its own thread loses half of its rate
# beside the rendering.
SWITCH_S = 5e-4
TARGETS = ("person",)  # targets of the scene without a rig.toml
NO_TARGET = 'none; [sim] targets = ["person"] has one to follow'
STOP_FILE = "stop"  # default stop file, beside the rig.toml that is written


def fault_names() -> str:
    """List the faults that can be switched on, for --help."""
    from cotarget.emulators.emulation import FAULTS

    return "faults: " + ", ".join(f"{device}.{name}" for device, names in FAULTS.items() for name in names)


def emulate_command(options: argparse.Namespace) -> None:
    """Run `cotarget emulate`: serve a simulated rig by the devices' wire protocols, and write a rig.toml for it."""
    os.environ.setdefault(*RENDER_THREADS)
    sys.setswitchinterval(SWITCH_S)
    from cotarget.backends import load_config
    from cotarget.config import RigConfig, SimConfig, read_tables
    from cotarget.emulators.emulation import Emulation, Ports, copied_tables, parse_fault
    from cotarget.emulators.world import paced
    from cotarget.files import write_atomically

    config = RigConfig(sim=SimConfig(targets=TARGETS)) if options.rig is None else load_config(options.rig)
    if config.backend != "sim":
        raise ConfigError(f"{options.rig}: backend is '{config.backend}'; what is emulated is a simulated rig")
    beside: dict[str, Any] = {}
    if options.rig is not None:
        beside = copied_tables(read_tables(options.rig), options.rig.parent)
    beside["safety"] = {"stop_file": STOP_FILE} | beside.get("safety", {})
    check_outputs([options.write], rig_files(options.rig, config))
    for fault in options.fault:
        with naming("--fault"):
            parse_fault(fault)
    ports = Ports(options.host, options.head, options.fixed, options.zoom, options.board, options.control)
    password = os.environ.get("COTARGET_PASSWORD", "") if options.user else ""
    if options.user and not password:
        raise ConfigError("--user needs a password: put it into the environment variable COTARGET_PASSWORD")
    with Emulation(paced(config), ports, user=options.user, password=password) as emulation:
        for fault in options.fault:
            emulation.switch(fault)
        with previous_kept(options.write):
            write_atomically(options.write, emulation.rig_toml(tcp=options.tcp, beside=beside).encode())
        print(
            f"head     {emulation.head.port} and {emulation.head.url}\n"
            f"fixed    {emulation.fixed.url}/mjpg/video.mjpg\n"
            f"zoom     ptpip:{options.host}:{emulation.zoom.port}:{emulation.zoom.port}\n"
            f"board    socket://{options.host}:{emulation.board.port}\n"
            f"control  socket://{options.host}:{emulation.control.port}\n"
            f"targets  {', '.join(config.sim.targets) or NO_TARGET}\n"
            f"{options.write} connects to them; Ctrl-C ends them",
            flush=True,
        )
        end = None if options.seconds is None else time.monotonic() + options.seconds
        try:
            while end is None or time.monotonic() < end:
                time.sleep(POLL_S)
                emulation.world.check()
        except KeyboardInterrupt:
            print("", file=sys.stderr)


CONSENT = "yes"
DIGITS = 4  # decimals of a latency [s]
# Accuracy of a measured latency [s]; a more negative one is refused.
ACCURACY_S = 0.01


def latency_command(options: argparse.Namespace) -> None:
    """Run `cotarget latency`: measure the latencies of cameras, head and lens, and print them as keys of rig.toml."""
    from cotarget.backends import describe, load_config
    from cotarget.latency import measure_fixed, measure_head, measure_lens
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's latencies cannot be measured")
    calibration = None
    if options.calibration is not None:  # refused before the head moves
        calibration = load_plausible(options.calibration, describe(config), insist=options.insist)
        calibration.zoom_head.hand_eye()
        check_board_size(options.rig, config)
    where = "sim" if config.backend == "sim" else "hardware"
    with open_named(options.rig, config) as rig:
        head = measure_head(rig)
        found = {
            f"{where}.zoom.latency_s": rig.spec.zoom.latency_s + head.zoom.seconds,
            f"{where}.head.command_delay_s": head.command,
        }
        agreement = {"zoom": head.zoom.agreement}
        if config.backend == "hardware":  # a simulated lens has the head's command delay
            found["hardware.zoom.command_delay_s"] = measure_lens(rig, head.zoom.seconds)
        if calibration is not None:
            fixed = measure_fixed(rig, calibration, config.board)
            # Relative to the zoom camera, whose frame times contain the error found above.
            found[f"{where}.fixed.latency_s"] = rig.spec.fixed.latency_s + fixed.seconds + head.zoom.seconds
            agreement["fixed"] = fixed.agreement
    if calibration is None:
        print("the fixed camera's latency needs --calibration, to look at a board with both cameras", file=sys.stderr)
    rounded = {name: None if math.isnan(value) else _plausible(name, value, head.late) for name, value in found.items()}
    if head.late:
        print(f"cotarget latency: the values are doubtful: {head.late}", file=sys.stderr)
    print_json({"measured": rounded, "agreement": agreement})


def _plausible(name: str, seconds: float, late: str) -> float:
    """Round a latency for rig.toml; refuse one that is negative beyond the measurement's accuracy."""
    if seconds < -ACCURACY_S:
        why = late or "see that the picture has structure and that nothing else moves in it, and measure again"
        raise CalibrationError(f"{name}: {1000 * seconds:.0f} ms was measured, which is implausible: {why}")
    return max(round(seconds, DIGITS), 0.0)


def point_command(options: argparse.Namespace) -> None:
    """Run `cotarget point`: move head and lens, and write a picture of each camera on request."""
    from cotarget.backends import load_config
    from cotarget.calibration.captures import write_image
    from cotarget.calibration.recorder import wait_for_head, wait_for_lens
    from cotarget.rig import refuse_outside
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    refuse_if_stopped(config.safety.stop_file)
    shots = {} if options.pictures is None else {name: options.pictures / f"{name}.png" for name in ("fixed", "zoom")}
    check_outputs(shots.values(), rig_files(options.rig, config))
    if config.backend == "replay":
        raise ConfigError(f"{options.rig}: backend is 'replay'; a recording's head and lens cannot be sent anywhere")
    with open_named(options.rig, config) as rig:
        limits = rig.head.limits
        for option, angle, bounds in (
            ("--pan-deg", options.pan_deg, limits.pan),
            ("--tilt-deg", options.tilt_deg, limits.tilt),
        ):
            if angle is not None:
                low, high = map(math.degrees, bounds)
                check_within(option, angle, (low, high), "the head's {} degrees", math.degrees(limits.step))
        now, asked = rig.head.state(), {"pan": options.pan_deg, "tilt": options.tilt_deg}
        moves = any(angle is not None for angle in asked.values())
        if moves:
            refuse_outside(now, limits, [axis for axis, angle in asked.items() if angle is None])
        if options.focal_mm is not None:
            shortest, longest = (focal * rig.spec.zoom.pitch_mm for focal in rig.zoom.focal_range)
            check_within("--focal-mm", options.focal_mm, (shortest, longest), "the lens's {} mm")
            rig.zoom.zoom(options.focal_mm / rig.spec.zoom.pitch_mm)
        if moves:  # an axis that is not asked for is sent to where it stands
            pan, tilt = (getattr(now, axis) if angle is None else math.radians(angle) for axis, angle in asked.items())
            goal = rig.head.move(pan, tilt, wait=True)
            if not wait_for_head(rig, goal, max(abs(goal[0] - now.pan), abs(goal[1] - now.tilt)))[1]:
                raise DeviceError(
                    "the head does not stand where it was sent: see that nothing is in its way and that its driver "
                    "reports where it is"
                )
        wait_for_lens(rig)
        head, lens = rig.head.state(), rig.zoom.state()
        for name, path in shots.items():
            frame = rig.fixed.read(newer_than=head.t) if name == "fixed" else rig.zoom.capture()
            with previous_kept(path):
                write_image(path, frame.image)
    print_json(
        {
            "pan_deg": math.degrees(head.pan),
            "tilt_deg": math.degrees(head.tilt),
            "focal_mm": lens.focal_px * rig.spec.zoom.pitch_mm,
            "pictures": {name: str(path) for name, path in shots.items()},
        }
    )


def stop_command(options: argparse.Namespace) -> None:
    """Run `cotarget stop`: write the stop file."""
    from cotarget.safety.stop_file import find_stop_file, write_stop_file

    path = find_stop_file(options.rig)
    # A reason that is no text must not keep the stop from being written.
    write_stop_file(path, options.reason.encode(errors="surrogateescape").decode(errors="replace"))
    print(f"stopped: no head that watches {path} moves until cotarget clear")


def clear_command(options: argparse.Namespace) -> None:
    """Run `cotarget clear`: remove the stop file."""
    from cotarget.safety.stop_file import clear_stop_file, find_stop_file

    path = find_stop_file(options.rig)
    reason = clear_stop_file(path)
    print(f"{path}: there was no stop" if reason is None else f"cleared: {reason}")


def reset_head_command(options: argparse.Namespace) -> None:
    """Run `cotarget reset-head`: reset the pan-tilt unit after consent."""
    from cotarget.backends import load_config
    from cotarget.drivers.clock import MonotonicClock
    from cotarget.drivers.interlock import rig_lock
    from cotarget.drivers.rig import devices
    from cotarget.safety.signals import end_politely
    from cotarget.safety.stop_file import StopLook, refuse_if_stopped
    from cotarget.schema import missing_key

    config = load_config(options.rig)
    head = devices(config.hardware)["head"]
    if config.backend != "hardware" or missing_key(head.settings):
        raise ConfigError(f'{options.rig}: names no pan-tilt unit; backend = "hardware" and [hardware.head] port do')
    refuse_if_stopped(config.safety.stop_file)
    if not hasattr(head.driver, "reset"):
        _trust_position(options, config, head)
        return
    _ask(options, "The head will turn through its whole range. Are camera and cables clear of it?")
    look, undo = StopLook(config.safety.stop_file), end_politely()
    try:
        with rig_lock(*head.addresses, file=options.rig):
            done = head.driver.reset(head.settings, MonotonicClock(), config.safety, look.reason)
    finally:
        undo()
        look.close()
    print(f"reset: {done}")


def _trust_position(options: argparse.Namespace, config: "RigConfig", head: "Device") -> None:
    """Remove the position-lost marker of a unit without a reset after consent."""
    from cotarget.drivers.interlock import PositionLostMarker
    from cotarget.drivers.rig import port_of

    lost = PositionLostMarker(port_of(head), config.safety.stop_file)
    if not lost.files():
        raise ConfigError(f"{options.rig}: the driver of {head.where} has no reset; the unit needs none")
    _ask(options, "The unit has no reset; switch it off and on. Does it stand where it reports?")
    lost.forget()
    print("reset: the reported position counts as true again")


def _ask(options: argparse.Namespace, question: str) -> None:
    """Ask for consent, unless --yes gives it.

    Raises:
        ConfigError: the answer is not yes, or there is none.
    """
    if options.yes:
        return
    print(f"{question} [yes/no]", flush=True)
    try:
        answer = sys.stdin.readline() if sys.stdin is not None else ""
    except (OSError, ValueError):  # closed terminal, closed file, or not text
        answer = ""
    if answer.strip().lower() != CONSENT:
        raise ConfigError("not reset; it needs the answer yes, or --yes")
