"""Where a JPEG's parts are, by its own markers (ITU-T T.81, annex B): no decoding, and no input or output."""

import re

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
