"""An RTSP server of pictures encoded as H.264: RTSP 1.0 (RFC 2326), RTP and RTCP within the connection (RFC 3550).

An `Encoder` makes a feed of pictures an `EncodedStream`, which `RtspServer` sends to any number of clients, each on
threads of its own: one that reads slowly misses pictures up to the next key frame, and one that reads nothing is
disconnected; others notice neither. As with cameras, a client that joins waits for a key frame by itself.
"""

import base64
import contextlib
import math
import re
import secrets
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from email.message import Message
from fractions import Fraction
from urllib.parse import urlsplit

import av
import cv2
import numpy as np

from cotarget.emulators.authentication import Authenticator
from cotarget.emulators.plant import Feed
from cotarget.emulators.serve import LOCAL, Closes, Faults, TcpServer
from cotarget.rig import Image

# Encoded pictures

TICKS_HZ = 90_000  # RTP's clock of video (RFC 6184)
START_CODE = re.compile(rb"\x00\x00\x00?\x01")
SLICE, KEY_SLICE, SEQUENCE_SET, PICTURE_SET = 1, 5, 7, 8  # types of NAL units
KEPT = 64  # newest pictures that a slow client can still get


@dataclass(frozen=True, eq=False)
class AccessUnit:
    """One encoded picture.

    Attributes:
        index: sequence number, which increases by one.
        t: middle of the exposure on the machine's monotonic clock [s].
        nals: NAL units without start codes.
    """

    index: int
    t: float
    nals: tuple[bytes, ...]

    @property
    def is_key(self) -> bool:
        """Whether decoding can begin here."""
        return any(nal[0] & 0x1F == KEY_SLICE for nal in self.nals)


class EncodedStream:
    """The newest encoded pictures, published by one thread and awaited by others."""

    def __init__(self) -> None:
        self._units = deque[AccessUnit](maxlen=KEPT)
        self._parameter_sets: tuple[bytes, ...] = ()
        self._new = threading.Condition()

    def publish(self, unit: AccessUnit) -> None:
        """Append a picture; a key frame brings its parameter sets."""
        sets = tuple(nal for nal in unit.nals if nal[0] & 0x1F in (SEQUENCE_SET, PICTURE_SET))
        with self._new:
            self._units.append(unit)
            self._parameter_sets = sets or self._parameter_sets
            self._new.notify_all()

    def after(self, index: int, timeout: float) -> AccessUnit | None:
        """Wait for the picture after one; where that is lost, for the newest key frame, and with -1 for the newest.

        Args:
            index: number of a picture.
            timeout: time limit [s]; None is returned then.
        """
        with self._new:
            self._new.wait_for(lambda: self._next(index) is not None, timeout)
            return self._next(index)

    def parameter_sets(self, timeout: float) -> tuple[bytes, ...]:
        """Wait for the parameter sets of the stream; empty if none come within ``timeout`` [s]."""
        with self._new:
            self._new.wait_for(lambda: self._parameter_sets, timeout)
            return self._parameter_sets

    def _next(self, index: int) -> AccessUnit | None:
        if not self._units or self._units[-1].index <= index:
            return None
        oldest, newest = self._units[0].index, self._units[-1].index
        if index < 0:
            return self._units[-1]
        if index + 1 >= oldest:
            return self._units[index + 1 - newest - 1]
        return next((unit for unit in reversed(self._units) if unit.is_key), None)


def split_nals(data: bytes) -> tuple[bytes, ...]:
    """Split a byte stream of H.264 at its start codes."""
    return tuple(nal for nal in START_CODE.split(data) if nal)


ENDLESS = 1_000_000  # pictures in a group
LONG_GROUP_S = 10.0
B_FRAMES = 2
BLUR_PX = 8.0
CHECK_S = 0.1  # period with which waiting threads check for the end [s]


class Encoder(Closes):
    """Encode a feed on a thread, from construction until it is closed; a context manager.

    Args:
        feed: of pictures with even sizes.
        stream: where the encoded pictures go.
        rate_hz: nominal rate of the pictures.
        group_s: time from one key frame to the next [s].
        crf: x264's quality; less is finer.
        faults: of `RTSP_FAULTS`.
    """

    def __init__(
        self,
        feed: Feed,
        stream: EncodedStream,
        rate_hz: float,
        *,
        group_s: float = 1.0,
        crf: int = 18,
        faults: Faults,
    ) -> None:
        self._feed, self._stream, self._faults = feed, stream, faults
        self._rate_hz, self._group = rate_hz, max(round(group_s * rate_hz), 1)
        self._crf = crf
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="encoder", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; may be called again."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        last, count, begin = -1, 0, time.monotonic()
        context, shown = None, None
        while not self._closing.is_set():
            picture = self._feed.newest(last, CHECK_S)
            if picture is None:
                continue
            last = picture.index
            shown = shown if "frozen" in self._faults and shown is not None else picture.image
            image = self._turned(half(shown) if "resolution" in self._faults else shown)
            image = cv2.GaussianBlur(image, None, BLUR_PX) if "blurred" in self._faults else image
            group = ENDLESS if "no-key" in self._faults else self._group
            group = round(LONG_GROUP_S * self._rate_hz) if "long-groups" in self._faults else group
            b_frames = B_FRAMES if "b-frames" in self._faults else 0
            kind = (*image.shape[1::-1], group, b_frames)
            if context is None or kind != (context.width, context.height, context.gop_size, context.max_b_frames):
                context = self._encoder(*kind)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")
            frame.time_base, frame.pts = context.time_base, round((picture.t - begin) * TICKS_HZ)
            for packet in context.encode(frame):
                t = begin + packet.pts / TICKS_HZ
                self._stream.publish(AccessUnit(count, t, split_nals(bytes(packet))))
                count += 1

    def _turned(self, image: Image) -> Image:
        """Turn or mirror an image as a camera on a ceiling may."""
        image = image[::-1, ::-1] if "upside-down" in self._faults else image
        return np.ascontiguousarray(image[:, ::-1] if "mirrored" in self._faults else image)

    def _encoder(self, width: int, height: int, group: int, b_frames: int) -> av.CodecContext:
        context = av.CodecContext.create("libx264", "w")
        context.width, context.height, context.pix_fmt = width, height, "yuv420p"
        context.time_base = Fraction(1, TICKS_HZ)
        context.framerate = Fraction(self._rate_hz).limit_denominator(1000)
        context.gop_size, context.max_b_frames = group, b_frames
        context.thread_count = 1  # the other core is the client's
        context.options = {"preset": "ultrafast", "crf": f"{self._crf}"}
        if not b_frames:
            context.options |= {"tune": "zerolatency"}
        return context


def half(image: Image) -> Image:
    """Halve an image to an even size."""
    height, width = (side // 4 * 2 for side in image.shape[:2])
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


# RTP

PAYLOAD_TYPE = 96  # the first dynamic one
LARGEST_PAYLOAD = 1400  # [bytes], as for an Ethernet frame
FU_A = 28  # type of a fragment (RFC 6184, 5.8)
NTP_EPOCH = 2_208_988_800  # 1970 on NTP's clock, which begins in 1900 [s]


def payloads(nal: bytes, largest: int = LARGEST_PAYLOAD) -> Iterator[bytes]:
    """Split a NAL unit into RTP payloads: itself where it fits, or fragments (FU-A)."""
    if len(nal) <= largest:
        yield nal
        return
    indicator, kind, size = nal[0] & 0xE0 | FU_A, nal[0] & 0x1F, largest - 2
    for begin in range(1, len(nal), size):
        is_first, is_last = begin == 1, begin + size >= len(nal)
        yield bytes([indicator, is_first << 7 | is_last << 6 | kind]) + nal[begin : begin + size]


class RtpSender:
    """Make the RTP packets and sender reports of one session."""

    def __init__(self) -> None:
        self._ssrc, self._sequence = secrets.randbits(32), secrets.randbits(16)
        self._offset = secrets.randbits(32)  # of the time stamps
        self._packets = self._octets = 0

    def timestamp(self, t: float) -> int:
        """Return the time stamp of a time on the machine's monotonic clock [s]."""
        return (self._offset + round(t * TICKS_HZ)) & 0xFFFFFFFF

    @property
    def sequence(self) -> int:
        """Sequence number of the next packet."""
        return self._sequence

    def packets(self, nals: Sequence[bytes], t: float) -> Iterator[bytes]:
        """Make the packets of a picture; the last one has the marker bit."""
        stamp = self.timestamp(t)
        for i, nal in enumerate(nals):
            parts = list(payloads(nal))
            for k, payload in enumerate(parts):
                marker = i == len(nals) - 1 and k == len(parts) - 1
                head = struct.pack("!BBHII", 0x80, marker << 7 | PAYLOAD_TYPE, self._sequence, stamp, self._ssrc)
                self._sequence = (self._sequence + 1) & 0xFFFF
                self._packets, self._octets = self._packets + 1, self._octets + len(payload)
                yield head + payload

    def report(self, now: float, unix: float) -> bytes:
        """Make a sender report with a source description.

        Args:
            now: on the machine's monotonic clock [s].
            unix: time of day at that moment, in seconds since 1970.
        """
        seconds, fraction = divmod(unix + NTP_EPOCH, 1.0)
        counts = (self._packets & 0xFFFFFFFF, self._octets & 0xFFFFFFFF)
        stamp = self.timestamp(now)
        sent = struct.pack("!BBHIIIIII", 0x80, 200, 6, self._ssrc, int(seconds), int(fraction * 2**32), stamp, *counts)
        name = b"\x01\x06camera"
        described = struct.pack("!I", self._ssrc) + name + bytes(4 - len(name) % 4)
        return sent + struct.pack("!BBH", 0x81, 202, len(described) // 4) + described


# RTSP

RTSP_FAULTS = (
    "stall",  # nothing is sent, and the connections stay open
    "cut",  # the connection closes in the middle of a picture
    "corrupt",  # bytes of every picture are destroyed
    "no-key",  # one key frame, and then no more
    "long-groups",  # a key frame every 10 s
    "b-frames",  # up to two in a row
    "jitter",  # pictures arrive up to 0.14 s late
    "sessions-end",  # each after a minute
    "blurred",  # the lens is out of focus
    "upside-down",  # the picture is turned by half a turn
    "mirrored",  # left and right of the picture are exchanged
    "frozen",  # the same image is sent at its rate
    "resolution",  # half the size
    "unauthorized",  # 401 for any password
    "busy",  # 453
    "not-found",  # 404
    "refuse",  # connections are closed at once
)
# Faults that refuse a client also end open streams, as a server does that restarts with other settings.
REFUSING = ("unauthorized", "busy", "not-found", "refuse")
METHODS = ("OPTIONS", "DESCRIBE", "SETUP", "PLAY", "TEARDOWN", "GET_PARAMETER", "SET_PARAMETER")
PATH, TRACK = "/stream1", "track1"
LONGEST_LINE, MOST_HEADERS, LONGEST_BODY = 8192, 64, 65536
SESSION_S = 60  # a client that sends nothing for this time has gone [s]
SEND_S = 5  # a client that takes nothing for this time is disconnected [s]
REPORT_S = 5.0  # period of sender reports [s]
FIRST_PICTURE_S = 5.0  # time limit for a camera's first picture [s]
SHORT_SESSION_S = 60.0  # of a camera that ends each
JITTER_S = (0.0, 0.02, 0.14, 0.0, 0.06, 0.09, 0.0)  # of one picture after the other: 0.05 s rms
REASONS = {
    200: "OK", 400: "Bad Request", 401: "Unauthorized", 404: "Not Found", 453: "Not Enough Bandwidth",
    454: "Session Not Found", 455: "Method Not Valid in This State", 461: "Unsupported Transport",
    501: "Not Implemented", 503: "Service Unavailable", 505: "RTSP Version Not Supported",
}  # fmt: skip


class RtspError(Exception):
    """A request is refused with a status and further header lines."""

    def __init__(self, status: int, *headers: str) -> None:
        super().__init__(REASONS[status])
        self.status, self.headers = status, headers


@dataclass(frozen=True)
class Request:
    """A request of a client."""

    method: str
    url: str
    headers: Message


def parse_head(lines: Sequence[bytes]) -> Request:
    """Parse request line and headers.

    Raises:
        RtspError: they are no request of RTSP 1.0.
    """
    words = lines[0].decode("latin-1").split()
    if len(words) != 3 or not words[2].startswith("RTSP/"):
        raise RtspError(400)
    headers = Message()
    for line in lines[1:]:
        name, colon, value = line.decode("latin-1").partition(":")
        if not colon:
            raise RtspError(400)
        headers[name.strip()] = value.strip()
    if words[2] != "RTSP/1.0":
        raise RtspError(505)
    return Request(words[0], words[1], headers)


class RtspServer(TcpServer):
    """A server of one stream, which runs from its construction until it is closed; a context manager.

    Args:
        stream: of encoded pictures.
        host: address to listen at.
        port: to listen at; 0 for any free port.
        user: user name; empty if everyone may connect.
        password: of that user; asked for by digest authentication.
        faults: of `RTSP_FAULTS`; may be switched on and off at any time.
        sent: called for each picture sent to a client with its index and the time at which its first byte is sent, on
            the machine's monotonic clock [s].
    """

    def __init__(
        self,
        stream: EncodedStream,
        *,
        host: str = LOCAL,
        port: int = 0,
        user: str = "",
        password: str = "",
        faults: Faults | None = None,
        sent: Callable[[int, float], None] = lambda index, t: None,
    ) -> None:
        self.stream, self.note_sent = stream, sent
        self.faults = Faults(RTSP_FAULTS) if faults is None else faults
        self.guard = Authenticator(user, password, "digest", "camera", secrets.token_hex(16), qop=False)
        super().__init__(self._serve_client, host, port)

    @property
    def url(self) -> str:
        """Address of the stream."""
        return (
            f"rtsp://[{self.host}]:{self.port}{PATH}" if ":" in self.host else f"rtsp://{self.host}:{self.port}{PATH}"
        )

    def is_refused(self) -> bool:
        """Return whether clients are refused now, or the server closes."""
        return self.closing.is_set() or any(name in self.faults for name in REFUSING)

    def _serve_client(self, connection: socket.socket) -> None:
        if "refuse" not in self.faults:
            for option, seconds in ((socket.SO_RCVTIMEO, SESSION_S), (socket.SO_SNDTIMEO, SEND_S)):
                connection.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", seconds, 0))
            with contextlib.closing(Session(connection, self)) as session:
                session.run()


class Session:
    """A client's connection: its requests, and the thread that sends pictures."""

    def __init__(self, connection: socket.socket, server: RtspServer) -> None:
        self._connection, self._server, self._faults = connection, server, server.faults
        self._received = connection.makefile("rb")
        self._sending = threading.Lock()  # answers come between pictures
        self._id = ""  # of the session, once a track is set up
        self._channels = (0, 1)  # of RTP and RTCP
        self._rtp = RtpSender()
        self._ended = threading.Event()
        self._player: threading.Thread | None = None

    def run(self) -> None:
        """Answer requests until the client has gone or sends what is none."""
        while True:
            try:
                request = self._request()
                if request is None:
                    return
            except RtspError as error:
                self._answer(error.status, None, error.headers)
                return
            try:
                headers, body = self._handle(request)
                self._answer(200, request, headers, body)
                if request.method == "PLAY":
                    self._play()
            except RtspError as error:
                self._answer(error.status, request, error.headers)

    def close(self) -> None:
        """End the thread that sends."""
        self._ended.set()
        with contextlib.suppress(OSError):  # the client has gone
            self._connection.shutdown(socket.SHUT_RDWR)
        self._stop()
        self._received.close()

    def _request(self) -> Request | None:
        """Read the next request; None at the end. RTCP of the client is skipped."""
        while (first := self._received.read(1)) == b"$":
            length = self._received.read(3)
            if len(length) < 3 or len(self._received.read(int.from_bytes(length[1:]))) < int.from_bytes(length[1:]):
                return None
        lines = [first + self._received.readline(LONGEST_LINE)] if first else []
        if not lines:
            return None
        while (line := self._received.readline(LONGEST_LINE)).strip():
            lines.append(line.strip())
            if len(lines) > MOST_HEADERS:
                raise RtspError(400)
        if not line:
            return None
        request = parse_head(lines)
        length_text = request.headers.get("Content-Length", "0")
        if not re.fullmatch("[0-9]{1,6}", length_text) or int(length_text) > LONGEST_BODY:
            raise RtspError(400)
        self._received.read(int(length_text))
        return request

    def _answer(self, status: int, request: Request | None, headers: Sequence[str], body: str = "") -> None:
        number = "0" if request is None else request.headers.get("CSeq", "0")
        lines = [f"RTSP/1.0 {status} {REASONS[status]}", f"CSeq: {number}", *headers]
        if body:
            lines.append(f"Content-Length: {len(body)}")
        with self._sending:
            self._connection.sendall("\r\n".join([*lines, "", body]).encode("latin-1", "replace"))

    def _handle(self, request: Request) -> tuple[list[str], str]:
        """Carry out a request; return header lines and body of the answer.

        Raises:
            RtspError: it is refused.
        """
        server, method = self._server, request.method
        if method not in METHODS:
            raise RtspError(501)
        if method == "OPTIONS":
            return [f"Public: {', '.join(METHODS)}"], ""
        if "unauthorized" in self._faults or not server.guard.allows(method, request.url, request.headers):
            raise RtspError(401, server.guard.challenge)
        if "busy" in self._faults:
            raise RtspError(453)
        try:
            path = urlsplit(request.url).path.rstrip("/")
        except ValueError:  # an invalid address in brackets
            raise RtspError(400) from None
        if "not-found" in self._faults or path not in (PATH, f"{PATH}/{TRACK}"):
            raise RtspError(404)
        if method == "DESCRIBE":
            return ["Content-Type: application/sdp", f"Content-Base: {server.url}/"], self._description()
        if method == "SETUP":
            return self._set_up(request.headers.get("Transport", "")), ""
        if not self._id:
            raise RtspError(455)
        if request.headers.get("Session", "").partition(";")[0] != self._id:
            raise RtspError(454)
        headers = [f"Session: {self._id}"]
        if method == "TEARDOWN":
            self._stop()
            self._id = ""
        if method == "PLAY":
            stamp = self._rtp.timestamp(time.monotonic())
            headers += [
                "Range: npt=now-",
                f"RTP-Info: url={server.url}/{TRACK};seq={self._rtp.sequence};rtptime={stamp}",
            ]
        return headers, ""

    def _set_up(self, transport: str) -> list[str]:
        found = re.search(r"RTP/AVP/TCP[^,]*", transport)
        if found is None:
            raise RtspError(461)
        if self._player is not None:
            raise RtspError(455)
        channels = re.search(r"interleaved=(\d{1,3})-(\d{1,3})", found[0])
        self._channels = (int(channels[1]), int(channels[2])) if channels else (0, 1)
        if max(self._channels) > 255:
            raise RtspError(400)
        self._id = self._id or secrets.token_hex(8)
        a, b = self._channels
        return [f"Transport: RTP/AVP/TCP;unicast;interleaved={a}-{b}", f"Session: {self._id};timeout={SESSION_S}"]

    def _description(self) -> str:
        """Describe the stream in SDP (RFC 8866, RFC 6184).

        Raises:
            RtspError: there are no pictures.
        """
        sets = self._server.stream.parameter_sets(FIRST_PICTURE_S)
        if not sets:
            raise RtspError(503)
        profile = next(nal[1:4].hex() for nal in sets if nal[0] & 0x1F == SEQUENCE_SET)
        said = ",".join(base64.b64encode(nal).decode() for nal in sets)
        version = 6 if ":" in self._server.host else 4
        lines = ["v=0", f"o=- 1 1 IN IP{version} {self._server.host}", "s=camera", "t=0 0", "a=control:*"]
        lines += [f"m=video 0 RTP/AVP {PAYLOAD_TYPE}", f"c=IN IP{version} {self._server.host}"]
        lines += [f"a=rtpmap:{PAYLOAD_TYPE} H264/{TICKS_HZ}"]
        lines += [f"a=fmtp:{PAYLOAD_TYPE} packetization-mode=1;profile-level-id={profile};sprop-parameter-sets={said}"]
        return "\r\n".join([*lines, f"a=control:{TRACK}", ""])

    # Pictures

    def _play(self) -> None:
        if self._player is None:
            self._ended.clear()
            self._player = threading.Thread(target=self._send_pictures, name="rtsp pictures", daemon=True)
            self._player.start()

    def _stop(self) -> None:
        self._ended.set()
        if self._player is not None:
            self._player.join()
            self._player = None

    def _send_pictures(self) -> None:
        """Send pictures until the client stops them, has gone, or takes nothing any more."""
        last, reported, begin = -1, -math.inf, time.monotonic()
        try:
            while not self._ended.is_set() and not self._server.is_refused():
                if "sessions-end" in self._faults and time.monotonic() > begin + SHORT_SESSION_S:
                    break
                unit = self._server.stream.after(last, CHECK_S)
                if unit is None or "stall" in self._faults:
                    self._ended.wait(CHECK_S if unit is not None else 0.0)
                    continue
                last = unit.index
                if "jitter" in self._faults:
                    self._ended.wait(JITTER_S[last % len(JITTER_S)])
                self._send_picture(unit)
                now = time.monotonic()
                if now - reported >= REPORT_S:
                    reported = now
                    self._send(self._interleaved(self._channels[1], self._rtp.report(now, time.time())))
        except OSError:  # the client has gone, or takes nothing
            pass
        if not self._ended.is_set():
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)

    def _send_picture(self, unit: AccessUnit) -> None:
        nals = unit.nals
        if "corrupt" in self._faults:
            nals = tuple(damaged(nal) for nal in nals)
        data = b"".join(self._interleaved(self._channels[0], each) for each in self._rtp.packets(nals, unit.t))
        self._server.note_sent(unit.index, time.monotonic())
        if "cut" in self._faults:
            self._send(data[: len(data) // 2])
            raise OSError("cut")
        self._send(data)

    @staticmethod
    def _interleaved(channel: int, packet: bytes) -> bytes:
        return b"$" + bytes([channel]) + len(packet).to_bytes(2) + packet

    def _send(self, data: bytes) -> None:
        with self._sending:
            self._connection.sendall(data)


def damaged(nal: bytes) -> bytes:
    """Destroy bytes in the middle of a slice; parameter sets stay as they are."""
    if nal[0] & 0x1F not in (SLICE, KEY_SLICE):
        return nal
    quarter = len(nal) // 4
    return nal[: 2 * quarter] + bytes(byte ^ 0x55 for byte in nal[2 * quarter : 3 * quarter]) + nal[3 * quarter :]
