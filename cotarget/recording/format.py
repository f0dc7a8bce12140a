"""Format of a recorded run's folder: write and parse events, read a recording.

    recording.json         schema, versions, when, target, whom, config; written after the next two, before the log
    calibration.json       byte-for-byte copy of the run's calibration
    template.*             image of a target that is detected by a template
    policy.onnx            copy of the learnt policy that drove head and lens, if one did
    log.jsonl              one JSON object a line, appended and flushed: the facts of the rig, then each call with its
        arguments, result and time; an operator's order comes before the calls that it leads to
    fixed/ and zoom/       frames as PNG, numbered; the line that names an image is written after the image is complete

If the program dies at any moment, the log is whole except for its last line, and every image that it names is on disk.
The last line of a run that ended in order, or by an error, is an `end`.
"""

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from cotarget.config import RigConfig, parse_config
from cotarget.control.orders import Order, parse_order
from cotarget.control.selection import check_selector_table
from cotarget.errors import ConfigError, choices
from cotarget.geometry import RigidTransform
from cotarget.rig import (
    AxisLimits,
    CameraSpec,
    Frame,
    HeadSpec,
    Image,
    PanTiltLimits,
    PanTiltState,
    RigSpec,
    ZoomSpec,
    ZoomState,
)

SCHEMA = 1
META, LOG, CALIBRATION, TEMPLATE = "recording.json", "log.jsonl", "calibration.json", "template"
POLICY = "policy.onnx"
FIXED, ZOOM = "fixed", "zoom"  # the frames' folders
COMPLETE = "complete"  # value of `end` for a run that nothing interrupted
Number = float | bool | None
Parsed = TypeVar("Parsed")
# Calls on a rig: valid numbers of arguments, and of values in the result. A frame's result is its time.
CALLS: Mapping[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "fixed.read": ((2,), (1,)),  # newer_than, timeout -> t
    "zoom.read": ((2,), (1,)),
    "zoom.capture": ((0,), (1,)),
    "zoom.zoom": ((1,), (1,)),  # focal_px -> focal_px
    "zoom.state": ((0,), (3,)),  # -> focal_px, moving, t
    "head.move": ((4, 5), (2,)),  # pan, tilt, speed (of both axes or of each), wait -> pan, tilt
    "head.state": ((0,), (4, 5)),  # -> pan, tilt, moving, t, and sigma where it is not 0
    "head.halt": ((0,), (0,)),
    "head.refused": ((0,), (0,)),  # the safety layer has refused a move of a stopped head; always an error
    "clock.now": ((0,), (1,)),
    "clock.sleep_until": ((1,), (0,)),
    "board.present": ((0, 6), (0,)),  # translation and rotation vector [rad], or no board
    "board.swing": ((6,), (0,)),
}
FRAMES = frozenset({"fixed.read", "zoom.read", "zoom.capture"})


@dataclass(frozen=True, slots=True)
class Event:
    """One call on the rig, with its result or error.

    Attributes:
        call: name of the call, one of `CALLS`.
        at: time of its return on the rig's clock [s].
        args: the arguments.
        result: values of the result; empty if the call failed.
        image: file of a frame's image; None if the image was not stored.
        size_bytes: size of that file [bytes].
        error: the exception's name and message if the call failed.
        error_class: name of its nearest base class in `cotarget.errors`, for an exception of another module.
        aside: whether another thread than the run's own called, such as a watchdog.
        repeated: whether a frame repeats the one before, where comparing their images says otherwise.
        number: a frame's `Frame.number`.
    """

    call: str
    at: float
    args: tuple[Number, ...] = ()
    result: tuple[Number, ...] = ()
    image: str | None = None
    size_bytes: int = 0
    error: tuple[str, str] | None = None
    error_class: str = ""
    aside: bool = False
    repeated: bool | None = None
    number: int | None = None

    @property
    def numbers(self) -> tuple[float, ...]:
        """Result as floats; that of a frame is its exposure time [s]."""
        return tuple(float(value or 0.0) for value in self.result)


def argument_numbers(call: str, arguments: Sequence[Any]) -> tuple[Number, ...]:
    """Flatten the arguments of a call, in the order of its signature, as an event has them."""
    if call == "board.present" and arguments[0] is None:
        return ()
    return tuple(number for each in arguments for number in ((None,) if each is None else _numbers_of(each)))


def result_numbers(result: Any) -> tuple[Number, ...]:
    """Flatten the result of a call as an event has it; a frame's image is stored apart."""
    match result:
        case None:
            return ()
        case Frame():
            return (result.t,)
        case ZoomState():
            return dataclasses.astuple(result)
        case PanTiltState():
            return (*dataclasses.astuple(result)[:4], *([result.sigma] if result.sigma else []))
    return _numbers_of(result)


def _numbers_of(value: Any) -> tuple[Number, ...]:
    match value:
        case tuple():
            return value
        case RigidTransform():
            return tuple(float(v) for v in (*value.translation, *value.rotation.as_rotvec()))
    return (value,)


def event_line(event: Event) -> str:
    """Write an event as a line of the log, without newline; floats keep every bit."""
    row: dict[str, Any] = {"call": event.call, "at": event.at}
    if event.args:
        row["args"] = [_plain(value) for value in event.args]
    if event.result:
        row["result"] = [_plain(value) for value in event.result]
    if event.image is not None:
        row |= {"image": event.image, "bytes": event.size_bytes}
    if event.error is not None:
        row["error"] = list(event.error)
        if event.error_class:
            row["error_class"] = event.error_class
    if event.aside:
        row["aside"] = True
    if event.repeated is not None:
        row["repeated"] = event.repeated
    if event.number is not None:
        row["number"] = event.number
    return json.dumps(row, allow_nan=False)


def parse_event(row: Mapping[str, Any]) -> Event:
    """Parse an event of the log.

    Raises:
        ValueError: the row is no valid event.
    """
    call = row.get("call")
    if not isinstance(call, str) or call not in CALLS:
        raise ValueError(f"unknown call {call!r}")
    error = None
    if (failure := row.get("error")) is not None:
        name, message = failure
        error = str(name), str(message)
    args, result = (tuple(map(_number, row.get(key, ()))) for key in ("args", "result"))
    arities, numbers = CALLS[call]
    if len(args) not in arities or len(result) not in ((0,) if error else numbers) or None in result:
        raise ValueError(f"{call} has other numbers")
    image, size, count = row.get("image"), row.get("bytes", 0), row.get("number")
    if image is not None and not (isinstance(image, str) and _is_inside(image) and call in FRAMES):
        raise ValueError("image is no file of the recording")
    if type(size) is not int:
        raise ValueError("bytes is not a whole number")
    if count is not None and type(count) is not int:
        raise ValueError("number is not a whole number")
    at = float(row["at"])
    if not math.isfinite(at):
        raise ValueError("at is not finite")
    named, aside, repeated = str(row.get("error_class", "")), row.get("aside") is True, row.get("repeated")
    repeated = None if repeated is None else bool(repeated)
    return Event(call, at, args, result, image, size, error, named, aside, repeated, count)


def is_same(a: Image, b: Image) -> bool:
    """Whether two images are the same to the last bit; noise differs in the first row already."""
    return a is b or (np.array_equal(a[0], b[0]) and np.array_equal(a, b))


def spec_table(spec: RigSpec) -> dict[str, Any]:
    """Write a rig's spec as a JSON object."""
    fixed, zoom, limits = spec.fixed, spec.zoom, spec.head.limits
    return {
        "fixed_size": list(fixed.size),
        "zoom_size": list(zoom.size),
        "still_size": list(zoom.still_size),
        "focal_range_px": [_plain(value) for value in zoom.focal_range],
        "pan": [_plain(value) for value in limits.pan.range],
        "tilt": [_plain(value) for value in limits.tilt.range],
        "speed": _of_axes(limits, "speed"),
        "acceleration": _of_axes(limits, "acceleration"),
        "step": _of_axes(limits, "step"),
        **({"slack": _of_axes(limits, "slack")} if limits.pan.slack or limits.tilt.slack else {}),
        "real_time": spec.real_time,
        "fixed_rate_hz": _plain(fixed.rate_hz),
        "fixed_latency_s": _plain(fixed.latency_s),
        "zoom_rate_hz": _plain(zoom.rate_hz),
        "zoom_latency_s": _plain(zoom.latency_s),
        "zoom_pitch_mm": zoom.pitch_mm and _plain(zoom.pitch_mm),
        "zoom_delay_s": _plain(zoom.delay_s),
        "head_delay_s": _plain(spec.head.delay_s),
        **({"head_zoomed_speeds": [list(each) for each in spec.head.zoomed_speeds]} if spec.head.zoomed_speeds else {}),
    }


def _of_axes(limits: PanTiltLimits, name: str) -> float | list[float | None] | None:
    """Write a limit of both axes: one value where they are equal, else [pan, tilt]; null for what is unknown."""
    pan, tilt = (None if (value := getattr(axis, name)) is None else _plain(value) for axis in limits.axes)
    return pan if pan == tilt else [pan, tilt]


def parse_spec(table: Mapping[str, Any], described: Callable[[], RigSpec]) -> RigSpec:
    """Parse a rig's spec; ``described`` gives rates and delays, which an earlier version did not record.

    Raises:
        KeyError, TypeError, ValueError: a key is missing, or a value is wrong.
    """

    def pair(key: str) -> tuple[float, float]:
        first, second = map(float, table[key])
        return first, second

    def size(key: str) -> tuple[int, int]:
        width, height = (int(value) for value in table[key])
        if min(width, height) <= 0:
            raise ValueError(f"{key} is not greater than zero")
        return width, height

    fixed_size, zoom_size, still_size = size("fixed_size"), size("zoom_size"), size("still_size")
    focal_range = pair("focal_range_px")

    def of_axes(key: str) -> Any:
        value = table.get(key, 0.0) if key == "slack" else table[key]  # an earlier version has no slack
        pan, tilt = value if isinstance(value, list) else (value, value)
        return pan, tilt

    def axis(name: str, number: int) -> AxisLimits:
        speed, acceleration, step, slack = (of_axes(key)[number] for key in ("speed", "acceleration", "step", "slack"))
        known = None if acceleration is None else float(acceleration)
        return AxisLimits(pair(name), float(speed), known, float(step), float(slack))

    limits = PanTiltLimits(axis("pan", 0), axis("tilt", 1))
    if "head_delay_s" in table:
        fixed = CameraSpec(fixed_size, float(table["fixed_rate_hz"]), float(table["fixed_latency_s"]))
        rates = {key: float(table[f"zoom_{key}"]) for key in ("rate_hz", "latency_s", "delay_s")}
        pitch_mm = None if table["zoom_pitch_mm"] is None else float(table["zoom_pitch_mm"])
        zoom = ZoomSpec(zoom_size, focal_range=focal_range, still_size=still_size, pitch_mm=pitch_mm, **rates)
        speeds = tuple((float(focal), float(speed)) for focal, speed in table.get("head_zoomed_speeds", ()))
        head = HeadSpec(limits, float(table["head_delay_s"]), speeds)
    else:
        spec = described()
        fixed = replace(spec.fixed, size=fixed_size)
        zoom = replace(spec.zoom, size=zoom_size, focal_range=focal_range, still_size=still_size)
        head = replace(spec.head, limits=limits)
    return RigSpec(fixed, zoom, head, bool(table["real_time"]))


def _read_meta(path: Path) -> Mapping[str, Any]:
    """Read recording.json and check its schema.

    Raises:
        ConfigError: the file is missing, is not valid, or has another schema.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{path.parent}: is no folder of a recording: it holds no {path.name}") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: is not JSON: {error}") from None
    if not isinstance(table, dict):
        raise ConfigError(f"{path}: holds no JSON object")
    if "schema" not in table:
        raise ConfigError(f"{path}: missing key 'schema'; this version reads schema {SCHEMA}")
    if table["schema"] != SCHEMA or isinstance(table["schema"], bool):
        raise ConfigError(f"{path}: schema {table['schema']!r} is not {SCHEMA}, the one that this version reads")
    keys = ("cotarget", "target", "config")
    if missing := [key for key in keys if key not in table]:
        raise ConfigError(f"{path}: missing key '{missing[0]}'; needed here: {choices(keys)}")
    return table


def _plain(value: Number) -> Any:
    """Convert a number for JSON; infinity, which unlimited heads have, becomes a text that `float` reads."""
    if value is None or isinstance(value, bool):
        return value
    return float(value) if math.isfinite(value) else str(float(value))


def _number(value: Any) -> Number:
    if value is None or isinstance(value, bool):
        return value
    if not isinstance(value, int | float | str):
        raise ValueError(f"{value!r} is not a number")
    return float(value)


def _is_inside(name: str) -> bool:
    """Return whether a file's name stays inside the recording's folder."""
    return not Path(name).is_absolute() and ".." not in Path(name).parts


# Reading


@dataclass(frozen=True)
class Recording:
    """A recorded run.

    Attributes:
        directory: folder of the recording.
        config: configuration of the recorded rig.
        calibration: path of the run's calibration.json.
        target: name of the followed target.
        selector_table: selection among several targets, see `cotarget.control.selection`; empty in older recordings.
        spec: spec of the recorded rig, with the head's own limits.
        events: every call on the rig, in order.
        orders: an operator's orders, in order, each with the number of calls before it.
        ending: "complete", the error that ended the run, or where a truncated log breaks off.
        truncated: whether the log has no end; then the last step, which may be incomplete, is left out.
        notes: remarks for the user, one line each.
        when: date and time at which it began, as text; empty in one that does not say.
        policy: path of the learnt policy that drove head and lens; None for none.
    """

    directory: Path
    config: RigConfig
    calibration: Path
    target: str
    selector_table: Mapping[str, Any]
    spec: RigSpec
    events: tuple[Event, ...]
    ending: str
    truncated: bool
    notes: tuple[str, ...]
    orders: tuple[tuple[int, Order], ...] = ()
    when: str = ""
    policy: Path | None = None

    @property
    def steps(self) -> int:
        """Number of the fixed camera's frames in the run."""
        return sum(event.call == "fixed.read" and event.image is not None for event in self.events)

    @property
    def pictures(self) -> dict[float, int]:
        """Numbers of the fixed camera's images, from 0, by their exposure time [s]."""
        frames = [event for event in self.events if event.call == "fixed.read"]
        return {event.numbers[0]: int(Path(event.image).stem) for event in frames if event.image is not None}

    @property
    def seconds(self) -> float:
        """Time from the first call to the last, on the rig's clock [s]."""
        return self.events[-1].at - self.events[0].at if self.events else 0.0


def read_recording(directory: Path, describe: Callable[[RigConfig], RigSpec]) -> Recording:
    """Read a recording up to where it is whole; images must exist, but are not read.

    Args:
        directory: folder of the recording.
        describe: gives the spec of a configured rig, for rates and delays that an earlier version did not record.

    Raises:
        ConfigError: the folder is no recording, has another schema, or holds nothing that can be replayed.
    """
    meta = _read_meta(directory / META)
    target, selector_table, config = _parse_meta(directory, meta)
    if not (directory / CALIBRATION).is_file():
        raise ConfigError(f"{directory / CALIBRATION}: no such file; the recording is not whole")
    spec, ending = None, ""
    rows, orders = list[Event](), list[tuple[int, Order]]()
    stop = "the run stopped without an end"
    try:
        for number, row in _rows(directory / LOG):
            if "rig" in row:
                spec = _parsed(number, parse_spec, row["rig"], partial(describe, config))
            elif "end" in row:
                ending = str(row["end"])
            elif "order" in row:
                orders.append((len(rows), _parsed(number, parse_order, row)))
            else:
                rows.append(_with_image_on_disk(directory, _parsed(number, parse_event, row)))
    except _DamageError as damage:
        stop = str(damage)
    if spec is None:
        raise ConfigError(f"{directory}: holds nothing to replay: {stop}")
    notes = []
    if truncated := not ending:
        rows = _without_last_step(rows)
        if not any(event.call == "fixed.read" for event in rows):
            raise ConfigError(f"{directory}: is cut short before its first step was complete: {stop}")
        notes.append(f"is cut short, and replays up to {rows[-1].at - rows[0].at:.2f} s: {stop}")
    elif ending != COMPLETE:
        notes.append(f"the run was ended by {ending}")
    missing = sum(e.call in ("zoom.read", "zoom.capture") and e.image is None and e.error is None for e in rows)
    if missing:
        notes.append(f"{missing} frames of the zoom camera lack their image; the one before stands in")
    if meta["cotarget"] != version("cotarget"):
        notes.append(f"was recorded by cotarget {meta['cotarget']}; this is {version('cotarget')}")
    return Recording(
        directory,
        config,
        directory / CALIBRATION,
        target,
        selector_table,
        spec,
        tuple(rows),
        ending or stop,
        truncated,
        tuple(notes),
        tuple(orders),
        str(meta.get("when", "")),
        directory / POLICY if (directory / POLICY).exists() else None,
    )


def read_spec(directory: Path, describe: Callable[[RigConfig], RigSpec]) -> RigSpec:
    """Read the recorded rig's spec alone; arguments as for `read_recording`.

    Raises:
        ConfigError: the folder is no recording, has another schema, or does not say it.
    """
    _, _, config = _parse_meta(directory, _read_meta(directory / META))
    with suppress(_DamageError):
        for number, row in _rows(directory / LOG):
            if "rig" in row:
                return _parsed(number, parse_spec, row["rig"], partial(describe, config))
    raise ConfigError(f"{directory}: does not say what the recorded rig was")


class _DamageError(Exception):
    """The log is not whole from a line on."""


def _parse_meta(directory: Path, meta: Mapping[str, Any]) -> tuple[str, dict[str, Any], RigConfig]:
    """Parse target name, selector table and configuration; the target's template is the recording's copy."""
    path = directory / META
    name, table = meta["target"], meta["config"]
    try:
        if not isinstance(name, str):
            raise ConfigError("target: is not a text")
        if not isinstance(table, Mapping):
            raise ConfigError(f"config: {table!r} is not a table")
        config = parse_config(table)
        target = config.target(name)
        selector_table = meta.get("whom", {})
        check_selector_table(selector_table)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: whom: {error}") from None
    recorded = table.get("targets", {}).get(name, {}).get("template")
    template = None if recorded is None else directory / Path(recorded).name
    if template is not None and not template.is_file():
        raise ConfigError(f"{template}: no such file; the recording is not whole")
    target = replace(target, template=template)
    return name, selector_table, dataclasses.replace(config, targets={**config.targets, name: target})


def _rows(path: Path) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """Yield the log's lines as objects, with their numbers from 1."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        raise _DamageError(f"there is no {path.name}") from None
    except OSError as error:
        raise _DamageError(f"{path.name} cannot be read: {error.strerror}") from None
    with file:
        for number, line in enumerate(file, start=1):
            if not line.endswith(b"\n"):
                raise _DamageError("the run stopped while a line was written")
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):
                row = None
            if not isinstance(row, dict):
                raise _DamageError(f"line {number} of {path.name} is damaged")
            yield number, row


def _parsed(number: int, parse: Callable[..., Parsed], *row: Any) -> Parsed:
    """Parse a line of the log by its number."""
    try:
        return parse(*row)
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        reason = f"missing key {error}" if isinstance(error, KeyError) else str(error)
        raise _DamageError(f"line {number} of {LOG} is damaged: {reason}") from None


def _with_image_on_disk(directory: Path, event: Event) -> Event:
    """Check that an event's image is on disk; a frame of the zoom camera may lack it."""
    if event.image is None:
        if event.call == "fixed.read" and event.error is None:
            raise _DamageError("a frame of the fixed camera has no image")
        return event
    try:
        size = (directory / event.image).stat().st_size
    except OSError:
        size = -1
    if size == event.size_bytes:
        return event
    if event.call == "fixed.read":
        raise _DamageError(f"{event.image} is {'missing' if size < 0 else 'damaged'}")
    return replace(event, image=None)


def _without_last_step(events: list[Event]) -> list[Event]:
    """Return the events before the last frame of the fixed camera."""
    looks = [i for i, event in enumerate(events) if event.call == "fixed.read" and not event.aside]
    return events[: looks[-1]] if looks else []
