"""PTP without a transport: values and datasets as bytes, response codes, and what a device is; source: ISO 15740."""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from cotarget.errors import CotargetError

PARAMETERS = 5  # an operation or a response has no more
LONGEST_STRING = 255  # UTF-16 units, the closing zero among them
ARRAY = 0x4000  # set in the data type of an array
INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64 = range(1, 9)
STRING = 0xFFFF
SIGNED = (INT8, INT16, INT32, INT64)
WIDTHS = {INT8: 1, UINT8: 1, INT16: 2, UINT16: 2, INT32: 4, UINT32: 4, INT64: 8, UINT64: 8}  # bytes
JPEG = 0x3801  # the object format: EXIF

Value = int | str | tuple[int, ...]


class Code(IntEnum):
    """Response codes."""

    OK = 0x2001
    GENERAL_ERROR = 0x2002
    SESSION_NOT_OPEN = 0x2003
    OPERATION_NOT_SUPPORTED = 0x2005
    INCOMPLETE_TRANSFER = 0x2007
    INVALID_STORAGE = 0x2008
    INVALID_HANDLE = 0x2009
    PROPERTY_NOT_SUPPORTED = 0x200A
    ACCESS_DENIED = 0x200F
    DEVICE_BUSY = 0x2019
    INVALID_PROPERTY_FORMAT = 0x201B
    INVALID_PROPERTY_VALUE = 0x201C
    INVALID_PARAMETER = 0x201D
    SESSION_ALREADY_OPEN = 0x201E


class PtpError(CotargetError):
    """Bytes that are no PTP, or that come at the wrong time."""


@dataclass(frozen=True)
class Answer:
    """What a device answers to an operation; ``data`` where the operation is one that gives data, even if empty."""

    code: int = Code.OK
    parameters: tuple[int, ...] = ()
    data: bytes | None = None


class PtpDevice(Protocol):
    """What a responder stands in front of."""

    def operate(self, code: int, parameters: tuple[int, ...], data: bytes) -> Answer:
        """Do an operation: five parameters, those that were not sent 0, and the data that came along."""

    def disconnected(self) -> None:
        """The initiator is gone."""


def array(values: Iterable[int], kind: int) -> bytes:
    """An array of integers of a data type, after its length."""
    items = tuple(values)
    return struct.pack("<I", len(items)) + b"".join(encode(kind, item) for item in items)


def string(text: str) -> bytes:
    """A string after its length; an empty one is a length of 0."""
    if not text:
        return b"\0"
    units = text.encode("utf-16-le")[: 2 * (LONGEST_STRING - 1)] + b"\0\0"
    return bytes([len(units) // 2]) + units


def encode(kind: int, value: Value) -> bytes:
    """A value as its data type has it."""
    if isinstance(value, str):
        return string(value)
    if isinstance(value, tuple):
        return array(value, kind & ~ARRAY)
    return value.to_bytes(WIDTHS[kind], "little", signed=kind in SIGNED)


def decode(kind: int, data: bytes) -> Value:
    """The value of a data type that is all of some bytes.

    Raises:
        PtpError: the bytes are no such value.
    """
    if kind == STRING:
        if not data or len(data) != 1 + 2 * data[0] or (data[0] and data[-2:] != b"\0\0"):
            raise PtpError(f"PTP: {len(data)} bytes are no string")
        return data[1:].decode("utf-16-le", "replace").partition("\0")[0]
    if kind & ~ARRAY not in WIDTHS:
        raise PtpError(f"PTP: unknown data type {kind:#06x}")
    width, signed = WIDTHS[kind & ~ARRAY], kind & ~ARRAY in SIGNED
    head = 4 if kind & ARRAY else 0
    count = int.from_bytes(data[:4], "little") if head else 1
    if len(data) != head + count * width:
        raise PtpError(f"PTP: {len(data)} bytes are no value of type {kind:#06x}")
    places = range(head, len(data), width)
    found = tuple(int.from_bytes(data[at : at + width], "little", signed=signed) for at in places)
    return found if head else found[0]


@dataclass(frozen=True)
class Range:
    """Values from ``low`` to ``high`` by ``step``."""

    low: int
    high: int
    step: int = 1


@dataclass(frozen=True)
class Property:
    """A property of a device.

    Attributes:
        code: its number.
        kind: data type.
        default: its value at first.
        writable: whether the initiator may set it.
        form: what may be set: a range, a list of values, or None for anything of that type.
    """

    code: int
    kind: int
    default: Value
    writable: bool = False
    form: Range | tuple[Value, ...] | None = None

    def allows(self, value: Value) -> bool:
        """Whether a value of the right type is one that may be set."""
        match self.form:
            case None:
                return True
            case Range(low, high, step):
                return isinstance(value, int) and low <= value <= high and (value - low) % step == 0
            case values:
                return value in values

    def describe(self, current: Value) -> bytes:
        """The dataset that describes it, with its value now."""
        head = struct.pack("<HHB", self.code, self.kind, self.writable)
        head += encode(self.kind, self.default) + encode(self.kind, current)
        match self.form:
            case None:
                return head + b"\0"
            case Range(low, high, step):
                return head + b"\1" + b"".join(encode(self.kind, value) for value in (low, high, step))
            case values:
                listed = b"".join(encode(self.kind, value) for value in values)
                return head + b"\2" + struct.pack("<H", len(values)) + listed


@dataclass(frozen=True)
class DeviceInfo:
    """What a device is and can do; lists of codes, and names."""

    extension: int  # the vendor's, as registered
    operations: tuple[int, ...]
    events: tuple[int, ...]
    properties: tuple[int, ...]
    formats: tuple[int, ...]  # of objects that it shows
    maker: str
    model: str
    version: str
    serial: str

    def pack(self) -> bytes:
        """The dataset, of PTP 1.0, of a camera that captures JPEG."""
        head = struct.pack("<HIH", 100, self.extension, 100) + string("") + struct.pack("<H", 0)
        lists = (self.operations, self.events, self.properties, (JPEG,), self.formats)
        names = (self.maker, self.model, self.version, self.serial)
        return head + b"".join(array(codes, UINT16) for codes in lists) + b"".join(string(name) for name in names)


def storage_info(label: str) -> bytes:
    """The dataset of a camera's memory: fixed RAM, a file system of its own, read and write, sizes unknown."""
    return struct.pack("<HHHQQI", 3, 0x8001, 0, 0, 0, 0xFFFFFFFF) + string("") + string(label)


@dataclass(frozen=True)
class ObjectInfo:
    """What a camera tells of an image in its memory; sizes in bytes and pixels."""

    storage: int
    length: int
    size: tuple[int, int]
    thumb_length: int
    thumb_size: tuple[int, int]
    name: str
    date: str  # of the capture, as "20080721T095816"

    def pack(self) -> bytes:
        """The dataset, of a JPEG (EXIF) image in no folder."""
        plain = 0
        head = struct.pack("<IHHI", self.storage, JPEG, plain, self.length)
        thumb = struct.pack("<HIII", JPEG, self.thumb_length, *self.thumb_size)
        rest = struct.pack("<IIIIHII", *self.size, 24, 0, 0, 0, 0)  # bits a pixel; parent, kind of folder, ..., number
        return head + thumb + rest + string(self.name) + string(self.date) * 2 + string("")
