"""The emulated Axis 241Q, byte for byte against VAPIX 2 and RFC 2617; each fault; slow and many viewers."""

import base64
import hashlib
import http.client
import io
import itertools
import random
import re
import socket
import threading
import time
from email.message import Message

import cv2
import numpy as np
import pytest

from cotarget.emulators import axis_241q
from cotarget.emulators.axis_241q import (
    AXIS_FAULTS,
    Authenticator,
    AxisServer,
    AxisUnit,
    HttpError,
    HttpRequest,
    Pace,
    damaged,
    fixed_ptz,
    list_parameters,
    named_sizes,
    parse_order,
    read_request,
    text_reply,
    video_status,
)
from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import Feed, Picture
from cotarget.errors import ConfigError, DeviceError

# No test waits this long unless something hangs [s].
DEADLINE_S = 20.0
# Mutated requests that are tried; seven hundred thousand found nothing.
FUZZ = 10_000
# JPEG's error in the mean of a flat picture [grey levels].
JPEG_LEVELS = 3.0
STREAM_HEAD = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=myboundary\r\n\r\n"
PART = re.compile(rb"--myboundary\r\nContent-Type: image/jpeg\r\nContent-Length: (\d+)\r\n\r\n")
SNAPSHOT = "/axis-cgi/jpg/image.cgi"
STREAM = "/axis-cgi/mjpg/video.cgi"
PAL = named_sizes("PAL")
# The example of RFC 2617, 3.5.
RFC_NONCE = "dcd98b7102dd2f0e8b11d0f600bfb0c093"
RFC_DIGEST = (
    f'Digest username="Mufasa", realm="testrealm@host.com", nonce="{RFC_NONCE}", uri="/dir/index.html", qop=auth, '
    'nc=00000001, cnonce="0a4f113b", response="6629fae49393a05397450978507c4ef1", opaque="5ccc069c403ebaf9f0171e9517"'
)


@pytest.fixture(autouse=True)
def no_thread_left():
    yield
    assert [thread.name for thread in threading.enumerate() if thread.name.startswith("axis")] == []


def flat(colour, size=(640, 480)):
    return np.full((size[1], size[0], 3), colour, np.uint8)


def publish(feed, index, image=None):
    feed.publish(Picture(flat((40, index % 256, 200)) if image is None else image, index, time.monotonic()))


@pytest.fixture
def feed():
    feed = Feed()
    publish(feed, 0)
    return feed


@pytest.fixture
def server(feed):
    with AxisServer({1: feed}, quality=90) as server:
        yield server


def address(server):
    host, _, port = server.url.removeprefix("http://").rpartition(":")
    return host.strip("[]"), int(port)


def ask(server, target, method="GET", headers=""):
    """A connection on which a request has been sent."""
    connection = socket.create_connection(address(server), DEADLINE_S)
    try:
        connection.sendall(f"{method} {target} HTTP/1.0\r\n{headers}\r\n".encode())
    except OSError:
        connection.close()
        raise
    return connection


def exchange(server, target, method="GET", headers=""):
    """All that the server answers until it closes."""
    with ask(server, target, method, headers) as connection, connection.makefile("rb") as stream:
        return stream.read()


def body(reply):
    return reply.partition(b"\r\n\r\n")[2]


def decode(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


class Viewer:
    """A client of a stream that reads the parts exactly as the manual has them."""

    def __init__(self, server, target=STREAM, head=STREAM_HEAD):
        self.connection = ask(server, target)
        self.stream = self.connection.makefile("rb")
        try:
            assert self.stream.read(len(head)) == head
        except BaseException:
            self.close()
            raise

    def part(self):
        """The JPEG of the next part."""
        head = b"".join(self.stream.readline() for _ in range(4))
        length = int(PART.fullmatch(head)[1])
        data = self.stream.read(length)
        assert len(data) == length
        assert self.stream.read(2) == b"\r\n"
        return data

    def close(self):
        self.stream.close()
        self.connection.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


# Pure: bytes in, bytes out
def request_of(text):
    return read_request(io.BytesIO(text.replace("\n", "\r\n").encode()))


@pytest.mark.parametrize("form", ["application/x-www-form-urlencoded", "text/plain"])
def test_a_request_is_read_with_its_arguments_and_its_form(form):
    request = request_of(
        "POST /axis-cgi/param.cgi?group=root.Brand HTTP/1.1\nHost: a\nContent-Length: 11\n"
        f"Content-Type: {form}\n\naction=list"
    )
    assert (request.method, request.path) == ("POST", "/axis-cgi/param.cgi")
    assert request.arguments == {"group": "root.Brand", "action": "list"}
    assert request.headers["host"] == "a"
    assert request_of("") is None


@pytest.mark.parametrize(
    "text",
    [
        "GET\n\n",
        "GET / HTTP/1.0 more\n\n",
        "GET / RTSP/1.0\n\n",
        "GET / HTTP/1.0",
        "GET http://[/ HTTP/1.0\n\n",
        "GET / HTTP/1.0\nContent-Length: -1\n\n",
        "GET / HTTP/1.0\nContent-Length: many\n\n",
        "GET / HTTP/1.0\nContent-Length: 4\n\nabc",
        "GET / HTTP/1.0\nContent-Length: 10000000\n\n",
        "GET /?" + "&".join(f"a{i}=1" for i in range(100)) + " HTTP/1.0\n\n",
        "GET / HTTP/1.0\n" + "a: b\n" * 200 + "\n",
        "GET /" + 9000 * "x" + " HTTP/1.0\n\n",
    ],
)
def test_what_is_no_request_is_refused(text):
    with pytest.raises(HttpError) as caught:
        request_of(text)
    assert caught.value.status == 400


def test_mutated_requests_are_answered_or_refused():
    rng = random.Random(1)
    seeds = [
        b"GET /mjpg/video.mjpg?camera=1&resolution=4CIF&fps=25&status=1 HTTP/1.0\r\nAuthorization: Basic QTpi\r\n\r\n",
        b"POST /axis-cgi/param.cgi HTTP/1.1\r\nContent-Length: 28\r\nAuthorization: "
        + RFC_DIGEST.encode()
        + b"\r\n\r\n"
        b"action=list&group=root.Brand",
    ]
    guards = [
        Authenticator("A", "b", "basic", "R"),
        Authenticator("Mufasa", "Circle Of Life", "digest", "testrealm@host.com"),
    ]
    outcomes = set()
    for _ in range(FUZZ):
        data = bytearray(rng.choice(seeds))
        for _ in range(rng.randrange(6)):
            at = rng.randrange(len(data))
            data[at : at + rng.randrange(4)] = rng.choice(
                [b"", rng.randbytes(1), b"%", b"\r\n", b"&", b'"', b"[", b"nan"]
            )
        try:
            request = read_request(io.BytesIO(data))
            if request is not None:
                outcomes |= {guard.refuse(request) is None for guard in guards}
                text_reply(list_parameters({"root.A": "1"}, request.arguments) + str(fixed_ptz(request.arguments)))
                video_status(bool, request.arguments)
                parse_order(request.arguments, None, PAL)
        except HttpError as error:
            outcomes.add(error.status)
    assert {True, False, 400} <= outcomes


def headers_of(authorization):
    message = Message()
    message["Authorization"] = authorization
    return message


def authorized(authorization, target="/dir/index.html", method="GET"):
    return HttpRequest(method, target, target, {}, headers_of(authorization))


@pytest.fixture
def rfc_guard(monkeypatch):
    nonces = itertools.chain([RFC_NONCE], (f"{i:032x}" for i in itertools.count()))
    monkeypatch.setattr(axis_241q.secrets, "token_hex", lambda _: next(nonces))
    guard = Authenticator("Mufasa", "Circle Of Life", "digest", "testrealm@host.com", now=lambda: guard.time)
    guard.time = 0.0
    assert guard.refuse(authorized("")) == (
        f'WWW-Authenticate: Digest realm="testrealm@host.com", nonce="{RFC_NONCE}", algorithm=MD5, qop="auth"'
    )
    return guard


def test_the_rfc_s_digest_opens_once(rfc_guard):
    assert rfc_guard.refuse(authorized(RFC_DIGEST)) is None
    assert rfc_guard.refuse(authorized(RFC_DIGEST)).endswith(", stale=true")


def test_a_digest_grows_stale_with_its_nonce(rfc_guard):
    rfc_guard.time = 301.0
    assert rfc_guard.refuse(authorized(RFC_DIGEST)).endswith(", stale=true")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("6629", "6628"),
        ("Mufasa", "Scar"),
        ("testrealm", "otherrealm"),
        ("nc=00000001", "nc=00000002"),
        ("nc=00000001", "nc=1"),
        ("qop=auth, ", ""),
        ("0a4f113b", ""),
        ("/dir/", "/other/"),
        ("Digest", "Basic"),
        (RFC_NONCE, "0"),
        ("username=", "username"),
        (", realm", "realm="),
    ],
)
def test_a_digest_that_is_not_right_is_refused(rfc_guard, old, new):
    challenge = rfc_guard.refuse(authorized(RFC_DIGEST.replace(old, new)))
    assert challenge.startswith("WWW-Authenticate: Digest ")
    assert "stale" not in challenge


def test_another_method_or_target_needs_another_digest(rfc_guard):
    assert rfc_guard.refuse(authorized(RFC_DIGEST, method="POST")) is not None
    assert rfc_guard.refuse(authorized(RFC_DIGEST, target="/secret")) is not None


def test_a_nonce_that_nobody_issued_is_stale():
    guard = Authenticator("u", "p", "digest", "R")

    def md5(text):
        return hashlib.md5(text.encode()).hexdigest()

    response = md5(f"{md5('u:R:p')}:abc:00000001:c:auth:{md5('GET:/')}")
    fields = f'username="u", realm="R", nonce="abc", uri="/", qop=auth, nc=00000001, cnonce="c", response="{response}"'
    assert guard.refuse(authorized(f"Digest {fields}", target="/")).endswith(", stale=true")


def test_nonces_do_not_pile_up():
    guard = Authenticator("u", "p", "digest", "R")
    for _ in range(3 * axis_241q.MAX_NONCES):
        guard.challenge()
    assert len(guard._issued) == len(guard._used) == axis_241q.MAX_NONCES


def test_basic_is_the_rfc_s():
    guard = Authenticator("Aladdin", "open sesame", "basic", "AXIS_00408C000241")
    refusal = 'WWW-Authenticate: Basic realm="AXIS_00408C000241"'
    assert guard.refuse(authorized("Basic QWxhZGRpbjpvcGVuIHNlc2FtZQ==")) is None
    wrong = base64.b64encode(b"Aladdin:open").decode()
    for authorization in ["", "Basic", "Basic ???", f"Basic {wrong}", "Basic /////w==", "Digest x"]:
        assert guard.refuse(authorized(authorization)) == refusal


def test_without_a_user_everybody_may_look():
    assert Authenticator("", "", "digest", "R").refuse(authorized("")) is None


@pytest.mark.parametrize(("source", "wanted"), [(25, 25), (25, 10), (25, 20), (30, 7), (10, 25)])
def test_a_stream_is_thinned_to_its_rate(source, wanted):
    rng = np.random.default_rng(1)
    times = np.arange(60 * source) / source + rng.uniform(-0.2, 0.2, 60 * source) / source
    pace = Pace(wanted)
    passed = [t for t in times if pace.due(t)]
    assert len(passed) == pytest.approx(60 * min(source, wanted), rel=0.01, abs=1)
    # What passes is at most a period and a frame late, and never two at a time.
    assert max(np.diff(passed)) < 1 / min(source, wanted) + 1.5 / source
    assert min(np.diff(passed)) > 0.5 / max(source, wanted)


def test_no_rate_lets_everything_pass():
    pace = Pace(0)
    assert all(pace.due(t) for t in [0.0, 0.0, 0.1, 0.1])


def test_an_order_is_read_as_vapix_has_it():
    order = parse_order(
        {"camera": "2", "resolution": "cif", "compression": "50", "req_fps": "10", "des_fps": "5", "colour": "?"},
        None,
        PAL,
    )
    assert (order.camera, order.size, order.compression, order.rate_hz) == (2, (352, 288), 50, 5)
    order = parse_order({"nbrofframes": "3", "duration": "1.5", "fps": "0", "showlength": "0"}, "quad", PAL)
    assert (order.camera, order.count, order.duration, order.rate_hz) == ("quad", 3, 1.5, 0)
    assert not order.show_length
    default = parse_order({}, None, PAL)
    assert (default.camera, default.size, default.compression, default.show_length) == (1, None, 30, True)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("camera", "5"),
        ("camera", "0"),
        ("camera", "one"),
        ("resolution", "9CIF"),
        ("resolution", "640"),
        ("resolution", "640x"),
        ("resolution", "-1x480"),
        ("compression", "101"),
        ("compression", "nan"),
        ("fps", "-1"),
        ("fps", "fast"),
        ("duration", "-1"),
        ("nbrofframes", "x"),
    ],
)
def test_an_order_that_makes_no_sense_is_refused(name, value):
    with pytest.raises(HttpError) as caught:
        parse_order({name: value}, None, PAL)
    assert caught.value.status == 400


def test_sizes_have_vapix_s_names():
    assert (PAL["4CIF"], PAL["2CIF"], PAL["CIF"], PAL["QCIF"]) == ((704, 576), (704, 288), (352, 288), (176, 144))
    ntsc = named_sizes("NTSC")
    assert (ntsc["4CIF"], ntsc["2CIF"], ntsc["CIF"]) == ((704, 480), (704, 240), (352, 240))


def test_groups_of_parameters():
    listed = {"root.Brand.Brand": "AXIS", "root.Brand.ProdNbr": "241Q", "root.Brandy.Age": "12"}

    def answer(**arguments):
        return list_parameters(listed, arguments)

    brand = "root.Brand.Brand=AXIS\nroot.Brand.ProdNbr=241Q\n"
    assert answer(action="list", group="root.Brand") == brand
    assert answer(action="list", group="Brand") == brand
    assert answer(action="list", group="root.Brand.ProdNbr") == "root.Brand.ProdNbr=241Q\n"
    assert answer(action="list") == answer(action="list", group="root") == brand + "root.Brandy.Age=12\n"
    nope = "# Error: Error -1 getting param in group 'root.Nope'\n"
    assert answer(action="list", group="root.Nope") == nope
    assert answer(action="list", group="Brand.ProdNbr,root.Nope") == "root.Brand.ProdNbr=241Q\n" + nope
    assert answer(action="update").startswith("# Error:")
    assert answer().startswith("# Error:")


def test_a_fixed_camera_says_that_it_is_fixed():
    assert fixed_ptz({"query": "position"}) == "pan=0\ntilt=0\nzoom=1\n"
    assert fixed_ptz({"query": "limits"}).startswith("MinPan=0\nMaxPan=0\n")
    assert fixed_ptz({"query": "mood"}).startswith("Error:")
    assert fixed_ptz({"camera": "1", "pan": "3"}).startswith("Error:")
    assert fixed_ptz({"camera": "1"}) is None


def test_damage_keeps_the_length_and_hits_start_end_and_middle():
    _, data = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8))
    data = bytes(data)
    start, end, middle = (damaged(data, index) for index in (0, 1, 2))
    assert len(start) == len(end) == len(middle) == len(data)
    assert not start.startswith(b"\xff\xd8")
    assert not end.endswith(b"\xff\xd9")
    assert middle.startswith(b"\xff\xd8")
    assert middle.endswith(b"\xff\xd9")
    assert middle != data


# Over loopback
@pytest.mark.wire
def test_a_snapshot_byte_for_byte(server):
    for target in [SNAPSHOT, "/jpg/image.jpg", "/jpg/1/image.jpg"]:
        reply = exchange(server, target)
        data = body(reply)
        assert reply == b"HTTP/1.0 200 OK\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data) + data
        np.testing.assert_allclose(decode(data).mean((0, 1)), (40, 0, 200), atol=JPEG_LEVELS)
    assert exchange(server, SNAPSHOT + "?showlength=0") == b"HTTP/1.0 200 OK\r\nContent-Type: image/jpeg\r\n\r\n" + data


@pytest.mark.wire
def test_a_stream_byte_for_byte(server, feed):
    for target in [STREAM, "/mjpg/video.mjpg", "/mjpg/1/video.mjpg"]:
        jpeg = body(exchange(server, SNAPSHOT))  # the stream sends the very same bytes: a picture is encoded once
        assert exchange(server, target + "?nbrofframes=1") == (
            STREAM_HEAD
            + b"--myboundary\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
            + jpeg
            + b"\r\n"
        )
    with Viewer(server) as viewer:
        for index in range(1, 6):
            viewer.part()
            publish(feed, index)
        np.testing.assert_allclose(decode(viewer.part()).mean((0, 1)), (40, 5, 200), atol=JPEG_LEVELS)


@pytest.mark.wire
def test_a_boundary_may_come_with_the_picture_before_it(feed):
    with (
        AxisServer({1: feed}, unit=AxisUnit(early_boundary=True)) as server,
        Viewer(server, head=STREAM_HEAD + b"--myboundary\r\n") as viewer,
    ):
        # Nothing more is published, so that the boundary after the picture can only have come with it.
        jpeg = body(exchange(server, SNAPSHOT))
        part = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg) + jpeg + b"\r\n--myboundary\r\n"
        assert viewer.stream.read(len(part)) == part


@pytest.mark.wire
def test_sizes_as_asked(server):
    for asked, size in [("CIF", (352, 288)), ("2CIF", (704, 288)), ("4CIF", (704, 576)), ("320x240", (320, 240))]:
        assert decode(body(exchange(server, f"{SNAPSHOT}?resolution={asked}"))).shape == (size[1], size[0], 3)
        said = f"image width = {size[0]}\nimage height = {size[1]}\n".encode()
        assert body(exchange(server, f"/axis-cgi/imagesize.cgi?camera=1&resolution={asked}")) == said
    assert decode(body(exchange(server, SNAPSHOT))).shape == (480, 640, 3)
    with Viewer(server, STREAM + "?resolution=QCIF") as viewer:
        assert decode(viewer.part()).shape == (144, 176, 3)


@pytest.mark.wire
def test_compression_makes_pictures_smaller(server, feed):
    publish(feed, 1, np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8))
    sizes = [len(exchange(server, f"{SNAPSHOT}?compression={value}")) for value in (0, 30, 60, 100)]
    assert sizes == sorted(sizes, reverse=True)
    assert len(set(sizes)) == 4
    _, exact = cv2.imencode(".jpg", feed.newest().image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert body(exchange(server, SNAPSHOT)) == bytes(exact)  # the quality of the fixture, at Axis' default


@pytest.mark.wire
def test_inputs_of_their_own_and_all_in_one(feed):
    other = Feed()
    publish(other, 0, flat((0, 255, 0)))
    with AxisServer({1: feed, 3: other}) as server:
        assert (
            body(exchange(server, "/axis-cgi/videostatus.cgi?status=1,2")) == b"Video 1 = video\nVideo 2 = no video\n"
        )
        assert body(exchange(server, "/axis-cgi/view/videostatus.cgi")).count(b"= video") == 2
        third = decode(body(exchange(server, SNAPSHOT + "?camera=3")))
        np.testing.assert_allclose(third.mean((0, 1)), (0, 255, 0), atol=JPEG_LEVELS)
        quad = decode(body(exchange(server, SNAPSHOT + "?camera=quad")))
        assert quad.shape == (480, 640, 3)
        np.testing.assert_allclose(quad[20:220, 20:300].mean((0, 1)), (40, 0, 200), atol=JPEG_LEVELS)
        np.testing.assert_allclose(quad[260:460, 20:300].mean((0, 1)), (0, 255, 0), atol=JPEG_LEVELS)
        with Viewer(server, "/mjpg/2/video.mjpg") as viewer:  # no signal, but a stream that goes on
            assert decode(viewer.part()).shape == decode(viewer.part()).shape == (576, 704, 3)


@pytest.mark.wire
def test_parameters_by_get_and_post_at_all_addresses(server):
    brand = (
        b"HTTP/1.0 200 OK\r\nContent-Type: text/plain\r\n\r\n"
        b"root.Brand.Brand=AXIS\nroot.Brand.ProdFullName=AXIS 241Q Video Server\nroot.Brand.ProdNbr=241Q\n"
        b"root.Brand.ProdShortName=AXIS 241Q\nroot.Brand.ProdType=Video Server\nroot.Brand.WebURL=http://www.axis.com\n"
    )
    for directory in ["", "admin/", "view/", "operator/"]:
        assert exchange(server, f"/axis-cgi/{directory}param.cgi?action=list&group=root.Brand") == brand
    form = b"action=list&group=root.Brand"
    connection = http.client.HTTPConnection(*address(server), timeout=DEADLINE_S)
    connection.request("POST", "/axis-cgi/param.cgi", form, {"Content-Type": "application/x-www-form-urlencoded"})
    assert connection.getresponse().read() == body(brand)
    connection.close()
    everything = body(exchange(server, "/axis-cgi/param.cgi?action=list")).decode().splitlines()
    assert "root.Properties.API.HTTP.Version=2" in everything
    assert "root.Image.I0.Appearance.Resolution=640x480" in everything
    assert "root.Image.I1.Appearance.Resolution=4CIF" in everything
    assert "root.Properties.System.SerialNumber=00408C000241" in everything


@pytest.mark.wire
def test_refusals(server):
    for target, method, status in [
        ("/axis-cgi/nothing.cgi", "GET", b"404 Not Found"),
        ("/", "GET", b"404 Not Found"),
        (SNAPSHOT + "?camera=7", "GET", b"400 Bad Request"),
        (SNAPSHOT + "?resolution=9999x9999", "GET", b"400 Bad Request"),
        (STREAM + "?resolution=8x8", "GET", b"400 Bad Request"),
        ("/mjpg/5/video.mjpg", "GET", b"400 Bad Request"),
        ("/axis-cgi/videostatus.cgi?status=9", "GET", b"400 Bad Request"),
        (SNAPSHOT, "DELETE", b"501 Not Implemented"),
    ]:
        assert exchange(server, target, method).startswith(b"HTTP/1.0 " + status + b"\r\n"), target
    assert exchange(server, "/axis-cgi/com/ptz.cgi?camera=1") == b"HTTP/1.0 204 No Content\r\n\r\n"
    assert exchange(server, "/a b c").startswith(b"HTTP/1.0 400 ")
    with socket.create_connection(address(server), DEADLINE_S) as connection, connection.makefile("rb") as stream:
        connection.sendall(bytes(range(256)) * 100)
        assert stream.read().startswith(b"HTTP/1.0 400 ")
    with socket.create_connection(address(server), DEADLINE_S) as connection:
        connection.shutdown(socket.SHUT_WR)
        assert connection.recv(1) == b""


@pytest.mark.wire
def test_a_camera_without_any_picture_is_not_ready(monkeypatch):
    monkeypatch.setattr(axis_241q, "FIRST_PICTURE_S", 0.1)
    with AxisServer({1: Feed()}) as server:
        assert exchange(server, SNAPSHOT).startswith(b"HTTP/1.0 503 Service Unavailable\r\n")


def digest(challenge, password, target, count=1):
    """The header of a client that answers a challenge as RFC 2617, 3.2.2 has it."""
    realm, nonce = (re.search(f'{name}="([^"]+)"', challenge)[1] for name in ("realm", "nonce"))

    def md5(*words):
        return hashlib.md5(":".join(words).encode()).hexdigest()

    told = f"{count:08x}"
    response = md5(md5("root", realm, password), nonce, told, "0a4f113b", "auth", md5("GET", target))
    return (
        f'Authorization: Digest username="root", realm="{realm}", nonce="{nonce}", uri="{target}", qop=auth, '
        f'nc={told}, cnonce="0a4f113b", response="{response}"\r\n'
    )


@pytest.mark.wire
def test_digest_is_asked_for_and_checked(feed):
    target = SNAPSHOT + "?camera=1"
    with AxisServer({1: feed}, user="root", password="pa:ss") as server:
        challenge = exchange(server, STREAM).partition(b"\r\n\r\n")[0].decode()
        assert challenge.startswith(
            'HTTP/1.0 401 Unauthorized\r\nWWW-Authenticate: Digest realm="AXIS_00408C000241", nonce="'
        )
        for count, password, status in [
            (1, "pa:ss", b"200"),
            (1, "pa:ss", b"401"),
            (2, "pa:ss", b"200"),
            (3, "", b"401"),
        ]:
            reply = exchange(server, target, headers=digest(challenge, password, target, count))
            assert reply.startswith(b"HTTP/1.0 " + status), (count, password)
        assert exchange(server, SNAPSHOT, headers=digest(challenge, "pa:ss", target, 4)).startswith(b"HTTP/1.0 401 ")


@pytest.mark.wire
def test_basic_is_asked_for_and_checked(feed):
    with AxisServer({1: feed}, user="root", password="pa:ss", auth="basic", unit=AxisUnit(serial="A1")) as server:
        head = b'HTTP/1.0 401 Unauthorized\r\nWWW-Authenticate: Basic realm="AXIS_A1"\r\n'
        assert exchange(server, SNAPSHOT).startswith(head)
        assert exchange(server, SNAPSHOT, headers="Authorization: Basic cm9vdDpwYXNz\r\n").startswith(head)
        reply = exchange(server, SNAPSHOT, headers="Authorization: Basic cm9vdDpwYTpzcw==\r\n")
        assert decode(body(reply)).shape == (480, 640, 3)


@pytest.mark.wire
def test_twenty_viewers_and_no_more(server, feed):
    viewers = [Viewer(server) for _ in range(20)]
    first = {viewer.part() for viewer in viewers}
    assert len(first) == 1
    assert server.viewers == 20
    assert exchange(server, STREAM).startswith(b"HTTP/1.0 503 Service Unavailable\r\n")
    assert exchange(server, SNAPSHOT).startswith(b"HTTP/1.0 200 OK\r\n")
    publish(feed, 1)
    assert len({viewer.part() for viewer in viewers}) == 1
    viewers.pop().close()
    deadline = time.monotonic() + DEADLINE_S
    while not exchange(server, STREAM + "?nbrofframes=1").startswith(b"HTTP/1.0 200 "):
        assert time.monotonic() < deadline
    for viewer in viewers:
        viewer.close()


@pytest.mark.wire
def test_a_slow_viewer_holds_up_nobody_and_then_gets_the_newest(server, feed):
    rng = np.random.default_rng(0)
    count = 60
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.settimeout(DEADLINE_S)
    slow.connect(address(server))
    slow.sendall(f"GET {STREAM}?compression=0&duration=60 HTTP/1.0\r\n\r\n".encode())
    with slow, slow.makefile("rb") as stream, Viewer(server, STREAM + "?compression=0") as quick:
        assert stream.read(len(STREAM_HEAD)) == STREAM_HEAD
        quick.part()
        for index in range(1, count):  # half a megabyte each: more than the kernel holds for a viewer
            publish(feed, index, rng.integers(0, 255, (480, 640, 3), np.uint8))
            newest = quick.part()
        # Of 60 pictures the slow viewer gets those that were under way, and then the newest at once.
        parts = 0
        while True:
            head = b"".join(stream.readline() for _ in range(4))
            data = stream.read(int(PART.fullmatch(head)[1]))
            parts += 1
            stream.read(2)
            if data == newest:
                break
        assert parts < count


@pytest.mark.wire
def test_parts_are_told_with_the_time_of_their_first_byte(feed):
    told = []
    with AxisServer({1: feed}, sent=lambda index, t: told.append((index, t))) as server, Viewer(server) as viewer:
        for index in range(1, 6):
            viewer.part()
            before = time.monotonic()
            publish(feed, index)
        viewer.part()
        after = time.monotonic()
    assert [index for index, _ in told] == list(range(6))
    assert before <= told[-1][1] <= after


@pytest.mark.wire
def test_streams_end_by_count_and_by_duration(server, feed):
    publish(feed, 1)
    reply = exchange(server, STREAM + "?nbrofframes=1")
    assert reply.count(b"--myboundary\r\n") == 1
    start = time.monotonic()
    reply = exchange(server, STREAM + "?duration=0.3")
    assert time.monotonic() - start >= 0.3
    assert reply.count(b"--myboundary\r\n") == 1


@pytest.mark.wire
def test_a_rate_that_is_asked_for_is_kept(server, feed):
    with Viewer(server, STREAM + "?fps=0.01") as viewer:
        viewer.part()
        viewer.connection.settimeout(0.3)
        for index in range(1, 10):
            publish(feed, index)
        with pytest.raises(TimeoutError):
            viewer.connection.recv(1)


@pytest.mark.wire
def test_close_ends_streams_stalls_and_idle_clients_soon(feed):
    server = AxisServer({1: feed})
    idle = socket.create_connection(address(server), DEADLINE_S)
    with Viewer(server) as viewer, idle:
        viewer.part()
        server.faults.set("stall")
        with ask(server, SNAPSHOT) as stalled:
            assert stalled.recv(10)
            start = time.monotonic()
            server.close()
            server.close()
            assert time.monotonic() - start < 5
            assert viewer.stream.read() == b""
            assert idle.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(address(server), DEADLINE_S)


@pytest.mark.wire
def test_an_address_in_use_is_told(server):
    host, port = address(server)
    with pytest.raises(DeviceError, match=f"cannot listen at {host}:{port}"):
        AxisServer({}, host=host, port=port)
    with pytest.raises(DeviceError, match="cannot listen at"):
        AxisServer({}, port=99999)


# Faults
@pytest.mark.wire
def test_stall_stops_half_way_and_goes_on(server, feed):
    jpeg = body(exchange(server, SNAPSHOT))
    server.faults.set("stall")
    with Viewer(server) as viewer:
        head = b"--myboundary\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
        half = head + jpeg[: len(jpeg) // 2]
        assert viewer.stream.read(len(half)) == half
        viewer.connection.settimeout(0.3)
        with pytest.raises(TimeoutError):
            viewer.connection.recv(1)
        publish(feed, 1)
        publish(feed, 2)
        server.faults.set("stall", False)
        viewer.connection.settimeout(DEADLINE_S)
        rest = jpeg[len(jpeg) // 2 :] + b"\r\n"
        assert viewer.connection.recv(len(rest), socket.MSG_WAITALL) == rest
        again = viewer.connection.recv(10**6)
        assert PART.match(again)


@pytest.mark.wire
def test_cut_closes_half_way(server):
    jpeg = body(exchange(server, SNAPSHOT))
    server.faults.set("cut")
    reply = exchange(server, STREAM)
    assert reply.endswith(jpeg[: len(jpeg) // 2])
    assert body(exchange(server, SNAPSHOT)) == jpeg[: len(jpeg) // 2]
    server.faults.set("cut", False)
    assert body(exchange(server, SNAPSHOT)) == jpeg


@pytest.mark.wire
def test_corrupt_pictures_have_the_right_length(server, feed):
    good = body(exchange(server, SNAPSHOT))
    server.faults.set("corrupt")
    with Viewer(server) as viewer:
        bad = viewer.part()
        assert len(bad) == len(good)
        assert decode(bad) is None


@pytest.mark.wire
def test_lengths_that_lie_and_lengths_that_are_missing(server, feed):
    server.faults.set("wrong-length")
    for index, error in [(2, -1), (3, 1)]:
        publish(feed, index)
        reply = exchange(server, SNAPSHOT)
        said = int(re.search(rb"Content-Length: (\d+)", reply)[1])
        assert np.sign(said - len(body(reply))) == error
    server.faults.set("wrong-length", False)
    server.faults.set("no-length")
    reply = exchange(server, STREAM + "?nbrofframes=1")
    assert reply.startswith(STREAM_HEAD + b"--myboundary\r\nContent-Type: image/jpeg\r\n\r\n\xff\xd8")
    assert reply.endswith(b"\xff\xd9\r\n")


@pytest.mark.wire
def test_the_boundary_may_be_told_with_its_dashes(server):
    server.faults.set("dashed-boundary")
    head = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=--myboundary\r\n\r\n"
    with Viewer(server, head=head) as viewer:
        viewer.part()  # delimited as ever


@pytest.mark.wire
@pytest.mark.parametrize(("fault", "status"), [("unauthorized", b"401"), ("busy", b"503"), ("refuse", None)])
def test_refusing_faults_refuse_and_end_the_streams(server, feed, fault, status):
    with Viewer(server) as viewer:
        viewer.part()
        server.faults.set(fault)
        assert viewer.stream.read() == b""
    if status is None:
        with pytest.raises((ConnectionResetError, BrokenPipeError)):
            exchange(server, SNAPSHOT)
    else:
        assert exchange(server, SNAPSHOT).startswith(b"HTTP/1.0 " + status)
        assert exchange(server, STREAM).startswith(b"HTTP/1.0 " + status)
    server.faults.set(fault, False)
    assert exchange(server, SNAPSHOT).startswith(b"HTTP/1.0 200 ")


@pytest.mark.wire
def test_no_video_is_told_and_shown(server, feed):
    server.faults.set("no-video")
    assert body(exchange(server, "/axis-cgi/videostatus.cgi?status=1")) == b"Video 1 = no video\n"
    image = decode(body(exchange(server, SNAPSHOT)))
    assert image.shape == (480, 640, 3)
    np.testing.assert_allclose(image[:100].mean((0, 1)), (160, 40, 20), atol=JPEG_LEVELS)
    server.faults.set("no-video", False)
    np.testing.assert_allclose(decode(body(exchange(server, SNAPSHOT))).mean((0, 1)), (40, 0, 200), atol=JPEG_LEVELS)


@pytest.mark.wire
def test_frozen_repeats_the_same_bytes(server, feed):
    with Viewer(server) as viewer:
        first = viewer.part()
        server.faults.set("frozen")
        publish(feed, 100)
        assert viewer.part() == first
        publish(feed, 101)
        assert viewer.part() == first
        server.faults.set("frozen", False)
        publish(feed, 200)
        np.testing.assert_allclose(decode(viewer.part()).mean((0, 1)), (40, 200, 200), atol=JPEG_LEVELS)


@pytest.mark.wire
def test_the_resolution_may_change_in_midstream(server, feed):
    with Viewer(server, STREAM + "?resolution=4CIF") as viewer:
        assert decode(viewer.part()).shape == (576, 704, 3)
        server.faults.set("resolution")
        publish(feed, 1)
        assert decode(viewer.part()).shape == (288, 352, 3)


def test_every_fault_has_a_name():
    faults = Faults(AXIS_FAULTS)
    with pytest.raises(ConfigError, match="unknown fault 'gremlins'; valid here: busy, corrupt, cut"):
        faults.set("gremlins")
    assert len(faults.known) == 12
