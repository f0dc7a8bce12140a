"""Firmware of the emulated PTU-D46: a state machine from bytes to bytes, on a given clock.

It implements the ASCII command language of the Command Reference Manual v3.00D and of the PTU-D46 manual v2.14.0, and
the deviations of units in the field (`cotarget.emulators.ptu_d46.unit`), without the binary language. Choices where no
source says what happens: docs/design-notes.md.

`make_twins` makes two firmwares in front of the same axes, because a unit has two lines and a line serves one firmware.
A fault holds for both. A fault that happens once (`ONCE`) happens to the firmware that received bytes last, so that its
client sees the banner or the event.
"""

import random
from collections import deque
from collections.abc import Callable

from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import AxisPlant
from cotarget.emulators.ptu_d46.commands import execute
from cotarget.emulators.ptu_d46.unit import RefusalError, Task, Unit, UnitProfile

SPACE, CR, LF, AT = 0x20, 0x0D, 0x0A, 0x40
NEWLINE = "\r\n"
# Longest command, and size of the input buffer while the unit is busy [bytes]. Unselected units were seen to keep
# about 100 bytes.
LONGEST_COMMAND = 100
INPUT_BUFFER = 256
# Delay of replies with the fault late-replies [s]: longer than drivers wait for ordinary commands.
LATE_S = 1.5
# silence: the unit obeys but sends nothing. garbage: it sends noise. half-replies: replies end halfway. late-replies:
# replies are LATE_S late. unplugged: no input, no output. power-cycle (once): it loses settings and position, prints
# its banner, and is uncalibrated until R. limit-hit (once, as soon as an axis turns): the axis stops with !P or !T and
# has lost steps. error-replies: every command but a halt is refused.
D46_FAULTS = (
    "silence",
    "garbage",
    "half-replies",
    "late-replies",
    "unplugged",
    "power-cycle",
    "limit-hit",
    "error-replies",
)


class D46:
    """A PTU-D46 some time after power-up: calibrated, echoing, verbose, standing.

    For one thread at a time: the line that serves it (`cotarget.emulators.serve`).

    Args:
        pan: mechanics of pan, in half steps of the unit.
        tilt: mechanics of tilt, in half steps of the unit.
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
        self._previous = 0  # the last character
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

    def set_baud(self, baud: int) -> None:
        """Set the baud rate of the serial line, for power-up too."""
        self._unit.baud = self._unit.baud_at_power_up = baud

    def receive(self, data: bytes) -> None:
        """Process bytes that arrive on the line now."""
        self._advance()
        if "unplugged" in self.faults:
            return
        for character in data:
            if len(self._input) < INPUT_BUFFER:
                self._input.append(character)
            self._work()

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
        if self._unit.settings.scan_at_power_up and self._unit.pan.calibrated:
            self._unit.start_scan({"P": self._unit.pan.factory_limits})
        return ""

    def _advance(self) -> None:
        """Do what is due by now: faults, stops hit, tasks, and characters that waited for a task."""
        if self.faults.take("power-cycle"):
            self.power_on(calibrate=False)
        for axis in self._unit.axes:
            if axis.stopped_at_stop():
                self._send(f"!{axis.letter}")
        if "limit-hit" in self.faults:
            self._hit()
        for sweep in self._unit.scan:
            next(sweep)
        self._run_task()
        self._work()

    def _hit(self) -> None:
        """Let the axes that turn hit an obstacle."""
        for axis in self._unit.axes:
            if axis.speed != 0 and self.faults.take("limit-hit"):
                axis.lose_steps(1 if axis.speed > 0 else -1)
                self._unit.scan = []
                self._send(f"!{axis.letter}")

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

    def _work(self) -> None:
        """Process the characters in the buffer, unless the unit is busy."""
        while self._input and self._task is None:
            self._character(self._input.popleft())

    def _character(self, character: int) -> None:
        """Process one character: echo it, and at a delimiter carry out the command before it."""
        unit, previous = self._unit, self._previous
        self._previous = character
        if unit.routed and character != AT:
            return
        rest_of_crlf = character == LF and previous == CR
        if unit.scan and not rest_of_crlf:
            unit.end_scan()
            return
        unit.routed = False
        if unit.settings.echo and unit.selected:
            self._send(bytes([character]).decode("latin-1"))
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
                raise RefusalError(self._unit.profile.wording.illegal)
            answer = execute(self._unit, text)
        except RefusalError as refusal:
            self._reply("!", str(refusal))
            return
        if isinstance(answer, str):
            if self._unit.selected:
                self._reply("*", answer)
        else:
            self._task = answer
            self._run_task()

    def _reply(self, mark: str, text: str) -> None:
        """Send the reply that ends a command."""
        line = f"{mark} {text}" if text else mark
        line += NEWLINE
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


# Two firmwares in front of the same axes

ONCE = ("power-cycle", "limit-hit")


def make_twins(
    pan: AxisPlant, tilt: AxisPlant, unit: UnitProfile, faults: Faults, now: Callable[[], float]
) -> tuple[D46, D46]:
    """Make two firmwares for the two lines of one unit; the arguments are those of `D46`."""
    last = _Last()
    first, second = (_Twin(pan, tilt, unit, _TwinFaults(faults, number, last), now) for number in range(2))
    return first, second


class _Last:
    """Number of the firmware that received bytes last; None before the first bytes."""

    number: int | None = None


class _TwinFaults(Faults):
    """The unit's faults as one of the two firmwares has them."""

    def __init__(self, both: Faults, number: int, last: _Last) -> None:
        super().__init__(both.known)
        self._both, self._number, self._last = both, number, last

    def spoken_to(self) -> None:
        self._last.number = self._number

    def set(self, name: str, on: bool = True) -> None:
        self._both.set(name, on)

    def __contains__(self, name: str) -> bool:
        return name in self._both and self._concerns(name)

    def take(self, name: str) -> bool:
        return self._concerns(name) and self._both.take(name)

    def wait_while(self, name: str, timeout: float) -> bool:
        return self._both.wait_while(name, timeout)

    def _concerns(self, name: str) -> bool:
        return name not in ONCE or self._last.number == self._number


class _Twin(D46):
    """One of the two firmwares; records that it received bytes."""

    def __init__(
        self, pan: AxisPlant, tilt: AxisPlant, unit: UnitProfile, faults: _TwinFaults, now: Callable[[], float]
    ) -> None:
        super().__init__(pan, tilt, unit, faults, now)
        self._spoken_to = faults.spoken_to

    def receive(self, data: bytes) -> None:
        self._spoken_to()
        super().receive(data)
