"""The emulated Axis 241Q, byte for byte against VAPIX 2 and RFC 2617; each fault; slow and many viewers."""

import re
import socket
import threading
from dataclasses import replace
from email.message import Message

import cv2
import numpy as np
import pytest

from cotarget.emulators.authentication import Authenticator
from cotarget.emulators.axis_241q import AxisServer, HttpError, Pace, list_parameters, parse_options
from cotarget.emulators.plant import Feed
from tests.support.emulated_camera import DEADLINE_S, plain, publish
from tests.support.plants import decoded, wait_for

JPEG_LEVELS = 3.0  # JPEG's error in the mean of a flat picture [grey levels]
STREAM_HEAD = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=myboundary\r\n\r\n"
PART = re.compile(rb"--myboundary\r\nContent-Type: image/jpeg\r\nContent-Length: (\d+)\r\n\r\n")
SNAPSHOT = "/axis-cgi/jpg/image.cgi"
STREAM = "/axis-cgi/mjpg/video.cgi"
STATUS = "/axis-cgi/videostatus.cgi"
# The example of RFC 2617, 3.5.
RFC_NONCE = "dcd98b7102dd2f0e8b11d0f600bfb0c093"
RFC_DIGEST = (
    f'Digest username="Mufasa", realm="testrealm@host.com", nonce="{RFC_NONCE}", uri="/dir/index.html", qop=auth, '
    'nc=00000001, cnonce="0a4f113b", response="6629fae49393a05397450978507c4ef1", opaque="5ccc069c403ebaf9f0171e9517"'
)


def show(feed, index):
    """Publish a picture whose green is its number."""
    publish(feed, index, plain((640, 480), (40, index % 256, 200)))


def shows(jpeg, green, blue=40):
    np.testing.assert_allclose(decoded(jpeg).mean((0, 1))[:2], (blue, green), atol=JPEG_LEVELS)


@pytest.fixture
def feed():
    feed = Feed()
    show(feed, 0)
    return feed


@pytest.fixture
def server(feed):
    before = set(threading.enumerate())
    with AxisServer({1: feed}, quality=90) as server:
        yield server
    assert set(threading.enumerate()) <= before


def ask(server, request):
    """A connection on which a request has been sent: its bytes, or a target to get."""
    connection = socket.create_connection((server.host, server.port), DEADLINE_S)
    try:
        connection.sendall(request if isinstance(request, bytes) else f"GET {request} HTTP/1.0\r\n\r\n".encode())
    except OSError:
        connection.close()
        raise
    return connection


def exchange(server, request):
    """All that the server answers until it closes."""
    with ask(server, request) as connection, connection.makefile("rb") as stream:
        return stream.read()


def body(reply):
    return reply.partition(b"\r\n\r\n")[2]


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
        data = self.stream.read(int(PART.fullmatch(head)[1]))
        assert self.stream.read(2) == b"\r\n"
        return data

    def close(self):
        self.stream.close()
        self.connection.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


# Pure: arguments and passwords
def allowed(guard, authorization, target="/dir/index.html", method="GET"):
    headers = Message()
    headers["Authorization"] = authorization
    return guard.allows(method, target, headers)


RFC_GUARD = Authenticator("Mufasa", "Circle Of Life", "digest", "testrealm@host.com", RFC_NONCE)


def test_the_digest_of_the_rfc_is_allowed():
    assert allowed(RFC_GUARD, RFC_DIGEST)
    assert RFC_GUARD.challenge == (
        f'WWW-Authenticate: Digest realm="testrealm@host.com", nonce="{RFC_NONCE}", algorithm=MD5, qop="auth"'
    )
    assert not allowed(RFC_GUARD, RFC_DIGEST, method="POST")
    assert not allowed(RFC_GUARD, RFC_DIGEST, target="/secret")
    assert not allowed(replace(RFC_GUARD, nonce="0"), RFC_DIGEST)


@pytest.mark.parametrize(("old", "new"), [
    ("6629", "6628"), ("Mufasa", "Scar"), ("testrealm", "otherrealm"), ("nc=00000001", "nc=00000002"),
    ("qop=auth, ", ""), ("0a4f113b", ""), ("/dir/", "/other/"), ("Digest", "Basic"), (RFC_NONCE, "0"),
    ("username=", "username"), (", realm", "realm="),
])  # fmt: skip
def test_a_wrong_digest_is_refused(old, new):
    assert not allowed(RFC_GUARD, RFC_DIGEST.replace(old, new))


def test_only_the_basic_authorization_of_the_rfc_is_allowed():
    guard = Authenticator("Aladdin", "open sesame", "basic", "AXIS_00408C000241", "")
    assert guard.challenge == 'WWW-Authenticate: Basic realm="AXIS_00408C000241"'
    assert allowed(guard, "Basic QWxhZGRpbjpvcGVuIHNlc2FtZQ==")
    for authorization in ["", "Basic", "Basic ???", "Basic QWxhZGRpbjpvcGVu", "Basic /////w==", "Digest x"]:
        assert not allowed(guard, authorization)


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


@pytest.mark.parametrize(("arguments", "camera", "wanted"), [
    ({}, None, (1, None, 30, 0, 0)),
    ({"camera": "2", "resolution": "cif", "compression": "50"}, None, (2, (352, 288), 50, 0, 0)),
    ({"req_fps": "10", "des_fps": "5", "colour": "?"}, "3", (3, None, 30, 5, 0)),
    ({"nbrofframes": "3", "fps": "0", "resolution": "320x240"}, None, (1, (320, 240), 30, 0, 3)),
    ({"resolution": "4CIF"}, None, (1, (704, 576), 30, 0, 0)),
    ({"resolution": "2CIF"}, None, (1, (704, 288), 30, 0, 0)),
    ({"resolution": "QCIF"}, None, (1, (176, 144), 30, 0, 0)),
])  # fmt: skip
def test_arguments_of_vapix(arguments, camera, wanted):
    options = parse_options(arguments, camera)
    assert (options.camera, options.size, options.compression, options.rate_hz, options.count) == wanted


@pytest.mark.parametrize(
    ("name", "values"),
    {
        "camera": ["5", "0", "one"],
        "resolution": ["9CIF", "640", "640x", "-1x480"],
        "compression": ["101", "nan"],
        "fps": ["-1", "fast"],
        "nbrofframes": ["x"],
    }.items(),
)
def test_wrong_arguments_are_refused(name, values):
    for value in values:
        with pytest.raises(HttpError) as caught:
            parse_options({name: value})
        assert caught.value.status == 400


BRAND = "root.Brand.Brand=AXIS\nroot.Brand.ProdNbr=241Q\n"
NOPE = "# Error: Error -1 getting param in group 'root.Nope'\n"


@pytest.mark.parametrize(("arguments", "answer"), [
    ({"action": "list", "group": "root.Brand"}, BRAND), ({"action": "list", "group": "Brand"}, BRAND),
    ({"action": "list", "group": "root.Brand.ProdNbr"}, "root.Brand.ProdNbr=241Q\n"),
    ({"action": "list"}, BRAND + "root.Brandy.Age=12\n"),
    ({"action": "list", "group": "root"}, BRAND + "root.Brandy.Age=12\n"),
    ({"action": "list", "group": "root.Nope"}, NOPE),
    ({"action": "list", "group": "Brand.ProdNbr,root.Nope"}, "root.Brand.ProdNbr=241Q\n" + NOPE),
    ({"action": "update"}, "# Error: Unknown action 'update'\n"), ({}, "# Error: Unknown action ''\n"),
])  # fmt: skip
def test_groups_of_parameters(arguments, answer):
    listed = {"root.Brand.Brand": "AXIS", "root.Brand.ProdNbr": "241Q", "root.Brandy.Age": "12"}
    assert list_parameters(listed, arguments) == answer


# Over loopback
@pytest.mark.wire
def test_a_snapshot_byte_for_byte(server):
    for target in [SNAPSHOT, "/jpg/image.jpg", "/jpg/1/image.jpg"]:
        reply = exchange(server, target)
        data = body(reply)
        assert reply == b"HTTP/1.0 200 OK\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data) + data
        shows(data, 0)


@pytest.mark.wire
def test_a_stream_byte_for_byte(server, feed):
    for target in [STREAM, "/mjpg/video.mjpg", "/mjpg/1/video.mjpg"]:
        jpeg = body(exchange(server, SNAPSHOT))
        head = b"--myboundary\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(jpeg)
        assert exchange(server, target + "?nbrofframes=1") == STREAM_HEAD + head + jpeg + b"\r\n"
    with Viewer(server) as viewer:
        for index in range(1, 6):
            viewer.part()
            show(feed, index)
        shows(viewer.part(), 5)


@pytest.mark.wire
def test_sizes_and_compression_as_requested(server, feed):
    publish(feed, 1, np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8))
    for asked, size in [("CIF", (352, 288)), ("2CIF", (704, 288)), ("4CIF", (704, 576)), ("64x48", (64, 48))]:
        assert decoded(body(exchange(server, f"{SNAPSHOT}?resolution={asked}"))).shape == (size[1], size[0], 3)
    with Viewer(server, STREAM + "?resolution=QCIF") as viewer:
        assert decoded(viewer.part()).shape == (144, 176, 3)
    lengths = [len(exchange(server, f"{SNAPSHOT}?compression={value}")) for value in (100, 60, 30, 0)]
    assert lengths == sorted(set(lengths))
    _, exact = cv2.imencode(".jpg", feed.newest().image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert body(exchange(server, SNAPSHOT)) == bytes(exact)  # the quality of the fixture, at Axis' default


@pytest.mark.wire
def test_each_input_has_its_own_images(feed):
    other = Feed()
    publish(other, 0, plain((640, 480), (0, 255, 0)))
    with AxisServer({1: feed, 3: other}) as server:
        assert body(exchange(server, STATUS + "?status=1,2")) == b"Video 1 = video\nVideo 2 = no video\n"
        assert body(exchange(server, "/axis-cgi/view/videostatus.cgi")).count(b"= video") == 2
        shows(body(exchange(server, SNAPSHOT + "?camera=3")), 255, blue=0)
        with Viewer(server, "/mjpg/2/video.mjpg") as viewer:  # no signal, but a stream that goes on
            assert decoded(viewer.part()).shape == decoded(viewer.part()).shape == (576, 704, 3)


@pytest.mark.wire
@pytest.mark.parametrize(
    ("directory", "form"),
    [("", ""), ("admin/", "application/x-www-form-urlencoded"), ("view/", "text/plain"), ("operator/", "")],
)
def test_parameters_by_get_and_post(server, directory, form):
    path, arguments = f"/axis-cgi/{directory}param.cgi", "action=list&group=root.Brand"
    head = f"POST {path} HTTP/1.1\r\nContent-Type: {form}\r\nContent-Length: {len(arguments)}\r\n\r\n"
    reply = exchange(server, f"{head}{arguments}".encode() if form else f"{path}?{arguments}")
    assert reply == (
        b"HTTP/1.0 200 OK\r\nContent-Type: text/plain\r\n\r\n"
        b"root.Brand.Brand=AXIS\nroot.Brand.ProdFullName=AXIS 241Q Video Server\nroot.Brand.ProdNbr=241Q\n"
        b"root.Brand.ProdShortName=AXIS 241Q\nroot.Brand.ProdType=Video Server\nroot.Brand.WebURL=http://www.axis.com\n"
    )


@pytest.mark.wire
@pytest.mark.parametrize(("request_", "status"), [
    ("/axis-cgi/nothing.cgi", 404), ("/", 404), (SNAPSHOT + "?camera=7", 400),
    (SNAPSHOT + "?resolution=9999x9999", 400), (STREAM + "?resolution=8x8", 400), ("/mjpg/5/video.mjpg", 400),
    (STATUS + "?status=9", 400), ("/a b c", 400), ("http://[/", 400), (b"DELETE / HTTP/1.0\r\n\r\n", 501),
    (b"GET\r\n\r\n", 400), (b"GET / RTSP/1.0\r\n\r\n", 400), (b"GET / HTTP/1.0\r\nContent-Length: many\r\n\r\n", 400),
])  # fmt: skip
def test_refusals(server, request_, status):
    assert exchange(server, request_).startswith(b"HTTP/1.0 %d " % status)


@pytest.mark.wire
def test_twenty_viewers_and_no_more(server, feed):
    viewers = [Viewer(server) for _ in range(20)]
    assert len({viewer.part() for viewer in viewers}) == 1
    assert exchange(server, STREAM).startswith(b"HTTP/1.0 503 Service Unavailable\r\n")
    assert exchange(server, SNAPSHOT).startswith(b"HTTP/1.0 200 OK\r\n")
    show(feed, 1)
    assert len({viewer.part() for viewer in viewers}) == 1
    viewers.pop().close()
    wait_for(lambda: exchange(server, STREAM + "?nbrofframes=1").startswith(b"HTTP/1.0 200 "))
    for viewer in viewers:
        viewer.close()


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
        show(feed, 1)
        show(feed, 2)
        server.faults.set("stall", False)
        viewer.connection.settimeout(DEADLINE_S)
        rest = jpeg[len(jpeg) // 2 :] + b"\r\n"
        assert viewer.connection.recv(len(rest), socket.MSG_WAITALL) == rest
        assert PART.match(viewer.connection.recv(10**6))


def corrupt(server, feed, good):
    bad = body(exchange(server, SNAPSHOT))
    assert len(bad) == len(good)
    assert decoded(bad) is None


def cut(server, feed, good):
    assert exchange(server, STREAM).endswith(good[: len(good) // 2])
    assert body(exchange(server, SNAPSHOT)) == good[: len(good) // 2]


def wrong_length(server, feed, good):
    for index, error in [(2, -1), (3, 1)]:
        show(feed, index)
        reply = exchange(server, SNAPSHOT)
        assert np.sign(int(re.search(rb"Content-Length: (\d+)", reply)[1]) - len(body(reply))) == error


def no_length(server, feed, good):
    reply = exchange(server, STREAM + "?nbrofframes=1")
    assert reply.startswith(STREAM_HEAD + b"--myboundary\r\nContent-Type: image/jpeg\r\n\r\n\xff\xd8")
    assert reply.endswith(b"\xff\xd9\r\n")


def dashed_boundary(server, feed, good):
    head = STREAM_HEAD.replace(b"=myboundary", b"=--myboundary")
    with Viewer(server, head=head) as viewer:
        assert viewer.part() == good  # delimited as ever


def no_video(server, feed, good):
    assert body(exchange(server, STATUS + "?status=1")) == b"Video 1 = no video\n"
    image = decoded(body(exchange(server, SNAPSHOT)))
    assert image.shape == (480, 640, 3)
    np.testing.assert_allclose(image.mean((0, 1)), (160, 40, 20), atol=JPEG_LEVELS)


def frozen(server, feed, good):
    for index in (100, 101):
        show(feed, index)
        assert body(exchange(server, SNAPSHOT)) == good
    show(feed, 0)


def resolution(server, feed, good):
    assert decoded(body(exchange(server, SNAPSHOT))).shape == (240, 320, 3)


@pytest.mark.wire
@pytest.mark.parametrize(
    "check", [corrupt, cut, wrong_length, no_length, dashed_boundary, no_video, frozen, resolution]
)
def test_faults_of_the_pictures(server, feed, check):
    good = body(exchange(server, SNAPSHOT))
    fault = check.__name__.replace("_", "-")
    server.faults.set(fault)
    check(server, feed, good)
    server.faults.set(fault, False)
    show(feed, 200)
    shows(body(exchange(server, SNAPSHOT)), 200)


@pytest.mark.wire
@pytest.mark.parametrize(("fault", "status"), [("unauthorized", b"401"), ("busy", b"503"), ("refuse", None)])
def test_refusing_faults_refuse_and_end_the_streams(server, fault, status):
    with Viewer(server) as viewer:
        viewer.part()
        server.faults.set(fault)
        assert viewer.stream.read() == b""
    for target in (SNAPSHOT, STREAM):
        if status is None:
            with pytest.raises((ConnectionResetError, BrokenPipeError)):
                exchange(server, target)
        else:
            assert exchange(server, target).startswith(b"HTTP/1.0 " + status)
    server.faults.set(fault, False)
    assert exchange(server, SNAPSHOT).startswith(b"HTTP/1.0 200 ")
