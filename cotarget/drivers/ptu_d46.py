"""The pan-tilt unit PTU-D46: identify it, move it, and reset it.

`D46Head` is the head of a rig, and `D46Link` its protocol as `PolledHead` asks for it; `connect` prepares the unit.
"""

import contextlib
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

from cotarget.config import SafetyConfig
from cotarget.drivers import ptu_protocol
from cotarget.drivers.axes import AxisFacts, Poll
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.head_link import HeadLink, Pair, Requests
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.link_errors import CutError, PositionLostError, RefusedError, ReplyError, SilentError
from cotarget.drivers.polled_head import NOTHING_SAID, PolledHead, PolledHeadSettings, braking_s
from cotarget.drivers.ptu_protocol import AXES, DELIMITER, HALT, PATIENCE_S, AxisName, Line, command, open_line
from cotarget.errors import DeviceError, EmergencyStopError
from cotarget.rig import Clock
from cotarget.schema import Limits, Needed, OneOf, Positive, model

log = logging.getLogger(__name__)
BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
GREETINGS = 2  # to a unit that was interrupted in the middle of an exchange
GREETING_QUIET_S, GREETING_MOST_S = 0.25, 1.5  # [s]; at open the unit's last command is unknown
ROUNDING = 1e-9  # relative; keeps a speed of whole steps/s from being rounded down after its conversion from degrees
STILL_S = 0.035  # longer than the slowest speed, 31 steps/s, takes for a step [s]
# A delimiter before the halt ends what noise may have left at the unit; the unit refuses that and not the halt.
HALT_NOW, HALT_TRIES = DELIMITER + HALT, 2


@model
class D46Settings(PolledHeadSettings):
    """A Directed Perception PTU-D46.

    Attributes:
        port: serial port such as "/dev/ttyUSB0", or "socket://host:port".
        step_deg: step size that the unit is expected to report, or those of pan and tilt [degrees].
        baud: baud rate of the serial line.
        pan_sign: 1 where the unit's positive pan turns right, -1 where it turns left, as in the D46's manual.
    """

    port: Annotated[str, Needed("/dev/ttyUSB0")] = ""
    step_deg: Positive | Annotated[tuple[Positive, Positive], "[pan, tilt]"] = 0.0514286
    pan_deg: Limits = (-158.9, 158.9)
    tilt_deg: Limits = (-46.6, 31.1)
    pan_sign: Annotated[int, OneOf(-1, 1)] = -1
    speed_deg_s: Positive = 149.0
    baud: Annotated[int, OneOf(*BAUDS)] = 9600


@dataclass(frozen=True)
class UnitInfo:
    """What a unit reports about itself."""

    version: str  # of the firmware, in the unit's words
    mode: str  # step mode, in the unit's words; empty where the firmware does not report it
    pan: AxisFacts
    tilt: AxisFacts

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """Lowest and highest pan, lowest and highest tilt [steps]."""
        return self.pan.lowest, self.pan.highest, self.tilt.lowest, self.tilt.highest


def connect(line: Line) -> UnitInfo:
    """Greet the unit, identify it, halt it, and set it to take positions.

    Raises:
        PositionLostError: the unit's position may be lost.
        DeviceError: there is no unit, or it cannot be used in its state.
    """
    greet(line)
    unit = identify(line)
    refuse_uncalibrated(line.name, unit.limits)
    line.query(HALT_NOW, ptu_protocol.done, PATIENCE_S + braking_s((unit.pan, unit.tilt)), even_if_refused=True)
    line.query(command("I"), ptu_protocol.done, PATIENCE_S)
    _make_independent(line)
    refuse_events(line)
    return unit


class D46Link(HeadLink):
    """The protocol of a PTU-D46 that `connect` has made ready, a `HeadLink`."""

    def __init__(self, line: Line) -> None:
        self._line, self.name = line, line.name
        self.unit: UnitInfo = connect(line)
        self.axes = self.unit.pan, self.unit.tilt
        self._next = 0  # the axis to poll
        self._goals: list[float | None] = [None, None]  # that the unit has [steps]; None after a halt
        self._speeds: list[int | None] = [None, None]  # that the unit has [steps/s]

    def poll(self, requests: Requests) -> Sequence[Poll]:
        """Ask for the position of one axis, in turn."""
        self._line.hurry, axis = requests.halt_waits, self._next
        order = command(AXES[axis] + "P")
        position, t = self._line.query(
            order, ptu_protocol.bare_integer, even_if_refused=True, resynchronized=self._refuse_cut
        )
        self._next = 1 - axis
        return [Poll(axis, position, t)]

    def move(self, goals: Pair, speeds: Pair, requests: Requests) -> None:
        """Send the speeds, rounded down to whole steps/s, and the positions that have changed."""
        self._line.hurry = requests.halt_waits
        for axis, fastest in enumerate(speeds):
            if (speed := max(math.floor(fastest * (1 + ROUNDING)), 1)) != self._speeds[axis]:
                self._order(AXES[axis] + "S", speed, requests)
                self._speeds[axis] = speed
        for axis, goal in enumerate(goals):
            if goal != self._goals[axis]:
                self._goals[axis] = None
                self._order(AXES[axis] + "P", round(goal), requests)
                self._goals[axis] = goal

    def halt(self, patience: float) -> None:
        """Stop both axes; return when the unit has acknowledged it."""
        self._goals = [None, None]
        self._line.query(HALT_NOW, ptu_protocol.done, patience, even_if_refused=True)

    def halt_last(self, patience: float) -> None:
        """Stop both axes of a unit that may have been switched off and on, and may still send old answers."""
        halt_outright(self._line, patience)

    def send_halt(self) -> None:
        """Send the halt and wait for no answer."""
        self._line.write(HALT_NOW)

    def check(self) -> None:
        """Raise if the unit has reported a limit or a cable event."""
        refuse_events(self._line)

    def close(self) -> None:
        """Release the port."""
        self._line.close()

    def _order(self, name: str, value: int, requests: Requests) -> None:
        def resynchronized(error: DeviceError, halted: bool) -> None:
            self._refuse_cut(error, halted)
            may_proceed()

        def may_proceed() -> None:
            self.check()
            requests.proceed()

        may_proceed()
        self._line.query(command(name, value), ptu_protocol.done, resynchronized=resynchronized)

    def _refuse_cut(self, error: DeviceError, halted: bool) -> None:
        """Raise CutError if the unit was halted because it was silent."""
        if halted:
            self._goals = [None, None]
            raise CutError(f"{error}, and the head was halted") from error


class D46Head(PolledHead):
    """A PTU-D46 at a serial port; arguments and errors are those of `PolledHead`."""

    Settings = D46Settings

    @staticmethod
    def probe(settings: D46Settings) -> str:
        """Query version, network number and limits of the unit; nothing is changed.

        Raises:
            UncalibratedError: the unit has not found its limits.
            DeviceError: there is no pan-tilt unit, or another program uses it.
        """
        port = settings.port
        with contextlib.closing(open_line(port, settings.baud, MonotonicClock())) as line:
            try:
                line.write(DELIMITER)
                line.drain(GREETING_QUIET_S, GREETING_MOST_S)
                version, _ = line.ask(command("V"), PATIENCE_S)
                if not version:
                    raise ReplyError(f"what answers at {port} reports no version")
                unit, *limits = (
                    ptu_protocol.integer(line.ask(command(name), PATIENCE_S)[0])
                    for name in ("U", "PN", "PX", "TN", "TX")
                )
            except (SilentError, ReplyError, RefusedError) as error:
                raise _no_unit(line) from error
        refuse_uncalibrated(port, limits)
        return f"{version}, unit {unit}"

    @staticmethod
    def reset(settings: D46Settings, clock: Clock, safety: SafetyConfig, stopped: Callable[[], str | None]) -> str:
        """Let the unit find its limits again; its position counts as lost until that has succeeded.

        Anything that ends the reset early, Ctrl-C included, sends a halt and waits `HALT_S` for the answer. Where none
        comes, the error or the log says so.

        Args:
            settings: port and baud rate of the unit.
            clock: for deadlines.
            safety: stop file, beside which the marker file lies.
            stopped: polled all the time; returns why the head must not move, None while it may.

        Returns:
            The unit with the limits that it found, in one line.

        Raises:
            EmergencyStopError: ``stopped`` returned a reason.
            DeviceError: the reset failed.
        """
        port, lost = settings.port, PositionLostMarker(settings.port, safety.stop_file)
        with contextlib.closing(open_line(port, settings.baud, clock)) as line:
            greet(line)
            _refuse_if_stopped(stopped)
            lost.note(str(PositionLostError(port, "has begun a reset that did not come to its end")))
            _run_reset(line, stopped)
            line.hurry = lambda: False
            _expect_both_axes(line)
            unit = identify(line)
            refuse_uncalibrated(port, unit.limits)
            refuse_events(line)
            lost.forget()
        return "{}: pan {} to {}, tilt {} to {} steps".format(unit.version, *unit.limits)

    def __init__(self, config: D46Settings, clock: Clock, safety: SafetyConfig = NOTHING_SAID) -> None:
        super().__init__(lambda: _open_link(config, clock), config, clock, safety)


def _open_link(config: D46Settings, clock: Clock) -> D46Link:
    line = open_line(config.port, config.baud, clock)
    try:
        return D46Link(line)
    except BaseException:
        line.close()
        raise


def refuse_events(line: Line) -> None:
    """Raise PositionLostError if the unit has reported a limit or a cable event: a motor may have lost steps."""
    if line.events:
        what = " and ".join(dict.fromkeys(ptu_protocol.EVENT_WORDS[event] for event in line.events))
        raise PositionLostError(line.name, f"reports that {what}: it was halted, and its position may be lost")


def halt_outright(line: Line, patience: float) -> None:
    """Halt a unit that may echo again or still send old answers; the line takes no other command afterwards."""
    line.hurry, line.strict = (lambda: False), False
    for left in reversed(range(HALT_TRIES)):
        try:
            line.ask(HALT_NOW, patience, skipping=True)
            return
        except (RefusedError, ReplyError):
            if not left:
                raise


def greet(line: Line) -> None:
    """Switch the unit's echo and verbose answers off, from any earlier mode; raise where there is no unit."""
    for _ in range(GREETINGS):
        line.write(DELIMITER)
        line.drain(GREETING_QUIET_S, GREETING_MOST_S)
        line.events.clear()  # from before the line was opened, as after a reset or a start
        try:
            for order in ("ED", "FT"):
                line.ask(command(order), PATIENCE_S)
            echoes = ptu_protocol.echoing(line.ask(command("E"), PATIENCE_S)[0])
            if not echoes and ptu_protocol.terse(line.ask(command("F"), PATIENCE_S)[0]):
                line.strict = True
                return
        except (SilentError, ReplyError, RefusedError) as error:
            log.info("%s: %s", line.name, error)
    raise _no_unit(line)


def identify(line: Line) -> UnitInfo:
    """Query the unit's version, step mode and axes."""
    return UnitInfo(_text(line, "V"), _text(line, "WP"), _axis(line, "P"), _axis(line, "T"))


class UncalibratedError(DeviceError):
    """The unit has not found its limits."""


def refuse_uncalibrated(name: str, limits: Sequence[float]) -> None:
    """Refuse a unit that has not found its limits: lowest and highest pan, lowest and highest tilt [steps].

    Raises:
        UncalibratedError: an axis has no range; the message names the remedy.
    """
    for word, (lowest, highest) in (("pan", limits[:2]), ("tilt", limits[2:])):
        if lowest >= highest:
            raise UncalibratedError(
                f"the pan-tilt unit at {name} is not calibrated: its {word} goes from {lowest} to {highest}; "
                "clear its way and run cotarget reset-head, which turns it through its whole range"
            )


def _axis(line: Line, axis: AxisName) -> AxisFacts:
    def number(what: str) -> int:
        return line.query(command(axis + what), ptu_protocol.integer, PATIENCE_S)[0]

    arcseconds, _ = line.query(command(axis + "R"), ptu_protocol.arcseconds, PATIENCE_S)
    step = math.radians(arcseconds / ptu_protocol.ARCSECONDS)
    lowest, highest, slowest, fastest, acceleration = (number(what) for what in ("N", "X", "L", "U", "A"))
    if not 0 <= slowest <= fastest or min(fastest, acceleration) <= 0:
        raise DeviceError(
            f"the pan-tilt unit at {line.name} reports for {ptu_protocol.AXIS_WORDS[axis]} speeds "
            f"from {slowest} to {fastest} and an acceleration of {acceleration}; restore its factory settings"
        )
    return AxisFacts(
        unit=step,
        lowest=lowest,
        highest=highest,
        fastest=fastest,
        slowest=max(slowest, 1),
        acceleration=acceleration,
        step=1.0,
        still_s=STILL_S,
        loses_steps=True,
    )


def _text(line: Line, question: str) -> str:
    """Query a text; empty where the firmware is too old for the query."""
    try:
        return line.query(command(question), str, PATIENCE_S)[0]
    except RefusedError:
        return ""


def _make_independent(line: Line) -> None:
    """Set the unit to take positions, and not velocities alone."""
    try:
        try:
            if ptu_protocol.independent(line.ask(command("C"), PATIENCE_S)[0]):
                return
        except ReplyError as error:
            log.info("%s: control mode: %s", line.name, error)
        line.query(command("CI"), ptu_protocol.done, PATIENCE_S)
    except RefusedError:
        log.info("%s: the firmware has no control modes", line.name)


def _no_unit(line: Line) -> DeviceError:
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


def _run_reset(line: Line, stopped: Callable[[], str | None]) -> None:
    """Send the reset and wait for its end."""
    line.hurry = lambda: stopped() is not None  # ends the wait for the reset's answer
    try:
        said, _ = line.ask(command("R"), RESET_S, skipping=True)
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
    """Refuse a reset in which an axis met no limit; a unit may be set to leave axes out of its resets."""
    left_out = [ptu_protocol.AXIS_WORDS[axis] for axis in ptu_protocol.AXES if axis not in line.events]
    line.events.clear()
    if left_out:
        raise DeviceError(
            f"the pan-tilt unit at {line.name} says that its reset is done, but not that {' or '.join(left_out)} met a "
            "limit: send it RE by a terminal, so that it resets both axes, and reset it again"
        )
