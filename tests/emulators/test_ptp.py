"""PTP and PTP/IP as bytes: against bytes worked by hand from CIPA DC-005 and ISO 15740, and against noise."""

import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cotarget.emulators import ptpip
from cotarget.emulators.ptpip import (
    Code,
    CommandSession,
    Kind,
    Property,
    PtpError,
    PtpReply,
    data_phase,
    packet,
    response,
    split,
)

PROPERTY = settings(derandomize=True, database=None, deadline=None, max_examples=500)
GUID = bytes(range(16))
OPEN, SET, ECHO = 0x1002, 0x1016, 0x9999  # operations


@given(st.lists(st.tuples(st.integers(0, 20), st.binary(max_size=80)), max_size=6), st.integers(1, 60))
@PROPERTY
def test_packets_arrive_in_pieces_or_together(packets, size):
    stream = b"".join(packet(kind, body) for kind, body in packets)
    assert list(split(stream[at : at + size] for at in range(0, len(stream), size))) == packets


@pytest.mark.parametrize("sent", ["07000000 06000000", "01001000 06000000"])  # shorter than its header; above 1 MiB
def test_a_packet_of_an_impossible_length_is_refused(sent):
    with pytest.raises(PtpError):
        list(split([bytes.fromhex(sent)]))


def test_packets_of_a_responder():
    assert ptpip.init_command_ack(3, GUID, "S5").hex(" ", 4) == (
        bytes.fromhex("26000000 02000000 03000000") + GUID + bytes.fromhex("5300 3500 0000 00000100")
    ).hex(" ", 4)
    assert ptpip.init_fail(2) == bytes.fromhex("0c000000 05000000 02000000")
    assert packet(Kind.INIT_EVENT_ACK) == bytes.fromhex("08000000 04000000")
    assert response(0x2001, 9, (5,)) == bytes.fromhex("12000000 07000000 0120 09000000 05000000")
    assert response(0xC009, ptpip.NO_TRANSACTION, (6,), Kind.EVENT) == bytes.fromhex(
        "12000000 08000000 09c0 ffffffff 06000000"
    )
    assert b"".join(data_phase(4, b"abc")) == bytes.fromhex(
        "14000000 09000000 04000000 0300000000000000  0f000000 0c000000 04000000 616263"
    )
    assert b"".join(data_phase(4, b"")) == bytes.fromhex(
        "14000000 09000000 04000000 0000000000000000  0c000000 0c000000 04000000"
    )


@pytest.mark.parametrize("length", [65536, 65537, 131072])
def test_a_long_data_phase(length):
    data = random.Random(length).randbytes(length)
    start, *pieces = split(data_phase(4, data))
    assert start == (Kind.START_DATA, struct.pack("<IQ", 4, length))
    assert b"".join(body[4:] for _, body in pieces) == data
    assert len(pieces) == -(-length // 65536)
    assert [kind for kind, _ in pieces] == [Kind.DATA] * (len(pieces) - 1) + [Kind.END_DATA]


@pytest.mark.parametrize(
    ("kind", "value", "coded"),
    [
        (ptpip.UINT8, 200, "c8"),
        (ptpip.UINT16, 0xD02A, "2ad0"),
        (ptpip.UINT32, 524288, "00000800"),
        (ptpip.STRING, "S5", "03 5300 3500 0000"),
        (ptpip.STRING, "", "00"),
        (ptpip.ARRAY | ptpip.UINT32, (119, 0), "02000000 77000000 00000000"),
        (ptpip.ARRAY | ptpip.UINT8, (), "00000000"),
        (ptpip.ARRAY | ptpip.UINT16, (2, 3), "02000000 0200 0300"),
    ],
)
def test_values(kind, value, coded):
    coded = bytes.fromhex(coded)
    assert ptpip.encode(kind, value) == coded
    assert ptpip.decode(kind, coded) == value
    for wrong in (coded[:-1], coded + b"\0"):
        with pytest.raises(PtpError):
            ptpip.decode(kind, wrong)


def test_descriptions_of_properties():
    # code, type UINT16, writable, default 0, now 64, a range: 0 to 134 by 1
    zoom = Property(0xD02A, ptpip.UINT16, 0, True, range(135))
    assert zoom.describe(64) == bytes.fromhex("2ad0 0400 01 0000 4000 01 0000 8600 0100")
    aperture = Property(0xD01D, ptpip.UINT16, 40, False, ())  # a list of nothing
    assert aperture.describe(40) == bytes.fromhex("1dd0 0400 00 2800 2800 02 0000")
    metering = Property(0xD010, ptpip.UINT8, 3, True, (3, 0, 1))
    assert metering.describe(0) == bytes.fromhex("10d0 0200 01 03 00 02 0300 03 00 01")
    assert Property(0xD038, ptpip.UINT16, 27).describe(27) == bytes.fromhex("38d0 0400 00 1b00 1b00 00")
    assert [zoom.allows(value) for value in (-1, 0, 134, 135)] == [False, True, True, False]
    assert [Property(1, ptpip.UINT8, 1, True, range(1, 10, 4)).allows(value) for value in (5, 6)] == [True, False]
    assert [metering.allows(value) for value in (1, 2)] == [True, False]


def test_info_of_a_device():
    lists = (0x1001, 0x1002), (0x4002,), (), (0x3801,), (0x3801,)
    assert ptpip.device_info(0xB, lists, ("C", "S5", "1", "")) == bytes.fromhex(
        "6400 0b000000 6400 00 0000"  # version 1.00, extension 0xB of version 1.00, no words on it, standard mode
        "02000000 0110 0210  01000000 0240  00000000  01000000 0138  01000000 0138"
        "02 4300 0000  03 5300 3500 0000  02 3100 0000  00"
    )


def test_info_of_an_object():
    packed = ptpip.object_info(0x80000001, 4321, (3264, 2448), "A", "20080721T095816")
    assert packed[:52] == struct.pack(
        "<IHHIHIIIIIIIHII", 0x80000001, 0x3801, 0, 4321, 0, 0, 0, 0, 3264, 2448, 24, 0, 0, 0, 0
    )
    date = b"\x10" + "20080721T095816\0".encode("utf-16-le")
    assert packed[52:] == b"\x02A\0\0\0" + date * 2 + b"\0"


class Echo:
    """Answers with what it was asked."""

    def __init__(self):
        self.asked = []

    def operate(self, code, parameters, data):
        self.asked.append((code, parameters, data))
        return PtpReply(data=data) if code == ECHO else PtpReply()

    def disconnected(self):
        self.asked.append("disconnected")


def request(code, transaction, *parameters, sends=False):
    return Kind.REQUEST, struct.pack(f"<IHI{len(parameters)}I", 1 + sends, code, transaction, *parameters)


def start(transaction, total):
    return Kind.START_DATA, struct.pack("<IQ", transaction, total)


def data(transaction, content, last=True):
    return Kind.END_DATA if last else Kind.DATA, struct.pack("<I", transaction) + content


PROBE, CANCEL = (Kind.PROBE_REQUEST, b""), (Kind.CANCEL, struct.pack("<I", 1))
CONVERSATIONS = {  # packets and the answer to each, and what the device was asked
    "an operation": (
        [(request(0x1003, 1, 7), response(Code.OK, 1))],
        [(0x1003, (7, 0, 0, 0, 0), b"")],
    ),
    "data both ways": (
        [
            (request(ECHO, 2, sends=True), b""),
            (start(2, 3), b""),
            (data(2, b"ab", last=False), b""),
            (data(2, b"c"), b"".join(data_phase(2, b"abc")) + response(Code.OK, 2)),
        ],
        [(ECHO, (0,) * 5, b"abc")],
    ),
    "too little data": (
        [
            (request(SET, 2, sends=True), b""),
            (start(2, 3), b""),
            (data(2, b"ab"), response(Code.INCOMPLETE_TRANSFER, 2)),
            (request(0x1001, 3), response(Code.OK, 3)),
        ],
        [(0x1001, (0,) * 5, b"")],
    ),
    "a probe at any time": (
        [(request(1, 1, sends=True), b""), (PROBE, bytes.fromhex("08000000 0e000000")), (CANCEL, b"")],
        [],
    ),
}


@pytest.mark.parametrize(("packets", "asked"), CONVERSATIONS.values(), ids=CONVERSATIONS)
def test_transactions(packets, asked):
    device = Echo()
    session = CommandSession(device)
    for (kind, body), answer in packets:
        assert b"".join(session.receive(kind, body)) == answer
    assert device.asked == asked


@pytest.mark.parametrize(
    "packets",
    [
        [start(1, 0)],
        [data(1, b"")],
        [(Kind.INIT_COMMAND, GUID + bytes(6))],
        [(Kind.INIT_EVENT, bytes(4))],
        [(Kind.RESPONSE, bytes(6))],  # what only a responder sends
        [(0, b"")],
        [(15, b"")],
        [(Kind.REQUEST, bytes(12))],  # parameters of two bytes
        [request(1, 1, *range(6))],
        [(Kind.PROBE_REQUEST, b"\0")],
        [request(1, 1, sends=True), request(1, 2)],
        [request(1, 1, sends=True), data(1, b"")],
        [request(1, 1, sends=True), (Kind.START_DATA, bytes(8))],
        [request(1, 1, sends=True), start(1, 1), start(1, 1)],
    ],
)
def test_packets_malformed_or_out_of_turn(packets):
    session = CommandSession(Echo())
    for kind, body in packets[:-1]:
        assert session.receive(kind, body) == []
    with pytest.raises(PtpError):
        session.receive(*packets[-1])
