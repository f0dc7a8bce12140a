"""The VISCA protocol over IP: messages, answers and the line.

The first part turns commands into bytes and answers into values, without I/O or time. `Line` exchanges one message at a
time over one of three transports: UDP with Sony's header, which numbers the messages; UDP bare; TCP bare. `open_line`
finds by asking which one a camera has.

A camera answers an order by an acknowledgement with the number of one of its two sockets, and later by a completion,
which is not waited for here. Cameras differ in the numbers of their answers: some repeat the one of the message, some
always send 1, some fall silent after a few messages until their counter is reset.

Sources: Sony's EVI-D70 and EVI-D80/D90 technical manuals; Sony's VISCA over IP, as in the manual of the SRG-300H.
"""

import errno
import select
import socket
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from cotarget.drivers.guardian import StopOrder
from cotarget.drivers.link_errors import LostError, RefusedError, ReplyError, SilentError
from cotarget.errors import ConfigError, DeviceError
from cotarget.rig import Clock

# Messages

END = 0xFF
CAMERA = 0x81  # to camera 1 from the controller; over IP there is no other
VERSION = bytes.fromhex("81 09 00 02 FF")
POWER = bytes.fromhex("81 09 04 00 FF")
PAN_TILT = bytes.fromhex("81 09 06 12 FF")
ZOOM = bytes.fromhex("81 09 04 47 FF")
# A valid speed must be given even here.
STOP = bytes.fromhex("81 01 06 01 01 01 03 03 FF")
DIGITAL_ZOOM_OFF = bytes.fromhex("81 01 04 06 03 FF")
SOCKETS = (1, 2)  # of a camera, each for a command under way
STANDBY = 3  # answer to POWER
SYNTAX, BUFFER_FULL, CANCELLED, NO_SOCKET, NOT_EXECUTABLE = 0x02, 0x03, 0x04, 0x05, 0x41
FOR_NOW = (BUFFER_FULL, NOT_EXECUTABLE)  # the same message may be obeyed a moment later
ERRORS = {
    SYNTAX: "it does not know the command",
    BUFFER_FULL: "its command buffer is full",
    NO_SOCKET: "it has no such socket",
    NOT_EXECUTABLE: "it cannot do that now, as while it starts, is in standby, or shows its menu",
}
ZOOM_NIBBLES = 4
# Bytes of data in the answers to these inquiries; those of pan and tilt have others.
LENGTHS = {POWER: 1, ZOOM: ZOOM_NIBBLES, VERSION: 7}
# Nibbles of pan and of tilt by their sum: most cameras have four and four, Sony's BRC five and four.
WIDTHS = {8: (4, 4), 9: (5, 4)}


def nibbles(value: int, count: int) -> bytes:
    """Encode an integer in two's complement, four bits a byte, the highest first.

    Raises:
        ValueError: the integer does not fit.
    """
    if not -(1 << (4 * count - 1)) <= value < 1 << (4 * count):
        raise ValueError(f"{value} does not fit into {count} nibbles")
    return bytes((value >> 4 * place) & 0xF for place in reversed(range(count)))


def number(data: bytes, signed: bool = True) -> int:
    """Decode nibbles; the width of two's complement is their count.

    Raises:
        ReplyError: a byte is no nibble.
    """
    if not data or max(data) > 0xF:
        raise ReplyError(f"{data.hex(' ')} are no nibbles")
    value = int("".join(f"{nibble:x}" for nibble in data), 16)
    return value - (1 << 4 * len(data)) if signed and data[0] & 0x8 else value


def absolute(goals: tuple[int, int], speeds: tuple[int, int], widths: tuple[int, int]) -> bytes:
    """Encode a move of pan and tilt to positions [counts], by indices of speeds and the camera's `WIDTHS`."""
    ends = b"".join(nibbles(goal, width) for goal, width in zip(goals, widths, strict=True))
    return bytes((CAMERA, 0x01, 0x06, 0x02, *speeds)) + ends + bytes([END])


def zoom_to(position: int) -> bytes:
    """Encode a move of the zoom to a position."""
    return bytes((CAMERA, 0x01, 0x04, 0x47)) + nibbles(position, ZOOM_NIBBLES) + bytes([END])


def pan_tilt(data: bytes) -> tuple[int, int]:
    """Decode the answer to `PAN_TILT`: positions [counts].

    Raises:
        ReplyError: it has an unknown length, or a byte that is no nibble.
    """
    if len(data) not in WIDTHS:
        raise ReplyError(f"it reports pan and tilt in {len(data)} nibbles, where 8 or 9 are known")
    width = WIDTHS[len(data)][0]
    return number(data[:width]), number(data[width:])


def _fits(question: bytes, data: bytes) -> bool:
    """Whether data may answer a question; on a bare transport a late answer may be another question's."""
    if question == PAN_TILT:
        return len(data) not in LENGTHS.values()
    return question == VERSION or len(data) == LENGTHS[question]


class Answer(NamedTuple):
    """An answer of a camera.

    Attributes:
        kind: 4 for an acknowledgement, 5 for a completion or the answer to an inquiry, 6 for an error.
        socket: number of the socket; 0 where there is none.
        data: of an inquiry's answer, or the error's code.
    """

    kind: int
    socket: int
    data: bytes = b""


def parse(message: bytes) -> Answer | None:
    """Parse one message with its end; None if it is no answer of a camera."""
    if len(message) < 3 or message[-1] != END or not 0x90 <= message[0] <= 0xF0 or message[0] & 0x0F:
        return None
    kind, place = message[1] >> 4, message[1] & 0xF
    if kind not in (4, 5, 6) or (kind == 6 and len(message) != 4):
        return None
    return Answer(kind, place, message[2:-1])


def _is_receipt(answer: Answer) -> bool:
    """Whether an answer is the first one to an order; a completion with a socket follows an acknowledgement."""
    return answer.kind == 4 or (answer.kind == 5 and not answer.data and not answer.socket)


# Sony's header

COMMAND, INQUIRY, REPLY, CONTROL, CONTROL_REPLY = 0x0100, 0x0110, 0x0111, 0x0200, 0x0201  # types of payloads
HEADER_BYTES = 8
RESET = bytes([0x01])  # control payload: the next number is 1
ABNORMAL_NUMBER = bytes([0x0F, 0x01])
FIRST = 1  # number after a reset
FEW = 8  # a camera that falls silent so soon answers no more numbers; later, messages were lost


class Packet(NamedTuple):
    """A message with its header; without one the number is None."""

    kind: int
    number: int | None
    payload: bytes


def pack(kind: int, count: int, payload: bytes) -> bytes:
    """Put Sony's header before a payload: type, length, number."""
    return kind.to_bytes(2, "big") + len(payload).to_bytes(2, "big") + count.to_bytes(4, "big") + payload


def unpack(data: bytes) -> Packet | None:
    """Split a datagram with Sony's header; None if it has none."""
    kind, length = int.from_bytes(data[:2], "big"), int.from_bytes(data[2:4], "big")
    if len(data) <= HEADER_BYTES or kind not in (REPLY, CONTROL_REPLY) or length != len(data) - HEADER_BYTES:
        return None
    return Packet(kind, int.from_bytes(data[4:8], "big"), data[HEADER_BYTES:])


# The line

ANSWER_S = 0.25  # for an answer; a camera needs one or two frames for it [s]
STOP_S = 0.1  # a stop that is not acknowledged for this time is repeated [s]
HURRY_S = 0.03  # for the answer in flight when a halt waits [s]
SLOWEST_S = 1.0  # for an answer of a camera that is slow on a bare transport [s]
BUSY_S, BUSY_PAUSE_S = 0.5, 0.03  # for how long an order that is refused for now is sent again, and how often [s]
TRIES = 6  # of an inquiry or an order
CONNECT_S, GREETINGS = 1.0, 2  # for a TCP connection [s]; inquiries to each transport
SLICE_S = 0.01  # [s]
RECEIVE = 4096  # bytes
LONGEST = 64  # bytes of a stream without an end of a message
FLOOD_S = 0.2  # beyond a deadline, after which not even what has come is read: it may never end [s]
MOST_DROPPED = 1000  # packets of a flood that are dropped at once
SHOWN = 24  # bytes of a wrong answer in an error


class Transport(NamedTuple):
    """A way to send VISCA over IP: its names in rig.toml and in messages, its socket, usual port, and header."""

    name: str
    words: str
    kind: socket.SocketKind
    port: int
    header: bool


TRANSPORTS = {
    each.name: each
    for each in (
        Transport("sony", "UDP {} with Sony's header", socket.SOCK_DGRAM, 52381, True),
        Transport("udp", "UDP {}", socket.SOCK_DGRAM, 1259, False),
        Transport("tcp", "TCP {}", socket.SOCK_STREAM, 5678, False),
    )
}


class Line:
    """Exchange of one message at a time with a camera.

    Every method but `close` raises LostError where the connection failed, and SilentError where no answer comes.

    Args:
        connection: a connected socket.
        transport: how messages are sent on it.
        name: of the camera, for messages.
        clock: the rig's clock.

    Attributes:
        hurry: returns whether a halt waits, so that an answer in flight gets `HURRY_S` at most.
        heard: the last bytes that were no VISCA.
    """

    def __init__(self, connection: socket.socket, transport: Transport, name: str, clock: Clock) -> None:
        self._socket, self.transport, self.name, self._clock = connection, transport, name, clock
        self.hurry: Callable[[], bool] = lambda: False
        self.heard = b""
        self._answer_s = ANSWER_S
        self._stream = b""  # of TCP: the begin of a message
        self._inbox: list[Packet] = []
        self._count = 0  # number of the last message
        self._answered = 0  # number of the last message that was answered
        self._most: int | None = None  # highest number that the camera answers after a reset; None for all
        self._repeats_numbers = True  # whether answers have the number of their message
        self._other: int | None = None  # number of the last answer with another one
        self._pending = deque[float]()  # when the orders were sent that have had no receipt or refusal [s]

    def inquire(self, question: bytes, tries: int = TRIES) -> tuple[bytes, float]:
        """Send an inquiry; return the answer's data, and the time at which the camera read it [s].

        Raises:
            RefusedError: the camera answers by an error, to each try where it may be of now; its `code` says which.
        """
        sent: dict[int, float] = {}
        silent = 0  # tries without an answer
        self._drain(0.0)
        for attempt in range(tries):
            if silent:
                self._recover(silent)
            count, refused = self._next(), None
            sent[count] = self._clock.now()
            self._send(INQUIRY, count, question)
            while (packet := self._receive(sent[count] + self._answer_s)) is not None:
                begin = self._sent_of(packet, sent)
                answer = None if begin is None or packet.kind == CONTROL_REPLY else parse(packet.payload)
                if begin is None or answer is None:
                    if self._is_abnormal(packet):
                        break
                    continue
                if answer.kind == 6 and not answer.socket:  # with a socket it is of an order
                    refused = self._error(answer)
                    if refused.code not in FOR_NOW:
                        raise refused
                if answer.kind == 5 and answer.data and _fits(question, answer.data):
                    self._answered, t = count, (begin + self._clock.now()) / 2
                    if attempt and not self.transport.header and self._drain(self._answer_s):
                        self._answer_s = min(2 * self._answer_s, SLOWEST_S)  # the first answer was late, and not lost
                    return answer.data, t
            if self.hurry():
                raise self._silent()
            silent = 0 if refused else silent + 1
        raise refused or self._silent()

    def order(self, command: bytes, patience: float = TRIES * ANSWER_S, again_s: float = ANSWER_S) -> int:
        """Send an order until it is acknowledged, each time with a new number; return the socket, 0 if unknown.

        Args:
            command: the order; one that may be executed twice.
            patience: for the acknowledgement [s].
            again_s: after this time without it the order is repeated [s].

        Raises:
            RefusedError: the camera refuses the order; its `code` says why.
        """
        self._drain(0.0)
        end, sent = self._clock.now() + patience, dict[int, float]()
        earlier = self._unacknowledged()
        while True:
            count, now = self._next(), self._clock.now()
            sent[count] = now
            self._send(COMMAND, count, command)
            self._pending.append(now)
            while (packet := self._receive(min(now + again_s, max(end, now + SLICE_S)))) is not None:
                if self._is_abnormal(packet):  # of this message or another: no receipt in any case
                    self._reset()
                    break
                answer = parse(packet.payload) if self._sent_of(packet, sent) is not None else None
                if answer is None or (answer.kind == 6 and answer.data[0] in (CANCELLED, NO_SOCKET)):
                    continue
                if answer.kind == 6:
                    if self._pending and not answer.socket:
                        self._pending.popleft()
                    raise self._error(answer)
                # A completion may be of an earlier order, unless its number says otherwise.
                if _is_receipt(answer) or (not answer.data and packet.number in sent):
                    if earlier:  # the order is sent again at once, and one more receipt waited for
                        earlier -= 1
                        break
                    self._answered = count
                    return answer.socket
            if self._clock.now() >= end or (self.hurry() and command != STOP):
                raise self._silent()

    def patiently(self, command: bytes, proceed: Callable[[], None], before: int = 0) -> int:
        """Send an order; send it again for `BUSY_S` where the camera refuses it for now. Returns as `order` does.

        Args:
            command: the order.
            proceed: called before each repetition; raises where the order is not wanted any more.
            before: socket of the order that this one replaces; it is cancelled where none is free.

        Raises:
            RefusedError: the camera refuses the order.
        """
        end = self._clock.now() + BUSY_S
        while True:
            try:
                return self.order(command)
            except CodedError as error:
                if error.code not in FOR_NOW or self._clock.now() >= end:
                    raise
                if error.code == BUFFER_FULL:
                    self.cancel((before,) if before else SOCKETS)
                    before = 0  # where that did not help
            self._clock.sleep_until(self._clock.now() + BUSY_PAUSE_S)
            proceed()

    def stop(self, patience: float) -> None:
        """Stop pan and tilt; repeat it until it is acknowledged, or for ``patience`` [s].

        Raises:
            DeviceError: it was not acknowledged.
        """
        end = self._clock.now() + patience
        while True:
            try:
                self.order(STOP, max(end - self._clock.now(), 0.0), STOP_S)
                return
            except CodedError as error:
                if error.code == BUFFER_FULL:
                    self.cancel(SOCKETS)
                if self._clock.now() >= end:
                    raise
            self._clock.sleep_until(self._clock.now() + BUSY_PAUSE_S)

    def last_stop(self) -> StopOrder:
        """Write a stop for a `Guardian`: with Sony's header the first message after a reset of the counter."""
        host, port, *_ = self._socket.getpeername()
        messages = [STOP]
        if self.transport.header:
            messages = [pack(CONTROL, 0, RESET), pack(COMMAND, FIRST, STOP)]
        is_udp = self.transport.kind == socket.SOCK_DGRAM
        return StopOrder(is_udp, host, port, [message.decode("latin-1") for message in messages])

    def cancel(self, places: Sequence[int]) -> None:
        """Cancel the commands in the camera's sockets; waits for no answer."""
        for place in places:
            self._send(COMMAND, self._next(), bytes((CAMERA, 0x20 | place, END)))

    def close(self) -> None:
        """Release the connection."""
        self._socket.close()

    def greet(self) -> bytes:
        """Reset the counter of messages and ask for the version; empty if the camera refuses to say it."""
        if self.transport.header:
            self._reset()
        try:
            return self.inquire(VERSION, GREETINGS)[0]
        except RefusedError:
            return b""

    # Numbers

    def _next(self) -> int:
        if self._most is not None and self._count >= self._most:
            self._reset()
        self._count = self._count % 0xFFFFFFFF + 1
        return self._count

    def _reset(self) -> None:
        """Reset the camera's counter of messages; wait for its answer."""
        for _ in range(GREETINGS):
            self._send(CONTROL, 0, RESET)
            deadline = self._clock.now() + STOP_S
            while (packet := self._receive(deadline)) is not None:
                if packet.kind == CONTROL_REPLY and packet.payload == RESET:
                    self._count = FIRST - 1
                    return
        self._count = FIRST - 1

    def _recover(self, attempt: int) -> None:
        """Learn how a silent camera numbers its answers; reset its counter the second time."""
        if self._other == FIRST:
            self._repeats_numbers = False
        elif self.transport.header and attempt >= 2:
            if 0 < self._answered <= FEW and self._count - attempt == self._answered:
                self._most = self._answered
            self._reset()

    def _sent_of(self, packet: Packet, sent: dict[int, float]) -> float | None:
        """Return when the message was sent that a packet answers; None if it answers another one."""
        if packet.number in sent:
            return sent[packet.number]
        self._other = packet.number
        return max(sent.values()) if packet.number is None or not self._repeats_numbers else None

    def _unacknowledged(self) -> int:
        """Return how many acknowledgements of earlier orders may still come, which nothing tells from later ones."""
        while self._pending and self._pending[0] < self._clock.now() - self._answer_s:
            self._pending.popleft()
        return 0 if self.transport.header and self._repeats_numbers else len(self._pending)

    def _is_abnormal(self, packet: Packet) -> bool:
        return packet.kind == CONTROL_REPLY and packet.payload == ABNORMAL_NUMBER

    # Bytes

    def _send(self, kind: int, count: int, payload: bytes) -> None:
        data = pack(kind, count, payload) if self.transport.header else payload
        try:
            self._socket.sendall(data)
        except OSError as error:
            if not isinstance(error, ConnectionRefusedError) or not self._answered:
                raise LostError(self.name, error) from error

    def _receive(self, deadline: float) -> Packet | None:
        """Return the next packet; None if none comes until a deadline [s], or soon enough where a halt waits."""
        hurried: float | None = None
        while not self._inbox:
            now = self._clock.now()
            if hurried is None and self.hurry():
                hurried = now + HURRY_S
            end = deadline if hurried is None else min(deadline, hurried)
            if self._readable(min(max(end - now, 0.0), SLICE_S)) and now < end + SLICE_S:
                self._read()
            elif self._clock.now() >= end:
                return None
        return self._inbox.pop(0) if self._clock.now() < deadline + FLOOD_S else None

    def _readable(self, seconds: float) -> bool:
        return bool(select.select([self._socket], [], [], seconds)[0])

    def _read(self) -> None:
        try:
            data = self._socket.recv(RECEIVE)
        except ConnectionRefusedError as error:  # nothing listens there now; a camera that answered may be starting
            if not self._answered:
                raise LostError(self.name, error) from error
            self._clock.sleep_until(self._clock.now() + SLICE_S)
            return
        except OSError as error:
            raise LostError(self.name, error) from error
        if self.transport.header:
            if (packet := unpack(data)) is None:
                self.heard = data
            else:
                self._take(packet)
            return
        if not data and self.transport.kind == socket.SOCK_STREAM:
            closed = ConnectionResetError(errno.ECONNRESET, "it closes the connection, as to a second program")
            raise LostError(self.name, closed) from closed
        *messages, rest = (self._stream + data).split(bytes([END]))
        self._stream = rest[-LONGEST:] if self.transport.kind == socket.SOCK_STREAM else b""
        for message in messages:
            if parse(message + bytes([END])) is None:
                self.heard = message
            else:
                self._take(Packet(REPLY, None, message + bytes([END])))
        self.heard = rest or self.heard

    def _take(self, packet: Packet) -> None:
        self._inbox.append(packet)
        answer = parse(packet.payload) if packet.kind == REPLY else None
        if answer is not None and _is_receipt(answer) and self._pending:
            self._pending.popleft()

    def _drain(self, quiet_s: float) -> int:
        """Drop what comes within a time [s]; return the number of answers to inquiries in it."""
        end = self._clock.now() + quiet_s
        for _ in range(MOST_DROPPED):
            if self._readable(min(max(end - self._clock.now(), 0.0), SLICE_S)):
                self._read()
            elif self._clock.now() >= end or self.hurry():
                break
        dropped = [parse(packet.payload) for packet in self._inbox]
        self._inbox.clear()
        return sum(answer is not None and answer.kind == 5 and bool(answer.data) for answer in dropped)

    def _error(self, answer: Answer) -> "CodedError":
        code = answer.data[0]
        return CodedError(f"the camera at {self.name} refuses: {ERRORS.get(code, f'error {code:02x}')}", code)

    def _silent(self) -> SilentError:
        return SilentError(f"the camera at {self.name} does not answer: check its power and network")


class CodedError(RefusedError):
    """The camera answered by an error.

    Attributes:
        code: of the error.
    """

    def __init__(self, text: str, code: int) -> None:
        super().__init__(text)
        self.code = code


# Find the transport


def open_line(host: str, port: int, names: Sequence[str], clock: Clock) -> tuple[Line, bytes]:
    """Connect by the first transport that answers; return the line and the answer to `VERSION`.

    Args:
        host: the camera's address.
        port: its port; 0 for the usual one of each transport.
        names: of `TRANSPORTS`, in the order in which they are tried.
        clock: the rig's clock.

    Raises:
        ConfigError: the address is not known.
        DeviceError: none of them answers; the message says what was tried, and what may help.
    """
    tried = []
    for transport in (TRANSPORTS[name] for name in names):
        words = transport.words.format(port or transport.port)
        found = _greeted(host, port or transport.port, transport, f"{host} ({words})", clock)
        if not isinstance(found, str):
            return found
        tried.append(f"{words}: {found}")
    raise DeviceError(
        f"no camera at {host} answers VISCA ({'; '.join(tried)}): check host and the camera's power, switch VISCA over "
        "IP on in its network settings, set its VISCA address to 1, and set port if it has another one there"
    )


def _greeted(host: str, port: int, transport: Transport, name: str, clock: Clock) -> tuple[Line, bytes] | str:
    """Connect and greet; return the line and the answer to `VERSION`, or why that failed."""
    why, line = "no answer", None
    try:
        line = Line(_connect(host, port, transport), transport, name, clock)
        return line, line.greet()
    except (socket.gaierror, UnicodeError):
        raise ConfigError(f"hardware.ptz.host: '{host}' is no address that is known here") from None
    except SilentError:
        pass
    except (LostError, OSError) as error:
        cause = error.__cause__ if isinstance(error, LostError) else error
        why = getattr(cause, "strerror", None) or str(cause)
    if line is not None:
        line.close()
        if line.heard:
            why = f"answers {ascii(line.heard[:SHOWN])[1:]}, which is no VISCA"
    return why


def _connect(host: str, port: int, transport: Transport) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=transport.kind)[0]
    connection = socket.socket(family, kind, protocol)
    try:
        connection.settimeout(CONNECT_S)
        connection.connect(address)
        if transport.kind == socket.SOCK_STREAM:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except BaseException:
        connection.close()
        raise
    return connection
