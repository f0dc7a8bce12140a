"""Connection to a PTU-D46: identify the unit, compare it with rig.toml, and reset it.

`connect` prepares a unit for `D46Head`. `probe` queries a unit without a rig. `reset` turns the unit through its whole
range to find its limits; an operator must have consented to it.
"""

import contextlib
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

from cotarget.config import HardwareHead
from cotarget.drivers import ptu_protocol
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.interlock import PositionLostError, PositionLostMarker, rig_lock
from cotarget.drivers.ptu_protocol import (
    DELIMITER,
    HALT,
    PATIENCE_S,
    AxisName,
    Line,
    RefusedError,
    ReplyError,
    RestartedError,
    SilentError,
    command,
    open_line,
)
from cotarget.errors import ConfigError, DeviceError, EmergencyStopError
from cotarget.rig import Clock

log = logging.getLogger(__name__)
TRIES = 2  # to greet a unit that was interrupted in the middle of an exchange
GREETING_QUIET_S, GREETING_MOST_S = 0.25, 1.5  # [s]; at open the unit's last command is unknown
# Limits differ by a few steps from unit to unit and from reset to reset; a larger difference is another unit's.
LIMITS_DEG = 3.0
STEP_SHARE = 2e-3  # tolerance relative to the resolution, which the unit and rig.toml round
# A delimiter before the halt ends what noise may have left at the unit; the unit refuses that and not the halt.
HALT_NOW, HALT_TRIES = DELIMITER + HALT, 2


@dataclass(frozen=True)
class AxisFacts:
    """What a unit reports about one of its axes.

    Attributes:
        arcseconds: size of a step [seconds of arc].
        lowest: position [steps].
        highest: position [steps].
        slowest: speed [steps/s].
        fastest: speed [steps/s].
        acceleration: [steps/s^2].
    """

    arcseconds: float
    lowest: int
    highest: int
    slowest: int
    fastest: int
    acceleration: int

    @property
    def step(self) -> float:
        """Size of a step [rad]."""
        return math.radians(self.arcseconds / ptu_protocol.ARCSECONDS)

    def degrees(self, sign: int) -> tuple[float, float]:
        """Convert the limits to degrees with rig.toml's sign of the axis: lowest, highest."""
        a, b = (sign * end * self.arcseconds / ptu_protocol.ARCSECONDS for end in (self.lowest, self.highest))
        return min(a, b), max(a, b)


@dataclass(frozen=True)
class UnitInfo:
    """What a unit reports about itself.

    Attributes:
        version: firmware version, in the unit's words.
        mode: step mode, in the unit's words; empty where the firmware does not report it.
        pan: facts of the pan axis.
        tilt: facts of the tilt axis.
    """

    version: str
    mode: str
    pan: AxisFacts
    tilt: AxisFacts

    @property
    def braking_s(self) -> float:
        """Longest time to stop from the highest speed [s]."""
        return max(axis.fastest / axis.acceleration for axis in (self.pan, self.tilt))


def connect(line: Line, config: HardwareHead) -> UnitInfo:
    """Greet the unit, halt it, check it against rig.toml, and set it to take positions.

    Raises:
        ConfigError: rig.toml describes another unit.
        PositionLostError: the unit's position may be lost.
        DeviceError: there is no unit, or it cannot be used in its state.
    """
    greet(line)
    try:
        unit = identify(line)
        refuse_uncalibrated(line.name, unit)
        compare(line.name, unit, config)
        _halt(line, PATIENCE_S + unit.braking_s)
        line.query(command("I"), ptu_protocol.done, PATIENCE_S)
        _make_independent(line)
    except RestartedError as error:
        raise restarted(line) from error
    refuse_events(line)
    return unit


def refuse_events(line: Line) -> None:
    """Raise if the unit has reported a limit or a cable event: a motor may have lost steps.

    Raises:
        PositionLostError: an event was reported; the message names it.
    """
    if line.events:
        what = " and ".join(dict.fromkeys(ptu_protocol.EVENT_WORDS[event] for event in line.events))
        raise PositionLostError(line.name, f"reports that {what}: it was halted, and its position may be lost")


def restarted(line: Line) -> PositionLostError:
    """Make the error for a unit that was switched off and on."""
    return PositionLostError(line.name, "was switched off and on, so that its position may be lost")


def halt_outright(line: Line, patience: float) -> None:
    """Halt a unit that may echo again or still send old answers; the line takes no other command afterwards.

    Raises:
        DeviceError: the unit did not acknowledge the halt in time.
    """
    line.hurry, line.strict = (lambda: False), False
    for left in reversed(range(HALT_TRIES)):
        try:
            line.ask(HALT_NOW, patience, skipping=True)
            return
        except (RefusedError, ReplyError):
            if not left:
                raise


def greet(line: Line) -> None:
    """Switch the unit's echo and verbose answers off, from any earlier mode.

    Raises:
        DeviceError: there is no unit.
    """
    for _ in range(TRIES):
        line.write(DELIMITER)
        line.drain(GREETING_QUIET_S, GREETING_MOST_S)
        line.events.clear()  # from before the line was opened, as after a reset or a start
        try:
            for order in ("ED", "FT"):
                line.ask(command(order), PATIENCE_S)
            echoes = ptu_protocol.echoing(line.ask(command("E"), PATIENCE_S).text)
            if not echoes and ptu_protocol.terse(line.ask(command("F"), PATIENCE_S).text):
                line.strict = True
                return
        except (SilentError, ReplyError, RefusedError) as error:
            log.info("%s: %s", line.name, error)
    raise _stranger(line)


def identify(line: Line) -> UnitInfo:
    """Query the unit's version, step mode and axes.

    Raises:
        DeviceError: the unit does not answer.
    """
    return UnitInfo(_told(line, "V"), _told(line, "WP"), _axis(line, "P"), _axis(line, "T"))


def refuse_uncalibrated(name: str, unit: UnitInfo) -> None:
    """Refuse a unit that has not found its limits.

    Raises:
        DeviceError: an axis has no range; the message names the remedy.
    """
    for word, axis in (("pan", unit.pan), ("tilt", unit.tilt)):
        if axis.lowest >= axis.highest:
            raise DeviceError(
                f"the pan-tilt unit at {name} is not calibrated: its {word} goes from {axis.lowest} to {axis.highest}; "
                "clear its way and run cotarget reset-head, which turns it through its whole range"
            )


def compare(name: str, unit: UnitInfo, config: HardwareHead) -> None:
    """Compare the unit's steps and limits with rig.toml.

    Raises:
        ConfigError: they differ; the message has both, and what to write.
    """
    for word, axis in (("pan", unit.pan), ("tilt", unit.tilt)):
        own = axis.arcseconds / ptu_protocol.ARCSECONDS
        if abs(own - config.step_deg) > STEP_SHARE * config.step_deg:
            raise ConfigError(
                f"hardware.head.step_deg: the {word} of the unit at {name} has steps of {own:.6g} degrees, "
                f"not {config.step_deg:.6g}; write step_deg = {own:.6g}, or change the unit's step mode"
            )
    for word, axis, expected, sign in (
        ("pan", unit.pan, config.pan_deg, config.pan_sign),
        ("tilt", unit.tilt, config.tilt_deg, config.tilt_sign),
    ):
        found = axis.degrees(sign)
        if not _alike(found, expected):
            turned = f", or {word}_sign = {-sign}" if _alike(axis.degrees(-sign), expected) else ""
            raise ConfigError(
                f"hardware.head.{word}_deg: the unit at {name} goes from {found[0]:.1f} to {found[1]:.1f} degrees, not "
                f"from {expected[0]:g} to {expected[1]:g}; write {word}_deg = [{found[0]:.1f}, {found[1]:.1f}]{turned}"
            )


def probe(port: str, baud: int) -> str:
    """Query version and network number of the unit at a port; nothing is changed.

    Raises:
        DeviceError: there is no pan-tilt unit, or another program uses it.
    """
    with rig_lock(port), contextlib.closing(open_line(port, baud, MonotonicClock())) as line:
        try:
            line.write(DELIMITER)
            line.drain(GREETING_QUIET_S, GREETING_MOST_S)
            version = line.ask(command("V"), PATIENCE_S).text
            if not version:
                raise ReplyError(f"what answers at {port} tells no version")
            return f"{version}, unit {ptu_protocol.integer(line.ask(command('U'), PATIENCE_S).text)}"
        except (SilentError, ReplyError, RefusedError) as error:
            raise _stranger(line) from error


def _axis(line: Line, axis: AxisName) -> AxisFacts:
    def number(what: str) -> int:
        return line.query(command(axis + what), ptu_protocol.integer, PATIENCE_S)[0]

    arcseconds, _ = line.query(command(axis + "R"), ptu_protocol.arcseconds, PATIENCE_S)
    facts = AxisFacts(arcseconds, number("N"), number("X"), number("L"), number("U"), number("A"))
    if not 0 <= facts.slowest <= facts.fastest or min(facts.fastest, facts.acceleration) <= 0:
        raise DeviceError(
            f"the pan-tilt unit at {line.name} tells for {ptu_protocol.AXIS_WORDS[axis]} speeds "
            f"from {facts.slowest} to {facts.fastest} and an acceleration of {facts.acceleration}; "
            "restore its factory settings"
        )
    return facts


def _halt(line: Line, patience: float) -> None:
    """Halt a unit whose line is synchronised."""
    for left in reversed(range(HALT_TRIES)):
        try:
            line.query(HALT_NOW, ptu_protocol.done, patience)
            return
        except RefusedError:
            if not left:
                raise


def _told(line: Line, question: str) -> str:
    """Query a text; empty where the firmware is too old for the query."""
    try:
        return line.query(command(question), str, PATIENCE_S)[0]
    except RefusedError:
        return ""


def _make_independent(line: Line) -> None:
    """Set the unit to take positions, and not velocities alone."""
    try:
        try:
            if ptu_protocol.independent(line.ask(command("C"), PATIENCE_S).text):
                return
        except ReplyError as error:
            log.info("%s: control mode: %s", line.name, error)
        line.query(command("CI"), ptu_protocol.done, PATIENCE_S)
    except RefusedError:
        log.info("%s: the firmware has no control modes", line.name)


def _alike(found: tuple[float, float], expected: tuple[float, float]) -> bool:
    return max(abs(a - b) for a, b in zip(found, expected, strict=True)) <= LIMITS_DEG


def _stranger(line: Line) -> DeviceError:
    """Make the error for a port without a usable pan-tilt unit, from the received bytes."""
    heard, events = line.heard, ptu_protocol.split_events(line.heard)[1]
    if not heard.strip():
        return DeviceError(
            f"nothing answers at {line.name}: is the pan-tilt unit switched on and plugged in, and does it speak at "
            f"{line.baud} baud?"
        )
    if events or ptu_protocol.BANNER.search(heard):
        return DeviceError(f"the pan-tilt unit at {line.name} is starting up; try again when it has come to rest")
    return DeviceError(
        f"what answers at {line.name} is no PTU-D46 that speaks at {line.baud} baud: "
        f"it says {ptu_protocol.shown(heard)}"
    )


# Reset

RESET_S = 120.0  # time limit; no manual gives a reset's duration, and published drivers wait up to a minute [s]
# For the answer to a halt, braking included [s]. No manual says whether a unit takes a halt during its reset.
HALT_S = 2.0
HALTED = "it was halted"
NOT_HALTED = (
    "it does not acknowledge the halt and may go on turning until its reset ends: to stop it at once, switch it off"
)


def reset(config: HardwareHead, clock: Clock, lost: PositionLostMarker, stopped: Callable[[], str | None]) -> UnitInfo:
    """Let the unit find its limits again; its position counts as lost until that has succeeded.

    Anything that ends the reset early, Ctrl-C included, sends a halt and waits `HALT_S` for the answer. Where none
    comes, the error or the log says so.

    Args:
        config: port and baud rate of the unit.
        clock: for deadlines.
        lost: marker file of the unit's port.
        stopped: polled all the time; returns why the head must not move, None while it may.

    Returns:
        The unit, with the limits that it found.

    Raises:
        EmergencyStopError: ``stopped`` returned a reason.
        DeviceError: the reset failed.
    """
    with rig_lock(config.port), contextlib.closing(open_line(config.port, config.baud, clock)) as line:
        greet(line)
        _refuse_if_stopped(stopped)
        lost.note(str(PositionLostError(line.name, "has begun a reset that did not come to its end")))
        _turn(line, stopped)
        line.hurry = lambda: False
        _expect_both_axes(line)
        unit = identify(line)
        refuse_uncalibrated(line.name, unit)
        refuse_events(line)
        lost.forget()
        return unit


def _turn(line: Line, stopped: Callable[[], str | None]) -> None:
    """Send the reset and wait for its end."""
    line.hurry = lambda: stopped() is not None  # ends the wait for the reset's answer
    try:
        said = line.ask(command("R"), RESET_S, skipping=True).text
        log.info("%s: reset: %s", line.name, said)
    except DeviceError as error:
        ending = _halt_after_reset(line)
        _refuse_if_stopped(stopped, f"; the pan-tilt unit at {line.name} was in its reset: {ending}")
        raise DeviceError(f"the reset failed: {error}; {ending}") from error
    except BaseException:
        if (ending := _halt_after_reset(line)) != HALTED:
            log.warning("the pan-tilt unit at %s was in its reset: %s", line.name, ending)
        raise


def _refuse_if_stopped(stopped: Callable[[], str | None], more: str = "") -> None:
    if (reason := stopped()) is not None:
        raise EmergencyStopError(f"emergency stop: {reason}{more}")


def _halt_after_reset(line: Line) -> str:
    """Halt the unit; return the outcome in words."""
    with contextlib.suppress(DeviceError):
        halt_outright(line, HALT_S)
        return HALTED
    return NOT_HALTED


def _expect_both_axes(line: Line) -> None:
    """Check that both axes met their limits; a unit may be set to leave one or both out of its resets.

    Raises:
        DeviceError: an axis did not.
    """
    left_out = [ptu_protocol.AXIS_WORDS[axis] for axis in ptu_protocol.AXES if axis not in line.events]
    line.events.clear()
    if left_out:
        raise DeviceError(
            f"the pan-tilt unit at {line.name} says that its reset is done, but not that {' or '.join(left_out)} met a "
            "limit: send it RE by a terminal, so that it resets both axes, and reset it again"
        )
