"""JPEGs as they come off a wire: decoded if they are whole, and refused otherwise."""

import itertools
import math
import threading

import av
import cv2
import numpy as np

from cotarget.hardware.jpegmarkers import Walk
from cotarget.rig import Image

SOI, EOI = b"\xff\xd8", b"\xff\xd9"
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
        if not jpeg.startswith(SOI) or walk.end is None or walk.broken:
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
            enough = self._decodes(header + data + EOI) or (
                self._decodes(jpeg) and not self._decodes(header + data + ZEROS + EOI)
            )
        return enough and self._usual(exact=not self._decodes(header + data[:-1] + EOI))

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
