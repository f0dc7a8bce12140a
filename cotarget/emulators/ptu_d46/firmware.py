"""Firmware of the emulated PTU-D46: a state machine from bytes to bytes, on a given clock.

It implements the ASCII command language of the Command Reference Manual v3.00D and of the PTU-D46 manual v2.14.0, and
the deviations of units in the field (`cotarget.emulators.ptu_d46.unit`), without the binary language and without what
neither our driver nor a known program sends: scanning, presets, setting the step mode, expansion ports, endless pan.
Choices where no source says what happens: docs/design-notes.md.
"""

import random
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cotarget.emulators.plant import AxisPlant
from cotarget.emulators.ptu_d46.unit import (
    RefusalError,
    Task,
    Unit,
    UnitAxis,
    UnitAxisSettings,
    UnitProfile,
    refuse_beyond,
)
from cotarget.emulators.serve import Faults

# Commands

Answer = str | Task
Version = tuple[int, int, int]


@dataclass(frozen=True)
class Command:
    """A command of the unit."""

    name: str  # its letters; a small x stands for P (pan) or T (tilt)
    # `NUMBER`, other numbers as a regular expression, a choice of letters such as "[ED]", or empty for no argument.
    argument: str = ""
    # Answers the command without argument, which mostly is a query; None where the argument is needed.
    alone: Callable[[Unit, UnitAxis], Answer] | None = None
    # Answers the command with its argument, an int where all of it is a number.
    given: Callable[[Unit, UnitAxis, Any], Answer] | None = None
    since: Version = (0, 0, 0)  # first firmware version that has it


NUMBER = r"[+-]?\d{1,9}"
# Baud rates of `@`; the E-series has more, and one D46 was seen at 38400.
BAUDS, E_BAUDS = (600, 1200, 2400, 4800, 9600, 19200, 38400), (57600, 115200)
E_VERSION = (3, 0, 0)
BYTE_DELAYS_MS = (0, *range(10, 1001))
POWER = {"R": "REGULAR", "L": "LOW", "O": "OFF", "H": "HIGH"}


def _bound(
    letter: str, name: str, allowed: Callable[[Unit, UnitAxisSettings, int], bool], sentence: str | None = None
) -> Command:
    """Describe the command of an axis's bound, set once the axis stands; without a sentence, of its acceleration."""

    def given(unit: Unit, axis: UnitAxis, n: int) -> Answer:
        if not allowed(unit, axis.settings, n):
            raise RefusalError(unit.wording.out_of_range)
        return unit.change(axis, name, n)

    return Command(
        f"x{letter}",
        NUMBER,
        lambda u, a: u.say(sentence or u.wording.acceleration, a, getattr(a.settings, name)),
        given,
    )


def _limit(letter: str, side: int, word: str) -> tuple[Command, Command]:
    """Describe the commands of the limit that the reset found, and of the user's, in force after LU."""
    name = ("user_lowest", "user_highest")[side]

    def given(unit: Unit, axis: UnitAxis, n: int) -> str:
        refuse_beyond(axis, n, axis.limits)
        return _set(axis.settings, name, n)

    sentence = f"{word} user defined {{axis}} Position is {{n}}"
    return (
        Command(f"x{letter}", alone=lambda u, a: u.say(f"{word} {{axis}} position is {{n}}", a, a.limits[side])),
        Command(f"x{letter}U", NUMBER, lambda u, a: u.say(sentence, a, getattr(a.settings, name)), given, (2, 13, 1)),
    )


def _power(letter: str, name: str, choices: str) -> Command:
    """Describe the command of the motor's power at rest or in motion."""

    def alone(unit: Unit, axis: UnitAxis) -> str:
        word = POWER[getattr(axis.settings, name)]
        terse = unit.wording.regular if word == "REGULAR" else word
        return unit.say(f"{{axis}} in {word} {name} power mode", axis, terse)

    return Command(f"x{letter}", choices, alone, lambda u, a, choice: _set(a.settings, name, choice))


def _switch(letter: str, name: str, answers: dict[str, str]) -> Command:
    """Describe the command of a setting with a few choices, each with its answer to the query."""
    return Command(
        letter,
        f"[{''.join(answers)}]",
        lambda u, a: answers[getattr(u.settings, name)],
        lambda u, a, choice: _set(u.settings, name, choice),
    )


def _set(settings: object, name: str, value: int | str) -> str:
    setattr(settings, name, value)
    return ""


def _present_speed(unit: Unit, axis: UnitAxis) -> int:
    speed = axis.plant.speed()
    return round(speed if unit.velocity_mode else abs(speed))


def _limits(unit: Unit, _: UnitAxis, choice: str) -> str:
    if choice == "U" and unit.profile.version < (2, 13, 1):
        raise RefusalError(unit.wording.illegal)
    return _set(unit.settings, "limits", choice)


def _execution(immediate: bool) -> Callable[[Unit, UnitAxis], str]:
    def alone(unit: Unit, _: UnitAxis) -> str:
        unit.settings.immediate = immediate
        if immediate:
            unit.release_pending()
        return ""

    return alone


def _await_arrival(unit: Unit, _: UnitAxis) -> Answer:
    unit.release_pending()
    return unit.wait_until_still(*unit.axes)


def _halt(unit: Unit, *axes: UnitAxis) -> Answer:
    for axis in axes:
        axis.velocity = 0
        axis.halt()
    return unit.wait_until_still(*axes) if unit.profile.halt_waits else ""


def _mode(unit: Unit, _: UnitAxis) -> str:
    words = unit.wording.velocity if unit.velocity_mode else unit.wording.independent
    return words[0 if unit.settings.feedback == "V" else 1]


def _set_mode(unit: Unit, _: UnitAxis, choice: str) -> str:
    unit.set_velocity_mode(choice == "V")
    return ""


def _reset(unit: Unit, _: UnitAxis, which: str) -> Answer:
    if unit.profile.reset_at_once and which != "D":
        return unit.reset(which)
    return _set(unit.settings, "reset", which)


def _defaults(unit: Unit, _: UnitAxis, choice: str) -> str:
    if choice == "S":
        unit.save()
    else:
        unit.restore(factory=choice == "F")
    return ""


def _select(unit: Unit, _: UnitAxis, n: int) -> str:
    unit.selected = n in (0, unit.settings.network_id) or unit.settings.network_id == 0
    return ""


def _serial_line(unit: Unit, _: UnitAxis, argument: str) -> str:
    baud, delay_ms, kept = argument.strip("()").split(",")
    known = BAUDS + (E_BAUDS if unit.profile.version >= E_VERSION else ())
    if unit.settings.network_id != 0 or int(baud) not in known or int(delay_ms) not in BYTE_DELAYS_MS:
        raise RefusalError(unit.wording.illegal)
    unit.baud, unit.byte_delay_s = int(baud), int(delay_ms) / 1000
    if kept == "T":
        unit.baud_at_power_up = unit.baud
    return ""


COMMANDS = (
    # Motion, set even during a move
    Command(
        "xP",
        NUMBER,
        lambda u, a: u.say("Current {axis} position is {n}", a, a.position),
        Unit.move,
    ),
    Command(  # offset from the present position; query of the desired one
        "xO",
        NUMBER,
        lambda u, a: u.say(u.wording.offset, a, a.desired),
        lambda u, a, n: u.move(a, a.position + n),
    ),
    Command(
        "xS",
        NUMBER,
        lambda u, a: u.say(u.wording.speed, a, a.velocity if u.velocity_mode else a.settings.speed),
        Unit.set_speed,
    ),
    Command(  # offset from the present speed, also of the query
        "xD",
        NUMBER,
        lambda u, a: u.say("Current {axis} speed is {n} positions/sec", a, _present_speed(u, a)),
        lambda u, a, n: u.set_speed(a, _present_speed(u, a) + n),
    ),
    # Bounds and acceleration, set once the axis stands
    _bound("A", "acceleration", lambda u, s, n: n > 0),
    _bound("B", "base", lambda u, s, n: 0 <= n <= s.upper, "Current {axis} base speed is {n} positions/sec"),
    _bound(
        "U",
        "upper",
        lambda u, s, n: max(s.lower, 1) <= n <= u.profile.ceiling,
        "Maximum {axis} speed is {n} positions/sec",
    ),
    _bound("L", "lower", lambda u, s, n: 0 <= n <= s.upper, "Minimum {axis} speed is {n} positions/sec"),
    # Limits and resolution
    *_limit("N", 0, "Minimum"),
    *_limit("X", 1, "Maximum"),
    Command("xR", alone=lambda u, a: u.say(u.wording.resolution, a, u.profile.resolution)),
    Command(
        "L",
        "[EDU]",
        lambda u, a: {
            "E": "Limit bounds are ENABLED (soft limits enabled)",
            "D": "Limit bounds are DISABLED (hard limits only: use care)",
            "U": "Limit user defined bounds are enabled",
        }[u.settings.limits],
        _limits,
    ),
    # Execution
    Command("I", alone=_execution(immediate=True)),
    Command("S", alone=_execution(immediate=False)),
    Command("A", alone=_await_arrival),
    Command("H", alone=lambda u, a: _halt(u, *u.axes)),
    Command("Hx", alone=_halt),
    Command("C", "[IV]", _mode, _set_mode, (1, 9, 7)),
    Command("R", "[EPTD]", lambda u, a: u.reset(u.settings.reset), _reset),
    # The unit
    _power("H", "hold", "[RLO]"),
    _power("M", "move", "[RLH]"),
    Command("Wx", alone=lambda u, a: u.say("{axis} axis is in HALF step mode", a, "H"), since=(2, 12, 8)),
    _switch("E", "echo", {"E": "Echoing ON", "D": "Echoing OFF"}),
    _switch("F", "feedback", {"V": "ASCII verbose mode", "T": "ASCII terse mode"}),
    Command("D", "[SRF]", given=_defaults),
    Command("V", alone=lambda u, a: u.profile.title),
    Command("O", alone=lambda u, a: "Input 30 VDC @ 86 degF"),
    Command(  # number on a shared line, and selection by it
        "U",
        r"\d{1,3}",
        lambda u, a: u.say("Unit ID is {n}", a, u.settings.network_id),
        lambda u, a, n: _set(u.settings, "network_id", n),
    ),
    Command("_", r"\d{1,3}", given=_select),
    Command("@", r"\(\d{1,7},\d{1,5},[TF]\)", lambda u, a: "", _serial_line),  # alone: back from an expansion port
)
FORMS = [
    (re.compile(f"{re.escape(c.name).replace('x', '(?P<axis>[PT])')}(?P<argument>{c.argument})?", re.ASCII), c)
    for c in COMMANDS
]


def execute(unit: Unit, text: str) -> Answer:
    """Carry out one command, in capital letters.

    Returns:
        The text after the star, or a task that ends with it.

    Raises:
        RefusalError: the command is refused; its message is the text after the exclamation mark.
    """
    for form, command in FORMS:
        match = form.fullmatch(text)
        if match is None or command.since > unit.profile.version:
            continue
        axis = unit.tilt if match.groupdict().get("axis") == "T" else unit.pan
        argument = match["argument"]
        if argument and command.given:
            return command.given(unit, axis, int(argument) if re.fullmatch(NUMBER, argument) else argument)
        if not argument and command.alone:
            return command.alone(unit, axis)
    raise RefusalError(unit.wording.illegal)


# Bytes

SPACE, CR, LF = 0x20, 0x0D, 0x0A
NEWLINE = "\r\n"
# Longest command, and size of the input buffer while the unit is busy [bytes]. Unselected units were seen to keep
# about 100 bytes.
LONGEST_COMMAND = 100
INPUT_BUFFER = 256
# Delay of replies with the fault late-replies [s]: longer than drivers wait for ordinary commands.
LATE_S = 1.5
D46_FAULTS = (
    "silence",  # the unit obeys but sends nothing
    "garbage",  # it sends noise
    "half-replies",  # replies end halfway
    "late-replies",  # replies are `LATE_S` late
    "unplugged",  # no input, no output
    "power-cycle",  # once: settings and position are lost; a banner; uncalibrated until R
    "limit-hit",  # once, as soon as an axis turns: it stops with !P or !T and has lost steps
    "error-replies",  # every command but a halt is refused
)


class D46:
    """A PTU-D46 some time after power-up: calibrated, echoing, verbose, standing.

    For one thread at a time: that of its ports (`cotarget.emulators.ptu_d46.ports.UnitPorts`).

    Args:
        pan: mechanics of pan, in the unit's steps.
        tilt: mechanics of tilt, in the unit's steps.
        unit: profile of the unit.
        faults: must know `D46_FAULTS`.
        now: returns the time [s], which never decreases.
    """

    def __init__(
        self, pan: AxisPlant, tilt: AxisPlant, unit: UnitProfile, faults: Faults, now: Callable[[], float]
    ) -> None:
        self.faults = faults
        self._unit = Unit(pan, tilt, unit, now)
        self._now = now
        self._input: deque[int] = deque()
        self._command = bytearray()
        self._task: Task | None = None  # the command that takes time
        self._output: deque[tuple[float, bytes]] = deque()  # (time to send [s], bytes)
        self._noise = random.Random(0)

    @property
    def baud(self) -> int:
        """Baud rate of the serial line, from the byte after the last output on."""
        return self._unit.baud

    @property
    def byte_delay_s(self) -> float:
        """Pause after each byte sent [s]."""
        return self._unit.byte_delay_s

    def receive(self, data: bytes) -> None:
        """Process bytes that arrive on the line now."""
        self._advance()
        if "unplugged" in self.faults:
            return
        for character in data:
            if len(self._input) < INPUT_BUFFER:
                self._input.append(character)
            self._process_input()

    def output(self) -> bytes:
        """Take the bytes that are to be sent by now; must be called often."""
        self._advance()
        now, due = self._now(), bytearray()
        while self._output and self._output[0][0] <= now:
            due += self._output.popleft()[1]
        return bytes(due)

    def connected(self) -> None:
        """Handle a new TCP client; E-series units greet it."""
        self._send(self._unit.profile.greeting)

    def power_on(self, calibrate: bool = True) -> None:
        """Interrupt the power: banner, then with ``calibrate`` the power-up reset, then a star."""
        self._input.clear()
        self._command.clear()
        self._output.clear()
        self._unit.lose_power()
        self._send(self._unit.profile.banner)
        self._task = self._boot(calibrate)

    def _boot(self, calibrate: bool) -> Task:
        ready = self._now() + self._unit.profile.boot_s
        while self._now() < ready:
            yield ""
        if calibrate:
            yield from self._unit.reset(self._unit.settings.reset)
        return ""

    def _advance(self) -> None:
        """Do what is due by now: faults, stops hit, the task, and characters that waited for it."""
        if self.faults.take("power-cycle"):
            self.power_on(calibrate=False)
        for axis in self._unit.axes:
            if axis.stopped_at_stop() or self._hits_obstacle(axis):
                self._send(f"!{axis.letter}")
        self._run_task()
        self._process_input()

    def _hits_obstacle(self, axis: UnitAxis) -> bool:
        if "limit-hit" not in self.faults or not (speed := axis.plant.speed()):
            return False
        self.faults.set("limit-hit", False)
        axis.lose_steps(1 if speed > 0 else -1)
        return True

    def _run_task(self) -> None:
        """Continue the command that takes time; its end is the reply."""
        while self._task is not None:
            try:
                printed = next(self._task)
            except StopIteration as end:
                self._task = None
                self._reply("*", end.value)
            else:
                if not printed:
                    return
                self._send(printed)

    def _process_input(self) -> None:
        """Process the characters in the buffer, unless the unit is busy."""
        while self._input and self._task is None:
            self._character(self._input.popleft())

    def _character(self, character: int) -> None:
        """Process one character: echo it, and at a delimiter carry out the command before it."""
        unit = self._unit
        if unit.settings.echo == "E" and unit.selected:
            self._send(chr(character))
        if character not in (SPACE, CR, LF):
            if len(self._command) < LONGEST_COMMAND:
                self._command.append(character)
            return
        text = self._command.decode("latin-1").upper()
        self._command.clear()
        if text and (unit.selected or text.startswith("_")):
            self._carry_out(text, character)

    def _carry_out(self, text: str, delimiter: int) -> None:
        """Carry out one command; reply now or by a task."""
        if delimiter == CR and self._unit.profile.leading_lf:
            self._send("\n")
        try:
            if "error-replies" in self.faults and not text.startswith("H"):
                raise RefusalError(self._unit.wording.illegal)
            answer = execute(self._unit, text)
        except RefusalError as refusal:
            self._reply("!", str(refusal))
            return
        if not isinstance(answer, str):
            self._task = answer
            self._run_task()
        elif self._unit.selected:
            self._reply("*", answer)

    def _reply(self, mark: str, text: str) -> None:
        """Send the reply that ends a command."""
        line = f"{mark} {text}{NEWLINE}" if text else mark + NEWLINE
        self._send(line[: len(line) // 2] if "half-replies" in self.faults else line)

    def _send(self, text: str) -> None:
        """Queue text to send, as the faults allow."""
        if not text or "silence" in self.faults or "unplugged" in self.faults:
            return
        data = text.encode("latin-1")
        if "garbage" in self.faults:
            data = self._noise.randbytes(len(data))
        when = self._now() + (LATE_S if "late-replies" in self.faults else 0.0)
        if self._output:
            when = max(when, self._output[-1][0])
        self._output.append((when, data))
