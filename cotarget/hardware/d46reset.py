"""The reset of a PTU-D46, which an operator has consented to: it turns through its whole range to find its limits."""

import contextlib
import logging
from collections.abc import Callable

from cotarget.errors import DeviceError, EmergencyStopError
from cotarget.hardware import d46
from cotarget.hardware.claim import claimed
from cotarget.hardware.d46 import command
from cotarget.hardware.d46lost import LostPosition, PositionLostError
from cotarget.hardware.d46unit import Unit, greet, halt_outright, identify, refuse_events, refuse_uncalibrated
from cotarget.hardware.line import Line, open_line
from cotarget.hwconfig import HardwareHead
from cotarget.rig import Clock

log = logging.getLogger(__name__)

RESET_S = 120.0  # no manual says how long a reset takes; published drivers wait up to a minute
# For the answer to a halt, braking included. No manual says whether a unit hears one while it resets itself.
HALT_S = 2.0
HALTED = "it was halted"
NOT_HALTED = (
    "it does not acknowledge the halt and may go on turning until its reset ends: to stop it at once, switch it off"
)


def reset(config: HardwareHead, clock: Clock, lost: LostPosition, stopped: Callable[[], str | None]) -> Unit:
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
    with claimed(config.port), contextlib.closing(open_line(config.port, config.baud, clock)) as line:
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
        ending = _halt(line)
        _refuse_if_stopped(stopped, f"; the pan-tilt unit at {line.name} was in its reset: {ending}")
        raise DeviceError(f"the reset failed: {error}; {ending}") from error
    except BaseException:
        if (ending := _halt(line)) != HALTED:
            log.warning("the pan-tilt unit at %s was in its reset: %s", line.name, ending)
        raise


def _refuse_if_stopped(stopped: Callable[[], str | None], more: str = "") -> None:
    if (reason := stopped()) is not None:
        raise EmergencyStopError(f"emergency stop: {reason}{more}")


def _halt(line: Line) -> str:
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
    left_out = [d46.AXIS_WORDS[axis] for axis in d46.AXES if axis not in line.events]
    line.events.clear()
    if left_out:
        raise DeviceError(
            f"the pan-tilt unit at {line.name} says that its reset is done, but not that {' or '.join(left_out)} met a "
            "limit: send it RE by a terminal, so that it resets both axes, and reset it again"
        )
