"""A device is stopped when the program that moves it is killed: programs in real time, and SIGKILL."""

import dataclasses
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import time
from urllib.request import parse_http_list, parse_keqv_list

import httpx
import pytest

from cotarget.drivers.guardian import Guardian, sign
from cotarget.drivers.onvif import OnvifLink
from cotarget.drivers.visca import ViscaLink
from cotarget.emulators.authentication import Authenticator
from tests.support.onvif_dome import OnvifUnit
from tests.support.plants import LiveDome, wait_for

pytestmark = pytest.mark.wire
STOPS_S = 0.5  # from the kill to the stop on the wire
BRAKES_S = 0.4  # of the emulated domes, from the highest speed, and the test's own thread
QUIET_S = 0.3

# A link is enough to turn a dome; it goes on until its goal, or until its velocities are renewed no more.
PROGRAM = """
import pickle, sys, time
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.head_link import Requests

link, settings, goals, speeds = pickle.loads(sys.stdin.buffer.read())
clock, requests = MonotonicClock(), Requests()
link = link(settings, clock)
link.make_ready()
link.move(goals, speeds, requests)
print("turns", flush=True)
while True:
    link.poll(requests)
    time.sleep(0.02)
"""


def kill_while_it_turns(unit, *task):
    """Run the program until the unit turns, kill it, and return how long the unit turned on [s]."""
    program = subprocess.Popen([sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        program.stdin.write(pickle.dumps(task))
        program.stdin.close()
        assert program.stdout.readline() == b"turns\n"
        wait_for(unit.turning)
    finally:
        program.send_signal(signal.SIGKILL)
        program.wait()
        program.stdout.close()
    begin = time.monotonic()
    wait_for(lambda: not unit.turning())
    return time.monotonic() - begin


@pytest.mark.parametrize("protocol", ["sony", "udp", "tcp"])
def test_a_visca_dome_is_stopped(protocol):
    with LiveDome(protocol=protocol) as unit:
        turned_s = kill_while_it_turns(unit, ViscaLink, unit.settings(), (-2160.0, 300.0), (115.0, 60.0))
        assert turned_s < STOPS_S + BRAKES_S
        assert unit.at()[0] > -2000


@pytest.mark.parametrize("also", [(), ("http-digest",), ("stop-ignored", "clock-20s")])
def test_an_onvif_dome_that_is_steered_is_stopped(also):
    """One that ignores the timeout of velocities, which would turn to the end of its range."""
    with OnvifUnit("continuous-only", "timeout-ignored", *also) as unit:
        turned_s = kill_while_it_turns(unit, OnvifLink, unit.settings, (150.0, 60.0), (10.0, 5.0))
        assert turned_s < STOPS_S + BRAKES_S
        assert unit.pan.degrees() < 100.0


def test_a_steered_onvif_dome_that_takes_each_nonce_once_is_stopped(monkeypatch):
    """What was signed while it turned is refused."""
    allows, challenge, valid = Authenticator.allows, Authenticator.challenge.fget, set()

    def challenge_anew(guard):
        valid.add(nonce := os.urandom(8).hex())
        return challenge(dataclasses.replace(guard, nonce=nonce))

    def allow_once(guard, method, target, headers):
        used = valid.intersection(re.findall(r'\bnonce="(.*?)"', headers.get("Authorization", "")))
        valid.difference_update(used)
        return bool(used) and allows(dataclasses.replace(guard, nonce=used.pop()), method, target, headers)

    monkeypatch.setattr(Authenticator, "challenge", property(challenge_anew))
    monkeypatch.setattr(Authenticator, "allows", allow_once)
    with OnvifUnit("continuous-only", "timeout-ignored", "http-digest") as unit:
        turned_s = kill_while_it_turns(unit, OnvifLink, unit.settings, (150.0, 60.0), (10.0, 5.0))
        assert turned_s < STOPS_S + BRAKES_S
        assert unit.pan.degrees() < 100.0


REFUSAL = 'HTTP/1.1 401 Unauthorized\r\nWWW-Authenticate: Basic realm="x"\r\nWWW-Authenticate: Digest {}\r\n\r\n'
REQUEST = "POST /onvif/ptz HTTP/1.1\r\nHost: dome\r\nAuthorization: Digest old\r\n\r\nstop"


@pytest.mark.parametrize("more", [', qop="auth,auth-int", algorithm=SHA-256, opaque="a, b"', ""])
def test_a_refused_stop_is_signed_as_an_http_client_signs_it(more):
    """httpx finds the same response for the same nonces."""
    challenge = f'realm="IP Camera (1), x", nonce="0a1b", stale=FALSE{more}'
    signed = sign(REQUEST, REFUSAL.format(challenge), ("jürgen ж", "geheim ß"))
    assert signed.endswith("\r\n\r\nstop")
    assert "old" not in signed
    said = signed.partition("Authorization: ")[2].partition("\r\n")[0]
    client = httpx.DigestAuth("jürgen ж", "geheim ß")
    client._get_client_nonce = lambda *_: "".join(re.findall('cnonce="(.*?)"', said)).encode()
    steps = client.sync_auth_flow(httpx.Request("POST", "http://dome/onvif/ptz"))
    asked = next(steps)
    expected = steps.send(httpx.Response(401, headers={"WWW-Authenticate": f"Digest {challenge}"}, request=asked))
    sent = [said.encode("latin-1").decode(), expected.headers.raw[-1][1].decode()]
    fields = [parse_keqv_list(parse_http_list(each.removeprefix("Digest "))) for each in sent]
    assert fields[0].pop("algorithm", "MD5") == fields[1].pop("algorithm")
    assert fields[0] == fields[1]


@pytest.mark.parametrize("answer", ["HTTP/1.1 200 OK\r\n\r\n", "HTTP/1.1 401 No\r\n\r\n", ""])
def test_what_asks_for_no_digest_is_not_signed(answer):
    assert sign(REQUEST, answer, ("admin", "secret")) is None


@pytest.fixture
def listener():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.settimeout(STOPS_S)
        yield bound


def test_nothing_is_sent_by_a_program_that_ends_as_it_should(listener):
    guardian = Guardian()
    guardian.hold([(True, *listener.getsockname(), ["stop"])])
    guardian.close()
    guardian.close()
    listener.settimeout(QUIET_S)
    with pytest.raises(TimeoutError):
        listener.recv(100)


def test_the_newest_orders_are_sent(listener):
    program = (
        "from cotarget.drivers.guardian import Guardian\nimport os\nguardian = Guardian()\n"
        f"for order in ('first', 'stop'): guardian.hold([(True, *{listener.getsockname()}, [order])])\n"
        "os.kill(os.getpid(), 9)"
    )
    listener.settimeout(None)
    subprocess.run([sys.executable, "-c", program], check=False)
    listener.settimeout(STOPS_S)
    assert {listener.recv(100) for _ in range(3)} == {b"stop"}


def test_a_guardian_that_was_killed_is_an_error_and_no_hang():
    guardian = Guardian()
    os.kill(guardian.pid, signal.SIGKILL)
    os.waitid(os.P_PID, guardian.pid, os.WEXITED | os.WNOWAIT)
    with pytest.raises(OSError, match="stop"):
        guardian.hold([(True, "127.0.0.1", 9, ["stop"])])
    guardian.close()
