"""Define what a detector takes and returns, and wrap external detectors.

A box has a centre (u, v) and a size (width, height). Pixel (0, 0) is the centre of the top-left pixel, so the box of a
single lit pixel at column 3 is centred on u = 3 and 1 wide. `ExternalDetector` makes a detector of any function from an
image to boxes, such as a neural network.
"""

import math
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Number
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from cotarget.errors import CotargetError
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image

if TYPE_CHECKING:
    from cotarget.tracking.track import Track

Tracks = Sequence["Track"]
# Foreground in a mask.
FOREGROUND = 255
# Largest part of foreground that may be targets; beyond it, the light or the camera has changed.
MOST_FOREGROUND = 0.45
# Shift of a camera up to which it stands, because its measurement has that noise [parts of the image's width].
QUIET_PART = 0.5 / 640
# Time for which a picture must be another, or a camera must stand, before it counts: a flash is shorter [s].
LASTING_S = 0.2
# Time for which a scene stays the same but for what moves: corners are kept and exposures averaged over it [s].
SAME_S = 0.5


@dataclass(frozen=True)
class Detections:
    """What a detector finds in one frame.

    Attributes:
        boxes: the targets, best first.
        make_mask: makes `mask`, which takes time and which few ask for.
        shift: shift of the scene in this frame since the first (du, dv) [px], (2,); None if it is not measured.
        cut: whether the frame shows another scene than the one before.
    """

    boxes: Sequence[Detection]
    make_mask: Callable[[], Image | None] = lambda: None
    shift: Array | None = None
    cut: bool = False

    @cached_property
    def mask(self) -> Image | None:
        """Foreground of the frame, (H, W), 0 to 255; None for a detector without one."""
        return self.make_mask()


class Detector(Protocol):
    """Detects targets of one kind in the frames of one camera."""

    def detect(self, frame: Frame, held: Tracks = ()) -> Detections:
        """Detect the targets.

        Args:
            frame: frame of the camera.
            held: tracks after the last frame. A detector that learns the background does not learn the confirmed ones.
        """


def flood(mask: Image | None) -> float:
    """Return the part of an image that is foreground, 0 to 1, if that is too much to be targets; otherwise 0."""
    part = 0.0 if mask is None else cv2.countNonZero(mask) / mask.size
    return part if part > MOST_FOREGROUND else 0.0


def box_detection(x: int, y: int, w: int, h: int, score: float, shape: tuple[int, ...]) -> Detection:
    """Make a detection from a box of whole pixels.

    Args:
        x: first column [px].
        y: first row [px].
        w: number of columns [px].
        h: number of rows [px].
        score: confidence of the detector, 0 to 1.
        shape: shape of the image, (H, W, ...); a box at its border is clipped.
    """
    center, size = np.array([x + (w - 1) / 2, y + (h - 1) / 2]), np.array([w, h], dtype=float)
    return Detection(center, size, score, is_clipped(center, size, shape))


def is_clipped(center_px: Array, size_px: Array, shape: tuple[int, ...]) -> bool:
    """Whether a box reaches the border of an image of a shape (H, W, ...)."""
    low, high = center_px - (size_px - 1) / 2, center_px + (size_px - 1) / 2
    return bool((low <= 0).any() or (high >= np.array(shape[1::-1]) - 1).any())


def halvings(image: Image, widest_px: int) -> list[Image]:
    """Return an image and its halvings, until one is at most ``widest_px`` wide [px]."""
    images = [image]
    while images[-1].shape[1] > widest_px:
        half = cv2.resize(images[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        images.append(np.asarray(half, dtype=np.uint8))
    return images


def moved(image: Image, shift: Array) -> Image:
    """Move an image by (du, dv) [px], interpolated linearly; its border's pixels fill what is uncovered."""
    if not shift.any():
        return image
    height, width = image.shape[:2]
    u, v = (np.array([width - 1, height - 1]) / 2 - shift).tolist()
    return np.asarray(cv2.getRectSubPix(image, (width, height), (u, v)), dtype=np.uint8)


def pieces(mask: Image, bridge_px: tuple[int, int]) -> list[Sequence[int]]:
    """Find the connected components of a mask (H, W), as left, top, width and height [px].

    Gaps of up to (across, down) are closed, and half a gap is included on each side.
    """
    left, top, width, height = cv2.boundingRect(mask)  # mostly small, which saves processing the rest
    if not width:
        return []
    across, down = bridge_px
    x, y = max(left - across // 2, 0), max(top - down // 2, 0)
    near = mask[y : top + height + down // 2, x : left + width + across // 2]
    joined = cv2.dilate(near, np.ones((down, across), np.uint8))
    contours = cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE, offset=(x, y))[0]
    return [cv2.boundingRect(contour) for contour in contours]


class SizeCheck:
    """Refuse images of another size than the first one."""

    def __init__(self) -> None:
        """Start without an image."""
        self._shape: tuple[int, ...] | None = None

    def check(self, image: Image) -> None:
        """Check the next image.

        Raises:
            CotargetError: the image's size changed.
        """
        shape = self._shape = self._shape or image.shape
        if image.shape != shape:
            raise CotargetError(
                f"the image's size changed from {shape[1]}x{shape[0]} to {image.shape[1]}x{image.shape[0]}; "
                "the detector needs one camera with one size"
            )


# External detectors

# (left column, top row, width, height) [px], and a score from 0 to 1 as an optional fifth number.
Box = Sequence[float]
FindBoxes = Callable[[Image], Sequence[Box]]
WHAT_A_BOX_IS = (
    "a box is (left, top, width, height) in pixels with a width and height above 0, and a score from 0 to 1 as a fifth "
    "where there is one"
)
# Score of a box without one.
UNKNOWN_SCORE = 0.5


class ExternalDetector:
    """Make a detector of a function; the result is checked, because it comes from outside the project."""

    def __init__(self, find: FindBoxes) -> None:
        """Wrap a function.

        Args:
            find: takes an image, (H, W, 3) BGR, and returns the targets' boxes; the box of a single lit pixel at column
                3 and row 5 is (3, 5, 1, 1).
        """
        self._find = find
        self._size = SizeCheck()

    def detect(self, frame: Frame, held: Tracks = ()) -> Detections:
        """Detect what the function finds; boxes are cut to the image.

        Raises:
            CotargetError: the image's size changed, or the function did not return boxes.
        """
        self._size.check(frame.image)
        size = np.array(frame.image.shape[1::-1], dtype=float)
        found = []
        for box in _listed(self._find(frame.image)):
            left, top, width, height, score = _check(box)
            low = np.array([left, top])
            cut = np.clip([low, np.add(low, (width, height))], 0.0, size)
            if (cut[1] - cut[0]).min() <= 0:
                continue  # wholly outside the image
            clipped = bool((cut[0] <= 0).any() or (cut[1] >= size).any())
            found.append(Detection((cut[0] + cut[1] - 1) / 2, cut[1] - cut[0], score, clipped))
        return Detections(sorted(found, key=lambda detection: -detection.score))


def _listed(boxes: Sequence[Box]) -> Iterable[Box]:
    """Convert the function's result to a list of boxes.

    Raises:
        CotargetError: it is no sequence, or a single box.
    """
    try:
        listed = list(boxes)
    except TypeError:
        listed = None
    if listed is None or isinstance(boxes, str | bytes | Mapping) or (listed and isinstance(listed[0], Number)):
        raise CotargetError(
            f"the external detector returned {_short(boxes)}; it has to return a list of boxes, empty where it finds "
            f"nothing; {WHAT_A_BOX_IS}"
        )
    return listed


def _check(box: Box) -> tuple[float, float, float, float, float]:
    """Check a box and complete it with a score.

    Raises:
        CotargetError: it is no box.
    """
    try:
        numbers = [float(x) for x in box]
    except (TypeError, ValueError):
        numbers = []
    whole = len(numbers) in (4, 5) and all(map(math.isfinite, numbers))
    if not whole or min(numbers[2:4]) <= 0 or (len(numbers) == 5 and not 0 <= numbers[4] <= 1):
        raise CotargetError(f"the external detector returned {_short(box)} for a box; {WHAT_A_BOX_IS}")
    left, top, width, height = numbers[:4]
    return left, top, width, height, numbers[4] if len(numbers) == 5 else UNKNOWN_SCORE


def _short(value: object) -> str:
    """Format a value on one line, shortened."""
    return " ".join(reprlib.repr(value).split())
