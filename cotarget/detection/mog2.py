"""Detect motion as the paper does: OpenCV's adaptive Gaussian mixture of the background (Zivkovic 2004), cleaned.

The paper does not say how foreground is grouped. Here it is opened and closed, and each connected component is a
target. Nothing is done against foliage, light or a camera that moves: `cotarget.detection.auto` is for these.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from cotarget.detection.base import Detections, SizeCheck, Tracks, box_detection, flood, pieces
from cotarget.rig import Frame

# Memory of OpenCV's default mixture, 120 frames at 30 a second, and time that is learnt before a detection [s].
HISTORY_S, WARM_UP_S = 4.0, 0.5
# Squared distance to the background, in variances, from which a pixel is foreground.
THRESHOLD = 25.0


@dataclass(frozen=True)
class Grouping:
    """How foreground becomes targets.

    Attributes:
        shadows: whether to separate shadows from the target.
        opening_px: foreground thinner than this is removed; 0 for none.
        bridge_px: (width, height) of gaps that are closed within one target.
        smallest_area_px: fewest foreground pixels of a target.
    """

    shadows: bool
    opening_px: int
    bridge_px: tuple[int, int]
    smallest_area_px: int


# A bird may be as small as four pixels and casts no shadow on the sky; a person falls apart into limbs and trunk.
FLYING = Grouping(shadows=False, opening_px=0, bridge_px=(5, 5), smallest_area_px=5)
ON_THE_GROUND = Grouping(shadows=True, opening_px=3, bridge_px=(5, 15), smallest_area_px=150)


class Mog2Detector:
    """Detect what differs from the mixture."""

    def __init__(self, grouping: Grouping, rate_hz: float) -> None:
        """Create a detector without a background; ``rate_hz`` is the nominal frame rate [Hz]."""
        self._grouping = grouping
        self._model = cv2.createBackgroundSubtractorMOG2(
            history=max(1, round(HISTORY_S * rate_hz)), varThreshold=THRESHOLD, detectShadows=grouping.shadows
        )
        self._model.setShadowValue(0)
        self._begun_t: float | None = None
        self._size = SizeCheck()

    def detect(self, frame: Frame, held: Tracks = ()) -> Detections:
        """Detect moving targets, largest first; the background is learnt everywhere.

        Raises:
            CotargetError: the image's size changed.
        """
        self._size.check(frame.image)
        mask = np.asarray(self._model.apply(frame.image), dtype=np.uint8)
        if self._grouping.opening_px:
            opening = np.ones((self._grouping.opening_px,) * 2, np.uint8)
            mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, opening), dtype=np.uint8)
        if self._begun_t is None:
            self._begun_t = frame.t
        if frame.t - self._begun_t < WARM_UP_S or flood(mask):
            return Detections([], lambda: mask)
        found = []
        for x, y, w, h in pieces(mask, self._grouping.bridge_px):
            # The component's gaps are bridged, so its box is that of the mask's own pixels.
            inside = mask[y : y + h, x : x + w]
            area, least = cv2.countNonZero(inside), self._grouping.smallest_area_px
            if area >= least:
                dx, dy, w, h = cv2.boundingRect(inside)
                found.append((area, box_detection(x + dx, y + dy, w, h, area / (area + least), mask.shape)))
        found.sort(key=lambda pair: -pair[0])
        return Detections([detection for _, detection in found], lambda: mask)
