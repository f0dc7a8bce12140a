"""PTP/IP responder: an emulated device on one TCP port, for one initiator at a time.

The first part encodes PTP's values and datasets (ISO 15740). The second splits and encodes the packets of PTP/IP (CIPA
DC-005): length of the whole packet (4 bytes), kind (4 bytes) and body, all little-endian. `CommandSession` turns
packets into packets, and `PtpIpServer` holds the connections and the faults of the line. With "hung" nothing is
answered, with "slow" answers are a second late, "cut" breaks the connection once in the middle of data.
"""

import contextlib
import itertools
import socket
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from cotarget.emulators.serve import Faults, TcpServer
from cotarget.errors import CotargetError

# PTP: values, datasets and response codes

PARAMETERS = 5  # most parameters of an operation or a response
ARRAY = 0x4000  # set in the data type of an array
UINT8, UINT16, UINT32, STRING = 2, 4, 6, 0xFFFF  # data types
WIDTHS = {UINT8: 1, UINT16: 2, UINT32: 4}  # bytes
JPEG = 0x3801  # the object format: EXIF
Value = int | str | tuple[int, ...]


class Code(IntEnum):
    """Response codes of PTP."""

    OK = 0x2001
    SESSION_NOT_OPEN = 0x2003
    OPERATION_NOT_SUPPORTED = 0x2005
    INCOMPLETE_TRANSFER = 0x2007
    INVALID_HANDLE = 0x2009
    PROPERTY_NOT_SUPPORTED = 0x200A
    ACCESS_DENIED = 0x200F
    DEVICE_BUSY = 0x2019
    INVALID_PROPERTY_FORMAT = 0x201B
    INVALID_PROPERTY_VALUE = 0x201C
    INVALID_PARAMETER = 0x201D
    SESSION_ALREADY_OPEN = 0x201E


class PtpError(CotargetError):
    """The bytes are no valid PTP, or come out of turn."""


@dataclass(frozen=True)
class PtpReply:
    """A device's answer to an operation."""

    code: int = Code.OK
    parameters: tuple[int, ...] = ()
    data: bytes | None = None  # of an operation that returns data, even if empty; None for any other


class PtpDevice(Protocol):
    """A device behind a responder."""

    def operate(self, code: int, parameters: tuple[int, ...], data: bytes) -> PtpReply:
        """Carry out an operation, with five parameters (0 where one was not sent) and its data."""

    def disconnected(self) -> None:
        """Handle the end of the initiator's connection."""


def array(values: Iterable[int], kind: int) -> bytes:
    """Encode an array of integers of a data type, after its length."""
    items = tuple(values)
    return struct.pack("<I", len(items)) + b"".join(encode(kind, item) for item in items)


def string(text: str) -> bytes:
    """Encode a string after its length; an empty one is a length of 0."""
    if not text:
        return b"\0"
    return bytes([len(text) + 1]) + f"{text}\0".encode("utf-16-le")


def encode(kind: int, value: Value) -> bytes:
    """Encode a value of a data type."""
    if isinstance(value, str):
        return string(value)
    if isinstance(value, tuple):
        return array(value, kind & ~ARRAY)
    return value.to_bytes(WIDTHS[kind], "little")


def decode(kind: int, data: bytes) -> Value:
    """Decode a value of one of the data types above from all of the bytes.

    Raises:
        PtpError: the bytes are no such value.
    """
    if kind == STRING:
        if not data or len(data) != 1 + 2 * data[0] or (data[0] and data[-2:] != b"\0\0"):
            raise PtpError(f"PTP: {len(data)} bytes are no string")
        return data[1:].decode("utf-16-le", "replace").partition("\0")[0]
    width = WIDTHS[kind & ~ARRAY]
    head = 4 if kind & ARRAY else 0
    count = int.from_bytes(data[:4], "little") if head else 1
    if len(data) != head + count * width:
        raise PtpError(f"PTP: {len(data)} bytes are no value of type {kind:#06x}")
    places = range(head, len(data), width)
    found = tuple(int.from_bytes(data[at : at + width], "little") for at in places)
    return found if head else found[0]


@dataclass(frozen=True)
class Property:
    """A property of a device."""

    code: int
    kind: int  # data type
    default: Value
    writable: bool = False
    form: range | tuple[Value, ...] | None = None  # valid values; None for any value of the data type

    def allows(self, value: Value) -> bool:
        """Return whether a value of the right type may be set."""
        return self.form is None or value in self.form

    def describe(self, current: Value) -> bytes:
        """Encode the dataset that describes the property, with its present value."""
        head = struct.pack("<HHB", self.code, self.kind, self.writable)
        head += encode(self.kind, self.default) + encode(self.kind, current)
        if self.form is None:
            return head + b"\0"
        if isinstance(self.form, range):
            values: tuple[Value, ...] = (self.form[0], self.form[-1], self.form.step)
            head += b"\1"
        else:
            values = self.form
            head += b"\2" + struct.pack("<H", len(values))
        return head + b"".join(encode(self.kind, value) for value in values)


def device_info(extension: int, lists: Iterable[Iterable[int]], names: Iterable[str]) -> bytes:
    """Encode the identity and the capabilities of a device with PTP 1.0.

    Args:
        extension: registered number of the vendor's extension.
        lists: codes of operations, events, properties, formats of captures, and formats of other objects.
        names: maker, model, version and serial number.
    """
    head = struct.pack("<HIH", 100, extension, 100) + string("") + struct.pack("<H", 0)
    return head + b"".join(array(codes, UINT16) for codes in lists) + b"".join(map(string, names))


def storage_info(label: str) -> bytes:
    """Encode the dataset of a camera's memory: fixed RAM with its own file system, read and write, sizes unknown."""
    return struct.pack("<HHHQQI", 3, 0x8001, 0, 0, 0, 0xFFFFFFFF) + string("") + string(label)


def object_info(storage: int, length: int, size: tuple[int, int], name: str, date: str) -> bytes:
    """Encode the description of a JPEG (EXIF) image in a camera's memory, without a folder and without a thumbnail.

    The date is as in "20080721T095816", the length in bytes, and the size (width, height) in pixels.
    """
    plain, bits, none = 0, 24, 0
    head = struct.pack("<IHHI", storage, JPEG, plain, length) + struct.pack("<HIII", none, none, none, none)
    rest = struct.pack("<IIIIHII", *size, bits, none, none, none, none)  # parent, kind of folder, its words, number
    return head + rest + string(name) + string(date) * 2 + string("")


# PTP/IP: packets

HEADER = struct.Struct("<II")
LONGEST_PACKET = 1 << 20  # bytes; initiators send data in pieces of 64 KiB or less
PIECE = 1 << 16  # bytes of data in one packet of the responder
VERSION = 0x00010000  # of PTP/IP: 1.0
NO_TRANSACTION = 0xFFFFFFFF


class Kind(IntEnum):
    """Kinds of packets of PTP/IP."""

    INIT_COMMAND = 1
    INIT_COMMAND_ACK = 2
    INIT_EVENT = 3
    INIT_EVENT_ACK = 4
    INIT_FAIL = 5
    REQUEST = 6
    RESPONSE = 7
    EVENT = 8
    START_DATA = 9
    DATA = 10
    CANCEL = 11
    END_DATA = 12
    PROBE_REQUEST = 13
    PROBE_RESPONSE = 14


Packet = tuple[int, bytes]  # kind and body


def split(pieces: Iterable[bytes]) -> Iterator[Packet]:
    """Split a stream of bytes into packets, and yield each as soon as it is complete.

    Raises:
        PtpError: the bytes are no packets.
    """
    pending = bytearray()
    for piece in pieces:
        pending += piece
        while len(pending) >= HEADER.size:
            length, kind = HEADER.unpack_from(pending)
            if not HEADER.size <= length <= LONGEST_PACKET:
                raise PtpError(f"PTP/IP: a packet cannot be {length} bytes long")
            if len(pending) < length:
                break
            body = bytes(pending[HEADER.size : length])
            del pending[:length]
            yield kind, body


def unpack(layout: str, body: bytes) -> tuple[int, ...]:
    """Unpack a body of a packet, little-endian.

    Raises:
        PtpError: the body has another length.
    """
    try:
        return struct.unpack(f"<{layout}", body)
    except struct.error:
        raise PtpError(f"PTP/IP: {len(body)} bytes are no such packet") from None


def packet(kind: Kind, body: bytes = b"") -> bytes:
    """Encode a packet."""
    return HEADER.pack(HEADER.size + len(body), kind) + body


def init_command_ack(connection: int, guid: bytes, name: str) -> bytes:
    """Encode the acceptance of a command connection, with its number and the responder's GUID and name."""
    body = struct.pack("<I", connection) + guid + name.encode("utf-16-le") + b"\0\0"
    return packet(Kind.INIT_COMMAND_ACK, body + struct.pack("<I", VERSION))


def init_fail(reason: int) -> bytes:
    """Encode the refusal of a connection: 1 rejected, 2 busy, 3 unspecified."""
    return packet(Kind.INIT_FAIL, struct.pack("<I", reason))


def response(code: int, transaction: int, parameters: Iterable[int] = (), kind: Kind = Kind.RESPONSE) -> bytes:
    """Encode the end of a transaction, or an event."""
    words = tuple(parameters)
    return packet(kind, struct.pack(f"<HI{len(words)}I", code, transaction, *words))


def data_phase(transaction: int, data: bytes) -> Iterator[bytes]:
    """Yield the packets that carry data; even empty data end with an end packet."""
    yield packet(Kind.START_DATA, struct.pack("<IQ", transaction, len(data)))
    number = struct.pack("<I", transaction)
    last = max(len(data) - 1, 0) // PIECE * PIECE
    for at in range(0, last, PIECE):
        yield packet(Kind.DATA, number + data[at : at + PIECE])
    yield packet(Kind.END_DATA, number + data[last:])


# The responder

LINE_FAULTS = ("hung", "slow", "cut")
SLOW_S = 1.0  # delay of a slow answer; libgphoto2 waits for 2.5 s [s]
HANDOVER_S = 1.0  # time limit for a new initiator to wait for the end of the one before [s]
RECEIVE = 1 << 16  # bytes
SENDS_DATA = 2  # in the data phase field of a request
# libgphoto2 sends a request and its data separately and without TCP_NODELAY. Unless the first is acknowledged at once,
# which is an option of Linux, the second leaves 40 ms late.
QUICK_ACK: int | None = getattr(socket, "TCP_QUICKACK", None)
REJECTED, BUSY = 1, 2  # reasons of INIT_FAIL


class CommandSession:
    """The transactions of one command connection; operations are ignored while ``hung`` returns True."""

    def __init__(self, device: PtpDevice, hung: Callable[[], bool] = lambda: False) -> None:
        self._device, self._hung = device, hung
        self._code, self._transaction, self._parameters = 0, 0, (0,) * PARAMETERS  # of the latest request
        self._waits = False  # whether the request's data are incomplete
        self._total = -1  # announced bytes of its data; -1 before the announcement
        self._data = b""

    def receive(self, kind: int, body: bytes) -> list[bytes]:
        """Process a packet of the initiator; return the packets to send back.

        Raises:
            PtpError: the packet is malformed or comes out of turn.
        """
        match kind:
            case Kind.REQUEST if not self._waits:
                count = min(max(len(body) - 10, 0) // 4, PARAMETERS)
                phase, self._code, self._transaction, *parameters = unpack(f"IHI{count}I", body)
                self._parameters = (*parameters, *(0,) * (PARAMETERS - count))
                self._waits, self._total, self._data = phase == SENDS_DATA, -1, b""
                return [] if self._waits else self._operate()
            case Kind.START_DATA if self._waits and self._total < 0:
                _, self._total = unpack("IQ", body)
            case Kind.DATA | Kind.END_DATA if self._waits and self._total >= 0:
                self._data += body[4:]  # after the number of the transaction
                if kind == Kind.END_DATA:
                    self._waits = False
                    if len(self._data) != self._total:
                        return [response(Code.INCOMPLETE_TRANSFER, self._transaction)]
                    return self._operate()
            case Kind.PROBE_REQUEST if not body:
                return [packet(Kind.PROBE_RESPONSE)]
            case Kind.PROBE_RESPONSE | Kind.CANCEL:
                pass
            case _:
                raise PtpError(f"PTP/IP: a packet out of turn: kind {kind} with {len(body)} bytes")
        return []

    def _operate(self) -> list[bytes]:
        if self._hung():
            return []
        answer = self._device.operate(self._code, self._parameters, self._data)
        phase: Iterable[bytes] = () if answer.data is None else data_phase(self._transaction, answer.data)
        return [*phase, response(answer.code, self._transaction, answer.parameters)]


class PtpIpServer(TcpServer):
    """Server of command and event connections on one port, for one initiator at a time.

    Args:
        device: the device.
        guid: 16 bytes that identify the device.
        name: name of the device.
        faults: must know `LINE_FAULTS`.
        absent: returns whether the device is unplugged or off now, which closes the port.
        host: address to listen at.
        port: to listen at; 0 for any free port.
    """

    def __init__(
        self,
        device: PtpDevice,
        guid: bytes,
        name: str,
        faults: Faults,
        absent: Callable[[], bool],
        host: str,
        port: int,
    ) -> None:
        self._device, self._guid, self._name, self._faults = device, guid, name, faults
        self._numbers = itertools.count(1)
        self._changed = threading.Condition()  # guards the attributes below
        self._initiator: int | None = None  # number of the command connection
        self._event_connections: dict[
            int, socket.socket
        ] = {}  # event connections by the number of their command connection
        super().__init__(self._serve_connection, host, port, absent)

    def send_event(self, code: int, parameters: Iterable[int]) -> None:
        """Send an event to the initiator, if it has an event connection."""
        with self._changed:
            listener = None if self._initiator is None else self._event_connections.get(self._initiator)
        if listener is not None and "hung" not in self._faults:
            with contextlib.suppress(OSError):  # the initiator is gone
                listener.sendall(response(code, NO_TRANSACTION, parameters, Kind.EVENT))

    def _serve_connection(self, connection: socket.socket) -> None:
        with contextlib.suppress(PtpError):
            packets = split(self._pieces(connection))
            match next(packets, None):
                case Kind.INIT_COMMAND, _:
                    self._command(connection, packets)
                case Kind.INIT_EVENT, body:
                    self._events(connection, packets, *unpack("I", body))

    def _pieces(self, connection: socket.socket) -> Iterator[bytes]:
        while True:
            if QUICK_ACK is not None:
                connection.setsockopt(socket.IPPROTO_TCP, QUICK_ACK, 1)
            received = connection.recv(RECEIVE)
            if not received:
                return
            yield received

    def _command(self, connection: socket.socket, packets: Iterator[Packet]) -> None:
        number = next(self._numbers)
        with self._changed:
            # A client may reconnect before the end of its first connection is noticed.
            if not self._changed.wait_for(lambda: self._initiator is None, HANDOVER_S):
                connection.sendall(init_fail(BUSY))
                return
            self._initiator = number
        try:
            self._send(connection, [init_command_ack(number, self._guid, self._name)])
            session = CommandSession(self._device, lambda: "hung" in self._faults)
            for kind, body in packets:
                self._send(connection, session.receive(kind, body))
        finally:
            self._device.disconnected()
            with self._changed:
                self._initiator = None
                self._changed.notify_all()

    def _events(self, connection: socket.socket, packets: Iterator[Packet], number: int) -> None:
        with self._changed:
            known = number == self._initiator and number not in self._event_connections
            if known:
                self._event_connections[number] = connection
        if not known:
            connection.sendall(init_fail(REJECTED))
            return
        try:
            self._send(connection, [packet(Kind.INIT_EVENT_ACK)])
            for kind, _ in packets:
                if kind == Kind.PROBE_REQUEST:
                    self._send(connection, [packet(Kind.PROBE_RESPONSE)])
        finally:
            with self._changed:
                del self._event_connections[number]

    def _send(self, connection: socket.socket, packets: list[bytes]) -> None:
        if not packets or "hung" in self._faults:
            return
        if "slow" in self._faults:
            self.closing.wait(SLOW_S)
        answer = b"".join(packets)
        if len(packets) > 1 and self._faults.take("cut"):
            connection.sendall(answer[: len(answer) // 2])
            raise PtpError("PTP/IP: cut")
        connection.sendall(answer)
