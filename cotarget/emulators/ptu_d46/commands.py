"""The commands of the PTU-D46: syntax, first firmware version, and effect on a `Unit`.

A handler returns the answer, or a task that ends with it. Most commands that take a value are queries without it.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

from cotarget.emulators.ptu_d46.unit import FINENESS, RefusalError, Task, Unit, UnitAxis

STEP_MODES = {"F": "FULL", "H": "HALF", "Q": "QUARTER", "E": "EIGHTH", "A": "AUTO"}
HOLD_POWER = {"R": "REGULAR", "L": "LOW", "O": "OFF"}
MOVE_POWER = {"R": "REGULAR", "L": "LOW", "H": "HIGH"}


def _parts(unit: Unit, command: re.Match[str]) -> tuple[UnitAxis, int | None]:
    """Return the axis that a command names, and its number or None."""
    return unit.axis(command[1]), None if command[2] is None else int(command[2])


def position(unit: Unit, command: re.Match[str]) -> str:
    """PP, TP: move to a position; query the present position."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Current {axis} position is {n}", axis, axis.position)
    return unit.move(axis, n)


def offset(unit: Unit, command: re.Match[str]) -> str:
    """PO, TO: move by an offset from the present position; query the desired position."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say(unit.profile.wording.offset, axis, axis.desired)
    return unit.move(axis, axis.position + n)


def speed(unit: Unit, command: re.Match[str]) -> str:
    """PS, TS: set or query the desired speed."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say(unit.profile.wording.speed, axis, axis.velocity if unit.velocity_mode else axis.settings.speed)
    return unit.set_speed(axis, n)


def speed_offset(unit: Unit, command: re.Match[str]) -> str:
    """PD, TD: set the desired speed as an offset from the present speed; query the present speed."""
    axis, n = _parts(unit, command)
    present = round(axis.speed if unit.velocity_mode else abs(axis.speed))
    if n is None:
        return unit.say("Current {axis} speed is {n} positions/sec", axis, present)
    return unit.set_speed(axis, present + n)


def acceleration(unit: Unit, command: re.Match[str]) -> str | Task:
    """PA, TA: set the acceleration, once the axis stands; query it."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say(unit.profile.wording.acceleration, axis, axis.settings.acceleration)
    return _change(unit, axis, "acceleration", n, n > 0)


def base_speed(unit: Unit, command: re.Match[str]) -> str | Task:
    """PB, TB: set the base speed, once the axis stands; query it."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Current {axis} base speed is {n} positions/sec", axis, axis.settings.base)
    return _change(unit, axis, "base", n, 0 <= n <= axis.settings.upper)


def upper_speed(unit: Unit, command: re.Match[str]) -> str | Task:
    """PU, TU: set the upper bound of speeds, once the axis stands; query it."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Maximum {axis} speed is {n} positions/sec", axis, axis.settings.upper)
    return _change(unit, axis, "upper", n, max(axis.settings.lower, 1) <= n <= unit.profile.ceiling)


def lower_speed(unit: Unit, command: re.Match[str]) -> str | Task:
    """PL, TL: set the lower bound of speeds, once the axis stands; query it."""
    axis, n = _parts(unit, command)
    if n is None:
        return unit.say("Minimum {axis} speed is {n} positions/sec", axis, axis.settings.lower)
    return _change(unit, axis, "lower", n, 0 <= n <= axis.settings.upper)


def _change(unit: Unit, axis: UnitAxis, name: str, value: int, sensible: bool) -> Task:
    """Set a bound or the acceleration; the desired speed is clipped to the bounds."""
    if not sensible:
        raise RefusalError(unit.profile.wording.out_of_range)

    def change() -> None:
        settings = axis.settings
        setattr(settings, name, value)
        settings.speed = min(max(settings.speed, settings.lower), settings.upper)

    return unit.compute_tables(axis, change)


def limit(unit: Unit, command: re.Match[str]) -> str:
    """PN, PX, TN, TX: query the limits that the reset found."""
    axis, upper = unit.axis(command[1]), command[2] == "X"
    word = "Maximum" if upper else "Minimum"
    return unit.say(f"{word} {{axis}} position is {{n}}", axis, axis.factory_limits[upper])


def user_limit(unit: Unit, command: re.Match[str]) -> str:
    """PNU, PXU, TNU, TXU: set or query the user's limits, in force after LU."""
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
    """PR, TR: query the resolution [seconds of arc]."""
    axis = unit.axis(command[1])
    number = f"{axis.resolution:.{unit.profile.resolution_digits}f}"
    return unit.profile.wording.resolution.format(axis=axis.name, n=number) if unit.settings.verbose else number


def power(unit: Unit, command: re.Match[str]) -> str:
    """PH, PM, TH, TM: set or query the power of the motor at rest and in motion."""
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
    """WP, WT: set or query the division of a full step; setting it resets the axis."""
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


# Commands of the whole unit

Version = tuple[int, int, int]
Answer = str | Task
Handler = Callable[[Unit, re.Match[str]], Answer]
# Baud rates of `@`; the E-series has more, and one D46 was seen at 38400.
BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400)
E_BAUDS = (*BAUDS, 57600, 115200)
BYTE_DELAY_MS = (10, 1000)  # 0 is valid too
PRESETS = 33  # numbers 0 to 32
E_VERSION = (3, 0, 0)
MENU = (
    "PP TP PO TO position  PS TS PD TD speed  PA TA acceleration  PB TB PU TU PL TL bounds  PN PX TN TX limits  "
    "PR TR resolution  L limits  I S A execution  H halt  C control  R reset  M scan  D defaults  E echo  F feedback  "
    "V version"
)


def echo(unit: Unit, command: re.Match[str]) -> str:
    """EE, ED, E: switch the echo on or off; query it."""
    if command[1]:
        unit.settings.echo = command[1] == "E"
        return ""
    return "Echoing ON" if unit.settings.echo else "Echoing OFF"


def feedback(unit: Unit, command: re.Match[str]) -> str:
    """FV, FT, F: switch verbose or terse replies on; query which."""
    if command[1]:
        unit.settings.verbose = command[1] == "V"
        return ""
    return "ASCII verbose mode" if unit.settings.verbose else "ASCII terse mode"


def limits(unit: Unit, command: re.Match[str]) -> str:
    """LE, LD, LU, L: enable the factory's limits, none or the user's; query which."""
    if command[1] == "U" and unit.profile.version < (2, 13, 1):
        raise RefusalError(unit.profile.wording.illegal)
    if command[1]:
        unit.settings.limits = command[1]
        return ""
    return {
        "E": "Limit bounds are ENABLED (soft limits enabled)",
        "D": "Limit bounds are DISABLED (hard limits only: use care)",
        "U": "Limit user defined bounds are enabled",
    }[unit.settings.limits]


def execution(unit: Unit, command: re.Match[str]) -> str:
    """I, S: execute positions at once, or on A or I."""
    unit.settings.immediate = command[0] == "I"
    if unit.settings.immediate:
        unit.release_pending()
    return ""


def await_arrival(unit: Unit, command: re.Match[str]) -> Task:
    """A: answer when both axes have arrived."""
    unit.release_pending()
    return unit.standing(unit.axes)


def halt(unit: Unit, command: re.Match[str]) -> Answer:
    """H, HP, HT: halt both axes or one."""
    halted = [axis for axis in unit.axes if command[1] in ("", axis.letter)]
    for axis in halted:
        axis.velocity = 0
        axis.halt()
    return unit.standing(halted) if unit.profile.halt_waits else ""


def control(unit: Unit, command: re.Match[str]) -> str:
    """CI, CV, C: set independent or pure velocity mode; query which."""
    if command[1]:
        unit.set_velocity_mode(command[1] == "V")
        return ""
    words = unit.profile.wording.velocity if unit.velocity_mode else unit.profile.wording.independent
    return words[0 if unit.settings.verbose else 1]


def reset(unit: Unit, command: re.Match[str]) -> Answer:
    """R: reset. RE, RP, RT, RD: set which axes R and power-up reset; on the E-series RE, RP, RT reset at once."""
    letter = command[1]
    if not letter:
        return unit.reset(unit.settings.reset)
    letters = {"E": "PT", "P": "P", "T": "T", "D": ""}[letter]
    if unit.profile.reset_at_once and letters:
        return unit.reset(letters)
    unit.settings.reset = letters
    return ""


def scan(unit: Unit, command: re.Match[str]) -> str:
    """M: scan between the limits or between positions. ME, MD, MQ: set or query whether power-up begins a scan."""
    match command[1]:
        case "E" | "D":
            unit.settings.scan_at_power_up = command[1] == "E"
            return ""
        case "Q":
            return f"Autoscan at power up is {'ENABLED' if unit.settings.scan_at_power_up else 'DISABLED'}"
    ranges = {"P": unit.pan.factory_limits}
    if command[2]:
        numbers = [int(n) for n in command[2].split(",")]
        ranges = {letter: (numbers[i], numbers[i + 1]) for letter, i in (("P", 0), ("T", 2)) if i < len(numbers)}
    for letter, ends in ranges.items():
        allowed = unit.limits(unit.axis(letter))
        if allowed is not None and not all(allowed[0] <= end <= allowed[1] for end in ends):
            raise RefusalError(unit.profile.wording.out_of_range)
    unit.start_scan(ranges)
    return ""


def preset(unit: Unit, command: re.Match[str]) -> str:
    """XS, XG, XC: store the present position under a number, move to it, delete it."""
    number = int(command[2] or 0)
    if number >= PRESETS or (command[1] == "G" and number not in unit.presets):
        raise RefusalError(unit.profile.wording.out_of_range)
    match command[1]:
        case "S":
            unit.presets[number] = (unit.pan.position, unit.tilt.position)
        case "G":
            for axis, goal in zip(unit.axes, unit.presets[number], strict=True):
                unit.move(axis, goal)
        case _:
            unit.presets.pop(number, None)
    return ""


def defaults(unit: Unit, command: re.Match[str]) -> str:
    """DS, DR, DF: save the settings, restore the saved or the factory's."""
    if command[1] == "S":
        unit.save()
    else:
        unit.restore(factory=command[1] == "F")
    return ""


def network(unit: Unit, command: re.Match[str]) -> str:
    """U: set or query the number on a shared line; 0 for a unit that is alone on its line."""
    if command[1] is None:
        return f"Unit ID is {unit.settings.network_id}" if unit.settings.verbose else str(unit.settings.network_id)
    unit.settings.network_id = int(command[1])
    return ""


def select(unit: Unit, command: re.Match[str]) -> str:
    """_: address the unit of this number, 0 for all."""
    unit.selected = int(command[1]) in (0, unit.settings.network_id) or unit.settings.network_id == 0
    return ""


def serial_line(unit: Unit, command: re.Match[str]) -> str:
    """@(baud,delay,T|F): set the line from the reply on; with T at power-up too."""
    baud, delay = int(command[1]), int(command[2])
    known = E_BAUDS if unit.profile.version >= E_VERSION else BAUDS
    if unit.settings.network_id != 0 or baud not in known or not (delay == 0 or _within(delay, BYTE_DELAY_MS)):
        raise RefusalError(unit.profile.wording.illegal)
    unit.baud, unit.byte_delay_s = baud, delay / 1000
    if command[3] == "T":
        unit.baud_at_power_up = baud
    return ""


def _within(n: int, bounds: tuple[int, int]) -> bool:
    return bounds[0] <= n <= bounds[1]


def route(unit: Unit, command: re.Match[str]) -> str:
    """@A, @B: connect the line to an expansion port; @: back to the unit."""
    if command[1] and not unit.profile.expansion:
        raise RefusalError(unit.profile.wording.illegal)
    unit.routed = bool(command[1])
    return ""


def continuous(unit: Unit, command: re.Match[str]) -> str:
    """%%1CPT, %%1CPF: switch endless pan on or off, on units with a slip ring."""
    if not unit.profile.slip_ring:
        raise RefusalError(unit.profile.wording.illegal)
    unit.pan.endless = command[1] == "T"
    return ""


def both(unit: Unit, command: re.Match[str]) -> str:
    """B pan,tilt,pan speed,tilt speed: command both axes at once (E-series)."""
    numbers = [int(n) for n in command[1].split(",")]
    for axis, goal, speed in zip(unit.axes, numbers[:2], numbers[2:], strict=True):
        unit.set_speed(axis, speed)
        unit.move(axis, goal)
    return ""


@dataclass(frozen=True)
class Command:
    """Syntax of a command, its handler, and the first firmware version that has it."""

    form: re.Pattern[str]
    handler: Handler
    since: Version = (0, 0, 0)


def _command(form: str, handler: Handler, since: Version = (0, 0, 0)) -> Command:
    return Command(re.compile(form.replace("#", r"([+-]?\d{1,9})"), re.ASCII), handler, since)


COMMANDS = (
    _command(r"([PT])P#?", position),
    _command(r"([PT])O#?", offset),
    _command(r"([PT])S#?", speed),
    _command(r"([PT])D#?", speed_offset),
    _command(r"([PT])A#?", acceleration),
    _command(r"([PT])B#?", base_speed),
    _command(r"([PT])U#?", upper_speed),
    _command(r"([PT])L#?", lower_speed),
    _command(r"([PT])([NX])", limit),
    _command(r"([PT])([NX])U#?", user_limit, (2, 13, 1)),
    _command(r"([PT])R", resolution),
    _command(r"([PT])([HM])([RLOH])?", power),
    _command(r"W([PT])([FHQE])?", step_mode, (2, 12, 8)),
    _command(r"W([PT])(A)", step_mode, (2, 13, 0)),
    _command(r"E([ED]?)", echo),
    _command(r"F([VT]?)", feedback),
    _command(r"L([EDU]?)", limits),
    _command(r"[IS]", execution),
    _command(r"A", await_arrival),
    _command(r"H([PT]?)", halt),
    _command(r"C([IV]?)", control, (1, 9, 7)),
    _command(r"R([EPTD]?)", reset),
    _command(r"M([EDQ]?)((?:-?\d{1,9},-?\d{1,9})(?:,-?\d{1,9},-?\d{1,9})?)?", scan),
    _command(r"X([SGC])(\d{1,9})?", preset, (2, 12, 11)),
    _command(r"D([SRF])", defaults),
    _command(r"V", lambda unit, command: unit.profile.title),
    _command(r"O", lambda unit, command: "Input 30 VDC @ 86 degF"),
    _command(r"U(\d{1,3})?", network),
    _command(r"_(\d{1,3})", select),
    _command(r"@\((\d{1,7}),(\d{1,5}),([TF])\)", serial_line),
    _command(r"@([AB]?)", route),
    _command(r"%%1CP([TF])", continuous, (2, 12, 12)),
    _command(r"\?", lambda unit, command: MENU),
    _command(r"B(-?\d{1,9}(?:,-?\d{1,9}){3})", both, E_VERSION),
)


def execute(unit: Unit, text: str) -> Answer:
    """Carry out one command, in capital letters.

    Returns:
        The text after the star, or a task that ends with it.

    Raises:
        RefusalError: the command is refused; its message is the text after the exclamation mark.
    """
    for command in COMMANDS:
        match = command.form.fullmatch(text)
        if match is not None and command.since <= unit.profile.version:
            return command.handler(unit, match)
    raise RefusalError(unit.profile.wording.illegal)
