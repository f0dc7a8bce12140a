"""Pictures out of a stream of JPEGs (multipart/x-mixed-replace): bytes in, whole pictures out, no input or output.

Servers differ in how they write the boundary, their Content-Length may be missing or wrong, bytes may follow a picture,
and parts are cut short. So a picture is taken for what the JPEG itself says, from its first marker to its last (ITU-T
T.81, annex B), and boundaries only serve to notice a cut one. Waiting for the boundary after a picture would cost a
frame's time besides.
"""

import re
from collections import deque
from dataclasses import dataclass

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
# Within compressed data 0xff is followed by a zero, a restart marker or another 0xff; all else is a marker.
MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
BOUNDARY = re.compile(r"""boundary\s*=\s*(?:"([^"]*)"|([^\s;]+))""", re.IGNORECASE)
SOI, EOI, SOS = 0xD8, 0xD9, 0xDA
# Frame headers, which carry the size: C0 to CF but for tables (C4, CC) and a reserved one (C8).
SIZED = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers that are followed by a length: frame headers, tables, scans, application data and comments.
SEGMENTS = SIZED | {0xC4, 0xCC} | frozenset(range(SOS, 0xF0)) | {0xFE}
# The shortest frame header, without its length: precision, height, width.
SIZED_LENGTH = 5


@dataclass(frozen=True)
class Picture:
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
        self._picture: _Walk | None = None  # of the picture that the data begins with
        self._skipped: int | None = None  # bytes dropped since a broken picture; None otherwise
        self._searched = 0  # how much of the data holds no delimiter

    @property
    def unfinished(self) -> bool:
        """Whether a picture has begun that has not ended."""
        return self._picture is not None

    def feed(self, data: bytes, t: float) -> list[Picture]:
        """Take the next bytes, which arrived at ``t`` [s]; return the pictures that they complete."""
        if data:
            self._data += data
            if len(self._arrivals) < MOST_ARRIVALS:
                self._arrivals.append((len(data), t))
            else:
                count, earlier = self._arrivals.pop()
                self._arrivals.append((count + len(data), earlier))
        pictures: list[Picture] = []
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
            self._picture = _Walk()
        return True

    def _continue(self, pictures: list[Picture]) -> bool:
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
            pictures.append(Picture(bytes(self._data[:end]), walk.size, self._arrivals[0][1]))
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


class _Walk:
    """Goes through one JPEG's markers as its bytes arrive.

    Attributes:
        position: as far as it has come.
        end: one past its last byte, once that is there.
        broken: whether it is no JPEG.
        size: (width, height) [px].
    """

    def __init__(self) -> None:
        self.position = 2  # behind the first marker
        self.end: int | None = None
        self.broken = False
        self.size = (0, 0)
        self._in_scan = False

    def advance(self, data: bytearray) -> None:
        """Go on as far as the data allows."""
        while self.end is None and not self.broken:
            if not (self._scan(data) if self._in_scan else self._segment(data)):
                return

    def _scan(self, data: bytearray) -> bool:
        """Go through compressed data to the next marker; whether there is one."""
        match = MARKER.search(data, self.position)
        if match is None:
            # The last byte may be a marker's first.
            self.position = max(len(data) - 1, self.position)
            return False
        self.position = match.start()
        if data[self.position + 1] == EOI:
            self.end = self.position + 2
        self._in_scan = False
        return True

    def _segment(self, data: bytearray) -> bool:
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
            # A second one belongs to no sequential or progressive JPEG; nor does a size without height.
            again, self.size = self.size != (0, 0), _size(data[start + 4 : start + 2 + length])
            self.broken = again or 0 in self.size
        if marker == SOS:
            self.broken = 0 in self.size
            self._in_scan = True
        self.position = start + 2 + length
        return True


def _size(header: bytearray) -> tuple[int, int]:
    """(width, height) of a frame header, which holds precision, height and width; zeros for one that is too short."""
    if len(header) < SIZED_LENGTH:
        return 0, 0
    return int.from_bytes(header[3:5]), int.from_bytes(header[1:3])
