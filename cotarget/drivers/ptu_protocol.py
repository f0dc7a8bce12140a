"""The PTU-D46's ASCII protocol: commands as bytes, and what the unit's answers mean. No I/O and no time.

Sources: Directed Perception's PTU-D46 manual 2.14.0 (2006) and Command Reference Manual 3.00D (2008). Answers are read
leniently, because firmware versions differ in wording, but a line that may have been garbled is refused.

The serial line to a PTU-D46: one command in flight, deadlines, and a way back in step when something went wrong.

What pyserial and the operating system raise becomes a one-line DeviceError that names the port.

What goes wrong with a line to a PTU-D46, but for answers that are no good.
"""

import contextlib
import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

from cotarget.drivers.serial_line import Port, open_port
from cotarget.errors import DeviceError
from cotarget.rig import Clock

NO_DATA = "returned no data"  # pyserial, of a port that has gone


class SilentError(DeviceError):
    """No answer came in time."""


class LostError(DeviceError):
    """The port itself failed: unplugged, or closed by the other side."""

    def __init__(self, name: str, error: OSError) -> None:
        why = "unplugged, or another program reads there too" if NO_DATA in str(error) else error
        super().__init__(f"the line to the pan-tilt unit at {name} is lost ({why}); plug it in and open it again")


class RestartedError(DeviceError):
    """The unit was switched off and on, and has forgotten where it is."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"the pan-tilt unit at {name} was switched off and on, so that its position may be lost; open it again"
        )


# After a command. A carriage return would do too, but makes some units put a line feed before the answer.
DELIMITER = b" "
HALT = b"H "
ARCSECONDS = 3600.0  # a degree
# Longer lines than the longest answer by far are another device's [bytes].
LONGEST_LINE = 4096
SHOWN = 40  # so much of a strange line is quoted in an error [characters]
# Told at any time, even inside of another answer: a pan or tilt limit was hit, the cable was pulled.
# Errors too begin with an exclamation mark, but go on with a space or, to be safe, with a small letter.
EVENT = re.compile(rb"!([PTD])(?![a-z])")
EVENT_INSIDE = re.compile(rb"!([PTD])")
PLAIN = re.compile(rb"[\x20-\x7e\t]*")
# Numbers stand by themselves: digits that something is glued to were garbled. Nine digits are enough for any.
INTEGER = re.compile(r"(?<!\S)[-+]?[0-9]{1,9}(?=[.,;]?(?:\s|$))")
DECIMAL = re.compile(r"(?<!\S)[0-9]{1,9}(?:\.[0-9]{1,9})?(?=[.,;]?(?:\s|$))")
# Words that tell modes, whatever stands around them.
ECHO_ON, ECHO_OFF = (re.compile(rf"echo.*\b{word}\b", re.IGNORECASE) for word in ("on", "off"))
TERSE, VERBOSE = re.compile("terse", re.IGNORECASE), re.compile("verbose", re.IGNORECASE)
INDEPENDENT, VELOCITY = re.compile("indep", re.IGNORECASE), re.compile("veloc", re.IGNORECASE)
# What a unit says when it is switched on, before it calibrates itself; its answer to V has a star and a space before.
BANNER = re.compile(rb"^(?!\s*\*\s).*pan[- ]?tilt", re.IGNORECASE | re.MULTILINE)
AxisName = Literal["P", "T"]
AXES: tuple[AxisName, AxisName] = ("P", "T")
AXIS_WORDS = {"P": "pan", "T": "tilt"}
EVENT_WORDS = {"P": "pan hit its limit (!P)", "T": "tilt hit its limit (!T)", "D": "its cable came off (!D)"}


class ReplyError(DeviceError):
    """What came back is no answer of a PTU-D46 to what was asked."""


class RefusedError(DeviceError):
    """The unit understood a command and refused it."""


@dataclass(frozen=True)
class Reply:
    """One line of the unit's.

    Attributes:
        text: what it says after the ``*`` or ``!``.
        refused: whether it is an error.
        echo: what stands before, the command itself where the unit echoes.
    """

    text: str
    refused: bool = False
    echo: str = ""


def command(name: str, value: int | None = None) -> bytes:
    """The bytes of a command, such as ``PP-120``; without a value it is a query or an order."""
    return f"{name}{'' if value is None else value}".encode("ascii") + DELIMITER


def shown(data: bytes) -> str:
    """Bytes as a short quotation for an error message of one line."""
    text = ascii(data.strip())[2:-1]
    return f"'{text}'" if len(text) <= SHOWN else f"'{text[:SHOWN]}...'"


def split_events(data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Take what the unit told in between out of its bytes: the rest, and "P", "T" or "D" of each in order."""
    start = EVENT.sub(b"", data).lstrip()
    # An answer that is no error has no other exclamation marks: there even "!Pos" is an event in front of "os".
    pattern = EVENT if start.startswith(b"!") or b"*" not in start else EVENT_INSIDE
    return pattern.sub(b"", data), tuple(found.decode("ascii") for found in pattern.findall(data))


def parse(line: bytes) -> Reply | None:
    """Read one line whose events are taken out; None if nothing is left of it.

    Raises:
        ReplyError: it is no answer.
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


def integer(text: str) -> int:
    """The number that an answer tells: the first integer after " is ", or the first of a terse answer.

    Never the last one of the line, which may be the 2 of "positions/sec^2".

    Raises:
        ReplyError: there is none.
    """
    return int(_number(INTEGER, text))


def bare_integer(text: str) -> int:
    """The number that a terse answer consists of.

    Raises:
        ReplyError: it consists of something else.
    """
    found = INTEGER.fullmatch(text)
    if found is None:
        raise ReplyError(f"{shown(text.encode())} is not a number alone")
    return int(found[0])


def arcseconds(text: str) -> float:
    """The resolution that an answer to ``PR`` or ``TR`` tells [seconds of arc].

    Raises:
        ReplyError: there is none, or it is zero.
    """
    value = float(_number(DECIMAL, text))
    if value == 0.0:
        raise ReplyError(f"{shown(text.encode())} is no resolution")
    return value


def done(text: str) -> None:
    """The answer to an order: nothing but the star. Anything more answers something else.

    Raises:
        ReplyError: it says more.
    """
    if text:
        raise ReplyError(f"{shown(text.encode())} answers something else")


def echoing(text: str) -> bool:
    """Whether the answer to ``E`` says that the unit echoes.

    Raises:
        ReplyError: it says neither.
    """
    return _either(text, ECHO_ON, ECHO_OFF)


def terse(text: str) -> bool:
    """Whether the answer to ``F`` says that the unit is terse.

    Raises:
        ReplyError: it says neither.
    """
    return _either(text, TERSE, VERBOSE)


def independent(text: str) -> bool:
    """Whether the answer to ``C`` says that positions can be commanded, rather than velocities alone.

    Raises:
        ReplyError: it says neither.
    """
    return _either(text, INDEPENDENT, VELOCITY)


def _number(pattern: re.Pattern[str], text: str) -> str:
    _, said, tail = text.partition(" is ")
    found = pattern.search(tail if said else text)
    if found is None:
        raise ReplyError(f"{shown(text.encode())} tells no number")
    return found[0]


def _either(text: str, one: re.Pattern[str], other: re.Pattern[str]) -> bool:
    """Whether an answer says the one and not the other."""
    yes, no = one.search(text) is not None, other.search(text) is not None
    if yes == no:
        raise ReplyError(f"{shown(text.encode())} does not tell the mode that was asked for")
    return yes


# --- line ---

log = logging.getLogger(__name__)
Meaning = TypeVar("Meaning")
# Beyond the time that the bytes take on the wire [s]:
PATIENCE_S = 1.0  # for an answer while a unit is opened
QUICK_S = 0.08  # for an answer in the middle of work, so that a silent unit is noticed while it can still be halted
LAST_S = 0.8  # for the answer that tells that a unit which was silent is in step again
LAST_TRIES = 10  # to hear from a unit that is silent, before it counts as dead
HURRY_S = 0.05  # for the answer in flight when somebody wants the head halted
QUIET_S = 0.03  # of silence, after which no more of an old answer is expected
DRAIN_S = 0.15  # but something that never stops talking is not listened to for longer
BITS = 10  # of a byte on the wire, 8N1
WORDY_ANSWER = 100  # the longest of a healthy unit, with its echo [bytes]
TERSE_ANSWER = 40  # the longest but for its version, once echo and words are off [bytes]
MOST_LINES = 64  # that are skipped in search of one answer
HEARD = 200  # so much of what was last heard is kept for error messages [bytes]


@dataclass(frozen=True)
class Answer:
    """What the unit says, and when it said it, or looked at what it tells [s]."""

    text: str
    t: float


class Line:
    """Strict lockstep with a unit; of one thread at a time.

    Args:
        port: an open port whose reads return empty after a short while.
        name: the port's, for error messages.
        baud: of the serial line, also where it ends at a terminal server.
        clock: the rig's.

    Attributes:
        events: "P", "T" and "D" as the unit told them, until somebody takes them out.
        strict: set when the unit's echo is off: from then on nothing may stand before an answer.
        hurry: whether the head is to be halted now, so that what is in flight is not waited for long.
    """

    def __init__(self, port: Port, name: str, baud: int, clock: Clock) -> None:
        self._port, self._clock = port, clock
        self.name, self.baud = name, baud
        self._byte_s = BITS / baud
        self._buffer = b""
        self._strange = b""  # the line that was no answer
        self._heard = b""
        self.events: list[str] = []
        self.strict = False
        self.hurry: Callable[[], bool] = lambda: False

    @property
    def heard(self) -> bytes:
        """The last that came over the line, whatever it was."""
        return self._heard

    def ask(self, order: bytes, patience: float = QUICK_S, skipping: bool = False) -> Answer:
        """Send one command and wait for its answer.

        Args:
            order: the command with its delimiter.
            patience: how long the unit may take beyond the wire's time [s].
            skipping: whether lines that are no answers may come first.

        Raises:
            SilentError: no complete answer came in time.
            ReplyError: what came is no answer.
            RefusedError: the unit refused.
            LostError: the port failed.
        """
        self._expect_nothing()
        sent = self._clock.now()
        self.write(order)
        reply, first = self._reply(self._deadline(order, patience), skipping)
        if reply.refused:
            what = order.decode("ascii").strip()
            raise RefusedError(f"the pan-tilt unit at {self.name} refused {what}: {reply.text}")
        # The unit looks between the command's last byte and the answer's first, unless the line is faster than it says.
        start, end = sent + len(order) * self._byte_s, first - self._byte_s
        return Answer(reply.text, (start + end) / 2 if start <= end else (sent + first) / 2)

    def query(
        self, order: bytes, understand: Callable[[str], Meaning], patience: float = QUICK_S, tries: int = 3
    ) -> tuple[Meaning, float]:
        """Ask what can be asked again: what the answer means, and when that was [s].

        Only for queries and orders that do no harm twice; a move relative to where the head is would.
        """
        for attempt in range(tries):
            try:
                answer = self.ask(order, patience)
                return understand(answer.text), answer.t
            except (SilentError, ReplyError) as error:
                self.resync(error)
                if attempt == tries - 1:
                    raise self.nonsense(error) from error
        raise AssertionError("unreachable")

    def resync(self, reason: DeviceError) -> bool:
        """Get back in step: silence, then questions whose answers cannot be taken for a position.

        Answers come in order, so nothing that was late can still follow the answer to a later question. That question
        is each time another than those before, so that their late answers are not taken for its own.

        Returns:
            Whether the line was silent for so long that the head was told to halt.

        Raises:
            SilentError: the unit does not answer any more; it was told to halt.
            RestartedError: it was switched off and on.
            LostError: the port failed.
        """
        log.info("%s: back in step after: %s", self.name, reason)
        noise, self._strange = self._strange + self._buffer, b""
        self.write(DELIMITER + HALT if self.hurry() else DELIMITER)
        noise += self.drain(QUIET_S, DRAIN_S)
        if BANNER.search(noise):
            raise RestartedError(self.name)
        if self._answers(command("E"), lambda text: not echoing(text), QUICK_S):
            return False
        self.write(DELIMITER + HALT)
        if BANNER.search(self.drain(QUIET_S, DRAIN_S)):
            raise RestartedError(self.name)
        back = any(self._answers(command("F"), terse, QUICK_S) for _ in range(LAST_TRIES))
        if not (back and self._answers(command("E"), lambda text: not echoing(text), LAST_S)):
            self.write(DELIMITER + HALT)
            raise SilentError(f"the pan-tilt unit at {self.name} does not answer any more; it was told to halt")
        log.warning("%s: the pan-tilt unit did not answer for a while and was halted", self.name)
        return True

    def drain(self, quiet_s: float, most_s: float) -> bytes:
        """Read until nothing came for a while, or for long enough [s]; what came, without events."""
        start = last = self._clock.now()
        data, self._buffer = self._buffer, b""
        while (now := self._clock.now()) - last < quiet_s and now - start < most_s:
            if more := self._read():
                data, last = data + more, self._clock.now()
        return self._without_events(data)

    def write(self, data: bytes) -> None:
        """Send bytes and expect nothing.

        Raises:
            LostError: the port failed.
        """
        try:
            self._port.write(data)
        except OSError as error:  # pyserial's exceptions are of this kind too
            raise LostError(self.name, error) from error

    def close(self) -> None:
        """Release the port."""
        # pyserial leaves a socket open if the other side closed first
        socket = getattr(self._port, "_socket", None)
        with contextlib.suppress(OSError):
            self._port.close()
        if socket is not None:
            socket.close()

    def nonsense(self, error: DeviceError) -> DeviceError:
        """What to say of a unit whose answers were no good for the last time."""
        if isinstance(error, SilentError):
            return error
        return DeviceError(f"the pan-tilt unit at {self.name} answers, but not what it was asked: {error}")

    def _deadline(self, order: bytes, patience: float) -> float:
        answer = TERSE_ANSWER if self.strict else WORDY_ANSWER
        return self._clock.now() + patience + (len(order) + answer) * self._byte_s

    def _expect_nothing(self) -> None:
        """Look at what came unasked: events are welcome, anything else is an answer that nobody waited for."""
        self._buffer += self._read(wait=False)
        if self._buffer:
            rest = self._without_events(self._buffer).strip()
            self._buffer = b""
            if rest == b"!":  # the first half of an event
                self._buffer = rest
            elif rest and self.strict:
                self._strange = rest
                raise ReplyError(f"{shown(rest)} came unasked")

    def _reply(self, deadline: float, skipping: bool) -> tuple[Reply, float]:
        """The next line that is an answer, and when its first byte came [s]."""
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
        """One line and when its first byte came [s]."""
        first = self._clock.now()
        begun = bool(self._buffer)
        while b"\n" not in self._buffer:
            now = self._clock.now()
            late = now > deadline  # a thread that slept too long still reads what came meanwhile
            data = self._read(wait=not late)
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
        """Whether a question is answered in time, whatever else comes before."""
        self.write(question)
        deadline = self._deadline(question, patience)
        for _ in range(MOST_LINES):
            try:
                line, _ = self._next_line(deadline)
                line = self._without_events(line)
                if BANNER.search(line):
                    raise RestartedError(self.name)
                reply = parse(line)
                well = reply is not None and not reply.refused and right(reply.text)
            except SilentError:
                return False
            except ReplyError:
                continue
            if well:
                return True
            if reply is not None and not reply.refused:
                raise RestartedError(self.name)
        return False

    def _without_events(self, data: bytes) -> bytes:
        rest, events = split_events(data)
        self.events += events
        return rest

    def _read(self, wait: bool = True) -> bytes:
        """What has come; if nothing has, wait a little for the first byte."""
        try:
            there = self._port.in_waiting
            data = self._port.read(max(there, 1)) if there or wait else b""
        except OSError as error:  # in_waiting raises the system's own, read and write pyserial's
            raise LostError(self.name, error) from error
        self._heard = (self._heard + data)[-HEARD:]
        return data


def open_line(name: str, baud: int, clock: Clock) -> Line:
    """Open the line at a port by the name or URL that pyserial knows it by.

    Raises:
        ConfigError: no port is named.
        DeviceError: it cannot be opened.
    """
    return Line(open_port(name, baud), name, baud, clock)
