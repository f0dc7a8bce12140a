"""The serial line to a PTU-D46: one command in flight, deadlines, and a way back in step when something went wrong.

What pyserial and the operating system raise becomes a one-line DeviceError that names the port.
"""

import contextlib
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from cotarget.errors import DeviceError
from cotarget.hardware import d46
from cotarget.hardware.d46 import DELIMITER, HALT, RefusedError, ReplyError, command, shown
from cotarget.hardware.lineerrors import LostError, RestartedError, SilentError
from cotarget.hardware.serialport import Port, open_port
from cotarget.rig import Clock

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
        if d46.BANNER.search(noise):
            raise RestartedError(self.name)
        if self._answers(command("E"), lambda text: not d46.echoing(text), QUICK_S):
            return False
        self.write(DELIMITER + HALT)
        if d46.BANNER.search(self.drain(QUIET_S, DRAIN_S)):
            raise RestartedError(self.name)
        back = any(self._answers(command("F"), d46.terse, QUICK_S) for _ in range(LAST_TRIES))
        if not (back and self._answers(command("E"), lambda text: not d46.echoing(text), LAST_S)):
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

    def _reply(self, deadline: float, skipping: bool) -> tuple[d46.Reply, float]:
        """The next line that is an answer, and when its first byte came [s]."""
        for _ in range(MOST_LINES):
            line, first = self._next_line(deadline)
            line = self._without_events(line)
            try:
                reply = d46.parse(line)
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
            if len(self._buffer) > d46.LONGEST_LINE:
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
                if d46.BANNER.search(line):
                    raise RestartedError(self.name)
                reply = d46.parse(line)
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
        rest, events = d46.split_events(data)
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
