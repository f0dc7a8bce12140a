"""Gets to know the PTU-D46 at a port: learns its manner of speaking, reads what it is, compares that with rig.toml.

Also a harmless look at a unit outside of a rig; for its reset see `cotarget.drivers.ptu_d46`.

The reset of a PTU-D46, which an operator has consented to: it turns through its whole range to find its limits.
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
TRIES = 2  # to come to terms with a unit that was interrupted in the middle of something
GREETING_QUIET_S, GREETING_MOST_S = 0.25, 1.5  # at open nobody knows what it was last asked
# Limits differ by a few steps from unit to unit and from reset to reset; more than this is another unit.
LIMITS_DEG = 3.0
STEP_SHARE = 2e-3  # of the resolution; the unit and people round it
# A halt is sent behind a delimiter: what noise has left at the unit ends there, and is refused in the halt's place.
HALT_NOW, HALT_TRIES = DELIMITER + HALT, 2


@dataclass(frozen=True)
class AxisFacts:
    """What a unit says about one of its axes.

    Attributes:
        arcseconds: of a step.
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
        """Lowest and highest angle in the sense of rig.toml, whose sign differs from the unit's or not [degrees]."""
        a, b = (sign * end * self.arcseconds / ptu_protocol.ARCSECONDS for end in (self.lowest, self.highest))
        return min(a, b), max(a, b)


@dataclass(frozen=True)
class UnitInfo:
    """What a unit says about itself: its version, its step mode as far as it knows it, its axes."""

    version: str
    mode: str
    pan: AxisFacts
    tilt: AxisFacts

    @property
    def braking_s(self) -> float:
        """Time to stop from the highest speed [s]."""
        return max(axis.fastest / axis.acceleration for axis in (self.pan, self.tilt))


def connect(line: Line, config: HardwareHead) -> UnitInfo:
    """Come to terms with the unit, check that it is the one that rig.toml describes, and make it ready; it halts.

    Raises:
        ConfigError: rig.toml describes another unit.
        PositionLostError: nobody knows where it is.
        DeviceError: there is no unit, or none that can be used as it is.
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
    """Raise where the unit has told of a limit or a cable: its motor lost steps, or nobody knows what it did.

    Raises:
        PositionLostError: with what it told.
    """
    if line.events:
        what = " and ".join(dict.fromkeys(ptu_protocol.EVENT_WORDS[event] for event in line.events))
        raise PositionLostError(line.name, f"reports that {what}: it was halted, and its position may be lost")


def restarted(line: Line) -> PositionLostError:
    """What to say of a unit that was switched off and on."""
    return PositionLostError(line.name, "was switched off and on, so that its position may be lost")


def halt_outright(line: Line, patience: float) -> None:
    """Halt a unit that may echo again or have answers left to send; nothing else can be asked of the line afterwards.

    Raises:
        DeviceError: it did not acknowledge that in time.
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
    """Switch the unit's echo and words off, whatever it was left at.

    Raises:
        DeviceError: there is no unit.
    """
    for _ in range(TRIES):
        line.write(DELIMITER)
        line.drain(GREETING_QUIET_S, GREETING_MOST_S)
        line.events.clear()  # from before anybody listened, as after a reset or a start
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
    """Ask the unit what it is.

    Raises:
        DeviceError: it does not say.
    """
    return UnitInfo(_told(line, "V"), _told(line, "WP"), _axis(line, "P"), _axis(line, "T"))


def refuse_uncalibrated(name: str, unit: UnitInfo) -> None:
    """Refuse a unit that does not know where it is.

    Raises:
        DeviceError: with what an operator can do about it.
    """
    for word, axis in (("pan", unit.pan), ("tilt", unit.tilt)):
        if axis.lowest >= axis.highest:
            raise DeviceError(
                f"the pan-tilt unit at {name} is not calibrated: its {word} goes from {axis.lowest} to {axis.highest}; "
                "clear its way and run cotarget reset-head, which turns it through its whole range"
            )


def compare(name: str, unit: UnitInfo, config: HardwareHead) -> None:
    """Compare what the unit says with what rig.toml expects.

    Raises:
        ConfigError: with both and what to write.
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
    """Look who is at a port, by questions that change nothing: version and number on the network.

    Raises:
        DeviceError: no pan-tilt unit, or another program has it.
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
    """Halt a unit that is in step."""
    for left in reversed(range(HALT_TRIES)):
        try:
            line.query(HALT_NOW, ptu_protocol.done, patience)
            return
        except RefusedError:
            if not left:
                raise


def _told(line: Line, question: str) -> str:
    """What the unit answers, in its own words; nothing where its firmware is too old for the question."""
    try:
        return line.query(command(question), str, PATIENCE_S)[0]
    except RefusedError:
        return ""


def _make_independent(line: Line) -> None:
    """See to it that positions can be commanded, and not velocities alone."""
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
    """Tell why there is no pan-tilt unit to talk with, from what was heard."""
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


# --- d46reset ---

RESET_S = 120.0  # no manual says how long a reset takes; published drivers wait up to a minute
# For the answer to a halt, braking included. No manual says whether a unit hears one while it resets itself.
HALT_S = 2.0
HALTED = "it was halted"
NOT_HALTED = (
    "it does not acknowledge the halt and may go on turning until its reset ends: to stop it at once, switch it off"
)


def reset(config: HardwareHead, clock: Clock, lost: PositionLostMarker, stopped: Callable[[], str | None]) -> UnitInfo:
    """Let the unit find its limits anew; until that has succeeded, its position counts as lost.

    Whatever ends it before, Ctrl-C and other exceptions included, sends a halt and waits a little for the answer;
    where none comes, the error or the log says so.

    Args:
        config: where the unit is.
        clock: for deadlines.
        lost: what is remembered of the unit.
        stopped: asked all the time: why the head must not move, None while it may.

    Returns:
        The unit, with the limits that it found.

    Raises:
        EmergencyStopError: it was stopped.
        DeviceError: it failed.
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
    """Order the reset and wait for its end."""
    line.hurry = lambda: stopped() is not None  # what is in flight is then not waited for any more
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
    """Halt the unit; how that went."""
    with contextlib.suppress(DeviceError):
        halt_outright(line, HALT_S)
        return HALTED
    return NOT_HALTED


def _expect_both_axes(line: Line) -> None:
    """See to it that both axes met their limits; a unit may be set to leave one or both out of its resets.

    Raises:
        DeviceError: one did not.
    """
    left_out = [ptu_protocol.AXIS_WORDS[axis] for axis in ptu_protocol.AXES if axis not in line.events]
    line.events.clear()
    if left_out:
        raise DeviceError(
            f"the pan-tilt unit at {line.name} says that its reset is done, but not that {' or '.join(left_out)} met a "
            "limit: send it RE by a terminal, so that it resets both axes, and reset it again"
        )
