"""The D46's commands that name one axis: P... and T..., and the step mode W."""

import re

from cotarget.emulators.d46_axis import FINENESS, Task, UnitAxis
from cotarget.emulators.d46_unit import RefusalError, Unit

STEP_MODES = {"F": "FULL", "H": "HALF", "Q": "QUARTER", "E": "EIGHTH", "A": "AUTO"}
HOLD_POWER = {"R": "REGULAR", "L": "LOW", "O": "OFF"}
MOVE_POWER = {"R": "REGULAR", "L": "LOW", "H": "HIGH"}


def _parts(unit: Unit, command: re.Match[str]) -> tuple[UnitAxis, int | None]:
    """The axis that a command names, and its number, if it has one."""
    return unit.axis(command[1]), None if command[2] is None else int(command[2])


def position(unit: Unit, command: re.Match[str]) -> str:
    """PP, TP: go there; where it is."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Current {axis} position is {n}", axis, axis.position)
    return unit.move(axis, n)


def offset(unit: Unit, command: re.Match[str]) -> str:
    """PO, TO: go so far from where it is; where it is to go."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say(unit.profile.wording.offset, axis, axis.desired)
    return unit.move(axis, axis.position + n)


def speed(unit: Unit, command: re.Match[str]) -> str:
    """PS, TS: the desired speed."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say(unit.profile.wording.speed, axis, axis.velocity if unit.velocity_mode else axis.settings.speed)
    return unit.set_speed(axis, n)


def speed_offset(unit: Unit, command: re.Match[str]) -> str:
    """PD, TD: the desired speed, from the present one; the present one."""
    axis, n = _parts(unit, command)
    present = round(axis.speed if unit.velocity_mode else abs(axis.speed))
    if n is None:
        return unit.say("Current {axis} speed is {n} positions/sec", axis, present)
    return unit.set_speed(axis, present + n)


def acceleration(unit: Unit, command: re.Match[str]) -> str | Task:
    """PA, TA: the acceleration, once the axis stands."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say(unit.profile.wording.acceleration, axis, axis.settings.acceleration)
    return _change(unit, axis, "acceleration", n, n > 0)


def base_speed(unit: Unit, command: re.Match[str]) -> str | Task:
    """PB, TB: the base speed, once the axis stands."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Current {axis} base speed is {n} positions/sec", axis, axis.settings.base)
    return _change(unit, axis, "base", n, 0 <= n <= axis.settings.upper)


def upper_speed(unit: Unit, command: re.Match[str]) -> str | Task:
    """PU, TU: the upper bound of speeds, once the axis stands."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Maximum {axis} speed is {n} positions/sec", axis, axis.settings.upper)
    return _change(unit, axis, "upper", n, max(axis.settings.lower, 1) <= n <= unit.profile.ceiling)


def lower_speed(unit: Unit, command: re.Match[str]) -> str | Task:
    """PL, TL: the lower bound of speeds."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Minimum {axis} speed is {n} positions/sec", axis, axis.settings.lower)
    return _change(unit, axis, "lower", n, 0 <= n <= axis.settings.upper)


def _change(unit: Unit, axis: UnitAxis, name: str, value: int, sensible: bool) -> Task:
    """Set a bound or the acceleration; the desired speed is kept within the bounds."""
    if not sensible:
        raise RefusalError(unit.profile.wording.out_of_range)

    def change() -> None:
        settings = axis.settings
        setattr(settings, name, value)
        settings.speed = min(max(settings.speed, settings.lower), settings.upper)

    return unit.compute_tables(axis, change)


def limit(unit: Unit, command: re.Match[str]) -> str:
    """PN, PX, TN, TX: the limits that the reset found."""
    axis, upper = unit.axis(command[1]), command[2] == "X"
    word = "Maximum" if upper else "Minimum"
    return unit.say(f"{word} {{axis}} position is {{n}}", axis, axis.factory_limits[upper])


def user_limit(unit: Unit, command: re.Match[str]) -> str:
    """PNU, PXU, TNU, TXU: the user's limits, in force by LU."""
    axis, upper = unit.axis(command[1]), command[2] == "X"
    lowest, highest = axis.factory_limits
    if command[3] is None:
        word, value = ("Maximum", axis.settings.user_highest) if upper else ("Minimum", axis.settings.user_lowest)
        return unit.say(f"{word} user defined {{axis}} Position is {{n}}", axis, value)
    n = int(command[3])
    if n > highest:
        raise RefusalError(f"Maximum allowable {axis.name} position is {highest}")
    if n < lowest:
        raise RefusalError(f"Minimum allowable {axis.name} position is {lowest}")
    setattr(axis.settings, "user_highest" if upper else "user_lowest", n)
    return ""


def resolution(unit: Unit, command: re.Match[str]) -> str:
    """PR, TR: seconds of arc a position."""
    axis = unit.axis(command[1])
    number = f"{axis.resolution:.{unit.profile.resolution_digits}f}"
    return unit.profile.wording.resolution.format(axis=axis.name, n=number) if unit.settings.verbose else number


def power(unit: Unit, command: re.Match[str]) -> str:
    """PH, PM, TH, TM: the power of the motor at rest and in motion."""
    axis, moving, letter = unit.axis(command[1]), command[2] == "M", command[3]
    words = MOVE_POWER if moving else HOLD_POWER
    if letter is None:
        word = axis.settings.move if moving else axis.settings.hold
        if unit.settings.verbose:
            return f"{axis.name} in {word} {'move' if moving else 'hold'} power mode"
        return unit.profile.wording.regular if word == "REGULAR" else word
    if letter not in words:
        raise RefusalError(unit.profile.wording.illegal)
    setattr(axis.settings, "move" if moving else "hold", words[letter])
    return ""


def step_mode(unit: Unit, command: re.Match[str]) -> str | Task:
    """WP, WT: into how many parts a full step is divided; a change resets the axis."""
    axis, mode = unit.axis(command[1]), command[2]
    if mode is None:
        word = axis.settings.step_mode
        return f"{axis.name} axis is in {STEP_MODES[word]} step mode" if unit.settings.verbose else word
    return _change_step_mode(axis, mode)


def _change_step_mode(axis: UnitAxis, mode: str) -> Task:
    settings = axis.settings
    ratio = FINENESS[mode] / axis.fineness
    settings.step_mode = mode
    settings.user_lowest = int(settings.user_lowest * ratio)
    settings.user_highest = int(settings.user_highest * ratio)
    yield from axis.reset()
    return ""
