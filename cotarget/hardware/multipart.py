"""Pictures out of a stream of JPEGs (multipart/x-mixed-replace): bytes in, whole pictures out, no input or output.

Servers differ in how they write the boundary, their Content-Length may be missing or wrong, bytes may follow a picture,
and parts are cut short. So a picture is taken for what the JPEG itself says, from its first marker to its last (ITU-T
T.81, annex B), and boundaries only serve to notice a cut one. Waiting for the boundary after a picture would cost a
frame's time besides.
"""

import re
from collections import deque
from dataclasses import dataclass

from cotarget.hardware.jpegmarkers import Walk

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
        self._picture: Walk | None = None  # of the picture that the data begins with
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
            self._picture = Walk()
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
