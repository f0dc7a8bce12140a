"""The PTU-D46's serial protocol: commands, answers and the line.

The first part turns commands into bytes and answers into values, without I/O or time. `Line` exchanges one command at a
time, with deadlines, and synchronises again after an error. An error of pyserial or of the operating system becomes a
one-line DeviceError that names the port.

Answers are read leniently, because firmware versions differ in wording, but a line that may be garbled is refused.

Sources: Directed Perception's PTU-D46 manual 2.14.0 (2006) and Command Reference Manual 3.00D (2008).
"""

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, TypeVar

from cotarget.drivers.link_errors import PositionLostError, RefusedError, ReplyError, SilentError
from cotarget.drivers.serial_line import SerialLine, open_port
from cotarget.errors import DeviceError
from cotarget.rig import Clock

if TYPE_CHECKING:
    import serial

log = logging.getLogger(__name__)


# Ends a command. A carriage return would too, but makes some units send a line feed before the answer.
DELIMITER = b" "
HALT = b"H "
ARCSECONDS = 3600.0  # in a degree
# A longer line comes from another device; the longest answer is far shorter [bytes].
LONGEST_LINE = 4096
SHOWN = 40  # longest quotation of an invalid line in an error [characters]
# Events may come at any time, even inside of another answer: a pan or tilt limit was hit, the cable was pulled.
# Errors also begin with an exclamation mark, followed by a space or, as a precaution, a small letter.
EVENT = re.compile(rb"!([PTD])(?![a-z])")
EVENT_INSIDE = re.compile(rb"!([PTD])")
PLAIN = re.compile(rb"[\x20-\x7e\t]*")
# Numbers stand alone: digits next to other characters were garbled. No number has more than nine digits.
INTEGER = re.compile(r"(?<!\S)[-+]?[0-9]{1,9}(?=[.,;]?(?:\s|$))")
DECIMAL = re.compile(r"(?<!\S)[0-9]{1,9}(?:\.[0-9]{1,9})?(?=[.,;]?(?:\s|$))")
# Words that name a mode; firmware versions differ in the text around them.
ECHO_ON, ECHO_OFF = (re.compile(rf"echo.*\b{word}\b", re.IGNORECASE) for word in ("on", "off"))
TERSE, VERBOSE = re.compile("terse", re.IGNORECASE), re.compile("verbose", re.IGNORECASE)
INDEPENDENT, VELOCITY = re.compile("indep", re.IGNORECASE), re.compile("veloc", re.IGNORECASE)
# The banner of a unit that is switched on, before it calibrates itself. The answer to V, a star before the same
# words, is no banner.
BANNER = re.compile(rb"^(?!\s*\*\s).*pan[- ]?tilt", re.IGNORECASE | re.MULTILINE)
AxisName = Literal["P", "T"]
AXES: tuple[AxisName, AxisName] = ("P", "T")
AXIS_WORDS = {"P": "pan", "T": "tilt"}
EVENT_WORDS = {"P": "pan hit its limit (!P)", "T": "tilt hit its limit (!T)", "D": "its cable came off (!D)"}


@dataclass(frozen=True)
class Reply:
    """One line from the unit, parsed."""

    text: str  # after the ``*`` or ``!``
    refused: bool = False  # whether the line is an error
    echo: str = ""  # before the mark: the command, where the unit echoes


def command(name: str, value: int | None = None) -> bytes:
    """Encode a command, such as ``PP-120``; without a value it is a query or an order."""
    return f"{name}{'' if value is None else value}".encode("ascii") + DELIMITER


def shown(data: bytes) -> str:
    """Quote bytes in at most `SHOWN` characters, for an error message of one line."""
    text = ascii(data.strip())[2:-1]
    return f"'{text}'" if len(text) <= SHOWN else f"'{text[:SHOWN]}...'"


def split_events(data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Separate events from other bytes; return those bytes, and "P", "T" or "D" for each event in order."""
    start = EVENT.sub(b"", data).lstrip()
    # An answer that is no error contains no other exclamation marks: in it even "!Pos" is the event "!P" before "os".
    pattern = EVENT if start.startswith(b"!") or b"*" not in start else EVENT_INSIDE
    return pattern.sub(b"", data), tuple(found.decode("ascii") for found in pattern.findall(data))


def parse(line: bytes) -> Reply | None:
    """Parse one line without events; None if it is empty.

    Raises:
        ReplyError: the line is no answer of a PTU-D46.
    """
    line = line.strip(b"\r\n\t \0")
    if not line:
        return None
    marks = [at for at in (line.find(b"*"), line.find(b"!")) if at >= 0]
    if not marks or not PLAIN.fullmatch(line):
        raise ReplyError(f"{shown(line)} is no answer of a PTU-D46")
    at = min(marks)
    return Reply(
        text=line[at + 1 :].strip().decode("ascii"),
        refused=line[at : at + 1] == b"!",
        echo=line[:at].strip().decode("ascii"),
    )


# What answers say; each of these raises ReplyError where the text says nothing of the kind.


def integer(text: str) -> int:
    """Parse the first integer after " is ", or of a terse answer; the last may be the 2 of "positions/sec^2"."""
    return int(_number(INTEGER, text))


def bare_integer(text: str) -> int:
    """Parse a terse answer that consists of one integer."""
    found = INTEGER.fullmatch(text)
    if found is None:
        raise ReplyError(f"{shown(text.encode())} is not a number alone")
    return int(found[0])


def arcseconds(text: str) -> float:
    """Parse the resolution in an answer to ``PR`` or ``TR`` [seconds of arc], which is above zero."""
    value = float(_number(DECIMAL, text))
    if value == 0.0:
        raise ReplyError(f"{shown(text.encode())} is no resolution")
    return value


def done(text: str) -> None:
    """Check that an answer to an order is the star alone; more text answers another command."""
    if text:
        raise ReplyError(f"{shown(text.encode())} answers something else")


def _number(pattern: re.Pattern[str], text: str) -> str:
    _, said, tail = text.partition(" is ")
    found = pattern.search(tail if said else text)
    if found is None:
        raise ReplyError(f"{shown(text.encode())} has no number")
    return found[0]


def _either(text: str, one: re.Pattern[str], other: re.Pattern[str]) -> bool:
    """Return whether an answer matches the first pattern and not the second; it must match one of them."""
    yes, no = one.search(text) is not None, other.search(text) is not None
    if yes == no:
        raise ReplyError(f"{shown(text.encode())} names neither mode")
    return yes


# Parse the answers to E, F and C: whether the unit echoes, is terse, takes positions rather than velocities alone.
echoing = partial(_either, one=ECHO_ON, other=ECHO_OFF)
terse = partial(_either, one=TERSE, other=VERBOSE)
independent = partial(_either, one=INDEPENDENT, other=VELOCITY)


# The line

Meaning = TypeVar("Meaning")
# Time limits, beyond the time that the bytes take on the wire [s]:
PATIENCE_S = 1.0  # for an answer while a unit is opened
QUICK_S = 0.08  # for an answer during operation: a silent unit must be noticed while it can still be halted
LAST_S = 0.8  # for the answer that confirms that a silent unit is synchronised again
TRIES = 3  # of a command; the line is synchronised again before each but the first
LAST_TRIES = 10  # queries to a silent unit before it counts as dead
HURRY_S = 0.05  # for the answer in flight when the head is to be halted
QUIET_S = 0.03  # of silence, after which an old answer counts as complete
DRAIN_S = 0.15  # for draining, where a device never stops sending
WORDY_ANSWER = 100  # longest answer with words and echo [bytes]
TERSE_ANSWER = 40  # longest answer but the version's, with echo and words off [bytes]
MOST_LINES = 64  # skipped in search of one answer


class Line(SerialLine):
    """Exchange of one command at a time with a unit."""

    def __init__(self, port: "serial.Serial", name: str, baud: int, clock: Clock) -> None:
        super().__init__(port, name, baud, clock)
        self._buffer = b""
        self._strange = b""  # the last line that was no answer
        self._refusal = ""  # the last one during `resync`
        self.events: list[str] = []  # "P", "T" and "D" as the unit sent them; the user of the line removes them
        self.strict = False  # set once the unit's echo is off; from then on text before an answer is an error
        # Returns whether the head is to be halted now, so that an answer in flight gets `HURRY_S` at most.
        self.hurry: Callable[[], bool] = lambda: False

    def ask(self, order: bytes, patience: float = QUICK_S, skipping: bool = False) -> tuple[str, float]:
        """Send one command and wait for its answer.

        Args:
            order: the command with its delimiter.
            patience: how long the unit may take beyond the time on the wire [s].
            skipping: whether to skip lines that are no answers.

        Returns:
            The answer's text, and the time [s] at which the unit answered or read the queried value.

        Raises:
            SilentError: no complete answer came in time.
            ReplyError: what came is no answer.
            RefusedError: the unit refused the command.
            LostError: the port failed.
        """
        self._expect_nothing()
        sent = self._clock.now()
        self.write(order)
        reply, first = self._reply(self._deadline(order, patience), skipping)
        if reply.refused:
            what = order.decode("ascii").strip()
            raise RefusedError(f"the pan-tilt unit at {self.name} refused {what}: {reply.text}")
        # The unit reads the value between the command's last byte and the answer's first. These are in the wrong
        # order where the line is faster than its baud rate.
        start, end = sent + len(order) * self.byte_s, first - self.byte_s
        return reply.text, (start + end) / 2 if start <= end else (sent + first) / 2

    def query(
        self,
        order: bytes,
        understand: Callable[[str], Meaning],
        patience: float = QUICK_S,
        even_if_refused: bool = False,
        resynchronized: Callable[[DeviceError, bool], None] = lambda error, halted: None,
    ) -> tuple[Meaning, float]:
        """Send a command that is safe to repeat, `TRIES` times at most; return its answer's meaning and time [s].

        For queries, and for orders that do no harm twice; a relative move would.

        Args:
            order: the command with its delimiter.
            understand: parses the answer's text, and raises ReplyError where that is no answer.
            patience: as in `ask` [s].
            even_if_refused: whether to repeat a refused command, which may have been garbled on its way.
            resynchronized: called after each `resync` with its reason and result; may raise.

        Raises:
            DeviceError: as `ask` and `resync`, after the last attempt.
        """
        for left in reversed(range(TRIES)):
            try:
                text, t = self.ask(order, patience)
                return understand(text), t
            except RefusedError:
                if not (even_if_refused and left):
                    raise
            except (SilentError, ReplyError) as error:
                resynchronized(error, self.resync(error))
                if not left:
                    raise self._final_error(error) from error
        raise AssertionError("unreachable")

    def resync(self, reason: DeviceError) -> bool:
        """Synchronise with the unit again: wait for silence, then send queries whose answers are no numbers.

        No answer to them can be taken for a position. Answers come in order, so no late answer can follow the answer to
        a later query. Each query differs from the ones before, so that a late answer to those is not taken for its own.

        Returns:
            Whether a halt was sent, because the unit was silent.

        Raises:
            SilentError: the unit does not answer any more; a halt was sent.
            RefusedError: it answers, but refuses every query; a halt was sent.
            PositionLostError: the unit was switched off and on.
            LostError: the port failed.
        """
        log.info("%s: synchronizing after: %s", self.name, reason)
        self._refusal = ""
        noise, self._strange = self._strange + self._buffer, b""
        self.write(DELIMITER + HALT if self.hurry() else DELIMITER)
        noise += self.drain(QUIET_S, DRAIN_S)
        if BANNER.search(noise):
            raise self._restarted()
        if self._answers(command("E"), lambda text: not echoing(text), QUICK_S):
            return False
        self.write(DELIMITER + HALT)
        if BANNER.search(self.drain(QUIET_S, DRAIN_S)):
            raise self._restarted()
        back = any(self._answers(command("F"), terse, QUICK_S) for _ in range(LAST_TRIES))
        if not (back and self._answers(command("E"), lambda text: not echoing(text), LAST_S)):
            self.write(DELIMITER + HALT)
            if self._refusal:
                raise RefusedError(
                    f"the pan-tilt unit at {self.name} refused every query: {self._refusal}; a halt was sent"
                )
            raise SilentError(f"the pan-tilt unit at {self.name} does not answer any more; a halt was sent")
        log.warning("%s: the pan-tilt unit did not answer for a while and was halted", self.name)
        return True

    def drain(self, quiet_s: float, most_s: float) -> bytes:
        """Read until ``quiet_s`` of silence or for ``most_s`` [s]; return the bytes without events."""
        data, self._buffer = self._buffer, b""
        return self._without_events(data + self.read_until_quiet(quiet_s, most_s))

    def _restarted(self) -> PositionLostError:
        return PositionLostError(self.name, "was switched off and on, so that its position may be lost")

    def _final_error(self, error: DeviceError) -> DeviceError:
        """Make the error for a unit whose answers stayed invalid or absent."""
        if isinstance(error, SilentError):
            return error
        return DeviceError(f"the pan-tilt unit at {self.name} answers, but not what it was asked: {error}")

    def _deadline(self, order: bytes, patience: float) -> float:
        answer = TERSE_ANSWER if self.strict else WORDY_ANSWER
        return self._clock.now() + patience + (len(order) + answer) * self.byte_s

    def _expect_nothing(self) -> None:
        """Check bytes that came without a query: events are kept, any other text is an error."""
        self._buffer += self.read(wait=False)
        if self._buffer:
            rest = self._without_events(self._buffer).strip()
            self._buffer = b""
            if rest == b"!":  # the first half of an event
                self._buffer = rest
            elif rest and self.strict:
                self._strange = rest
                raise ReplyError(f"{shown(rest)} came without a command")

    def _reply(self, deadline: float, skipping: bool) -> tuple[Reply, float]:
        """Read the next line that is an answer; return it and the time of its first byte [s]."""
        for _ in range(MOST_LINES):
            line, first = self._next_line(deadline)
            line = self._without_events(line)
            try:
                reply = parse(line)
                if reply is not None and reply.echo and self.strict:
                    raise ReplyError(f"{shown(line)} is echoed, though that was switched off")
            except ReplyError:
                if skipping:
                    continue
                self._strange = line
                raise
            if reply is not None:
                return reply, first
        raise ReplyError(f"{self.name} sends lines without end, but no answer of a PTU-D46")

    def _next_line(self, deadline: float) -> tuple[bytes, float]:
        """Read one line; return it and the time of its first byte [s]."""
        first = self._clock.now()
        begun = bool(self._buffer)
        while b"\n" not in self._buffer:
            now = self._clock.now()
            late = now > deadline  # a thread that slept too long still reads what has arrived
            data = self.read(wait=not late)
            if data and not begun:
                first, begun = self._clock.now(), True
            self._buffer += data
            if len(self._buffer) > LONGEST_LINE:
                self._strange, self._buffer = self._buffer, b""
                raise ReplyError(f"{shown(self._strange)} goes on without end and is no answer of a PTU-D46")
            if late and b"\n" not in self._buffer:
                raise SilentError(f"the pan-tilt unit at {self.name} did not answer in time")
            if not data and self.hurry():
                deadline = min(deadline, now + HURRY_S)
        line, self._buffer = self._buffer.split(b"\n", 1)
        return line, first

    def _answers(self, question: bytes, right: Callable[[str], bool], patience: float) -> bool:
        """Send a query and return whether the right answer comes in time; other lines may come first."""
        self.write(question)
        deadline = self._deadline(question, patience)
        for _ in range(MOST_LINES):
            try:
                line, _ = self._next_line(deadline)
                line = self._without_events(line)
                if BANNER.search(line):
                    raise self._restarted()
                reply = parse(line)
                well = reply is not None and not reply.refused and right(reply.text)
            except SilentError:
                return False
            except ReplyError:
                continue
            if well:
                return True
            if reply is not None and reply.refused:
                self._refusal = reply.text
            elif reply is not None:
                raise self._restarted()
        return False

    def _without_events(self, data: bytes) -> bytes:
        rest, events = split_events(data)
        self.events += events
        return rest


def open_line(name: str, baud: int, clock: Clock) -> Line:
    """Open the line at a port by pyserial's name or URL of it.

    Raises:
        ConfigError: the name is empty.
        DeviceError: the port cannot be opened.
    """
    return Line(open_port(name, baud), name, baud, clock)
