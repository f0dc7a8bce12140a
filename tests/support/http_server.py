"""An HTTP server on loopback with streams of pictures, and with what is none."""

import base64
import contextlib
import http.server
import io
from fractions import Fraction

import av
import cv2
import numpy as np

from tests.support.loopback import Loopback

SIZE, RATE_HZ = (320, 240), 25
USER, PASSWORD = "viewer", "hunter2 & co"
LOGIN = base64.b64encode(f"{USER}:{PASSWORD}".encode()).decode()


def image(index):
    return np.full((SIZE[1], SIZE[0], 3), index % 256, np.uint8)


def jpegs():
    """Pictures as cameras send them by multipart/x-mixed-replace, without times."""
    for index in range(10_000):
        data = cv2.imencode(".jpg", image(index))[1].tobytes()
        yield b"--b\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n" % (len(data), data)


def transport_stream():
    """H.264 in MPEG-TS."""
    parts = io.BytesIO()
    with av.open(parts, "w", format="mpegts", options={"flush_packets": "1"}) as film:
        track = film.add_stream("libx264", rate=RATE_HZ, options={"tune": "zerolatency", "preset": "ultrafast"})
        (track.width, track.height), track.codec_context.gop_size = SIZE, 10
        for index in range(10_000):
            picture = av.VideoFrame.from_ndarray(image(index), format="bgr24")
            picture.pts, picture.time_base = index, Fraction(1, RATE_HZ)
            film.mux(track.encode(picture))
            yield parts.getvalue()
            parts.seek(0)
            parts.truncate()


class _Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        page, server = self.path.strip("/"), self.server
        server.asked.append(dict(self.headers))
        if page == "visited":
            server.visited.append(page)
        lists = {
            "redirect": (302, {"Location": server.url("visited")}),
            "login": (401, {"WWW-Authenticate": 'Basic realm="camera"'}),
            "mjpeg": (200, {"Content-Type": "multipart/x-mixed-replace; boundary=b"}),
            "mpegts": (200, {"Content-Type": "video/mp2t"}),
        }
        if page == "login" and self.headers["Authorization"] == f"Basic {LOGIN}":
            page = "mjpeg"
        status, headers = lists.get(page, (int(page) if page.isdigit() else 200, {}))
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        with contextlib.suppress(OSError):
            if page in ("mjpeg", "mpegts"):
                for part in jpegs() if page == "mjpeg" else transport_stream():
                    self.wfile.write(part)
                    if server.closing.wait(1 / RATE_HZ):
                        return
            while page == "endless" and not server.closing.is_set():
                self.wfile.write(bytes(100_000))
            self.wfile.write(server.LISTS.get(page, b"").replace(b"ELSEWHERE", server.url("visited").encode()))

    def log_message(self, *_):
        pass


class HttpServer(Loopback, http.server.ThreadingHTTPServer):
    """Serves the pages; a context manager.

    Attributes:
        asked: headers of all requests.
        visited: requests of the address that the redirection and the playlists name.
    """

    LISTS = {  # noqa: RUF012
        "m3u8": b"#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:2,\nELSEWHERE\n",
        "ffconcat": b"ffconcat version 1.0\nfile ELSEWHERE\n",
        "sdp": b"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=x\r\nt=0 0\r\nc=IN IP4 127.0.0.1\r\nm=video 5000 RTP/AVP 96\r\n"
        b"a=rtpmap:96 H264/90000\r\n",
        "html": b"<html><body>Log in</body></html>",
    }

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.asked, self.visited = [], []

    def url(self, page):
        return f"http://127.0.0.1:{self.server_address[1]}/{page}"
