"""SOAP of ONVIF by hand: XML, the user's token, faults, durations and spaces."""

import base64
import contextlib
import hashlib
import http.server
import socket
import threading
import time
from datetime import UTC, datetime, timedelta
from xml.etree.ElementTree import fromstring

import pytest

from cotarget.drivers.link_errors import SilentError
from cotarget.drivers.onvif import Coordinate, Range, abilities_of, path_of, seconds, status_of, vector
from cotarget.drivers.soap import (
    EmptyAnswerError,
    LoginFaultError,
    SoapClient,
    device_time,
    fault_of,
    find,
    parse_xml,
    text_at,
    user_token,
)
from cotarget.emulators.onvif import BOMB
from cotarget.errors import DeviceError
from tests.support.loopback import Loopback

TT = "http://www.onvif.org/ver10/schema"


CLOCK = "<q:Time><q:Hour>%H</q:Hour><q:Minute>%M</q:Minute><q:Second>%S</q:Second></q:Time>"
DATE = "<q:Date><q:Year>%Y</q:Year><q:Month>%m</q:Month><q:Day>%d</q:Day></q:Date>"
TIME = (
    "<r:GetSystemDateAndTimeResponse xmlns:r='x'><r:SystemDateAndTime><q:UTCDateTime>{}{}</q:UTCDateTime>"
    "</r:SystemDateAndTime></r:GetSystemDateAndTimeResponse>"
)
REFUSED = (
    "<env:Fault><env:Code><env:Value>env:Sender</env:Value><env:Subcode><env:Value>wsse:FailedAuthentication"
    "</env:Value></env:Subcode></env:Code><env:Reason><env:Text>no</env:Text></env:Reason></env:Fault>"
)


def wrapped(body):
    return (
        f'<?xml version="1.0"?><env:Envelope xmlns:env="http://www.w3.org/2003/05/soap-envelope" xmlns:q="{TT}" '
        f'xmlns:er="http://www.onvif.org/ver10/error"><env:Body>{body}</env:Body></env:Envelope>'
    )


def said(body):
    """An answer, whose prefixes are none that a client may rely on."""
    return parse_xml(wrapped(body).encode())


@pytest.mark.parametrize("data", [
    BOMB.encode(), b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', b"", b"<a>", b"\x00\xff<<",
    b'<?xml version="1.0" encoding="nonsense"?><a/>', BOMB.encode("utf-16"),
])  # fmt: skip
def test_what_is_no_plain_xml_is_refused(data):
    with pytest.raises(ValueError, match=r"."):
        parse_xml(data)


def test_the_password_is_sent_as_a_digest_of_nonce_time_and_password():
    """The example of ONVIF's Application Programmer's Guide, 6.1.1.3."""
    nonce = base64.b64decode("LKqI6G/AikKCQrN0zqZFlg==")
    header = fromstring(
        user_token("user", "userpassword", datetime(2010, 9, 16, 7, 50, 45, tzinfo=UTC), nonce).replace(
            "<s:Header>", '<s:Header xmlns:s="x">'
        )
    )
    token = "{*}Security/{*}UsernameToken/{*}"
    assert header.find(f"{token}Created").text == "2010-09-16T07:50:45.000Z"
    assert header.find(f"{token}Nonce").text == "LKqI6G/AikKCQrN0zqZFlg=="
    wanted = base64.b64encode(hashlib.sha1(nonce + b"2010-09-16T07:50:45.000Zuserpassword").digest()).decode()
    assert header.find(f"{token}Password").text == wanted


def test_a_fault_is_its_reason_and_its_innermost_codes():
    root = said(
        "<env:Fault><env:Code><env:Value>env:Sender</env:Value><env:Subcode><env:Value>er:NotAuthorized</env:Value>"
        "</env:Subcode></env:Code><env:Reason><env:Text>Sender\n  not Authorized</env:Text></env:Reason></env:Fault>"
    )
    fault = fault_of(root, "the device at x", "Stop")
    assert type(fault).__name__ == "LoginFaultError"
    assert fault.codes == ("Sender", "NotAuthorized")
    assert str(fault) == "the device at x refuses Stop: Sender not Authorized"
    assert fault_of(said("<StopResponse/>"), "x", "Stop") is None


@pytest.mark.parametrize(("text", "value"), [
    ("PT5S", 5.0), ("PT1M30.5S", 90.5), ("P1DT1H", 90000.0), ("PT0S", 0.0), ("", 0.0), ("5", 0.0), ("PT-1S", 0.0),
    ("P0Y0M0DT0H0M10.000S", 10.0),
])  # fmt: skip
def test_durations(text, value):
    assert seconds(text) == value


@pytest.mark.parametrize(("address", "path"), [
    ("http://192.168.1.64:80/onvif/PTZ", "/onvif/PTZ"), ("https://a.lan/ptz.cgi?unit=1&a=2", "/ptz.cgi?unit=1&a=2"),
    ("http://192.168.1.64", "/onvif/device_service"), ("", "/onvif/device_service"),
])  # fmt: skip
def test_of_an_address_of_a_service_path_and_query_count(address, path):
    assert path_of(address) == path


def test_the_devices_time_is_its_utc_time():
    clock = CLOCK.replace("%H", "23").replace("%M", "5").replace("%S", "{}")
    date = DATE.replace("%Y", "2026").replace("%m", "2").replace("%d", "{}")
    found = device_time(said(TIME.format(clock.format(7), date.format(28))))
    assert found == datetime(2026, 2, 28, 23, 5, 7, tzinfo=UTC)
    assert device_time(said(TIME.format(clock.format(60), date.format(28)))) is not None  # a leap second
    assert device_time(said(TIME.format(clock.format(7), date.format(30)))) is None
    assert device_time(said("<other/>")) is None


def status(inner):
    return status_of(
        said(f"<r:GetStatusResponse xmlns:r='x'><r:PTZStatus>{inner}</r:PTZStatus></r:GetStatusResponse>"), 3.0
    )


@pytest.mark.parametrize(("inner", "wanted"), [
    ('<q:Position><q:PanTilt x="0.5" y="-1" space="u"/><q:Zoom x="0"/></q:Position>', (0.5, -1.0, 0.0)),
    ('<q:Position><q:Zoom x="0.25"/></q:Position>', (None, None, 0.25)),
    ('<q:Position><q:PanTilt x="nan" y="-"/></q:Position>', (None, None, None)),
    ('<q:Position><q:PanTilt/></q:Position>', (None, None, None)),
    ("", (None, None, None)),
])  # fmt: skip
def test_a_number_that_a_status_lacks_is_unknown_and_not_zero(inner, wanted):
    assert status(inner)[:3] == wanted


def test_spaces_have_their_ranges_and_the_timeout_its_limits():
    space = (
        "<q:{0}><q:URI>{1}</q:URI><q:XRange><q:Min>0</q:Min><q:Max>360</q:Max></q:XRange>"
        "<q:YRange><q:Min>-90</q:Min><q:Max>9e1</q:Max></q:YRange></q:{0}>"
    )
    name = "AbsolutePanTiltPositionSpace"
    found = abilities_of(
        said(
            "<r:GetConfigurationOptionsResponse xmlns:r='x'><r:PTZConfigurationOptions><q:Spaces>"
            f"{space.format(name, 'plain')}{space.format(name, 'degrees')}</q:Spaces>"
            "<q:PTZTimeout><q:Min>PT1S</q:Min><q:Max>PT10M</q:Max></q:PTZTimeout>"
            "</r:PTZConfigurationOptions></r:GetConfigurationOptionsResponse>"
        )
    )
    assert found.timeout_s == (1.0, 600.0)
    assert found.space(name).uri == "plain"
    assert found.space(name, "degrees").uri == "degrees"
    assert found.space(name, "other").ranges == (Range(0.0, 360.0), Range(-90.0, 90.0))
    assert found.space("AbsoluteZoomPositionSpace") is None


def test_coordinates_are_converted_at_their_ends():
    """From -1 to 1 is from -30 to 90 degrees: 0 is 30."""
    coordinate = Coordinate(Range(-1.0, 1.0), Range(-30.0, 90.0))
    assert [coordinate.to_degrees(number) for number in (-1, 0, 1)] == [-30.0, 30.0, 90.0]
    assert coordinate.to_number(60.0) == pytest.approx(0.5)


def test_a_vector_leaves_out_what_is_not_named():
    assert vector(0.5, -1.0, None) == '<t:PanTilt x="0.500000" y="-1.000000"/>'
    assert vector(None, None, 0.1, ("", "u")) == '<t:Zoom x="0.100000" space="u"/>'


def test_elements_are_found_in_any_namespace():
    root = said("<a xmlns='1'><b xmlns='2'> c </b></a>")
    assert text_at(root, "Body/a/b") == "c"
    assert find(root, "Body/b") is None
    assert text_at(None, "a") == ""


# The client


@contextlib.contextmanager
def listening(*user):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(10.0)
        with contextlib.closing(SoapClient(f"127.0.0.1:{listener.getsockname()[1]}", *user)) as client:
            yield listener, client


class _Server(Loopback, http.server.ThreadingHTTPServer):
    answer = None


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"  # a connection is kept

    def do_POST(self):
        asked = self.rfile.read(int(self.headers["Content-Length"])).decode()
        status, page = self.server.answer(asked)
        self.send_response(status)
        self.send_header("Content-Length", len(page.encode()))
        self.end_headers()
        self.wfile.write(page.encode())

    def log_message(self, *_):
        pass


@contextlib.contextmanager
def answering(answer, *user):
    """A client of a device that answers an envelope by a status and a page."""
    with _Server(("127.0.0.1", 0), _Handler) as server:
        server.answer = answer
        with contextlib.closing(SoapClient(f"127.0.0.1:{server.server_address[1]}", *user)) as client:
            yield client


def test_a_command_that_was_given_up_is_discarded_with_its_connection():
    """A reset says so; after an orderly end the system would go on sending what has not arrived."""
    with listening() as (listener, client):
        with pytest.raises(SilentError):
            client.call("/", "x", "AbsoluteMove", timeout=0.2)
        connection, _ = listener.accept()
        with connection, pytest.raises(ConnectionResetError):
            b"".join(iter(lambda: connection.recv(1000), b""))


def close_unasked(listener, heard):
    """Answer one request a connection, and close that only when the next one comes, without an answer."""
    page = wrapped("<StopResponse/>").encode()

    def read(connection):
        said = b""
        while b"</s:Envelope>" not in said and (part := connection.recv(10_000)):
            said += part
        heard.append(said)

    with contextlib.suppress(OSError):
        while True:
            connection, _ = listener.accept()
            with connection:
                read(connection)
                connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%s" % (len(page), page))
                read(connection)


def test_a_request_that_a_kept_connection_takes_no_more_is_sent_again_unless_it_may_be_sent_once():
    """As of Thingino's firmware, which closes a connection after each answer and does not say so."""
    heard = []
    with listening() as (listener, client):
        thread = threading.Thread(target=close_unasked, args=(listener, heard))
        thread.start()
        client.call("/", "x", "Stop")
        client.call("/", "x", "AbsoluteMove")
        assert [b"AbsoluteMove" in each for each in heard] == [False, True, True]
        with pytest.raises(SilentError, match="broke off at RelativeMove"):
            client.call("/", "x", "RelativeMove", once=True)
        assert sum(b"RelativeMove" in each for each in heard) == 1
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()


def test_a_device_that_has_gone_is_silent():
    """So that its unplugging is one error, and the missing answer to the last halt no second one."""
    with listening() as (listener, client):
        listener.close()
        with pytest.raises(SilentError, match="cannot be reached"):
            client.call("/", "x", "GetStatus")


@pytest.mark.parametrize("status", [200, 204])
def test_success_without_an_answer_is_told_from_another_protocol(status):
    with answering(lambda asked: (status, "")) as client, pytest.raises(EmptyAnswerError, match="by nothing"):
        client.call("/", "x", "AbsoluteMove")


def test_a_connection_takes_no_longer_than_the_answer_may():
    """One that nothing takes: the queue of the listener is full."""
    with contextlib.ExitStack() as opened:
        listener = opened.enter_context(socket.create_server(("127.0.0.1", 0), backlog=0))
        for _ in range(4):
            waiting = opened.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(listener.getsockname())
        client = opened.enter_context(contextlib.closing(SoapClient(f"127.0.0.1:{listener.getsockname()[1]}")))
        begin = time.monotonic()
        with pytest.raises(DeviceError, match="does not answer"):
            client.call("/", "x", "Stop", timeout=0.3)
        assert time.monotonic() - begin < 1.0


def test_a_refused_request_is_read_with_the_limits_of_any_other():
    """An answer that comes piece by piece for 5 s."""

    def serve(listener):
        connection, _ = listener.accept()
        with connection, contextlib.suppress(OSError):
            connection.recv(10_000)
            connection.sendall(b'HTTP/1.1 401 Unauthorized\r\nWWW-Authenticate: Digest realm="r", nonce="n"\r\n\r\n')
            for _ in range(50):
                connection.sendall(b"<p>")
                time.sleep(0.1)

    with listening("root", "wrong") as (listener, client):
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        begin = time.monotonic()
        with pytest.raises(SilentError):
            client.call("/", "x", "Stop", timeout=0.5)
        assert time.monotonic() - begin < 2.0
        thread.join()


@pytest.mark.parametrize(
    "page", ["", "<!DOCTYPE html><html><p>Unauthorized<br></html>", "<html><p>Unauthorized</html>"]
)
def test_a_page_with_status_401_is_a_refused_login(page):
    """As of Axis and Hikvision."""
    with (
        answering(lambda asked: (401, page)) as client,
        pytest.raises(LoginFaultError, match="check user and password"),
    ):
        client.call("/", "x", "GetProfiles")


@pytest.mark.parametrize(("steps", "logins"), [((0, 0), 1), ((0, 3600), 2)])
def test_a_refused_login_is_repeated_only_where_the_clock_was_set_since(steps, logins):
    """A device of gSOAP, which locks a user who is refused often."""
    clock, asked = list(steps), []

    def answer(envelope):
        if "GetSystemDateAndTime" in envelope:
            now = datetime.now(UTC) + timedelta(seconds=clock.pop(0))
            return 200, wrapped(TIME.format(f"{now:{CLOCK}}", f"{now:{DATE}}"))
        asked.append(envelope)
        return 400, wrapped(REFUSED)

    with answering(answer, "root", "wrong") as client, pytest.raises(LoginFaultError, match="not for the user 'root'"):
        client.call("/", "x", "GetProfiles")
    assert len(asked) == logins


def test_a_connection_made_while_the_client_was_closed_is_closed_too(monkeypatch):
    """httpx closes the connections that it knows, and this one comes later."""
    connect, made = socket.create_connection, []

    def late(*args, **kwargs):
        made.append(connect(*args, **kwargs))
        client.close()
        return made[0]

    with answering(lambda asked: (200, wrapped("<GetProfilesResponse/>"))) as client:
        monkeypatch.setattr(socket, "create_connection", late)
        client.call("/", "x", "GetProfiles")
    assert made[0].fileno() == -1
