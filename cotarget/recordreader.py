"""Opens the folder of a recorded run and reads as much of it as is whole."""

import dataclasses
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cotarget import __version__
from cotarget.config import RigConfig, parse_config
from cotarget.errors import ConfigError
from cotarget.recordformat import (
    CALIBRATION,
    COMPLETE,
    LOG,
    META,
    Event,
    RigFacts,
    parse_event,
    parse_facts,
    read_json,
)
from cotarget.tables import expect_table
from cotarget.whom import Whom, parse_whom


@dataclass(frozen=True)
class Recording:
    """A recorded run.

    Attributes:
        directory: its folder.
        config: of the rig that was recorded; its backend is that rig's.
        calibration: the run's calibration.json.
        target: name of the target that was followed.
        whom: which one, where there were several; nothing is said where an older version recorded it.
        facts: what the rig said of itself.
        events: every call on the rig, in order.
        ending: "complete"; or the error that ended the run; or, where it just stops, what it stops with.
        truncated: whether it just stops; then the last step, which may be half a one, is left out.
        notes: one line each for what a user should know.
    """

    directory: Path
    config: RigConfig
    calibration: Path
    target: str
    whom: Whom
    facts: RigFacts
    events: tuple[Event, ...]
    ending: str
    truncated: bool
    notes: tuple[str, ...]

    @property
    def steps(self) -> int:
        """How many frames of the fixed camera the run looked at."""
        return sum(event.call == "fixed.read" and event.image is not None for event in self.events)

    @property
    def pictures(self) -> dict[float, int]:
        """The numbers of the fixed camera's pictures, from 0, by when they were exposed [s]."""
        frames = [event for event in self.events if event.call == "fixed.read"]
        return {float(e.result[0] or 0.0): int(Path(e.image).stem) for e in frames if e.image is not None}

    @property
    def seconds(self) -> float:
        """From the first call to the last, on the rig's clock [s]."""
        return self.events[-1].at - self.events[0].at if self.events else 0.0


def open_recording(directory: Path) -> Recording:
    """Read a recording, up to where it is whole; its images are looked for, but not read.

    Raises:
        ConfigError: it is none, is another version's, or holds nothing that can be replayed.
    """
    if not directory.exists():
        raise ConfigError(f"{directory}: no such folder; give the folder of a recording")
    meta = read_json(directory / META)
    target, whom, config = _parse_meta(directory, meta)
    if not (directory / CALIBRATION).is_file():
        raise ConfigError(f"{directory / CALIBRATION}: no such file; the recording is not whole")
    facts, rows, ending = None, [], ""
    stop = "the run stopped without an end"
    try:
        for number, row in _rows(directory / LOG):
            if "rig" in row:
                facts = _facts(row["rig"], number)
            elif "end" in row:
                ending = str(row["end"])
            else:
                rows.append(_whole(directory, _event(row, number)))
    except _DamageError as damage:
        stop = str(damage)
    if facts is None:
        raise ConfigError(f"{directory}: holds nothing to replay: {stop}")
    notes = []
    if truncated := not ending:
        rows = _without_last_step(rows)
        if not any(event.call == "fixed.read" for event in rows):
            raise ConfigError(f"{directory}: is cut short before its first step was complete: {stop}")
        notes.append(f"is cut short, and replays up to {rows[-1].at - rows[0].at:.2f} s: {stop}")
    elif ending != COMPLETE:
        notes.append(f"the run was ended by {ending}")
    if missing := sum(event.call in ("zoom.read", "zoom.capture") and _imageless(event) for event in rows):
        notes.append(f"{missing} frames of the zoom camera lack their image; the one before stands in")
    if meta["cotarget"] != __version__:
        notes.append(f"was recorded by cotarget {meta['cotarget']}; this is {__version__}")
    return Recording(
        directory,
        config,
        directory / CALIBRATION,
        target,
        whom,
        facts,
        tuple(rows),
        ending or stop,
        truncated,
        tuple(notes),
    )


class _DamageError(Exception):
    """Where a log stops being whole."""


def _parse_meta(directory: Path, meta: Mapping[str, Any]) -> tuple[str, Whom, RigConfig]:
    """The target's name, which one, and the configuration, whose picture of the target lies in the recording."""
    path = directory / META
    name, table = meta["target"], meta["config"]
    try:
        if not isinstance(name, str):
            raise ConfigError("target: is not a text")
        expect_table(table, "config")
        config = parse_config(table, recorded=True)
        target = config.target(name)
        whom = parse_whom(meta.get("whom", {}))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: whom: {error}") from None
    recorded = table.get("targets", {}).get(name, {}).get("template")
    template = None if recorded is None else directory / Path(recorded).name
    if template is not None and not template.is_file():
        raise ConfigError(f"{template}: no such file; the recording is not whole")
    target = replace(target, template=template)
    return name, whom, dataclasses.replace(config, targets={**config.targets, name: target})


def _rows(path: Path) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """The log's lines as objects, with their numbers from 1."""
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


def _event(row: Mapping[str, Any], number: int) -> Event:
    try:
        return parse_event(row)
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise _DamageError(f"line {number} of {LOG} is damaged: {_words(error)}") from None


def _facts(table: Any, number: int) -> RigFacts:
    try:
        return parse_facts(table)
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise _DamageError(f"line {number} of {LOG} is damaged: {_words(error)}") from None


def _words(error: Exception) -> str:
    return f"missing key {error}" if isinstance(error, KeyError) else str(error)


def _whole(directory: Path, event: Event) -> Event:
    """An event whose image is on disk; a frame of the zoom camera can do without."""
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


def _imageless(event: Event) -> bool:
    return event.image is None and event.error is None


def _without_last_step(events: list[Event]) -> list[Event]:
    """What comes before the last frame of the fixed camera."""
    looks = [i for i, event in enumerate(events) if event.call == "fixed.read" and not event.aside]
    return events[: looks[-1]] if looks else []
