"""Read and decode JPEG images from a multipart/x-mixed-replace stream.

`Walk` finds a JPEG's end by its markers (ITU-T T.81, annex B). `decode_jpeg` decodes whole images and refuses
damaged ones. `MultipartReader` takes the stream's bytes and returns whole images. Nothing here does I/O.

Servers differ in how they write the boundary, Content-Length may be missing or wrong, bytes may follow an image, and
parts are cut short. An image is therefore taken from its first marker to its last, and the boundary only shows that an
image was cut. Waiting for the boundary after an image would also cost a frame period.
"""

import re
import threading
from collections import deque
from dataclasses import dataclass
from types import ModuleType

from cotarget.errors import MissingPackageError, install_extra
from cotarget.rig import Image

# Within compressed data 0xff is followed by a zero, a restart marker or another 0xff; any other byte makes a marker.
MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
EOI, SOS = 0xD9, 0xDA
# Markers that are followed by a length: frame headers, tables, scans, application data and comments.
SEGMENTS = frozenset(range(0xC0, 0xD0)) - {0xC8} | frozenset(range(SOS, 0xF0)) | {0xFE}


class Walk:
    """Parser of one JPEG's markers, as its bytes arrive."""

    def __init__(self) -> None:
        self.position = 2  # index of the next byte to parse: behind the first marker
        self.end: int | None = None  # index after the last byte, once that has arrived
        self.broken = False  # whether the data are no JPEG
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
        self.position = start + 2 + length
        self._in_scan = marker == SOS
        return True


# Decoding

# Some cameras put further bytes before every image's last marker (github.com/ros-drivers/axis_camera, issue 51: about
# 650 of them). Such images are accepted once several in a row had them: a few where no other image came before, and
# many where an exact one shows that this camera usually sends none.
USUAL, USUAL_AFTER_EXACT = 5, 100
# libjpeg-turbo's warning of such bytes; it comes after all blocks are decoded.
EXCESS = re.compile("extraneous bytes before marker 0xd9")
# Largest image [px]; a damaged header may ask for far more memory than a machine has.
MOST_PIXELS = 100_000_000


class DamagedError(ValueError):
    """An image is damaged, cut short or no JPEG."""


class ExcessError(DamagedError):
    """An image has further bytes before its last marker, and is whole apart from that."""


def import_simplejpeg() -> ModuleType:
    """Import the decoder's library, which is optional.

    Raises:
        MissingPackageError: it is not installed.
    """
    try:
        import simplejpeg
    except ImportError:
        raise MissingPackageError(
            f"JPEG cameras need simplejpeg, of the extra hardware: {install_extra('hardware')}"
        ) from None
    return simplejpeg


def decode_jpeg(jpeg: bytes, excess: bool = False) -> Image:
    """Decode an image, (H, W, 3) BGR and read-only, and refuse one that libjpeg-turbo warns of.

    Bytes after the image's end are ignored, and so is its EXIF orientation: the image stays as the sensor has it.

    Args:
        jpeg: bytes of the image.
        excess: whether to accept further bytes before the last marker.

    Raises:
        ExcessError: there are such bytes, and they are not accepted.
        DamagedError: the image is damaged otherwise, or larger than `MOST_PIXELS`.
        MissingPackageError: simplejpeg is not installed.
    """
    library = import_simplejpeg()
    try:
        height, width, *_ = library.decode_jpeg_header(jpeg)
        if height * width > MOST_PIXELS:
            raise DamagedError(f"its header says {width} x {height}")
        image: Image = library.decode_jpeg(jpeg, "BGR")
    except ValueError as error:
        if EXCESS.search(str(error)) is None:
            raise DamagedError(str(error)) from None
        if not excess:
            raise ExcessError(str(error)) from None
        image = library.decode_jpeg(jpeg, "BGR", strict=False)
    image.flags.writeable = False
    return image


class StreamDecoder:
    """Decoder of one camera's images, which learns whether the camera usually sends excess bytes.

    Safe to use from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._run, self._needed = 0, USUAL  # images with excess bytes in a row, and how many make them usual

    def decode(self, jpeg: bytes) -> Image:
        """Decode an image as `decode_jpeg` does.

        Raises:
            DamagedError: the image is damaged, or has excess bytes that are not usual for this camera.
            MissingPackageError: simplejpeg is not installed.
        """
        try:
            image = decode_jpeg(jpeg)
        except ExcessError:
            with self._lock:
                self._run += 1
                usual = self._run > self._needed
            if not usual:
                raise
            return decode_jpeg(jpeg, excess=True)
        with self._lock:
            self._run, self._needed = 0, USUAL_AFTER_EXACT
        return image


# The stream

# Longest image [bytes]; more is garbage: a hundred times a coarse 4CIF image.
LONGEST_PICTURE = 16_000_000
# After a broken image the next boundary is searched in this number of bytes, after that the start of any image.
LONGEST_SKIP = 1_000_000
# Start of an image: a marker and the first byte of the next. Nothing else between images contains these bytes.
START = b"\xff\xd8\xff"
# Begin of a part's header, for streams whose boundary differs from the announced one.
HEADERS = (b"\r\nContent-Type:", b"\r\nContent-type:")
BOUNDARY = re.compile(r"""boundary\s*=\s*(?:"([^"]*)"|([^\s;]+))""", re.IGNORECASE)


@dataclass(frozen=True)
class JpegPicture:
    """A whole JPEG image."""

    jpeg: bytes
    t: float  # arrival of its first byte [s]


def boundary_of(content_type: str) -> str | None:
    """Extract the boundary from a Content-Type, without quotes and without the dashes that some servers add."""
    match = BOUNDARY.search(content_type)
    return None if match is None else (match[1] or match[2] or "").strip().lstrip("-") or None


class MultipartReader:
    """Reader of images from a stream that arrives in pieces; no bytes make it raise.

    Args:
        boundary: from `boundary_of`; None where none is announced.
    """

    def __init__(self, boundary: str | None = None) -> None:
        own = () if boundary is None else (b"--" + boundary.encode("latin-1", "replace"),)
        self._delimiters = own + HEADERS
        self.broken = 0  # number of images that began and were dropped
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
            self._arrivals.append((len(data), t))
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
            pictures.append(JpegPicture(bytes(self._data[:end]), self._arrivals[0][1]))
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
