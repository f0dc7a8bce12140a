"""The folder of a recorded run: who wrote what, and one line for every answer that the rig gave.

    recording.json         schema, versions, when, target, whom, config; written last of what comes before
    calibration.json       the very bytes that the run was started with
    template.*             the target's picture, where it is found by one
    log.jsonl              one JSON object a line, appended and flushed: what the rig is, then calls with their
                           arguments, results and times
    fixed/ and zoom/       the frames as PNG, by number; a line that names one is written after the image is complete

So whatever moment the program dies at, the log up to there is whole but for its last line, and every image that it
names is on disk. The last line of a run that was ended, and did not just stop, is an `end`.
"""

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from cotarget.config import RigConfig
from cotarget.errors import ConfigError, choices
from cotarget.geometry import RigidTransform, pose_dict
from cotarget.rig import PanTiltLimits, Speed

SCHEMA = 1
META, LOG, CALIBRATION, TEMPLATE = "recording.json", "log.jsonl", "calibration.json", "template"
FIXED, ZOOM = "fixed", "zoom"  # the frames' folders
COMPLETE = "complete"  # what the `end` says of a run that nothing interrupted

Number = float | bool | None

# The calls on a rig: how many arguments and how many numbers of a result each has. A frame's result is its time.
CALLS: Mapping[str, tuple[tuple[int, ...], int]] = {
    "fixed.read": ((2,), 1),  # newer_than, timeout -> t
    "zoom.read": ((2,), 1),
    "zoom.capture": ((0,), 1),
    "zoom.zoom": ((1,), 1),  # focal_px -> focal_px
    "zoom.state": ((0,), 3),  # -> focal_px, moving, t
    "head.move": ((4, 5), 2),  # pan, tilt, speed (of both axes or of each), wait -> pan, tilt
    "head.state": ((0,), 4),  # -> pan, tilt, moving, t
    "head.halt": ((0,), 0),
    "clock.now": ((0,), 1),
    "clock.sleep_until": ((1,), 0),
    "board.present": ((0, 6), 0),  # translation and rotation vector [rad], or no board
    "board.swing": ((6,), 0),
}
FRAMES = frozenset({"fixed.read", "zoom.read", "zoom.capture"})


@dataclass(frozen=True, slots=True)
class Event:
    """One call on the rig and what came of it.

    Attributes:
        call: which, one of `CALLS`.
        at: the rig's clock when it returned [s].
        args: as they were given.
        result: numbers of the answer; none where it failed.
        image: file of a frame's image; None where it could not be kept.
        size_bytes: of that file.
        error: the exception's name and message, where it failed.
        aside: whether another thread than the run's own called, such as a watchdog.
    """

    call: str
    at: float
    args: tuple[Number, ...] = ()
    result: tuple[Number, ...] = ()
    image: str | None = None
    size_bytes: int = 0
    error: tuple[str, str] | None = None
    aside: bool = False


@dataclass(frozen=True)
class RigFacts:
    """What a rig says of itself once and for all.

    Attributes:
        fixed_size: (width, height) of the fixed camera's frames [px].
        zoom_size: the same of the zoom camera's.
        still_size: the same of its stills.
        focal_range: shortest and longest nominal focal length [px].
        limits: what the head can do.
        real_time: whether its time passes by itself, which the safety layer wants to know.
    """

    fixed_size: tuple[int, int]
    zoom_size: tuple[int, int]
    still_size: tuple[int, int]
    focal_range: tuple[float, float]
    limits: PanTiltLimits
    real_time: bool


def move_args(pan: float, tilt: float, speed: Speed | None, wait: bool) -> tuple[Number, ...]:
    """The arguments of `head.move` as an event has them."""
    return (pan, tilt, *(speed if isinstance(speed, tuple) else (speed,)), wait)


def event_line(event: Event) -> str:
    """Write an event as a line of the log, without its end; floats keep every bit."""
    row: dict[str, Any] = {"call": event.call, "at": event.at}
    if event.args:
        row["args"] = [_plain(value) for value in event.args]
    if event.result:
        row["result"] = [_plain(value) for value in event.result]
    if event.image is not None:
        row |= {"image": event.image, "bytes": event.size_bytes}
    if event.error is not None:
        row["error"] = list(event.error)
    if event.aside:
        row["aside"] = True
    return json.dumps(row, allow_nan=False)


def parse_event(row: Mapping[str, Any]) -> Event:
    """Read an event.

    Raises:
        ValueError: it is none.
    """
    call = row.get("call")
    if not isinstance(call, str) or call not in CALLS:
        raise ValueError(f"unknown call {call!r}")
    error = None
    if (failure := row.get("error")) is not None:
        name, message = failure
        error = str(name), str(message)
    args, result = (tuple(_number(value) for value in row.get(key, ())) for key in ("args", "result"))
    arities, numbers = CALLS[call]
    if len(args) not in arities or len(result) != (0 if error else numbers) or None in result:
        raise ValueError(f"{call} has other numbers")
    image, size = row.get("image"), row.get("bytes", 0)
    if image is not None and not (isinstance(image, str) and _is_inside(image) and call in FRAMES):
        raise ValueError("image is no file of the recording")
    if type(size) is not int:
        raise ValueError("bytes is not a whole number")
    at = float(row["at"])
    if not math.isfinite(at):
        raise ValueError("at is not finite")
    return Event(call, at, args, result, image, size, error, row.get("aside") is True)


def facts_table(facts: RigFacts) -> dict[str, Any]:
    """Write what a rig says of itself."""
    limits = facts.limits
    return {
        "fixed_size": list(facts.fixed_size),
        "zoom_size": list(facts.zoom_size),
        "still_size": list(facts.still_size),
        "focal_range_px": [_plain(value) for value in facts.focal_range],
        "pan": [_plain(value) for value in limits.pan],
        "tilt": [_plain(value) for value in limits.tilt],
        "speed": _plain(limits.speed),
        "acceleration": _plain(limits.acceleration),
        "step": _plain(limits.step),
        "real_time": facts.real_time,
    }


def parse_facts(table: Mapping[str, Any]) -> RigFacts:
    """Read what a rig said of itself.

    Raises:
        KeyError: something is missing.
        TypeError, ValueError: something is of another kind.
    """

    def pair(key: str) -> tuple[float, float]:
        first, second = map(float, table[key])
        return first, second

    def size(key: str) -> tuple[int, int]:
        width, height = (int(value) for value in table[key])
        if min(width, height) <= 0:
            raise ValueError(f"{key} is not greater than zero")
        return width, height

    return RigFacts(
        size("fixed_size"),
        size("zoom_size"),
        size("still_size"),
        pair("focal_range_px"),
        PanTiltLimits(
            pair("pan"), pair("tilt"), float(table["speed"]), float(table["acceleration"]), float(table["step"])
        ),
        bool(table["real_time"]),
    )


def config_table(config: RigConfig) -> dict[str, Any]:
    """Write a configuration as `parse_config` reads it.

    Passwords stay behind; and so does what would keep a replay, which moves nothing, from running.
    """
    table: dict[str, Any] = _tables(dataclasses.replace(config, recording=None))
    table["safety"].pop("stop_file", None)
    fixed = table["hardware"]["fixed"]
    fixed["password"] = ""
    url = urlsplit(fixed["url"])
    fixed["url"] = url._replace(netloc=url.netloc.rpartition("@")[2]).geturl()
    return table


def read_json(path: Path) -> Mapping[str, Any]:
    """Read recording.json and check its schema.

    Raises:
        ConfigError: it is missing, is none, or is another version's.
    """
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path.parent}: is no recording: it holds no {path.name}") from None
    except NotADirectoryError:
        raise ConfigError(f"{path.parent}: is a file; give the folder of a recording") from None
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


def _tables(value: Any) -> Any:
    """Dataclasses as tables, without what is None, for TOML cannot say that."""
    if isinstance(value, RigidTransform):
        return pose_dict(value)
    if dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return {name: _tables(part) for name, part in parts.items() if part is not None}
    if isinstance(value, Mapping):
        return {key: _tables(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return [_tables(part) for part in value]
    return str(value) if isinstance(value, Path) else value


def _plain(value: Number) -> Any:
    """A number as JSON can say it: infinity, which unlimited heads have, becomes a text that `float` reads."""
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
    """Whether a file's name stays inside the recording's folder."""
    return not Path(name).is_absolute() and ".." not in Path(name).parts
