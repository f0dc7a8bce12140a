"""Estimate the shift of the fixed camera's image since the first frame, by tracked corners."""

import math

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.detection.base import SAME_S
from cotarget.geometry import Array
from cotarget.rig import Image

# Factor by which the image is reduced before corners are tracked; full size gives no better shift at twice the cost.
SCALE = 2
# Cells along width and height; of each, the strongest corner is tracked, so that a large target does not have most.
CORNER_CELLS = (16, 12)
# Least eigenvalue of a corner, of cv2.cornerMinEigenVal: noise of 5 grey levels reaches it. In an image of sky
# alone, the strongest corners are the target and artefacts of the codec.
LEAST_CORNER = 3e-4
# Fewer corners are no measurement, and the camera is taken to stand still.
FEWEST = 8
# Least standard deviation of the corners' places along one axis, over the image's side. Corners nearer together are on
# a target before a plain background, and the camera is taken to stand still. It is that of half an image.
SPREAD = math.sqrt(1 / 48)
# Fewest corners, where there were too few before, that show another scene.
MANY = 24
# If less than this part of the corners is found again, or of these at one shift, since the last image and since they
# were detected, the film was cut, the camera was moved or the corners are on a flock. Standing corners count as the
# scene's from this part on.
FEWEST_ALIKE = 0.35
# A film goes on while half of the corners look as before, to this mean difference of their surroundings [grey levels],
# wherever they have gone: before a plain sky all are on birds. Or while so many stand: a car that fills the image is
# blurred. After a cut only those of writing do.
SAME_LOOK, FEWEST_STANDING = 8.0, 5
# Window in which a corner is tracked, and pyramid levels: up to 20 px a frame of the full image.
WINDOW_PX, LEVELS = (11, 11), 2
# Largest difference of a corner's shift from the common one, along each axis [px].
AGREEMENT_PX = 2.0


class CameraMotion:
    """Estimate the camera's shake, nudges and slow turns as the shift that most corners have (Lucas and Kanade).

    Only a shift is estimated: the shake and slow turns of a fixed camera hardly rotate the image, and the remainder is
    small beside a target.

    Attributes:
        jumped: whether the last frame shows another scene than the one before.
    """

    def __init__(self) -> None:
        """Start with no shift."""
        self._last: Image | None = None
        self._corners = self._first = np.zeros((0, 1, 2), np.float32)  # now, and where each was detected
        self._before = np.zeros(2)  # shift of the image in which they were detected
        self._t = self._begun_t = -math.inf  # times of the last image, and of that in which they were detected
        self._shift = np.zeros(2)
        self.jumped = False

    def update(self, grey: Image, t: float) -> Array:
        """Update the shift with the next frame.

        Args:
            grey: image, (H, W).
            t: its time [s].

        Returns:
            Shift (du, dv) of the scene since the first frame [px], (2,).
        """
        size = (max(1, grey.shape[1] // SCALE), max(1, grey.shape[0] // SCALE))
        half = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        if self._last is not None:
            self._step(self._last, half)
        self._last, self._t = half, t
        return self._shift

    def _step(self, before: Image, after: Image) -> None:
        """Update the shift from one image of reduced size to the next.

        It is measured since the corners were detected and not from frame to frame: clouds, which drift by a tenth of a
        pixel a frame, are then distinguished from the scene, and their drift does not add up.
        """
        self.jumped = False
        if not 0 <= self._t - self._begun_t < SAME_S:  # some have drifted off, and some are on a target
            self._begin(_corners(before))
            self._begun_t = self._t
        if len(self._corners) < FEWEST or _spread(self._corners, before) < SPREAD:
            # A film that goes on in another place: where there was sky alone, there are many corners at once.
            come = _corners(after)
            self.jumped = len(self._corners) < FEWEST and len(come) >= MANY and _spread(come, after) >= SPREAD
            self._begin(come)
            return
        ahead, found, error = cv2.calcOpticalFlowPyrLK(
            before, after, self._corners, None, winSize=WINDOW_PX, maxLevel=LEVELS
        )
        kept = found.ravel() > 0
        flow = (ahead - self._corners).reshape(-1, 2)
        alike = kept & _alike(flow, np.median(flow[kept], axis=0) if kept.any() else np.zeros(2))
        standing = kept & _alike(flow, np.zeros(2)) & ~alike
        # A large target may have more corners than the scene, but the scene extends over more of the image. So may
        # leaves or letters that stand in a shaken image, but they are few.
        fewest = FEWEST_ALIKE * kept.sum()
        if standing.sum() >= fewest and (
            _spread(self._corners[standing], before) > _spread(self._corners[alike], before)
        ):
            alike = standing
        way = (ahead - self._first).reshape(-1, 2)  # since the corners were detected
        shift = np.array([_shorth(way[alike, axis]) for axis in (0, 1)]) if alike.any() else np.zeros(2)
        if kept.mean() < FEWEST_ALIKE or (alike & _alike(way, shift)).sum() < fewest:
            look = int(np.count_nonzero(kept & (error.ravel() < SAME_LOOK)))
            stand = int(np.count_nonzero(kept & _alike(flow, np.zeros(2))))
            self.jumped = 2 * look < len(kept) and stand < FEWEST_STANDING
            self._begun_t = -math.inf
            return
        self._corners, self._first = ahead[kept], self._first[kept]
        self._shift = self._before + SCALE * shift

    def _begin(self, corners: npt.NDArray[np.float32]) -> None:
        """Measure the shift by these corners, from the image on that they were detected in."""
        self._corners = self._first = corners
        self._before = self._shift


def _corners(picture: Image) -> npt.NDArray[np.float32]:
    """Detect the strongest corner of each cell that is stronger than noise, (n, 1, 2)."""
    strength = cv2.cornerMinEigenVal(picture, blockSize=3)
    columns, rows = CORNER_CELLS
    height, width = -(-picture.shape[0] // rows), -(-picture.shape[1] // columns)  # of a cell
    below, beside = rows * height - picture.shape[0], columns * width - picture.shape[1]
    whole = cv2.copyMakeBorder(strength, 0, below, 0, beside, cv2.BORDER_CONSTANT)
    cells = whole.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(rows, columns, -1)
    v, u = np.nonzero(cells.max(axis=2) >= LEAST_CORNER)
    down, across = np.divmod(cells.argmax(axis=2)[v, u], width)
    return np.asarray(np.stack([u * width + across, v * height + down], axis=1)[:, None], dtype=np.float32)


def _spread(corners: npt.NDArray[np.float32], picture: Image) -> float:
    """Standard deviation of corners' places over the image's side, the larger of both axes; 0 for none."""
    return float((corners.std(axis=(0, 1)) / picture.shape[::-1]).max()) if len(corners) else 0.0


def _shorth(values: Array) -> float:
    """Mean of the shortest half of values, (n,) (Andrews et al. 1972), which corners on clouds do not change."""
    ordered, half = np.sort(values), len(values) // 2
    first = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
    return float(ordered[first : first + half + 1].mean())


def _alike(flow: Array, shift: Array) -> npt.NDArray[np.bool_]:
    """Whether each corner's flow is that of a shift [px of the reduced image]."""
    return np.asarray((np.abs(flow - shift) <= AGREEMENT_PX / SCALE).all(axis=1))
