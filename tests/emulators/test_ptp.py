"""PTP and PTP/IP as bytes: against bytes worked by hand from CIPA DC-005 and ISO 15740, and against noise."""

import contextlib
import random
import struct
import time

import pytest

from cotarget.emulators import ptpip
from cotarget.emulators import ptpip as ptpip_module
from cotarget.emulators.canon_s5is import OPERATIONS, S5IS_FAULTS, Exposure, S5isCamera
from cotarget.emulators.faults import Faults
from cotarget.emulators.ptpip import (
    Answer,
    Cancel,
    Code,
    CommandSession,
    Data,
    DeviceInfo,
    InitCommand,
    InitEvent,
    ObjectInfo,
    OperationRequest,
    PacketReader,
    Probe,
    Property,
    PtpError,
    Range,
    StartData,
)

GUID = bytes(range(16))
# What libgphoto2 sends when it connects from a machine named "ab", asks for its info and sets the zoom to 105.
CONVERSATION = (
    (bytes.fromhex("22000000 01000000") + GUID + bytes.fromhex("6100 6200 0000 0000 0100"), InitCommand(GUID, "ab")),
    (bytes.fromhex("0c000000 03000000 07000000"), InitEvent(7)),
    (bytes.fromhex("12000000 06000000 01000000 0110 00000000"), OperationRequest(0x1001, 0, ())),
    (bytes.fromhex("16000000 06000000 01000000 0210 01000000 01000000"), OperationRequest(0x1002, 1, (1,))),
    (bytes.fromhex("16000000 06000000 02000000 1610 02000000 2ad00000"), OperationRequest(0x1016, 2, (0xD02A,), True)),
    (bytes.fromhex("14000000 09000000 02000000 0200000000000000"), StartData(2, 2)),
    (bytes.fromhex("0e000000 0c000000 02000000 6900"), Data(2, b"\x69\x00", True)),
    (bytes.fromhex("0d000000 0a000000 02000000 69"), Data(2, b"\x69", False)),
    (bytes.fromhex("0c000000 0b000000 02000000"), Cancel(2)),
    (bytes.fromhex("08000000 0d000000"), Probe()),
    (bytes.fromhex("08000000 0e000000"), Probe(answer=True)),
)
FUZZ_SEED = 5
BATCH = 1000
BATCH_S = 20.0  # a batch takes a tenth of a second; a hang takes for ever


@pytest.mark.parametrize(("sent", "meant"), CONVERSATION, ids=lambda part: getattr(type(part), "__name__", "packet"))
def test_packets_of_an_initiator(sent, meant):
    assert list(PacketReader().feed(sent)) == [meant]


def test_packets_arrive_in_pieces_or_together():
    stream = b"".join(sent for sent, _ in CONVERSATION)
    meant = [packet for _, packet in CONVERSATION]
    assert list(PacketReader().feed(stream)) == meant
    for size in (1, 3, 7, 50):
        reader = PacketReader()
        pieces = (stream[at : at + size] for at in range(0, len(stream), size))
        assert [packet for piece in pieces for packet in reader.feed(piece)] == meant


@pytest.mark.parametrize(
    "sent",
    [
        "07000000 06000000",  # shorter than its own head
        "01001000 06000000",  # longer than 1 MiB
        "08000000 00000000",  # kinds that there are not
        "08000000 0f000000",
        "0c000000 02000000 01000000",  # what only a responder sends
        "0e000000 07000000 0120 00000000",
        "14000000 06000000 01000000 0110 00000000 0000",  # parameters of 2 bytes
        "2a000000 06000000 01000000 0110 00000000" + "00000000" * 6,  # six of them
        "10000000 09000000 02000000 02000000",  # a length of 4 bytes
        "0a000000 0c000000 0200",  # data without its transaction
        "09000000 0d000000 00",
        "18000000 01000000" + "00" * 16,  # no name, no version
    ],
)
def test_what_is_no_packet_of_an_initiator(sent):
    with pytest.raises(PtpError, match="PTP/IP"):
        list(PacketReader().feed(bytes.fromhex(sent)))


def test_packets_of_a_responder():
    assert ptpip.init_command_ack(3, GUID, "S5").hex(" ", 4) == (
        bytes.fromhex("26000000 02000000 03000000") + GUID + bytes.fromhex("5300 3500 0000 00000100")
    ).hex(" ", 4)
    assert ptpip.init_fail(2) == bytes.fromhex("0c000000 05000000 02000000")
    assert ptpip.packet(ptpip.Kind.INIT_EVENT_ACK) == bytes.fromhex("08000000 04000000")
    assert ptpip.response(0x2001, 9, (5,)) == bytes.fromhex("12000000 07000000 0120 09000000 05000000")
    assert ptpip.event(0xC009, (6,)) == bytes.fromhex("12000000 08000000 09c0 ffffffff 06000000")


def test_a_data_phase():
    assert b"".join(ptpip.data_phase(4, b"abc")) == bytes.fromhex(
        "14000000 09000000 04000000 0300000000000000  0f000000 0c000000 04000000 616263"
    )
    assert b"".join(ptpip.data_phase(4, b"")) == bytes.fromhex(
        "14000000 09000000 04000000 0000000000000000  0c000000 0c000000 04000000"
    )


@pytest.mark.parametrize("length", [65535, 65536, 65537, 131072, 200000])
def test_a_long_data_phase(length):
    data = random.Random(length).randbytes(length)
    start, *pieces = PacketReader().feed(b"".join(ptpip.data_phase(4, data)))
    assert start == StartData(4, length)
    assert b"".join(piece.data for piece in pieces) == data
    assert len(pieces) == -(-length // 65536)
    assert [piece.last for piece in pieces] == [False] * (len(pieces) - 1) + [True]


@pytest.mark.parametrize(
    ("kind", "value", "coded"),
    [
        (ptpip_module.UINT8, 200, "c8"),
        (ptpip_module.INT8, -2, "fe"),
        (ptpip_module.UINT16, 0xD02A, "2ad0"),
        (ptpip_module.INT16, -2, "feff"),
        (ptpip_module.UINT32, 524288, "00000800"),
        (ptpip_module.UINT64, 1, "0100000000000000"),
        (ptpip_module.STRING, "S5", "03 5300 3500 0000"),
        (ptpip_module.STRING, "", "00"),
        (ptpip_module.ARRAY | ptpip_module.UINT32, (119, 0), "02000000 77000000 00000000"),
        (ptpip_module.ARRAY | ptpip_module.UINT8, (), "00000000"),
        (ptpip_module.ARRAY | ptpip_module.INT16, (-2, 3), "02000000 feff 0300"),
    ],
)
def test_values(kind, value, coded):
    coded = bytes.fromhex(coded)
    assert ptpip_module.encode(kind, value) == coded
    assert ptpip_module.decode(kind, coded) == value
    for wrong in (coded[:-1], coded + b"\0"):
        with pytest.raises(PtpError):
            ptpip_module.decode(kind, wrong)


def test_a_type_that_there_is_not():
    with pytest.raises(PtpError, match="0x000b"):
        ptpip_module.decode(11, b"\0")


def test_descriptions_of_properties():
    # code, type UINT16, writable, default 0, now 64, range, 0 to 134 by 1
    zoom = Property(0xD02A, ptpip_module.UINT16, 0, True, Range(0, 134))
    assert zoom.describe(64) == bytes.fromhex("2ad0 0400 01 0000 4000 01 0000 8600 0100")
    aperture = Property(0xD01D, ptpip_module.UINT16, 40, False, ())  # a list of nothing
    assert aperture.describe(40) == bytes.fromhex("1dd0 0400 00 2800 2800 02 0000")
    metering = Property(0xD010, ptpip_module.UINT8, 3, True, (3, 0, 1))
    assert metering.describe(0) == bytes.fromhex("10d0 0200 01 03 00 02 0300 03 00 01")
    assert Property(0xD038, ptpip_module.UINT16, 27).describe(27) == bytes.fromhex("38d0 0400 00 1b00 1b00 00")
    assert [zoom.allows(value) for value in (-1, 0, 134, 135)] == [False, True, True, False]
    assert [Property(1, ptpip_module.UINT8, 1, True, Range(1, 9, 4)).allows(value) for value in (5, 6)] == [True, False]
    assert [metering.allows(value) for value in (1, 2)] == [True, False]


def test_info_of_a_device():
    info = DeviceInfo(0xB, (0x1001, 0x1002), (0x4002,), (), (0x3801,), "C", "S5", "1", "")
    assert info.pack() == bytes.fromhex(
        "6400 0b000000 6400 00 0000"  # version 1.00, extension 0xB of version 1.00, no words on it, standard mode
        "02000000 0110 0210  01000000 0240  00000000  01000000 0138  01000000 0138"
        "02 4300 0000  03 5300 3500 0000  02 3100 0000  00"
    )


def test_info_of_an_object():
    packed = ObjectInfo(0x80000001, 4321, (3264, 2448), 99, (160, 120), "A", "20080721T095816").pack()
    assert packed[:52] == struct.pack(
        "<IHHIHIIIIIIIHII", 0x80000001, 0x3801, 0, 4321, 0x3801, 99, 160, 120, 3264, 2448, 24, 0, 0, 0, 0
    )
    date = b"\x10" + "20080721T095816\0".encode("utf-16-le")
    assert packed[52:] == b"\x02A\0\0\0" + date * 2 + b"\0"


class Echo:
    """Answers with what it was asked."""

    def __init__(self):
        self.asked = []

    def operate(self, code, parameters, data):
        self.asked.append((code, parameters, data))
        return Answer(data=data) if code == 0x9999 else Answer()

    def disconnected(self):
        self.asked.append("disconnected")


def test_transactions():
    device = Echo()
    session = CommandSession(device)
    assert session.receive(OperationRequest(0x1003, 1, (7,))) == [ptpip.response(Code.OK, 1)]
    assert session.receive(OperationRequest(0x9999, 2, (), True)) == []
    assert session.receive(StartData(2, 3)) == []
    assert session.receive(Data(2, b"ab", False)) == []
    assert b"".join(session.receive(Data(2, b"c", True))) == b"".join(ptpip.data_phase(2, b"abc")) + ptpip.response(
        Code.OK, 2
    )
    assert device.asked == [(0x1003, (7, 0, 0, 0, 0), b""), (0x9999, (0, 0, 0, 0, 0), b"abc")]


def test_data_that_is_too_little():
    device = Echo()
    session = CommandSession(device)
    for packet in (OperationRequest(0x1016, 2, (), True), StartData(2, 3)):
        session.receive(packet)
    assert session.receive(Data(2, b"ab", True)) == [ptpip.response(Code.INCOMPLETE_TRANSFER, 2)]
    assert device.asked == []
    assert session.receive(OperationRequest(0x1001, 3, ())) == [ptpip.response(Code.OK, 3)]


@pytest.mark.parametrize(
    "packets",
    [
        [StartData(1, 0)],
        [Data(1, b"", True)],
        [InitCommand(GUID, "")],
        [InitEvent(1)],
        [OperationRequest(1, 1, (), True), OperationRequest(1, 2, ())],
        [OperationRequest(1, 1, (), True), Data(1, b"", True)],
        [OperationRequest(1, 1, (), True), StartData(2, 0)],
        [OperationRequest(1, 1, (), True), StartData(1, 1), StartData(1, 1)],
        [OperationRequest(1, 1, (), True), StartData(1, 1), Data(1, b"ab", True)],
        [OperationRequest(1, 1, (), True), StartData(1, 1), Data(2, b"a", True)],
        [OperationRequest(1, 1, (), True), StartData(1, 1 << 40)],
    ],
)
def test_packets_out_of_turn(packets):
    session = CommandSession(Echo())
    for packet in packets[:-1]:
        assert session.receive(packet) == []
    with pytest.raises(PtpError):
        session.receive(packets[-1])


def test_a_probe_is_answered_at_any_time_and_a_cancel_ignored():
    session = CommandSession(Echo())
    session.receive(OperationRequest(1, 1, (), True))
    assert session.receive(Probe()) == [bytes.fromhex("08000000 0e000000")]
    assert session.receive(Cancel(1)) == []


def test_the_deaf_do_and_answer_nothing():
    device = Echo()
    assert CommandSession(device, lambda: True).receive(OperationRequest(0x1001, 1, ())) == []
    assert device.asked == []


class Blind:
    """Viewfinder and shutter that need no time."""

    on = False

    def switch(self, on):
        self.on = on

    def image(self):
        return b"jpeg" if self.on else None

    def release(self, done):
        done(Exposure(b"JPEG", (4, 3), b"jpg"))


class Lens:
    last = 128

    def __init__(self):
        self.commanded = 0

    def command(self, position):
        assert 0 <= position <= self.last
        self.commanded = position

    def position(self):
        return self.commanded

    def moving(self):
        return False


def request(rng):
    """Bytes of an operation with, mostly, sensible numbers, and its data."""
    number = rng.randrange(4)
    code = rng.choice(OPERATIONS) if rng.random() < 0.9 else rng.randrange(1 << 16)
    words = [rng.choice((0, 1, 0xD02A, 0xD045, 0xD006, 0xD402, 0x81000001, rng.getrandbits(32))) for _ in range(5)]
    data = rng.randbytes(rng.choice((0, 1, 2, 2, 4, 8)))
    count, sends = rng.randrange(6), rng.random() < 0.5 or code == 0x1016
    body = struct.pack(f"<IHI{count}I", 1 + sends, code, number, *words[:count])
    sent = ptpip.packet(6, body)
    return sent + b"".join(ptpip.data_phase(number, data)) if sends else sent


def mutated(rng, sent):
    """Bytes with some of them changed, lost, doubled, or put in."""
    sent = bytearray(sent)
    for _ in range(rng.choice((0, 1, 1, 2, 5))):
        at = rng.randrange(len(sent)) if sent else 0
        match rng.randrange(5):
            case 0 if sent:
                sent[at] = rng.getrandbits(8)
            case 1 if sent:
                sent[at] ^= 1 << rng.randrange(8)
            case 2:
                del sent[at : at + rng.randrange(1, 9)]
            case 3:
                sent[at:at] = rng.randbytes(rng.randrange(1, 9))
            case 4:
                sent[at:at] = sent[at : at + rng.randrange(1, 40)]
    return bytes(sent)


def fuzz(count):
    """Feed strings of bytes to parser, session and camera; only PtpError may come out, and whole packets."""
    rng = random.Random(FUZZ_SEED)
    camera = S5isCamera(Blind(), Blind(), Lens(), Faults(S5IS_FAULTS))
    refused = answered = 0
    for batch in range(count // BATCH):
        began = time.monotonic()
        for at in range(BATCH):
            # Mostly in a session, and shooting: what lies behind the first refusal is to be met as well.
            if at % 50 == 0:
                camera.disconnected()
                camera.operate(0x1002, (1, 0, 0, 0, 0), b"")
                if batch % 2:
                    camera.operate(0x9008, (0, 0, 0, 0, 0), b"")
            if rng.random() < 0.1:
                sent = rng.randbytes(rng.randrange(80))
            else:
                sent = mutated(rng, b"".join(request(rng) for _ in range(rng.choice((1, 1, 3)))))
            reader, session = PacketReader(), CommandSession(camera)
            try:
                for packet in reader.feed(sent):
                    answer = b"".join(session.receive(packet))
                    answered += answer != b""
                    whole(answer)
            except PtpError:
                refused += 1
            kind = rng.choice((*range(12), *(0x4000 | kind for kind in range(12)), 0xFFFF, rng.getrandbits(16)))
            with contextlib.suppress(PtpError):
                ptpip_module.encode(kind, ptpip_module.decode(kind, sent[: rng.randrange(20)]))
        assert time.monotonic() - began < BATCH_S
    assert refused > 0.2 * count  # both happen often, or the noise was of the wrong sort
    assert answered > 0.3 * count


def whole(answer):
    """Check that bytes are packets, one after the other."""
    at = 0
    while at < len(answer):
        length, kind = struct.unpack_from("<II", answer, at)
        assert length >= 8
        assert kind in (7, 9, 10, 12, 14)
        at += length
    assert at == len(answer)


def test_noise_is_refused_and_nothing_else_happens():
    fuzz(50_000)


@pytest.mark.slow
def test_much_noise():
    fuzz(1_000_000)
