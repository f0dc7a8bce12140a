"""The emulated PowerShot S5 IS: PTP/IP as bytes, its answers, on images and a lens made here, and its faults."""

import contextlib
import socket
import struct
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cotarget.emulators import canon_s5is, ptpip
from cotarget.emulators.canon_s5is import S5IS_FAULTS, S5isCamera, S5isServer, Shutter, Viewfinder
from cotarget.emulators.plant import Feed
from cotarget.emulators.ptpip import Code, CommandSession, Kind, PtpError, PtpReply, data_phase, packet, response, split
from cotarget.emulators.serve import Faults
from tests.support.emulated_camera import DEADLINE_S, LensModel, plain, publish
from tests.support.plants import decoded, wait_for

OK, BUSY = 0x2001, 0x2019
ZOOM, EVENT_MODE = 0xD02A, 0xD045
REPLY_S = 2.5  # that libgphoto2 waits for an answer
GREY = 2.0  # grey levels by which JPEG may change an even picture
SIZE = (64, 48)  # of the pictures of the viewfinder's feed


def show(feed, grey, index=0, t=None):
    publish(feed, index, plain(SIZE, grey), t)


class Bench:
    """The camera without a wire, in an open session."""

    def __init__(self, still=None, lens=None, shooting=True, shutter_s=0.0):
        self.preview, self.lens, self.faults = Feed(), lens or LensModel(), Faults(S5IS_FAULTS)
        self.shutter = Shutter(still or (lambda: plain(SIZE, 50)), 95, shutter_s)
        self.interrupted = []
        viewfinder = Viewfinder(self.preview, (32, 24), 95)
        self.camera = S5isCamera(
            viewfinder, self.shutter, self.lens, self.faults, lambda *event: self.interrupted.append(event)
        )
        self.ask(0x1002, 1)
        if shooting:
            self.ask(0x9008)
            self.events()

    def answer(self, code, *parameters, data=b""):
        return self.camera.operate(code, (*parameters, 0, 0, 0, 0, 0)[:5], data)

    def ask(self, code, *parameters, data=b""):
        found = self.answer(code, *parameters, data=data)
        assert found.code == OK
        return found.data

    def code(self, code, *parameters, data=b""):
        return self.answer(code, *parameters, data=data).code

    def set(self, prop, value):
        return self.code(0x1016, prop, data=struct.pack("<H", value))

    def get(self, prop):
        return struct.unpack("<H", self.ask(0x1015, prop))[0]

    def events(self):
        """All events that CheckEvent returns, as (code, parameters)."""
        found = []
        while data := self.ask(0x9013):
            length, kind, code, _ = struct.unpack_from("<IHHI", data)
            assert (length, kind) == (len(data), 4)  # an event container of PTP over USB
            found.append((code, struct.unpack(f"<{(length - 12) // 4}I", data[12:])))
        return found

    def events_when(self, count):
        deadline, found = time.monotonic() + DEADLINE_S, []
        while len(found) < count:
            assert time.monotonic() < deadline
            found += self.events()
        return found

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.shutter.close()


def get(prop):
    return 0x1015, (prop,), b""


def put(prop, value):
    return 0x1016, (prop,), value if isinstance(value, bytes) else struct.pack("<H", value)


def do(code, *words):
    return code, words, b""


# Each: whether the camera shoots; operations with their response codes; what the lens was commanded.
OPERATIONS = {
    "play mode has no zoom": (
        False,
        [(do(0x1014, ZOOM), 0x200A), (get(ZOOM), 0x200A), (put(ZOOM, 5), 0x200A)]
        + [(do(code), 0xA005) for code in (0x900B, 0x900C, 0x901A, 0x901D)],
        [],
    ),
    "modes are entered once": (
        False,
        [(do(0x9009), 0xA009), (do(0x9008), OK), (do(0x9008), 0xA009), (do(0x9009), OK), (get(ZOOM), 0x200A)],
        [],
    ),
    "digital zoom leaves the lens at its end": (
        True,
        [(put(ZOOM, n), OK) for n in (0, 1, 105, 128, 129, 134)],
        [0, 1, 105, 128, 128, 128],
    ),
    "values that cannot be": (
        True,
        [
            *((put(ZOOM, n), 0x201C) for n in (135, 0xFFFF)),
            (put(EVENT_MODE, 8), 0x201C),
            *((put(ZOOM, data), 0x201B) for data in (b"\x05", b"\x05\0\0")),
            (put(0xD03D, 5), 0x200F),
            (put(0xDEAD, 5), 0x200A),
        ],
        [],
    ),
    "sessions": (
        True,
        [
            (do(0x1002, 2), 0x201E),
            (do(0x1003), OK),
            (do(0x1003), 0x2003),
            (get(ZOOM), 0x2003),
            (do(0x1001), OK),  # needs no session
            (do(0x1002, 0), 0x201D),
            (do(0x1002, 5), OK),
            (do(0x9008), 0xA009),  # it went on shooting
        ],
        [],
    ),
    "what it cannot do": (True, [(do(code), 0x2005) for code in (0x1017, 0x9801, 0x7777)], []),
}


@pytest.mark.parametrize(("shooting", "operations", "commands"), OPERATIONS.values(), ids=OPERATIONS)
def test_operations(shooting, operations, commands):
    with Bench(shooting=shooting) as bench:
        for (code, words, data), response in operations:
            assert bench.code(code, *words, data=data) == response, (hex(code), words, data)
        assert bench.lens.commands == commands


@pytest.mark.parametrize(
    ("mode", "interrupts", "checked"), [(1, 1, 0), (2, 1, 0), (3, 1, 1), (4, 1, 1), (5, 1, 1), (6, 0, 0), (7, 0, 1)]
)
def test_events_are_sent_or_fetched_by_mode(mode, interrupts, checked):
    with Bench(shooting=False) as bench:
        bench.set(EVENT_MODE, mode)
        bench.ask(0x9008)
        assert bench.interrupted == [(0xC00C, ())] * interrupts
        assert bench.events() == [(0xC00C, ())] * checked


def test_the_viewfinder_gives_each_picture_once(monkeypatch):
    monkeypatch.setattr(canon_s5is, "PICTURE_WAIT_S", 0.05)
    with Bench() as bench:
        assert bench.code(0x901D) == BUSY  # it is off
        show(bench.preview, 10, 0)
        bench.ask(0x900B)
        assert bench.code(0x901D) == BUSY  # that one was before it was on
        show(bench.preview, 20, 1)
        show(bench.preview, 30, 2)
        np.testing.assert_allclose(decoded(bench.ask(0x901D)), 30, atol=GREY)
        bench.ask(0x900B)  # on already
        assert bench.code(0x901D) == BUSY
        show(bench.preview, 40, 3)
        np.testing.assert_allclose(decoded(bench.ask(0x901D)), 40, atol=GREY)


def half_red(size):
    image = plain(size, 0)
    image[:, : size[0] // 2] = (0, 0, 255)
    return image


def test_a_still():
    with Bench(still=lambda: half_red((640, 480))) as bench:
        bench.set(EVENT_MODE, 7)
        bench.ask(0x901A)
        (transfer, (handle,)), complete = bench.events_when(2)
        assert (transfer, complete) == (0xC009, (0x400D, ()))
        info, jpeg = bench.ask(0x1008, handle), bench.ask(0x1009, handle)
        storage, kind, _, length = struct.unpack_from("<IHHI", info)
        assert (storage, kind, length) == (0x80000001, 0x3801, len(jpeg))
        assert struct.unpack_from("<II", info, 26) == (640, 480)
        assert struct.unpack_from("<I", info, 38) == (0,)  # in no folder
        np.testing.assert_allclose(decoded(jpeg)[240, 100], (0, 0, 255), atol=5)
        assert bench.code(0x1009, handle + 1) == bench.code(0x1008, 0) == 0x2009
        bench.ask(0x901A)
        (_, (later,)), _ = bench.events_when(2)
        assert [bench.code(0x1009, each) for each in (handle, later)] == [0x2009, OK]  # it takes the first one's place


# On the wire: what libgphoto2 does not show in the tests of its driver
@pytest.fixture
def server():
    """An emulated camera with its lens as an attribute; no thread may be left of it."""
    before, lens = set(threading.enumerate()), LensModel()
    with S5isServer(Feed(), lambda: half_red((640, 480)), lens, shutter_s=0.0) as server:
        server.lens = lens
        yield server
    assert set(threading.enumerate()) <= before


class Line:
    """A connection of an initiator, on which the first bytes have been sent; a context manager."""

    def __init__(self, port, first):
        self.socket = socket.create_connection(("127.0.0.1", port), DEADLINE_S)
        self.socket.sendall(first)
        self._stream = self.socket.makefile("rb")

    def packet(self):
        """Kind and body of the next packet."""
        length, kind = struct.unpack("<II", self._stream.read(8))
        return kind, self._stream.read(length - 8)

    def ends(self):
        """Whether the other side has closed, after whatever it sent."""
        with contextlib.suppress(ConnectionError):
            self._stream.read()
        return True

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stream.close()
        self.socket.close()


INIT_COMMAND = bytes.fromhex("20000000 01000000") + bytes(16) + bytes.fromhex("6100 0000 0000 0100")


class Initiator(Line):
    """A command connection in an open session."""

    def __init__(self, port):
        super().__init__(port, INIT_COMMAND)
        kind, body = self.packet()
        assert kind == 2, f"refused: {kind}"
        self.number = struct.unpack_from("<I", body)[0]
        self._transaction = 0
        assert self.ask(0x1002, 1)[0] == OK

    def request(self, code, *parameters, data=None):
        self._transaction += 1
        phase = 1 if data is None else 2
        body = struct.pack(f"<IHI{len(parameters)}I", phase, code, self._transaction, *parameters)
        self.socket.sendall(struct.pack("<II", 8 + len(body), 6) + body)
        if data is not None:
            self.socket.sendall(struct.pack("<IIIQ", 20, 9, self._transaction, len(data)))
            self.socket.sendall(struct.pack("<III", 12 + len(data), 12, self._transaction) + data)

    def ask(self, code, *parameters, data=None):
        """(response code, data)."""
        self.request(code, *parameters, data=data)
        answer = b""
        while (packet := self.packet())[0] != 7:
            answer += packet[1][4:] if packet[0] in (10, 12) else b""
        assert struct.unpack_from("<I", packet[1], 2)[0] == self._transaction
        return struct.unpack_from("<H", packet[1])[0], answer

    def shoot(self, mode=7):
        assert self.ask(0x1016, EVENT_MODE, data=bytes([mode, 0]))[0] == OK
        assert self.ask(0x9008)[0] in (OK, 0xA009)

    def zoom(self, position):
        return self.ask(0x1016, ZOOM, data=struct.pack("<H", position))[0]


def listen_to(port, number):
    return Line(port, struct.pack("<III", 12, 3, number))


def listens(port):
    with contextlib.suppress(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), DEADLINE_S).close()
        return True
    return False


@pytest.mark.wire
def test_a_still_interrupts_on_the_event_connection(server):
    with Initiator(server.port) as camera, listen_to(server.port, camera.number) as events:
        assert events.packet() == (4, b"")
        events.socket.sendall(bytes.fromhex("08000000 0d000000"))
        assert events.packet() == (14, b"")
        camera.shoot(mode=1)
        assert events.packet()[1][:2] == b"\x0c\xc0"
        assert camera.ask(0x901A)[0] == OK
        kind, body = events.packet()
        code, _, handle = struct.unpack("<HII", body)
        assert (kind, code) == (8, 0xC009)
        assert events.packet()[1][:2] == b"\x0d\x40"
        assert decoded(camera.ask(0x1009, handle)[1]).shape == (480, 640, 3)
        with listen_to(server.port, camera.number + 1) as stranger:
            assert stranger.packet() == (5, struct.pack("<I", 1))
            assert stranger.ends()


@pytest.mark.wire
def test_faults_of_the_line(server):
    with Initiator(server.port) as camera:
        camera.shoot()
        server.faults.set("slow")
        began = time.monotonic()
        assert camera.zoom(6) == OK
        assert time.monotonic() - began >= ptpip.SLOW_S
        assert ptpip.SLOW_S < REPLY_S / 2
        server.faults.set("slow", False)
        server.faults.set("hung")
        camera.request(0x1016, ZOOM, data=b"\x05\0")
        camera.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            camera.socket.recv(1)
        camera.socket.settimeout(DEADLINE_S)
        server.faults.set("hung", False)
        assert camera.zoom(7) == OK
        assert server.lens.commands == [6, 7]
        server.faults.set("cut")
        assert camera.zoom(8) == OK  # brings no data
        camera.request(0x1001)
        assert camera.packet()[0] == 9
        assert camera.ends()
    with Initiator(server.port) as camera:
        assert camera.ask(0x1001)[0] == OK  # it happens once


@pytest.mark.wire
@pytest.mark.parametrize(("fault", "zoom"), [("gone", 60), ("power-off", 0)])
def test_an_absent_camera_comes_back_in_play_mode(server, fault, zoom):
    """A camera that switches itself off retracts its lens, too."""
    with Initiator(server.port) as camera, listen_to(server.port, camera.number) as events:
        assert events.packet() == (4, b"")
        camera.shoot()
        assert camera.zoom(60) == OK
        server.faults.set(fault)
        assert camera.ends()
        assert events.ends()
    assert not listens(server.port)
    assert server.lens.position() == zoom
    server.faults.set(fault, False)
    wait_for(lambda: listens(server.port))
    with Initiator(server.port) as camera:
        assert camera.ask(0x1015, ZOOM)[0] == 0x200A
        camera.shoot()
        assert camera.ask(0x1015, ZOOM) == (OK, struct.pack("<H", zoom))


PROPERTY = settings(derandomize=True, database=None, deadline=None, max_examples=200)
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
