"""Read and decode JPEG images from a multipart/x-mixed-replace stream.

`Walk` finds the parts of a JPEG by its markers (ITU-T T.81, annex B). `JpegDecoder` decodes whole images and refuses
damaged ones. `MultipartReader` takes the stream's bytes and returns whole images. Nothing here does I/O.

Servers differ in how they write the boundary, Content-Length may be missing or wrong, bytes may follow an image, and
parts are cut short. An image is therefore taken from its first marker to its last, and the boundary only shows that an
image was cut. Waiting for the boundary after an image would also cost a frame period.
"""

import itertools
import math
import re
import threading
from collections import deque
from dataclasses import dataclass

import av
import cv2
import numpy as np

from cotarget.rig import Image

# Within compressed data 0xff is followed by a zero, a restart marker or another 0xff; any other byte makes a marker.
MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
EOI, SOS, DRI = 0xD9, 0xDA, 0xDD
# Frame headers, which hold the size: C0 to CF except tables (C4, CC) and a reserved marker (C8).
SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers that are followed by a length: frame headers, tables, scans, application data and comments.
SEGMENTS = SIZED | {0xC4, 0xCC} | frozenset(range(SOS, 0xF0)) | {0xFE}
# The shortest frame header, without its length: precision, height, width.
SIZED_LENGTH = 5


class Walk:
    """Parser of one JPEG's markers, as its bytes arrive.

    Attributes:
        position: index of the next byte to parse.
        end: index after the last byte, once that has arrived.
        broken: whether the data are no JPEG.
        size: (width, height) [px].
        frame: index of the frame header's marker.
        scans: (begin, end) of the compressed data of each scan.
        restarts: whether an interval between restart markers is defined.
    """

    def __init__(self) -> None:
        self.position = 2  # behind the first marker
        self.end: int | None = None
        self.broken = False
        self.size = (0, 0)
        self.frame = 0
        self.scans: list[tuple[int, int]] = []
        self.restarts = False
        self._in_scan = False

    def advance(self, data: bytes | bytearray) -> None:
        """Parse as far as the data allow; they begin with the bytes of earlier calls."""
        while self.end is None and not self.broken:
            if not (self._scan(data) if self._in_scan else self._segment(data)):
                return

    def _scan(self, data: bytes | bytearray) -> bool:
        """Skip compressed data up to the next marker; return whether there is one."""
        match = MARKER.search(data, self.position)
        if match is None:
            # The last byte may be the first of a marker.
            self.position = max(len(data) - 1, self.position)
            return False
        self.position = match.start()
        self.scans[-1] = self.scans[-1][0], self.position
        if data[self.position + 1] == EOI:
            self.end = self.position + 2
        self._in_scan = False
        return True

    def _segment(self, data: bytes | bytearray) -> bool:
        """Parse one marker and its segment; return whether it has arrived completely."""
        start = self.position
        while data[start : start + 2] == b"\xff\xff":
            start += 1  # any number of 0xff may precede a marker
        self.position = start
        if len(data) < start + 4:
            # Only an end marker before any scan is shorter than this, and that is no valid image.
            self.broken = len(data) > start and data[start] != 0xFF
            return False
        marker, length = data[start + 1], int.from_bytes(data[start + 2 : start + 4])
        if data[start] != 0xFF or marker not in SEGMENTS or length < 2:
            self.broken = True
            return False
        if len(data) < start + 2 + length:
            return False
        if marker in SIZED:
            self.frame = start
            # A sequential or progressive JPEG has one frame header, with a height.
            again, self.size = self.size != (0, 0), _size(data[start + 4 : start + 2 + length])
            self.broken = again or 0 in self.size
        self.position = start + 2 + length
        self.restarts = self.restarts or marker == DRI
        if marker == SOS:
            self.broken = 0 in self.size
            self._in_scan = True
            self.scans.append((self.position, self.position))
        return True


def _size(header: bytes | bytearray) -> tuple[int, int]:
    """Read (width, height) from a frame header of precision, height and width; zeros if it is too short."""
    if len(header) < SIZED_LENGTH:
        return 0, 0
    return int.from_bytes(header[3:5]), int.from_bytes(header[1:3])


# Decoding

START_OF_IMAGE, END_OF_IMAGE = b"\xff\xd8", b"\xff\xd9"
# Frame headers of sequential JPEGs with Huffman coding, which hold block after block in their only scan.
SEQUENTIAL = (0xC0, 0xC1)
BLOCK = 8  # side [px]
LONGEST_SIDE = 65535  # that a frame header can express [px]
# Some cameras put further bytes before an image's last marker (github.com/ros-drivers/axis_camera, issue 51: 651 of
# them). Excess bytes are accepted once they are usual: after `USUAL` images with them, at most.
USUAL = 5
# More bytes than a unit's blocks take if all their bits are zero.
ZEROS = bytes(4096)


class JpegDecoder:
    """Decoder of JPEG images that refuses damaged ones; safe to use from any thread.

    OpenCV decodes what is left of a damaged image and only prints to stderr. FFmpeg's decoder therefore checks the
    image first. With err_detect=explode it refuses invalid codes, and data that end before a unit (of some blocks,
    T.81, A.2) begins. After most damage the codes become valid again soon, but the number of units changes. The image
    is therefore checked under a header with one unit more. Its data must suffice to begin that unit, and must not
    without their last byte, unless this camera usually sends excess bytes. Progressive images, and those with restart
    markers, are only decoded as they are.
    """

    def __init__(self) -> None:
        self._checker = av.CodecContext.create("mjpeg", "r")
        self._checker.options = {"err_detect": "explode"}
        self._checker.thread_count = 1  # with more threads an image comes out only with the next one
        self._exact = 0  # recent images without excess bytes less those with some, 0 to USUAL
        self._lock = threading.Lock()

    def decode(self, jpeg: bytes) -> Image | None:
        """Decode an image, (H, W, 3) BGR and read-only; None if it is damaged, cut short or no JPEG.

        Args:
            jpeg: bytes of the image; bytes after its end are ignored.
        """
        walk = Walk()
        walk.advance(jpeg)
        if not jpeg.startswith(START_OF_IMAGE) or walk.end is None or walk.broken:
            return None
        jpeg = jpeg[: walk.end]
        with self._lock:
            if not self._whole(jpeg, walk):
                return None
        try:
            # The EXIF orientation is ignored: the image must stay as the sensor has it.
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
            image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), flags)
        except cv2.error:
            return None
        if image is None or image.shape != (walk.size[1], walk.size[0], 3):
            return None
        image.flags.writeable = False
        return image

    def _whole(self, jpeg: bytes, walk: Walk) -> bool:
        """Return whether an image has the data that its blocks need, neither less nor more."""
        unit = _unit(jpeg, walk)
        if unit is None:
            return self._decodes(jpeg)
        units = math.prod(math.ceil(side / each) for side, each in zip(walk.size, unit, strict=True))
        # The header with one unit more: one row of units if a side can be that long. For large stills, the next
        # number of units that fills whole rows.
        count, size = next((n, size) for n in itertools.count(units + 1) if (size := _sides(n, unit)))
        header, data = _resized(jpeg[: walk.scans[0][0]], walk.frame, size), _data(jpeg, walk)
        if count > units + 1:
            enough = self._decodes(jpeg)
        else:
            # FFmpeg reads zeros beyond the end. Where these are no valid unit, whole data fail the first check too.
            enough = self._decodes(header + data + END_OF_IMAGE) or (
                self._decodes(jpeg) and not self._decodes(header + data + ZEROS + END_OF_IMAGE)
            )
        return enough and self._usual(exact=not self._decodes(header + data[:-1] + END_OF_IMAGE))

    def _usual(self, exact: bool) -> bool:
        """Record whether an image has no excess bytes; return whether that is acceptable for this camera."""
        usual = exact or self._exact == 0
        self._exact = min(self._exact + 1, USUAL) if exact else max(self._exact - 1, 0)
        return usual

    def _decodes(self, jpeg: bytes) -> bool:
        try:
            return len(self._checker.decode(av.Packet(jpeg))) == 1
        except (av.error.FFmpegError, ValueError):
            return False


def _unit(jpeg: bytes, walk: Walk) -> tuple[int, int] | None:
    """Find (width, height) of a unit of the image's only scan [px]; None for another kind of JPEG."""
    # FFmpeg does not notice missing data where it looks for a restart marker.
    if jpeg[walk.frame + 1] not in SEQUENTIAL or len(walk.scans) != 1 or walk.restarts:
        return None
    # Frame header: marker, length, precision, height, width, then the number of components and 3 bytes for each.
    components = jpeg[walk.frame + 9]
    sampling = jpeg[walk.frame + 11 : walk.frame + 10 + 3 * components : 3]
    if components == 1:
        return BLOCK, BLOCK
    across, down = (max((each >> 4 for each in sampling), default=0), max((each & 15 for each in sampling), default=0))
    return (BLOCK * across, BLOCK * down) if across and down else None


def _sides(units: int, unit: tuple[int, int]) -> tuple[int, int] | None:
    """Find the widest size [px] that has this number of units; None if there is none."""
    columns, rows = (LONGEST_SIDE // each for each in unit)
    fewest = math.ceil(units / columns)
    found = next((n for n in range(fewest, rows + 1) if units % n == 0), None)
    return None if found is None else (units // found * unit[0], found * unit[1])


def _resized(header: bytes, frame: int, size: tuple[int, int]) -> bytes:
    """Replace the size in an image's header."""
    return header[: frame + 5] + size[1].to_bytes(2) + size[0].to_bytes(2) + header[frame + 9 :]


def _data(jpeg: bytes, walk: Walk) -> bytes:
    """Cut out a scan's compressed data, without the fill bytes before its last marker."""
    start, end = walk.scans[0]
    return jpeg[start:end].rstrip(b"\xff")


# The stream

# Longest image [bytes]; more is garbage: a hundred times a coarse 4CIF image.
LONGEST_PICTURE = 16_000_000
# After a broken image the next boundary is searched in this number of bytes, after that the start of any image.
LONGEST_SKIP = 1_000_000
# Start of an image: a marker and the first byte of the next. Nothing else between images contains these bytes.
START = b"\xff\xd8\xff"
# Longest list of arrival times; further pieces, which only a hostile server sends, share the last time.
MOST_ARRIVALS = 10_000
# Begin of a part's header, for streams whose boundary differs from the announced one.
HEADERS = (b"\r\nContent-Type:", b"\r\nContent-type:")
BOUNDARY = re.compile(r"""boundary\s*=\s*(?:"([^"]*)"|([^\s;]+))""", re.IGNORECASE)


@dataclass(frozen=True)
class JpegPicture:
    """A whole JPEG image.

    Attributes:
        jpeg: its bytes.
        size: (width, height) in its header [px].
        t: arrival of its first byte [s].
    """

    jpeg: bytes
    size: tuple[int, int]
    t: float


def boundary_of(content_type: str) -> str | None:
    """Extract the boundary from a Content-Type, without quotes and without the dashes that some servers add."""
    match = BOUNDARY.search(content_type)
    return None if match is None else (match[1] or match[2] or "").strip().lstrip("-") or None


class MultipartReader:
    """Reader of images from a stream that arrives in pieces; no bytes make it raise.

    Args:
        boundary: from `boundary_of`; None where none is announced.

    Attributes:
        broken: number of images that began and were dropped.
    """

    def __init__(self, boundary: str | None = None) -> None:
        own = () if boundary is None else (b"--" + boundary.encode("latin-1", "replace"),)
        self._delimiters = own + HEADERS
        self.broken = 0
        self._data = bytearray()
        self._arrivals: deque[tuple[int, float]] = deque()  # (number of bytes, time of arrival) of the data's pieces
        self._picture: Walk | None = None  # of the image at the start of the data
        self._skipped: int | None = None  # bytes dropped since a broken image; None if there was none
        self._searched = 0  # number of leading bytes known to hold no delimiter

    @property
    def unfinished(self) -> bool:
        """Whether an image has begun and not ended."""
        return self._picture is not None

    def feed(self, data: bytes, t: float) -> list[JpegPicture]:
        """Add bytes that arrived at ``t`` [s]; return the images that they complete."""
        if data:
            self._data += data
            if len(self._arrivals) < MOST_ARRIVALS:
                self._arrivals.append((len(data), t))
            else:
                count, earlier = self._arrivals.pop()
                self._arrivals.append((count + len(data), earlier))
        pictures: list[JpegPicture] = []
        while self._skip() and self._begin() and self._continue(pictures):
            pass
        return pictures

    def _skip(self) -> bool:
        """Drop the rest of a broken image; return whether that is done."""
        if self._skipped is None:
            return True
        found = self._delimiter()
        gone = self._searched if found is None else found
        self._drop(gone)
        self._skipped += gone
        if found is None and self._skipped <= LONGEST_SKIP:
            return False
        self._skipped = None
        return True

    def _begin(self) -> bool:
        """Drop the bytes before an image; return whether the data begin with one."""
        if self._picture is None:
            start = self._data.find(START)
            self._drop(max(len(self._data) - len(START) + 1, 0) if start < 0 else start)
            if start < 0:
                return False
            self._picture = Walk()
        return True

    def _continue(self, pictures: list[JpegPicture]) -> bool:
        """Parse on through an image; return whether it ended, whole or broken."""
        walk = self._picture
        assert walk is not None
        walk.advance(self._data)
        cut = self._delimiter()
        end = None if walk.broken else walk.end
        if cut is not None and cut < (walk.position if end is None else end):
            end, walk.broken = None, True
        if end is None and not walk.broken:
            if len(self._data) <= LONGEST_PICTURE and cut is None:
                return False
            walk.broken = True
        self._picture = None
        if end is None:
            self.broken += 1
            self._skipped = 0
        else:
            pictures.append(JpegPicture(bytes(self._data[:end]), walk.size, self._arrivals[0][1]))
            self._drop(end)
        return True

    def _delimiter(self) -> int | None:
        """Find the index of the first delimiter in the data; None if there is none."""
        places = [place for d in self._delimiters if (place := self._data.find(d, self._searched)) >= 0]
        # Not beyond the first, which later calls must find again. A delimiter may lie across the end of the data.
        longest = max(map(len, self._delimiters))
        self._searched = min(places, default=max(len(self._data) - longest + 1, 0))
        return min(places, default=None)

    def _drop(self, count: int) -> None:
        """Delete the first bytes of the data, with their arrival times."""
        del self._data[:count]
        self._searched = max(self._searched - count, 0)
        while count:
            there, t = self._arrivals.popleft()
            if there > count:
                self._arrivals.appendleft((there - count, t))
                break
            count -= there
