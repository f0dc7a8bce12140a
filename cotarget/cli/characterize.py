"""Turn and zoom a dome, and print for rig.toml what its picture shows of it: `cotarget characterize > dome.toml`."""

import argparse
import itertools
import math
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from cotarget.cli.common import add_rig, ask, open_named
from cotarget.errors import ConfigError, DeviceError

if TYPE_CHECKING:
    from cotarget.characterization import Characteristics
    from cotarget.drivers.ptz import PtzSettings
    from cotarget.rig import Rig

# The picture shows scales to 1 %, to 2 % where it has 320 px, and the focal length to 4 %. What rig.toml has stays
# where it is as near: it is from the data sheet.
SAME_SCALE, SAME_FOCAL, SCALE_PX = 0.01, 0.05, 640
SURE_DEG = 0.2  # rms angle beyond which positions are not where the picture shows
SHARE = 1.3  # of the largest distance from the goal that was seen: the next may be larger
SAME_STOP_S = 0.1  # stops are measured to 0.03 s
USUAL_DELAY_S = 0.05  # from a command to motion, where it is not seen apart from the picture's delay
SHORTEST_S = 0.02  # no stream is faster
SLOWER = 0.8  # of the highest speed, below which it depends on the zoom
DIGITS = 3


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_rig(parser)
    parser.add_argument("--yes", action="store_true", help="confirm that the dome may turn as it says")


def run(options: argparse.Namespace) -> None:
    """Measure what a dome does, after consent; say it on stderr, and print keys of rig.toml on stdout."""
    import tomli_w

    from cotarget.backends import load_config
    from cotarget.characterization import characterize, room_of
    from cotarget.drivers.ptz import PtzSettings
    from cotarget.drivers.rig import devices
    from cotarget.safety.stop_file import refuse_if_stopped

    config = load_config(options.rig)
    settings = devices(config.hardware)["head"].settings
    if config.backend != "hardware" or not isinstance(settings, PtzSettings):
        raise ConfigError(
            f"{options.rig}: has no dome, [hardware.ptz]; `cotarget latency` measures the delays of another head"
        )
    refuse_if_stopped(config.safety.stop_file)
    with open_named(options.rig, config) as rig:
        room = room_of(rig)
        pan, tilt = (f"from {low:.0f} to {high:.0f} degrees" for low, high in room.ends_deg)
        fastest = math.degrees(max(axis.speed for axis in rig.head.limits.axes))
        ask(
            options.yes,
            f"The dome will turn {pan} of pan and {tilt} of tilt, at up to {fastest:.0f} degrees/s, for two minutes, "
            "and the lens through its whole range. May it?",
            "nothing was turned",
            sys.stderr,
        )
        found = characterize(rig, room, lambda line: print(line, file=sys.stderr, flush=True))
        if not found.moves:
            raise DeviceError(_unmoved(settings))
        keys = _keys(settings, found, rig)
    for line in _words(settings, found, keys):
        print(line, file=sys.stderr)
    print(tomli_w.dumps({"hardware": {"ptz": keys}}), end="")


def _unmoved(settings: "PtzSettings") -> str:
    steered = getattr(settings, "absolute", False)
    remedy = "write absolute = false into [hardware.ptz], and try again" if steered else "see what its page says"
    return f"the dome at {settings.address} takes moves, and its picture does not move: {remedy}"


def _keys(settings: "PtzSettings", found: "Characteristics", rig: "Rig") -> dict[str, Any]:
    """List the keys of rig.toml that are to change."""
    keys: dict[str, Any] = {}
    scales = [abs(scale) for scale in found.scale]
    nearest = SAME_SCALE * max(SCALE_PX / settings.size[0], 1.0)
    same = [abs(scale - 1) <= nearest for scale in scales]
    counted = all(settings.steps_deg)
    if counted and not all(same):
        steps = [step if as_is else step * k for step, as_is, k in zip(settings.steps_deg, same, scales, strict=True)]
        keys["step_deg"] = [float(f"{step:.4g}") for step in steps]
    for name, scale, as_is in zip(("pan", "tilt"), found.scale, same, strict=True):
        factor = 1.0 if as_is or counted else abs(scale)
        low, high = (factor * end for end in getattr(settings, f"{name}_deg"))
        if scale < 0:
            keys[f"{name}_sign"] = -getattr(settings, f"{name}_sign")
            low, high = -high, -low
        if scale < 0 or factor != 1.0:
            keys[f"{name}_deg"] = [round(low, 1), round(high, 1)]
    if abs(found.focal_px / settings.wide_px - 1) > SAME_FOCAL:
        keys["wide_deg"] = round(math.degrees(2 * math.atan(settings.size[0] / 2 / found.focal_px)), 1)
    if found.is_whole:
        keys["lens"] = list(_lens(found, rig))
    if speeds := _zoomed_speeds(found):
        keys["zoomed_speeds"] = speeds
    keys |= _delays(settings, found)
    if found.stop_s is not None and hasattr(settings, "stop_delay_s"):
        stop_delay_s = max(found.stop_s, 0.0)
        if abs(stop_delay_s - settings.stop_delay_s) > SAME_STOP_S:
            keys["stop_delay_s"] = round(stop_delay_s, 2)
    if found.missed_deg > getattr(settings, "slack_deg", math.inf) + max(settings.steps_deg):
        keys["slack_deg"] = round(SHARE * found.missed_deg, 2)
    if found.turns_at_zoom and hasattr(settings, "all_axes"):
        keys["all_axes"] = True
    return keys


def _lens(found: "Characteristics", rig: "Rig") -> Iterator[list[float]]:
    """List zoom numbers and magnifications, both increasing."""
    last = -math.inf, 0.0
    for focal_px, times in found.growths:
        number = rig.zoom.number(focal_px)  # type: ignore[attr-defined]
        if number > last[0] and times > last[1]:
            last = number, times
            yield [round(number, 4), round(times, 3)]


def _zoomed_speeds(found: "Characteristics") -> list[list[float]]:
    """List from which magnification on which speed is the highest; it may be slow from the last fast one on."""
    slow: list[list[float]] = []
    fastest = found.speeds[0][1] if found.speeds else 0.0
    for (times, _), (_, speed) in itertools.pairwise(found.speeds):
        if speed < SLOWER * fastest:
            fastest = speed
            slow.append([round(times, 2), round(math.degrees(speed), 1)])
    return slow


def _delays(settings: "PtzSettings", found: "Characteristics") -> dict[str, float]:
    """Divide the time from a command to its picture; see `cotarget.characterization` why it has to be divided."""
    command_s = min(USUAL_DELAY_S, found.light_s / 2)
    late_s = found.light_s - command_s
    keys = {}
    if found.report_s is not None and found.report_s >= SHORTEST_S:
        late_s = found.report_s
        command_s = max(found.light_s - late_s, 0.0)
    elif found.report_s is not None and hasattr(settings, "status_delay_s"):
        keys["status_delay_s"] = round(settings.status_delay_s + late_s - found.report_s, DIGITS)
    return {"latency_s": round(late_s, DIGITS), "command_delay_s": round(command_s, DIGITS)} | keys


def _words(settings: "PtzSettings", found: "Characteristics", keys: dict[str, Any]) -> Iterator[str]:
    """Say what was measured."""
    if not found.orientation:
        yield (
            "The fixed camera sees too little of what the dome sees to tell whether its picture is upright, which the "
            "signs below suppose: see zoom.png of `cotarget point --pictures .`; upside down, both signs are the other "
            "way."
        )
    elif found.orientation != "upright":
        yield f"Its picture is {found.orientation}, against the fixed camera's: set it upright in the dome's page."
    for name, scale in zip(("pan", "tilt"), found.scale, strict=True):
        way = " the other way" if scale < 0 else ""
        yield f"A degree of {name} by rig.toml is {abs(scale):.3f} degrees{way}, by the picture."
    if found.off_deg > SURE_DEG:
        yield f"Its positions cannot be believed: they are {found.off_deg:.1f} degrees (rms) off the picture."
    if found.both_axes:
        yield "It moves only where pan and tilt both change: a move of one axis alone is ignored."
    if "slack_deg" in keys:
        yield f"It ends up to {found.missed_deg:.2f} degrees off its goal: it cannot be pointed more finely."
    yield f"The picture shows a motion {found.light_s:.3f} s after its command."
    if "status_delay_s" in keys:
        yield f"The positions that it reports are {keys['status_delay_s']:.2f} s late."
    if found.report_s is None:
        yield "It reports no positions while it moves."
    if found.stop_s is not None:
        yield f"It turns on for {max(found.stop_s + keys['command_delay_s'], 0.0):.2f} s after a halt."
    if {"stop_delay_s", "slack_deg"} <= keys.keys():
        yield "With stop_delay_s in rig.toml, and no slack_deg, characterize it again: it may be pointed more finely."
    if "zoomed_speeds" in keys:
        yield f"It turns by {keys['zoomed_speeds'][-1][1]:g} degrees/s at most when zoomed in."
    if found.turns_at_zoom:
        yield "It turns when only the zoom is sent."
    times = found.growths[-1][1]
    if len(found.growths) == 1:
        yield "Its picture was not seen to grow with the zoom: keep `lens` as it is."
    elif found.is_whole:
        yield f"It magnifies {times:.1f} times."
    else:
        yield (
            f"Its picture shows too little beyond a magnification of {times:.1f}: point it at something with structure "
            "and try again; until then keep `lens` as it is."
        )
