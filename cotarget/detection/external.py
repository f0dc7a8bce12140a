"""Any detector from elsewhere, a neural network for instance: a function from a picture to boxes."""

import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Number

import numpy as np

from cotarget.detection.base import Detection, check_size
from cotarget.errors import CotargetError
from cotarget.rig import Frame, Image

# (left column, top row, width, height) [px], and the score from 0 to 1 as a fifth where the detector has one.
Box = Sequence[float]
FindBoxes = Callable[[Image], Sequence[Box]]
WHAT_A_BOX_IS = (
    "a box is (left, top, width, height) in pixels with a width and height above 0, and a score from 0 to 1 as a fifth "
    "where there is one"
)
# What a box without a score gets.
UNKNOWN_SCORE = 0.5
# So many characters of a wrong answer are shown.
SHOWN = 80


class ExternalDetector:
    """Makes a Detector of a function; what it returns is checked, because it comes from outside."""

    def __init__(self, find: FindBoxes) -> None:
        """Wrap a function.

        Args:
            find: given a (H, W, 3) BGR picture, returns the targets' boxes; the box of a single lit pixel at column
                3 and row 5 is (3, 5, 1, 1).
        """
        self._find = find
        self._shape: tuple[int, ...] | None = None
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """Find what the function finds, the surest first; boxes are cut to the image.

        Raises:
            CotargetError: the image's size changed, or the function returned something else than boxes.
        """
        check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        size = np.array(frame.image.shape[1::-1], dtype=float)
        found = []
        for box in _listed(self._find(frame.image)):
            left, top, width, height, score = _check(box)
            low = np.array([left, top])
            cut = np.clip([low, np.add(low, (width, height))], 0.0, size)
            if (cut[1] - cut[0]).min() <= 0:
                continue  # wholly outside
            clipped = bool((cut[0] <= 0).any() or (cut[1] >= size).any())
            found.append(Detection((cut[0] + cut[1] - 1) / 2, cut[1] - cut[0], score, clipped))
        found.sort(key=lambda detection: -detection.score)
        return found


def _listed(boxes: Sequence[Box]) -> Iterable[Box]:
    """What the function returned, as something to go through.

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
    """A box with its score.

    Raises:
        CotargetError: it is none.
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
    """A value in one line that is not too long."""
    return textwrap.shorten(repr(value), SHOWN, placeholder=" ...")
