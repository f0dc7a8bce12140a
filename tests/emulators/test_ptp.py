"""PTP and PTP/IP as bytes: against bytes worked by hand from CIPA DC-005 and ISO 15740, and against noise."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cotarget.emulators import ptpip
from cotarget.emulators.ptpip import Code, CommandSession, Kind, PtpError, PtpReply, data_phase, packet, response, split

PROPERTY = settings(derandomize=True, database=None, deadline=None, max_examples=500)
GUID = bytes(range(16))
SET, ECHO = 0x1016, 0x9999  # operations


@given(st.lists(st.tuples(st.integers(0, 20), st.binary(max_size=80)), max_size=6), st.integers(1, 60))
@PROPERTY
def test_packets_arrive_in_pieces_or_together(packets, size):
    stream = b"".join(packet(kind, body) for kind, body in packets)
    assert list(split(stream[at : at + size] for at in range(0, len(stream), size))) == packets


@pytest.mark.parametrize("sent", ["07000000 06000000", "01001000 06000000"])  # shorter than its header; above 1 MiB
def test_a_packet_of_an_impossible_length_is_refused(sent):
    with pytest.raises(PtpError):
        list(split([bytes.fromhex(sent)]))


@pytest.mark.parametrize(("kind", "value", "coded"), [
    (ptpip.UINT8, 200, "c8"), (ptpip.UINT16, 0xD02A, "2ad0"), (ptpip.UINT32, 524288, "00000800"),
    (ptpip.STRING, "S5", "03 5300 3500 0000"), (ptpip.STRING, "", "00"),
    (ptpip.ARRAY | ptpip.UINT32, (119, 0), "02000000 77000000 00000000"), (ptpip.ARRAY | ptpip.UINT8, (), "00000000"),
    (ptpip.ARRAY | ptpip.UINT16, (2, 3), "02000000 0200 0300"),
])  # fmt: skip
def test_values(kind, value, coded):
    coded = bytes.fromhex(coded)
    assert ptpip.encode(kind, value) == coded
    assert ptpip.decode(kind, coded) == value
    for wrong in (coded[:-1], coded + b"\0"):
        with pytest.raises(PtpError):
            ptpip.decode(kind, wrong)


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
    "an operation": ([(request(0x1003, 1, 7), response(Code.OK, 1))], [(0x1003, (7, 0, 0, 0, 0), b"")]),
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
