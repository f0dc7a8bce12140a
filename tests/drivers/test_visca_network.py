"""The VISCA driver on a network that loses, delays and adds messages."""

import contextlib
import math
import select
import socket
import threading

import pytest

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.head_link import DroppedError, Halt, Requests
from cotarget.drivers.link_errors import RefusedError, SilentError
from cotarget.drivers.visca import ViscaLink
from cotarget.drivers.visca_protocol import STOP
from tests.support.plants import LiveDome, wait_for

pytestmark = pytest.mark.wire
GOAL, SPEEDS = (-2160, 0), (115.0, 115.0)  # counts, and counts/s: 150 degrees at 8 degrees/s take 19 s
PATIENCE_S = 5.0  # for a stop, on a busy machine
LARGEST = 4096  # bytes
CHECK_S = 0.05  # period of looking for the end of the relay
HEADER, CAMERA_SAYS = 8, 0x90  # bytes of Sony's header; the first byte without it


class Relay:
    """A network between driver and camera, by UDP; a context manager.

    Attributes:
        port: of the camera, as the driver sees it.
        to_camera: takes what the driver sends; returns what the camera gets, in datagrams.
        to_driver: the same the other way.
    """

    def __init__(self, port):
        self.to_camera = self.to_driver = lambda data: [data]
        self._camera = ("127.0.0.1", port)
        self._ours, self._theirs = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._ours.bind(("127.0.0.1", 0))
        self._theirs.bind(("127.0.0.1", 0))
        self.port = self._ours.getsockname()[1]
        self._driver, self._ended = None, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()
        self._ours.close()
        self._theirs.close()

    def answer(self, data):
        """Send the driver something of its own."""
        self._ours.sendto(data, self._driver)

    def _run(self):
        while not self._ended.is_set():
            for source in select.select([self._ours, self._theirs], [], [], CHECK_S)[0]:
                data, sender = source.recvfrom(LARGEST)
                if source is self._ours:
                    self._driver = sender
                    for each in self.to_camera(data):
                        self._theirs.sendto(each, self._camera)
                else:
                    for each in self.to_driver(data):
                        self.answer(each)


@contextlib.contextmanager
def linked(protocol="sony", fault=None):
    """A camera, the network before it, and the link of the driver."""
    live = LiveDome(protocol=protocol)
    with live:
        if fault:
            live.faults.set(fault)
        with Relay(live.settings().port) as relay:
            link = ViscaLink(live.settings(port=relay.port), MonotonicClock())
            with contextlib.closing(link):
                link.poll(Requests())  # pan and tilt, which say how wide positions are
                yield live, relay, link


def turning(live, link):
    link.move(GOAL, SPEEDS, Requests())
    wait_for(live.turning)


def assert_halts(live, link):
    """When a halt has returned, the head brakes."""
    link.halt(PATIENCE_S)
    wait_for(lambda: not live.turning())
    assert live.at()[0] > GOAL[0] / 2


def lost(count, loses):
    """What loses the first messages for which a condition is true."""
    left = [count]

    def carry(data):
        if left[0] and loses(data):
            left[0] -= 1
            return []
        return [data]

    return carry


# Numbers of messages


def test_a_refused_number_of_a_repeated_stop_is_no_receipt():
    """The line is cut for so long that a reset of the camera's counter is lost, and then the first stop."""
    with linked() as (live, relay, link):
        for _ in range(3):  # its counter is far beyond 1
            link.poll(Requests())
        turning(live, link)
        relay.to_camera = lambda data: []
        with pytest.raises(SilentError):
            link.poll(Requests())
        relay.to_camera = lost(1, lambda data: data.endswith(STOP))
        assert_halts(live, link)


def test_a_late_refusal_of_an_earlier_number_is_no_receipt_of_a_stop():
    """The first two stops are lost; then the camera refuses the number of an earlier message."""
    with linked() as (live, relay, link):
        turning(live, link)
        stops = []

        def carry(data):
            if not data.endswith(STOP) or len(stops) == 2:
                return [data]
            stops.append(data)
            if len(stops) == 2:
                relay.answer(bytes.fromhex("02 01 00 02 00 00 00 02 0F 01"))
            return []

        relay.to_camera = carry
        assert_halts(live, link)


@pytest.mark.parametrize(("protocol", "fault"), [("udp", None), ("sony", "constant-number")])
def test_a_late_acknowledgement_of_a_move_is_none_of_the_stop(protocol, fault):
    """A halt interrupts a move; the stop is lost, and only then comes the acknowledgement of the move."""
    with linked(protocol, fault) as (live, relay, link):
        held = []
        relay.to_driver = lambda data: held.append(data) or []
        requests = Requests()
        requests.add(requests.halts, Halt(1))
        with pytest.raises(DroppedError):
            link.move(GOAL, SPEEDS, requests)
        wait_for(live.turning)
        wait_for(lambda: held)

        def carry(data):
            if not (data.endswith(STOP) and held):
                return [data]
            relay.to_driver = lambda data: [data]
            while held:
                relay.answer(held.pop(0))
            return []

        relay.to_camera = carry
        assert_halts(live, link)


# Errors


def with_header(like, payload):
    """An answer with the header of another answer, if it has one."""
    if like[0] == CAMERA_SAYS:
        return payload
    return like[:2] + len(payload).to_bytes(2, "big") + like[4:HEADER] + payload


@pytest.mark.parametrize("protocol", ["sony", "udp"])
def test_an_error_of_a_move_is_none_of_the_inquiry_during_which_it_comes(protocol):
    with linked(protocol) as (live, relay, link):
        live.pan.command(100, 1e6, math.inf)
        wait_for(lambda: not live.turning())
        relay.to_driver = lambda data: [with_header(data, bytes.fromhex("90 61 41 FF")), data]
        pan, *_ = link.poll(Requests())
        assert pan.position == 100


@pytest.mark.parametrize("protocol", ["sony", "udp"])
@pytest.mark.parametrize("code", ["03", "41"])
def test_an_inquiry_that_is_refused_for_now_is_asked_again(protocol, code):
    with linked(protocol) as (live, relay, link):
        live.pan.command(100, 1e6, math.inf)
        wait_for(lambda: not live.turning())
        refusals = iter([bytes.fromhex(f"90 60 {code} FF")] * 2)

        def refuse(data):
            refusal = next(refusals, None)
            return [with_header(data, refusal) if refusal else data]

        relay.to_driver = refuse
        pan, *_ = link.poll(Requests())
        assert pan.position == 100


def test_an_inquiry_that_is_refused_again_and_again_is_an_error():
    with linked() as (_, relay, link):
        relay.to_driver = lambda data: [with_header(data, bytes.fromhex("90 60 41 FF"))]
        with pytest.raises(RefusedError, match="it cannot do that now"):
            link.poll(Requests())
