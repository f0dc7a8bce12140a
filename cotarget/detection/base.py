"""What a detector takes and gives.

Boxes are (u, v) middle and (width, height), in pixels whose (0, 0) is the centre of the top-left one, so that the
box of a single lit pixel at column 3 is centred on u = 3 and 1 wide.
"""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from cotarget.errors import CotargetError
from cotarget.geometry import Array
from cotarget.rig import Frame, Image

# A target is small: when more of the picture than this changed at once, the light or the camera did.
MOST_FOREGROUND = 0.3


@dataclass(frozen=True)
class Detection:
    """One target seen in one frame.

    Attributes:
        center_px: middle of the box (u, v), (2,).
        size_px: its width and height, (2,).
        score: how sure the detector is, 0 to 1.
        clipped: whether the image's border cuts the box, so that its size is only a lower bound.
    """

    center_px: Array
    size_px: Array
    score: float
    clipped: bool = False


class Detector(Protocol):
    """Finds targets of one kind in the frames of one camera."""

    @property
    def mask(self) -> Image | None:
        """The last frame's foreground, (H, W), 0 to 255; for pictures."""

    def detect(self, frame: Frame) -> list[Detection]:
        """Find the targets, best first; [] where there is none."""


def flood(mask: Image | None) -> float:
    """The part of a picture that is foreground, 0 to 1, where that is too much to be targets; else 0."""
    part = 0.0 if mask is None else cv2.countNonZero(mask) / mask.size
    return part if part > MOST_FOREGROUND else 0.0


def box_detection(x: int, y: int, w: int, h: int, score: float, shape: tuple[int, ...]) -> Detection:
    """Make a detection of a box of whole pixels.

    Args:
        x: its first column [px].
        y: its first row [px].
        w: how many columns it has [px].
        h: how many rows [px].
        score: how sure the detector is, 0 to 1.
        shape: of the image, (H, W, ...); a box at its border is clipped.
    """
    clipped = x <= 0 or y <= 0 or x + w >= shape[1] or y + h >= shape[0]
    return Detection(np.array([x + (w - 1) / 2, y + (h - 1) / 2]), np.array([w, h], dtype=float), score, clipped)


def check_size(shape: tuple[int, ...] | None, image: Image) -> None:
    """Refuse an image of another shape than before.

    Raises:
        CotargetError: the image's size changed.
    """
    if shape is not None and image.shape != shape:
        raise CotargetError(
            f"the image's size changed from {shape[1]}x{shape[0]} to {image.shape[1]}x{image.shape[0]}; "
            "the detector needs one camera with one size"
        )
