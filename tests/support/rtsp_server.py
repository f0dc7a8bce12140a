"""An RTSP server on loopback, which encodes what a test draws and sends it as RTP, in the connection or by UDP."""

import contextlib
import hashlib
import re
import socket
import socketserver
import time
from dataclasses import dataclass, field
from fractions import Fraction

import av

from tests.support.loopback import Loopback

USER, PASSWORD = "viewer", "hunter2 & co"
REALM, NONCE = "camera", "f00d"
TICKS_HZ = 90_000  # RTP's clock of video
TICK = Fraction(1, TICKS_HZ)
ENCODERS = {"H264": "libx264", "H265": "libx265", "JPEG": "mjpeg"}
HANG_S = 120.0  # longer than any test takes


@dataclass
class Feed:
    """What the server sends.

    Attributes:
        draw: makes the image of an index, (H, W, 3) BGR.
        rate_hz: images a second.
        group: images from one key frame to the next.
        codec: of `ENCODERS`.
        b_frames: number of B-frames in a row.
        late: makes from an index by how much its packets are delayed [s].
        skip: packets that are not sent at the begin, as to a client that joins within a group of pictures.
        shift: makes from an index by how much its time stamp is shifted [s].
        end: index at which the connection is closed.
        silent: from which index on nothing is sent.
        answers: statuses and header lines by method, in place of the usual answer.
        login: whether user and password are asked for.
    """

    draw: object
    rate_hz: float = 25.0
    group: int = 10
    codec: str = "H264"
    b_frames: int = 0
    late: object = lambda index: 0.0
    skip: int = 0
    shift: object = lambda index: 0.0
    end: float = float("inf")
    silent: float = float("inf")
    answers: dict = field(default_factory=dict)
    login: bool = False

    def encoder(self):
        """Make the encoder, which gives a frame's packet without waiting for later frames."""
        context = av.CodecContext.create(ENCODERS[self.codec], "w")
        height, width = self.draw(0).shape[:2]
        context.width, context.height, context.time_base = width, height, TICK
        context.framerate, context.gop_size = Fraction(self.rate_hz).limit_denominator(1000), self.group
        context.pix_fmt = "yuvj420p" if self.codec == "JPEG" else "yuv420p"
        context.max_b_frames = self.b_frames
        if self.codec == "JPEG":
            context.options = {"huffman": "default"}  # RTP does not carry others
        else:
            context.options = {"preset": "ultrafast", "crf": "20"} | ({} if self.b_frames else {"tune": "zerolatency"})
        if self.codec == "H265":
            context.options |= {"x265-params": "log-level=none:repeat-headers=1"}
        return context

    def packets(self):
        """Encode without end: (index, packet)."""
        context, index = self.encoder(), 0
        while True:
            picture = av.VideoFrame.from_ndarray(self.draw(index), format="bgr24")
            picture = picture.reformat(format=context.pix_fmt)
            picture.time_base = context.time_base
            picture.pts = round(index / self.rate_hz * TICKS_HZ)
            for packet in context.encode(picture):
                shift = round(self.shift(index) * TICKS_HZ)
                packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                yield index, packet
            index += 1


class _Sender:
    """Takes RTP and RTCP packets from FFmpeg's muxer, and sends them.

    Args:
        connection: the RTSP connection.
        ports: the client's UDP ports for RTP and RTCP; None to send within the connection.
    """

    def __init__(self, connection, ports):
        self._connection, self._ports = connection, ports

    def write(self, data):
        channel = 1 if 200 <= data[1] <= 204 else 0
        with contextlib.suppress(OSError):  # the client has gone; an error would be FFmpeg's
            if self._ports:
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
                    line.sendto(data, ("127.0.0.1", self._ports[channel]))
            else:
                self._connection.sendall(b"$" + bytes([channel]) + len(data).to_bytes(2) + bytes(data))
        return len(data)


class _Session(socketserver.StreamRequestHandler):
    timeout = HANG_S

    def handle(self):
        with contextlib.suppress(OSError):
            while request := self._request():
                if self._answer(*request):
                    self._play()
                    return

    def _request(self):
        line = self.rfile.readline().decode()
        if not line:
            return None
        lines = iter(lambda: self.rfile.readline().decode().strip(), "")
        headers = {name.lower(): value.strip() for name, _, value in (each.partition(":") for each in lines)}
        method, url = line.split()[:2]
        self.server.requests.append((method, url, headers))
        return method, url, headers

    def _answer(self, method, url, headers):
        """Answer a request; return whether pictures follow."""
        feed, body, more = self.server.feed, b"", []
        status = "200 OK"
        if method in feed.answers:
            status, more = feed.answers[method]
        elif feed.login and method != "OPTIONS" and not _is_authorized(headers.get("authorization", ""), method):
            status, more = "401 Unauthorized", [f'WWW-Authenticate: Digest realm="{REALM}", nonce="{NONCE}"']
        elif not url.startswith(self.server.url):
            status = "404 Not Found"
        elif method == "OPTIONS":
            more = ["Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN"]
        elif method == "DESCRIBE":
            body = _description(feed.codec)
            more = ["Content-Type: application/sdp", f"Content-Base: {self.server.url}/"]
        elif method == "SETUP":
            asked = re.search(r"client_port=(\d+)-(\d+)", headers["transport"])
            self._ports = asked and (int(asked[1]), int(asked[2]))
            how = f"UDP;unicast;{asked[0]};server_port=9-10" if asked else "TCP;unicast;interleaved=0-1"
            more = [f"Transport: RTP/AVP/{how}", "Session: 7;timeout=60"]
        elif method == "PLAY":
            more = ["Session: 7"]
        lines = [f"RTSP/1.0 {status}", f"CSeq: {headers.get('cseq', 0)}", *more, f"Content-Length: {len(body)}", "", ""]
        self.connection.sendall("\r\n".join(lines).encode() + body)
        return method == "PLAY" and status.startswith("200")

    def _play(self):
        """Send pictures at their times, until the client or the feed ends."""
        feed = self.server.feed
        with contextlib.closing(
            av.open(_Sender(self.connection, self._ports), "w", format="rtp", options=RTP)
        ) as muxer:
            height, width = feed.draw(0).shape[:2]
            stream = muxer.add_mux_stream(ENCODERS[feed.codec], width=width, height=height, time_base=TICK)
            begin = time.monotonic()
            for sent, (index, packet) in enumerate(feed.packets()):
                due = begin + index / feed.rate_hz + feed.late(index)
                if self.server.closing.wait(max(due - time.monotonic(), 0.0)) or index >= feed.end:
                    return
                if index >= feed.silent:
                    self.server.closing.wait(HANG_S)
                if sent >= feed.skip:
                    self.server.sent[index] = time.monotonic()
                    packet.stream = stream
                    muxer.mux(packet)


RTP = {"packetsize": "1400"}


def _description(codec):
    payload = 26 if codec == "JPEG" else 96
    lines = ["v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=live", "t=0 0", f"m=video 0 RTP/AVP {payload}"]
    lines += [f"a=rtpmap:{payload} {codec}/{TICKS_HZ}", "a=control:track1"]
    lines += ["m=audio 0 RTP/AVP 0", "a=control:track2", ""]
    return "\r\n".join(lines).encode()


def _is_authorized(header, method):
    said = dict(re.findall(r'(\w+)="([^"]*)"', header))

    def digest(*parts):
        return hashlib.md5(":".join(parts).encode()).hexdigest()

    wanted = digest(digest(USER, REALM, PASSWORD), NONCE, digest(method, said.get("uri", "")))
    return said.get("username") == USER and said.get("response") == wanted


class RtspServer(Loopback, socketserver.ThreadingTCPServer):
    """Serves a feed to any number of clients; a context manager.

    Attributes:
        url: address of the stream.
        feed: what is sent; another one is for the next client.
        requests: (method, address, headers) of all requests.
        sent: time at which each image's packet was sent [s], by index.
    """

    allow_reuse_address = True

    def __init__(self, feed):
        super().__init__(("127.0.0.1", 0), _Session)
        self.feed, self.url = feed, f"rtsp://127.0.0.1:{self.server_address[1]}/live"
        self.requests, self.sent = [], {}
        self._clients = []

    def process_request(self, request, client_address):
        self._clients.append(request)
        super().process_request(request, client_address)

    def cut(self):
        """Close every client's connection."""
        for client in self._clients:
            with contextlib.suppress(OSError):
                client.shutdown(2)
        self._clients.clear()
