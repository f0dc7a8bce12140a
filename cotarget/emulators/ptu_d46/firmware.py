"""Firmware of the emulated PTU-D46: a state machine from bytes to bytes, on a given clock.

It implements the ASCII commands of the Command Reference Manual v3.00D and of the PTU-D46 manual v2.14.0 that our
driver, MRPT and flir-ptu send; every other one is refused. Choices where no source says what happens:
docs/design-notes.md.
"""

import random
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cotarget.emulators.plant import AxisPlant
from cotarget.emulators.ptu_d46.unit import Task, UnitAxis, UnitProfile
from cotarget.emulators.serve import Faults

# Commands

Answer = str | Task
ILLEGAL = "Illegal argument"


class RefusalError(Exception):
    """The unit refuses a command: it answers an exclamation mark and this message."""


@dataclass(frozen=True)
class Command:
    """A command of the unit."""

    name: str  # its letters; a small x stands for P (pan) or T (tilt)
    argument: str = ""  # `NUMBER`, or a choice of letters such as "[ED]"; empty for no argument
    # Answers the command without argument, which mostly is a query.
    alone: Callable[["D46", UnitAxis], Answer] | None = None
    # Answers the command with its argument, an int where it is a number.
    given: Callable[["D46", UnitAxis, Any], Answer] | None = None


NUMBER = r"[+-]?\d{1,9}"


def _query(name: str, sentence: str, value: Callable[["D46", UnitAxis], object]) -> Command:
    """Describe a query, answered by a sentence or by the value alone."""
    return Command(name, alone=lambda u, a: u.say(sentence, a, value(u, a)))


def _set_echo(unit: "D46", _: UnitAxis, choice: str) -> str:
    unit.echo = choice == "E"
    return ""


def _set_verbose(unit: "D46", _: UnitAxis, choice: str) -> str:
    unit.verbose = choice == "V"
    return ""


COMMANDS = (
    # Motion, set even during a move
    Command(
        "xP", NUMBER, lambda u, a: u.say("Current {axis} position is {n}", a, a.position), lambda u, a, n: u.move(a, n)
    ),
    Command(  # offset from the present position; query of the desired one
        "xO",
        NUMBER,
        lambda u, a: u.say("Target {axis} position is {n}", a, a.desired),
        lambda u, a, n: u.move(a, a.position + n),
    ),
    Command(
        "xS",
        NUMBER,
        lambda u, a: u.say("Target {axis} speed is {n} positions/sec", a, a.speed),
        lambda u, a, n: u.set_speed(a, n),
    ),
    # Bounds, limits and resolution
    _query("xA", "{axis} acceleration is {n} positions/sec^2", lambda u, a: u.profile.acceleration),
    _query("xU", "Maximum {axis} speed is {n} positions/sec", lambda u, a: u.profile.highest_speed),
    _query("xL", "Minimum {axis} speed is {n} positions/sec", lambda u, a: u.profile.lowest_speed),
    _query("xN", "Minimum {axis} position is {n}", lambda u, a: a.limits[0]),
    _query("xX", "Maximum {axis} position is {n}", lambda u, a: a.limits[1]),
    _query("xR", "{n} seconds arc per position", lambda u, a: u.profile.resolution),
    # Execution
    Command("I", alone=lambda u, a: ""),  # positions are executed at once, as they are here anyhow
    Command("A", alone=lambda u, a: u.wait_until_still()),
    Command("H", alone=lambda u, a: u.halt()),
    Command("C", "I", lambda u, a: "independent control mode", lambda u, a, choice: ""),
    Command("R", alone=lambda u, a: u.reset()),
    # The unit
    Command("E", "[ED]", lambda u, a: f"Echoing {'ON' if u.echo else 'OFF'}", _set_echo),
    Command("F", "[VT]", lambda u, a: f"ASCII {'verbose' if u.verbose else 'terse'} mode", _set_verbose),
    Command("V", alone=lambda u, a: u.profile.title),
    _query("U", "Unit ID is {n}", lambda u, a: 0),
    _query("Wx", "{axis} axis is in HALF step mode", lambda u, a: "H"),
)
FORMS = [
    (re.compile(f"{c.name.replace('x', '(?P<axis>[PT])')}(?P<argument>{c.argument})?", re.ASCII), c) for c in COMMANDS
]


def execute(unit: "D46", text: str) -> Answer:
    """Carry out one command, in capital letters.

    Returns:
        The text after the star, or a task that ends with it.

    Raises:
        RefusalError: the command is refused; its message is the text after the exclamation mark.
    """
    for form, command in FORMS:
        if (match := form.fullmatch(text)) is None:
            continue
        axis = unit.axes[match.groupdict().get("axis") == "T"]
        argument = match["argument"]
        if argument and command.given:
            return command.given(unit, axis, int(argument) if command.argument == NUMBER else argument)
        if not argument and command.alone:
            return command.alone(unit, axis)
    raise RefusalError(ILLEGAL)


# Bytes

SPACE, CR, LF = 0x20, 0x0D, 0x0A
NEWLINE = "\r\n"
# Longest command, and size of the input buffer while the unit is busy [bytes].
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
        self.profile: UnitProfile = unit
        self.echo: bool = True
        self.verbose: bool = True
        self.axes = UnitAxis("Pan", pan, unit, unit.pan), UnitAxis("Tilt", tilt, unit, unit.tilt)
        self._now = now
        self._input: deque[int] = deque()
        self._command = bytearray()
        self._task: Task | None = None  # the command that takes time
        self._output: deque[tuple[float, bytes]] = deque()  # (time to send [s], bytes)
        self._noise = random.Random(0)

    # What commands do

    def say(self, sentence: str, axis: UnitAxis, value: object) -> str:
        """Make the answer to a query, a sentence or the value alone."""
        return sentence.format(axis=axis.name, n=value) if self.verbose else str(value)

    def move(self, axis: UnitAxis, goal: int) -> str:
        """Go to a position.

        Raises:
            RefusalError: the position is beyond a limit.
        """
        lowest, highest = axis.limits
        if goal > highest:
            raise RefusalError(f"Maximum allowable {axis.name} position is {highest}")
        if goal < lowest:
            raise RefusalError(f"Minimum allowable {axis.name} position is {lowest}")
        axis.go(goal)
        return ""

    def set_speed(self, axis: UnitAxis, speed: int) -> str:
        """Set a speed, even during a move.

        Raises:
            RefusalError: the speed is out of bounds.
        """
        if speed > self.profile.highest_speed:
            raise RefusalError(f"{axis.name} speed cannot exceed {self.profile.highest_speed} positions/sec")
        if speed < self.profile.lowest_speed:
            raise RefusalError(f"Motor speed cannot be less than {self.profile.lowest_speed} pos/sec")
        axis.set_speed(speed)
        return ""

    def halt(self) -> str:
        """Brake both axes; the sources do not say whether the answer waits until they stand, and here it does not."""
        for axis in self.axes:
            axis.halt()
        return ""

    def wait_until_still(self) -> Task:
        """Wait until the axes stand."""
        while any(axis.plant.moving() for axis in self.axes):
            yield ""
        return ""

    def reset(self) -> Task:
        """Find the limits of both axes, tilt first, as real units' replies show."""
        for axis in reversed(self.axes):
            yield from axis.reset()
        return ""

    # Bytes

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

    def _restart(self) -> Task:
        """Interrupt the power: settings and position are lost; a banner comes, and then a star."""
        self._input.clear()
        self._command.clear()
        self._output.clear()
        self.echo = self.verbose = True
        for axis in self.axes:
            axis.lose_power()
        ready = self._now() + self.profile.boot_s
        yield f"{NEWLINE}{self.profile.title}{NEWLINE}"
        while self._now() < ready:
            yield ""
        return ""

    def _advance(self) -> None:
        """Do what is due by now: faults, the task, and characters that waited for it."""
        if self.faults.take("power-cycle"):
            self._task = self._restart()
            self._run_task()
        for axis in self.axes:
            if "limit-hit" in self.faults and (speed := axis.plant.speed()):
                self.faults.set("limit-hit", False)
                axis.lose_steps(1 if speed > 0 else -1)
                self._send(f"!{axis.letter}")
        self._run_task()
        self._process_input()

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
        if self.echo:
            self._send(chr(character))
        if character not in (SPACE, CR, LF):
            if len(self._command) < LONGEST_COMMAND:
                self._command.append(character)
            return
        text = self._command.decode("latin-1").upper()
        self._command.clear()
        if text:
            self._carry_out(text)

    def _carry_out(self, text: str) -> None:
        """Carry out one command; reply now or by a task."""
        try:
            if "error-replies" in self.faults and not text.startswith("H"):
                raise RefusalError(ILLEGAL)
            answer = execute(self, text)
        except RefusalError as refusal:
            self._reply("!", str(refusal))
            return
        if not isinstance(answer, str):
            self._task = answer
            self._run_task()
        else:
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
