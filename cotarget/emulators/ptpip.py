"""PTP/IP as bytes: the packets that an initiator and a responder exchange over TCP; source: CIPA DC-005.

A packet is its length (of itself, 4 bytes), its kind (4 bytes), and a body; all of it little-endian.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum

from cotarget.emulators.ptp import PARAMETERS, PtpError

HEADER = struct.Struct("<II")
LONGEST_PACKET = 1 << 20  # bytes; initiators send data in pieces of 64 KiB or less
PIECE = 1 << 16  # bytes of data in one packet of ours
GUID_LENGTH = 16
VERSION = 0x00010000  # of PTP/IP: 1.0


class Kind(IntEnum):
    """Packets of PTP/IP."""

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


@dataclass(frozen=True)
class InitCommand:
    """The first packet of a command connection: who calls."""

    guid: bytes
    name: str


@dataclass(frozen=True)
class InitEvent:
    """The first packet of an event connection: the number of the command connection that it belongs to."""

    connection: int


@dataclass(frozen=True)
class Request:
    """An operation to do; ``sends_data`` where its data follows."""

    code: int
    transaction: int
    parameters: tuple[int, ...]
    sends_data: bool = False


@dataclass(frozen=True)
class StartData:
    """Data of ``total`` bytes follows."""

    transaction: int
    total: int


@dataclass(frozen=True)
class Data:
    """A piece of data; ``last`` for the last one."""

    transaction: int
    data: bytes
    last: bool


@dataclass(frozen=True)
class Cancel:
    """The transaction is wanted no more."""

    transaction: int


@dataclass(frozen=True)
class Probe:
    """A question, or the ``answer``, whether the other side is still there."""

    answer: bool = False


Packet = InitCommand | InitEvent | Request | StartData | Data | Cancel | Probe


class PacketReader:
    """Cuts a stream of bytes into the packets that an initiator may send."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Add bytes, and give each packet that they complete.

        Raises:
            PtpError: these are no packets of an initiator.
        """
        self._pending += data
        while len(self._pending) >= HEADER.size:
            length, kind = HEADER.unpack_from(self._pending)
            if not HEADER.size <= length <= LONGEST_PACKET:
                raise PtpError(f"PTP/IP: a packet cannot be {length} bytes long")
            if len(self._pending) < length:
                return
            body = bytes(self._pending[HEADER.size : length])
            del self._pending[:length]
            yield parse_packet(kind, body)


def parse_packet(kind: int, body: bytes) -> Packet:
    """Tell what a packet of an initiator says.

    Raises:
        PtpError: it says nothing that an initiator may say.
    """
    match kind, len(body):
        case Kind.INIT_COMMAND, length if length >= GUID_LENGTH + 6 and length % 2 == 0:
            name = body[GUID_LENGTH:-4].decode("utf-16-le", "replace")
            return InitCommand(body[:GUID_LENGTH], name.partition("\0")[0])
        case Kind.INIT_EVENT, 4:
            return InitEvent(*struct.unpack("<I", body))
        case Kind.REQUEST, length if 10 <= length <= 10 + 4 * PARAMETERS and length % 4 == 2:
            phase, code, transaction, *parameters = struct.unpack(f"<IHI{(length - 10) // 4}I", body)
            return Request(code, transaction, tuple(parameters), sends_data=phase == 2)
        case Kind.START_DATA, 12:
            return StartData(*struct.unpack("<IQ", body))
        case ((Kind.DATA | Kind.END_DATA), length) if length >= 4:
            return Data(int.from_bytes(body[:4], "little"), body[4:], last=kind == Kind.END_DATA)
        case Kind.CANCEL, 4:
            return Cancel(*struct.unpack("<I", body))
        case Kind.PROBE_REQUEST, 0:
            return Probe()
        case Kind.PROBE_RESPONSE, 0:
            return Probe(answer=True)
    raise PtpError(f"PTP/IP: no initiator sends a packet of kind {kind} with {len(body)} bytes")


def packet(kind: Kind, body: bytes = b"") -> bytes:
    """The bytes of a packet."""
    return HEADER.pack(HEADER.size + len(body), kind) + body


def init_command_ack(connection: int, guid: bytes, name: str) -> bytes:
    """The responder's welcome on a command connection, with its number, GUID and name."""
    body = struct.pack("<I", connection) + guid + name.encode("utf-16-le") + b"\0\0"
    return packet(Kind.INIT_COMMAND_ACK, body + struct.pack("<I", VERSION))


def init_fail(reason: int) -> bytes:
    """The responder's refusal of a connection: 1 rejected, 2 busy, 3 unspecified."""
    return packet(Kind.INIT_FAIL, struct.pack("<I", reason))


def response(code: int, transaction: int, parameters: Iterable[int] = ()) -> bytes:
    """The end of a transaction."""
    words = tuple(parameters)
    return packet(Kind.RESPONSE, struct.pack(f"<HI{len(words)}I", code, transaction, *words))


def event(code: int, parameters: Iterable[int] = ()) -> bytes:
    """An event on the event connection, of no transaction."""
    words = tuple(parameters)
    return packet(Kind.EVENT, struct.pack(f"<HI{len(words)}I", code, 0xFFFFFFFF, *words))


def data_phase(transaction: int, data: bytes) -> Iterator[bytes]:
    """The packets that bring data; an end packet there is even for none."""
    yield packet(Kind.START_DATA, struct.pack("<IQ", transaction, len(data)))
    number = struct.pack("<I", transaction)
    last = max(len(data) - 1, 0) // PIECE * PIECE
    for at in range(0, last, PIECE):
        yield packet(Kind.DATA, number + data[at : at + PIECE])
    yield packet(Kind.END_DATA, number + data[last:])
