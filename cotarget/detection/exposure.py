"""Measure what a camera's automatic exposure does, so that it is not taken for a change of the scene."""

import math

import cv2
import numpy as np

from cotarget.detection.background import BRIGHTEST, HISTORY_S
from cotarget.detection.base import LASTING_S
from cotarget.geometry import Array
from cotarget.rig import Image

# Cells along width and height in which brightness is compared.
CELLS = (32, 24)
# Relative change of brightness beyond which the picture is another: of the median cell, from the change that they have
# in common; and of an image, from the one before, because lamps flicker by less.
OTHER_PICTURE = 0.15
# Least change that is one of the exposure.
DARKEST = 1 / 3
# Images are compared if their exposures differ by at most this part, because a codec draws texture again. They
# are averaged over SAME_S for it, so that a lamp may flicker and a cloud pass.
SAME_EXPOSURE = 0.02


class Exposure:
    """Measures the brightness of images relative to that of the last HISTORY_S."""

    def __init__(self) -> None:
        """Start without a reference."""
        self._reference: Array | None = None
        self._t = 0.0
        self._change = 1.0  # of the last image that shows the same picture
        self._changed_t: float | None = None  # since when the picture is another

    def measure(self, image: Image, t: float) -> float:
        """Return an image's brightness over that of the reference; the last one where the picture has changed.

        It is the median ratio over cells of the image, so that a target may cover nearly half of it.

        Args:
            image: image in a reduced size, (H, W, 3).
            t: its time [s].
        """
        cells = cv2.cvtColor(cv2.resize(image, CELLS, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY) + 1.0
        if self._reference is None:
            self._reference, self._t = cells, t
        ratio = cells / self._reference
        change = float(np.median(ratio))
        since, self._t = max(0.0, t - self._t), t
        if np.median(np.abs(ratio / change - 1)) > OTHER_PICTURE or not DARKEST < change < BRIGHTEST:
            self._changed_t = t if self._changed_t is None else self._changed_t
            if t - self._changed_t >= LASTING_S:
                self._reference, self._changed_t = cells / self._change, None
            return self._change
        self._change, self._changed_t = change, None
        self._reference = self._reference + (1 - math.exp(-since / HISTORY_S)) * (cells - self._reference)
        return change
