"""Pictures out of a stream of JPEGs (multipart/x-mixed-replace): bytes in, whole pictures out, no input or output.

Servers differ in how they write the boundary, their Content-Length may be missing or wrong, bytes may follow a picture,
and parts are cut short. So a picture is taken for what the JPEG itself says, from its first marker to its last (ITU-T
T.81, annex B), and boundaries only serve to notice a cut one. Waiting for the boundary after a picture would cost a
frame's time besides.

JPEGs as they come off a wire: decoded if they are whole, and refused otherwise.

Where a JPEG's parts are, by its own markers (ITU-T T.81, annex B): no decoding, and no input or output.
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

# Within compressed data 0xff is followed by a zero, a restart marker or another 0xff; all else is a marker.
MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
EOI, SOS, DRI = 0xD9, 0xDA, 0xDD
# Frame headers, which carry the size: C0 to CF but for tables (C4, CC) and a reserved one (C8).
SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers that are followed by a length: frame headers, tables, scans, application data and comments.
SEGMENTS = SIZED | {0xC4, 0xCC} | frozenset(range(SOS, 0xF0)) | {0xFE}
# The shortest frame header, without its length: precision, height, width.
SIZED_LENGTH = 5


class Walk:
    """Goes through one JPEG's markers as its bytes arrive.

    Attributes:
        position: as far as it has come.
        end: one past its last byte, once that is there.
        broken: whether it is no JPEG.
        size: (width, height) [px].
        frame: where its frame header's marker is.
        scans: where the compressed data of each of its scans begin and end.
        restarts: whether it defines an interval between restart markers.
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
        """Go on as far as the data allows."""
        while self.end is None and not self.broken:
            if not (self._scan(data) if self._in_scan else self._segment(data)):
                return

    def _scan(self, data: bytes | bytearray) -> bool:
        """Go through compressed data to the next marker; whether there is one."""
        match = MARKER.search(data, self.position)
        if match is None:
            # The last byte may be a marker's first.
            self.position = max(len(data) - 1, self.position)
            return False
        self.position = match.start()
        self.scans[-1] = self.scans[-1][0], self.position
        if data[self.position + 1] == EOI:
            self.end = self.position + 2
        self._in_scan = False
        return True

    def _segment(self, data: bytes | bytearray) -> bool:
        """Go over one marker and what belongs to it; whether it is all there."""
        start = self.position
        while data[start : start + 2] == b"\xff\xff":
            start += 1  # a marker may be preceded by any number of these
        self.position = start
        if len(data) < start + 4:
            # An end of the picture before any scan would be shorter than this, but is none either.
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
            # A second one belongs to no sequential or progressive JPEG; nor does a size without height.
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
    """(width, height) of a frame header, which holds precision, height and width; zeros for one that is too short."""
    if len(header) < SIZED_LENGTH:
        return 0, 0
    return int.from_bytes(header[3:5]), int.from_bytes(header[1:3])


# --- jpeg ---

START_OF_IMAGE, END_OF_IMAGE = b"\xff\xd8", b"\xff\xd9"
# Frame headers of sequential JPEGs with Huffman's code, whose only scan holds block after block.
SEQUENTIAL = (0xC0, 0xC1)
BLOCK = 8  # to each side [px]
LONGEST_SIDE = 65535  # that a frame header can tell [px]
# Some cameras put further bytes before a picture's last marker (github.com/ros-drivers/axis_camera, issue 51: 651 of
# them). One whose last so many pictures had too many is such a one, and theirs are not damaged.
USUAL = 5
# More than the blocks of a unit take where all their bits are zero.
ZEROS = bytes(4096)


class JpegDecoder:
    """Decodes JPEGs; safe to use from any thread.

    OpenCV shows whatever is left of a damaged picture and says so on stderr only. So FFmpeg's decoder looks at it
    first: told to, it refuses codes that make no sense, and data that end before a unit (of some blocks, T.81, A.2)
    begins. After most damage the codes make sense again soon, but there are more units or fewer than there were. So
    the picture is checked under a header that tells of one unit more: its data must suffice to begin that one, and must
    not without their last byte, unless that is this camera's way. Progressive pictures, and those with restart markers,
    are only decoded as they are.
    """

    def __init__(self) -> None:
        self._checker = av.CodecContext.create("mjpeg", "r")
        self._checker.options = {"err_detect": "explode"}
        self._checker.thread_count = 1  # more of them would give each picture with the next
        self._exact = 0  # how many pictures lately had no byte too many, more than had some
        self._lock = threading.Lock()

    def decode(self, jpeg: bytes) -> Image | None:
        """The image as the sensor has it, (H, W, 3) BGR and read-only; None if it is damaged, cut short or no JPEG.

        Args:
            jpeg: its bytes; what follows its end does no harm.
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
            # A camera that is told to turn its pictures does so; a note in them to turn them is none of ours.
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
            image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), flags)
        except cv2.error:
            return None
        if image is None or image.shape != (walk.size[1], walk.size[0], 3):
            return None
        image.flags.writeable = False
        return image

    def _whole(self, jpeg: bytes, walk: Walk) -> bool:
        """Whether the data of a picture are as many as its blocks take."""
        unit = _unit(jpeg, walk)
        if unit is None:
            return self._decodes(jpeg)
        units = math.prod(math.ceil(side / each) for side, each in zip(walk.size, unit, strict=True))
        # One row of units if a side can be so long; of large stills the next number that makes some even rows.
        count, size = next((n, size) for n in itertools.count(units + 1) if (size := _sides(n, unit)))
        header, data = _resized(jpeg[: walk.scans[0][0]], walk.frame, size), _data(jpeg, walk)
        if count > units + 1:
            enough = self._decodes(jpeg)
        else:
            # Beyond the end all bits are zero. They may make no unit; then this tells nothing.
            enough = self._decodes(header + data + END_OF_IMAGE) or (
                self._decodes(jpeg) and not self._decodes(header + data + ZEROS + END_OF_IMAGE)
            )
        return enough and self._usual(exact=not self._decodes(header + data[:-1] + END_OF_IMAGE))

    def _usual(self, exact: bool) -> bool:
        """Note whether a picture has no byte too many; whether it may be so."""
        usual = exact or self._exact == 0
        self._exact = min(self._exact + 1, USUAL) if exact else max(self._exact - 1, 0)
        return usual

    def _decodes(self, jpeg: bytes) -> bool:
        try:
            return len(self._checker.decode(av.Packet(jpeg))) == 1
        except (av.error.FFmpegError, ValueError):
            return False


def _unit(jpeg: bytes, walk: Walk) -> tuple[int, int] | None:
    """(width, height) of a unit of the picture's only scan [px]; None where it is another kind of JPEG."""
    # FFmpeg does not miss the data where it looks for a restart marker.
    if jpeg[walk.frame + 1] not in SEQUENTIAL or len(walk.scans) != 1 or walk.restarts:
        return None
    # The frame header: marker, length, precision, height, width, then the number of components and 3 bytes for each.
    components = jpeg[walk.frame + 9]
    sampling = jpeg[walk.frame + 11 : walk.frame + 10 + 3 * components : 3]
    if components == 1:
        return BLOCK, BLOCK
    across, down = (max((each >> 4 for each in sampling), default=0), max((each & 15 for each in sampling), default=0))
    return (BLOCK * across, BLOCK * down) if across and down else None


def _sides(units: int, unit: tuple[int, int]) -> tuple[int, int] | None:
    """A size [px] of so many units, as wide as can be; None if there is none."""
    columns, rows = (LONGEST_SIDE // each for each in unit)
    fewest = math.ceil(units / columns)
    found = next((n for n in range(fewest, rows + 1) if units % n == 0), None)
    return None if found is None else (units // found * unit[0], found * unit[1])


def _resized(header: bytes, frame: int, size: tuple[int, int]) -> bytes:
    """A picture's header with another size in it."""
    return header[: frame + 5] + size[1].to_bytes(2) + size[0].to_bytes(2) + header[frame + 9 :]


def _data(jpeg: bytes, walk: Walk) -> bytes:
    """A scan's compressed data, without the bytes that may fill up what is before a marker."""
    start, end = walk.scans[0]
    return jpeg[start:end].rstrip(b"\xff")


# A picture of more bytes is garbage: a hundred times a coarse 4CIF one.
LONGEST_PICTURE = 16_000_000
# After a broken picture the next boundary is looked for in as many bytes, then any picture.
LONGEST_SKIP = 1_000_000
# A marker and a half: nothing else that a server sends between pictures looks like it.
START = b"\xff\xd8\xff"
# So many pieces are told apart by their time of arrival; more of them, which only a wicked server sends, are not.
MOST_ARRIVALS = 10_000
# A part's header, for streams that do not keep to the boundary that they announce.
HEADERS = (b"\r\nContent-Type:", b"\r\nContent-type:")
BOUNDARY = re.compile(r"""boundary\s*=\s*(?:"([^"]*)"|([^\s;]+))""", re.IGNORECASE)


@dataclass(frozen=True)
class JpegPicture:
    """A whole JPEG.

    Attributes:
        jpeg: its bytes.
        size: (width, height) as it says [px].
        t: when its first byte arrived [s].
    """

    jpeg: bytes
    size: tuple[int, int]
    t: float


def boundary_of(content_type: str) -> str | None:
    """The boundary that a Content-Type announces, without quotes and the dashes that some put before it."""
    match = BOUNDARY.search(content_type)
    return None if match is None else (match[1] or match[2] or "").strip().lstrip("-") or None


class MultipartReader:
    """Reads pictures from a stream, piece by piece; no bytes make it raise.

    Args:
        boundary: what `boundary_of` gave; None where none is announced.

    Attributes:
        broken: how many pictures were begun and dropped.
    """

    def __init__(self, boundary: str | None = None) -> None:
        own = () if boundary is None else (b"--" + boundary.encode("latin-1", "replace"),)
        self._delimiters = own + HEADERS
        self.broken = 0
        self._data = bytearray()
        self._arrivals: deque[tuple[int, float]] = deque()  # how many bytes of the data came when
        self._picture: Walk | None = None  # of the picture that the data begins with
        self._skipped: int | None = None  # bytes dropped since a broken picture; None otherwise
        self._searched = 0  # how much of the data holds no delimiter

    @property
    def unfinished(self) -> bool:
        """Whether a picture has begun that has not ended."""
        return self._picture is not None

    def feed(self, data: bytes, t: float) -> list[JpegPicture]:
        """Take the next bytes, which arrived at ``t`` [s]; return the pictures that they complete."""
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
        """After a broken picture drop what is left of it; whether that is done."""
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
        """Drop what comes before a picture; whether the data begins with one."""
        if self._picture is None:
            start = self._data.find(START)
            self._drop(max(len(self._data) - len(START) + 1, 0) if start < 0 else start)
            if start < 0:
                return False
            self._picture = Walk()
        return True

    def _continue(self, pictures: list[JpegPicture]) -> bool:
        """Walk on through a picture; whether it came to an end, good or bad."""
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
        """Where the data first holds a delimiter."""
        places = [place for d in self._delimiters if (place := self._data.find(d, self._searched)) >= 0]
        # Not beyond the first: it is asked for again. The longest may lie across the end of the data.
        longest = max(map(len, self._delimiters))
        self._searched = min(places, default=max(len(self._data) - longest + 1, 0))
        return min(places, default=None)

    def _drop(self, count: int) -> None:
        """Forget the first bytes of the data."""
        del self._data[:count]
        self._searched = max(self._searched - count, 0)
        while count:
            there, t = self._arrivals.popleft()
            if there > count:
                self._arrivals.appendleft((there - count, t))
                break
            count -= there
