"""Who may come in and what he can do: each protection of the page has a test that fails without it."""

import base64
import contextlib
import hashlib
import json
import logging
import re
import socket
import threading
import time

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect

from cotarget.errors import ConfigError, DeviceError
from cotarget.page import server
from cotarget.page.html import render
from cotarget.page.server import LOOPBACK, MOST_STRANGERS, listen
from tests.support.page_client import (
    DEADLINE_S,
    SPEC,
    UPGRADE,
    NotingSession,
    ask,
    browser,
    say,
    sentence,
    served,
    status,
    step,
    until,
)

pytestmark = pytest.mark.wire
STOP = ("stop", "stopped from the page")
OLD_S = 0.5  # a tick of then is too old


@pytest.fixture
def at():
    with served() as made:
        yield made


def closed(socket, within=DEADLINE_S):
    """The code with which the server closes a socket."""
    end = time.monotonic() + within
    try:
        while time.monotonic() < end:
            socket.recv(end - time.monotonic())
    except ConnectionClosed as end_of_socket:
        return end_of_socket.rcvd.code if end_of_socket.rcvd else 0
    raise AssertionError("it stays open")


# The token


def test_the_token_has_128_bits_and_is_another_at_every_start(at):
    assert len(base64.urlsafe_b64decode(at.page.token + "==")) == 16
    assert at.page.link == f"http://127.0.0.1:{at.port}/#{at.page.token}"
    with served() as other:
        assert other.page.token != at.page.token


@pytest.mark.parametrize("first", [{"do": "hello", "token": "wrong", "who": "x"}, {"do": "stop"}, {"do": "take"}])
def test_without_the_token_nothing_is_done_or_shown(at, first):
    at.page.show(step(), SPEC)
    with browser(at, hello=False) as socket:
        say(socket, **first)
        with contextlib.suppress(ConnectionClosed):
            say(socket, do="stop")
        with pytest.raises(ConnectionClosed) as end:
            socket.recv(DEADLINE_S)  # not one message
        assert end.value.rcvd.code == 4401
    assert at.session.noted == []
    with browser(at) as socket:  # a wrong one costs only its socket
        assert status(socket)["control"] == "nobody"


def test_the_token_is_compared_in_constant_time(at, monkeypatch):
    compared = []
    compare = server.hmac.compare_digest
    monkeypatch.setattr(server.hmac, "compare_digest", lambda a, b: compared.append((a, b)) or compare(a, b))
    with browser(at, token="x" * 22) as socket:
        closed(socket)
    assert compared == [(b"x" * 22, at.page.token.encode())]


def test_a_socket_that_says_nothing_is_closed_after_2_s(at):
    begun = time.monotonic()
    with browser(at, hello=False) as socket:
        assert closed(socket) == 4401
    assert 1.5 < time.monotonic() - begun < 5.0


def test_a_connection_that_asks_for_nothing_is_closed_after_2_s(at):
    with socket.create_connection((LOOPBACK, at.port)) as raw:
        raw.settimeout(DEADLINE_S)
        assert raw.recv(1) == b""


def test_the_end_of_the_page_waits_for_no_connection_that_asks_for_nothing():
    with contextlib.ExitStack() as stack:
        with served() as made:
            stack.enter_context(socket.create_connection((LOOPBACK, made.port)))
            until(lambda: made.page._strangers)
            begun = time.monotonic()
        assert time.monotonic() - begun < 1.0  # the connection itself would be closed after 2 s


def test_strangers_give_way_so_that_nobody_is_locked_out_of_stop(at):
    with contextlib.ExitStack() as stack:
        raws = [stack.enter_context(socket.create_connection((LOOPBACK, at.port))) for _ in range(MOST_STRANGERS + 8)]
        with browser(at) as mine:
            assert len(at.page._strangers) <= MOST_STRANGERS
            say(mine, do="stop")
            until(lambda: STOP in at.session.noted)
            raws[0].settimeout(1.0)
            with contextlib.suppress(ConnectionResetError):
                assert raws[0].recv(1) == b""  # the oldest went


def test_who_has_shown_the_token_gives_way_to_no_stranger(at):
    with browser(at) as mine, contextlib.ExitStack() as stack:
        status(mine)
        for _ in range(MOST_STRANGERS + 8):
            stack.enter_context(socket.create_connection((LOOPBACK, at.port)))
        with browser(at, who="b") as other:  # all of them have been let in
            status(other)
        say(mine, do="stop")
        until(lambda: STOP in at.session.noted)


def test_the_token_is_in_no_log(at, caplog):
    caplog.set_level(logging.DEBUG)
    with browser(at) as mine:
        status(mine)
    with browser(at, token="wrong") as other:
        closed(other)
    ours = [record for record in caplog.records if record.name.startswith("cotarget")]
    assert not any(at.page.token in record.getMessage() for record in ours)
    assert at.page.token not in render("page.html")


# Host and Origin


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "evil.example:8080", "", "localhost:8080,x"]
)
@pytest.mark.parametrize("path", ["/", "/socket"])
def test_a_rebound_name_gets_nothing(at, host, path):
    said = ask(at, f"GET {path} HTTP/1.1", f"Host: {host}", f"Origin: http://{host}", *UPGRADE)
    assert said.startswith("HTTP/1.1 403"), said
    assert "cotarget" not in said


def test_two_hosts_get_nothing(at):
    assert ask(at, "GET / HTTP/1.1", "Host: localhost", "Host: evil.example").startswith("HTTP/1.1 403")


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:9", "[::1]:8080", "LOCALHOST:1"])
def test_the_own_names_are_served_at_any_port(at, host):
    """A tunnel changes the port."""
    assert ask(at, "GET / HTTP/1.1", f"Host: {host}").startswith("HTTP/1.1 200")
    for scheme in ("http", "https"):
        lines = (f"Host: {host}", f"Origin: {scheme}://{host.lower()}")
        assert ask(at, "GET /socket HTTP/1.1", *lines, *UPGRADE).startswith("HTTP/1.1 101")


@pytest.mark.parametrize(
    "origin", [None, "null", "http://evil.example", "http://localhost:2", "http://localhost:1.evil.example", "file://"]
)
def test_only_the_page_itself_opens_a_socket(at, origin):
    lines = [] if origin is None else [f"Origin: {origin}"]
    said = ask(at, "GET /socket HTTP/1.1", "Host: localhost:1", *lines, *UPGRADE)
    assert said.startswith("HTTP/1.1 403"), said


def test_two_origins_open_no_socket(at):
    lines = ("Host: localhost", "Origin: http://localhost", "Origin: http://evil.example", *UPGRADE)
    assert ask(at, "GET /socket HTTP/1.1", *lines).startswith("HTTP/1.1 403")


# Requests


def test_no_get_changes_anything_and_nothing_else_is_answered(at):
    for path in ("/stop", "/favicon.ico", "/../etc/passwd", "/?do=stop", f"/?token={at.page.token}&do=stop"):
        assert ask(at, f"GET {path} HTTP/1.1", "Host: localhost").startswith("HTTP/1.1 404")
    for method in ("POST", "PUT", "DELETE", "OPTIONS"):
        assert " 200 " not in ask(at, f"{method} / HTTP/1.1", "Host: localhost", "Content-Length: 0")[:20]
    assert at.session.noted == []


def test_the_page_may_load_nothing_but_itself(at):
    head, _, body = ask(at, "GET / HTTP/1.1", "Host: localhost:7").partition("\r\n\r\n")
    headers = dict(line.split(": ", 1) for line in head.split("\r\n")[1:])
    found = dict(part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; "))
    for tag in ("script", "style"):
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", body, re.DOTALL)
        assert len(texts) == 1
        digest = base64.b64encode(hashlib.sha256(texts[0].encode()).digest()).decode()
        assert found.pop(f"{tag}-src") == f"'sha256-{digest}'"
    assert found.pop("connect-src") == "ws://localhost:7 wss://localhost:7"
    assert found == dict.fromkeys(("default-src", "base-uri", "form-action", "frame-ancestors"), "'none'")
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    assert headers["Cache-Control"] == "no-store"
    assert headers["Content-Type"] == "text/html; charset=utf-8"


@pytest.mark.parametrize("name", ["page.html", "run.html"])
def test_a_page_is_small_and_writes_no_markup(name):
    text = render(name)
    assert len(text.encode()) <= 60_000
    assert len(text.splitlines()) <= 1200
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function", text)
    for own in ("${location", '"http://www.w3.org/2000/svg"', "film.src = URL.createObjectURL("):  # no address to load
        text = text.replace(own, "")
    assert not re.search(r"(src|href)\s*=|https?://|@import|url\(", text)
    assert not re.search(r"<[^>]+ (style|on\w+)=", text)


# Messages


@pytest.mark.parametrize(
    "data",
    [
        "{}",
        "stop",
        b"\xff\x00",
        '{"do": "dance"}',
        '{"do": "stand"}',
        '{"do": "stand", "of": "head", "more": 1}',
        '{"do": "manual", "of": "head", "rates": [1.01, 0], "tick": 1}',
        '{"do": "manual", "of": "head", "rates": [NaN, 0], "tick": 1}',
        '{"do": "manual", "of": "head", "rates": [0], "tick": 1}',
        '{"do": "manual", "of": "head", "rates": ["0", 0], "tick": 1}',
        '{"do": "zoom", "of": "head", "factor": 100.0, "tick": 1}',
        '{"do": "follow", "of": "head", "click": [1e300, 0]}',
        '{"do": "follow", "of": "head", "track": true}',
        json.dumps({"do": "stand", "of": "h" * 65}),
        "[" * 2000,
    ],
)
def test_what_is_no_message_costs_its_socket_and_moves_nothing(at, data):
    with browser(at) as mine, browser(at, who="b") as other:
        say(mine, do="take")
        mine.send(data)
        assert closed(mine) == 1008
        assert status(other)["pages"] >= 1
    assert {name for name, *_ in at.session.noted} <= {"leave", "left alone"}


def test_a_message_has_4_kB_at_most(at):
    with browser(at) as mine:
        mine.send(json.dumps({"do": "stand", "of": "head" + " " * 5000}))
        assert closed(mine) == 1009


def test_a_flood_costs_its_socket_and_not_the_others(at):
    with browser(at, who="flood") as flood, browser(at, who="b") as mine:
        with contextlib.suppress(ConnectionClosed):
            for i in range(2000):
                say(flood, do="drawn", n=i)
        assert closed(flood) == 1008
        say(mine, do="stop")
        until(lambda: STOP in at.session.noted)


def test_a_stop_is_counted_by_nobody(at):
    with browser(at) as mine:
        for _ in range(200):
            say(mine, do="stop")
        until(lambda: at.session.noted.count(STOP) == 200)
        assert status(mine, lambda message: message["stopped"] is not None)["stopped"] == STOP[1]  # older ones may wait


def test_a_stop_waits_for_no_picture(at, monkeypatch):
    packing, leave = threading.Event(), threading.Event()
    monkeypatch.setattr(server, "pack", lambda *_: packing.set() or leave.wait(2 * DEADLINE_S) or b"")
    with browser(at) as mine:
        at.page.show(step(), SPEC)
        assert packing.wait(DEADLINE_S)
        say(mine, do="stop")
        try:
            until(lambda: STOP in at.session.noted)
        finally:
            leave.set()


def test_a_stop_that_takes_long_delays_nobody_else():
    leave = threading.Event()

    class Slow(NotingSession):
        def stop(self, reason):
            super().stop(reason)
            leave.wait(2 * DEADLINE_S)

    with served(Slow()) as slow, browser(slow) as mine, browser(slow, who="b") as other:
        say(mine, do="stop")
        try:
            until(lambda: STOP in slow.session.noted)
            first = status(other)["tick"]
            status(other, lambda message: message["tick"] > first + 2)
        finally:
            leave.set()


def test_sockets_are_not_compressed(at):
    with connect(f"ws://{LOOPBACK}:{at.port}/socket", origin=f"http://{LOOPBACK}:{at.port}") as socket:
        assert socket.response.headers.get("Sec-WebSocket-Extensions") is None


# By hand


def test_a_message_by_hand_that_quotes_an_old_tick_moves_nothing(at):
    with browser(at) as mine:
        say(mine, do="take")
        tick = status(mine, lambda message: message["control"] == "you")["tick"]
        say(mine, do="manual", of="head", rates=[0.5, 0.0], tick=tick)
        until(lambda: ("manual", "head", (0.5, 0.0)) in at.session.noted)
        time.sleep(OLD_S)
        count = len(at.session.noted)
        for old in (tick, tick + 1000, -1):
            say(mine, do="manual", of="head", rates=[0.5, 0.0], tick=old)
            say(mine, do="zoom", of="head", factor=1.5, tick=old)
        say(mine, do="stop")
        until(lambda: STOP in at.session.noted)
        assert at.session.noted[count:] == [STOP]


# Control


def test_others_watch_and_may_stop_but_not_clear_or_move(at):
    with browser(at) as mine, browser(at, who="b") as other:
        say(mine, do="take")
        assert status(other, lambda message: message["control"] != "nobody")["control"] == "another"
        tick = status(other)["tick"]
        for order in (
            {"do": "clear"},
            {"do": "home", "of": "head"},
            {"do": "stand", "of": "head"},
            {"do": "follow", "of": "head", "track": 1},
            {"do": "manual", "of": "head", "rates": [1, 0], "tick": tick},
            {"do": "zoom", "of": "head", "factor": 2, "tick": tick},
            {"do": "record", "on": True},
        ):
            say(other, **order)
            assert "control" in sentence(other)
        assert at.session.noted == []
        say(other, do="stop")
        until(lambda: at.session.noted == [STOP])
        assert status(mine, lambda message: message["stopped"])["stopped"] == STOP[1]
        say(other, do="take")  # both see it
        assert status(mine, lambda message: message["control"] != "you")["control"] == "another"
        assert status(other, lambda message: message["control"] != "another")["control"] == "you"


def test_a_closed_page_leaves_control_unless_it_is_open_twice(at):
    with browser(at) as mine:
        say(mine, do="take")
        status(mine, lambda message: message["control"] == "you")
        with browser(at) as again:  # by a reload
            status(again, lambda message: message["control"] == "you")
        status(mine)
        assert at.session.noted == []
    until(lambda: at.session.noted == [("leave", "a"), ("left alone",)])


def test_a_browser_that_no_longer_answers_has_left(monkeypatch):
    """Its line is cut, and the system does not know yet."""
    monkeypatch.setattr(server, "PING_S", 0.2)
    with served() as at, socket.create_connection((LOOPBACK, at.port)) as raw:
        lines = ("GET /socket HTTP/1.1", "Host: localhost", "Origin: http://localhost", *UPGRADE, "")
        raw.sendall("".join(f"{line}\r\n" for line in lines).encode())
        for message in ({"do": "hello", "token": at.page.token, "who": "a"}, {"do": "take"}):
            raw.sendall(Frame(Opcode.TEXT, json.dumps(message).encode()).serialize(mask=True))
        until(lambda: at.session.control == "a")
        until(lambda: at.session.noted == [("leave", "a"), ("left alone",)])


def test_the_end_of_the_run_is_no_lost_connection():
    with contextlib.ExitStack() as stack:
        at = stack.enter_context(served())
        with browser(at) as mine:
            status(mine)
            stack.close()
            assert closed(mine) == 4410


# Addresses


def test_a_port_that_is_taken_is_refused_in_one_line(at):
    with pytest.raises(DeviceError, match=f"--page-port {at.port}: ") as error:
        listen(LOOPBACK, at.port)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "0", "0:0::0", "a..b"])
def test_all_addresses_have_no_name_to_check(host):
    with pytest.raises(ConfigError, match="--page-host"):
        listen(host, 0)


def test_an_address_of_another_machine_is_refused_by_its_name():
    with pytest.raises(DeviceError, match=r"--page-host 192\.0\.2\.1: "):  # of documentation alone, RFC 5737
        listen("192.0.2.1", 0)


def test_by_itself_it_listens_on_loopback_alone(at):
    assert at.page._listener.getsockname()[0] == LOOPBACK


def test_a_session_that_fails_to_stop_says_so(at):
    class Broken(NotingSession):
        def stop(self, reason):
            raise DeviceError("NOT stopped: the disk is full")

    with served(Broken()) as broken, browser(broken) as mine:
        say(mine, do="stop")
        assert "NOT stopped" in sentence(mine)
