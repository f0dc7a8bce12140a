"""How far the wide view has shifted since it was first looked at: shake, a nudge, a slow pan (ego-motion)."""

import cv2
import numpy as np

from cotarget.geometry import Array
from cotarget.rig import Image

# Corners are sought and followed in a picture of half the size; a whole one gives no better shift at twice the cost.
SCALE = 2
# How many corners are followed, how far apart they lie [px of the half picture], and how strong the weakest is beside
# the strongest.
CORNERS, APART_PX, WEAKEST = 60, 6, 0.02
# Least eigenvalue of a corner, as cv2.cornerMinEigenVal has it: noise of 5 grey levels makes as much. In a picture of
# nothing but sky the strongest corners are the target and what the codec leaves.
LEAST_CORNER = 3e-4
CORNER_BLOCK = 3
# With fewer corners than this the median is no measurement, and the camera is taken to stand.
FEWEST = 8
# When fewer than this part of many corners is found again, the film was cut or the camera was put elsewhere.
FOUND_AGAIN = 0.3
# Corners are sought anew after so many frames: some drift off, some were on a target.
RENEW_FRAMES = 15
# Window in which a corner is followed, and levels of its pyramid: up to 20 px a frame of the whole picture.
WINDOW_PX, LEVELS = (11, 11), 2
# Corners that disagree by more than this (median absolute deviation) show another scene, not a shift [px].
DISAGREEMENT_PX = 2.0


class CameraMotion:
    """Follows corners of the picture from frame to frame (Lucas and Kanade); their median is the camera's doing.

    Only the shift is estimated: the shake and the slow turns of a fixed camera hardly rotate its picture, and what
    is left is small beside a target.

    Attributes:
        jumped: whether the last frame was of another scene than the one before.
    """

    def __init__(self) -> None:
        """Begin at no shift."""
        self._last: Image | None = None
        self._corners: Image | None = None
        self._age = 0
        self._shift = np.zeros(2)
        self.jumped = False

    def update(self, grey: Image) -> Array:
        """Take the next frame into account.

        Args:
            grey: (H, W) picture.

        Returns:
            Where a point of the first frame's scene is now, less where it was then (du, dv) [px], (2,).
        """
        size = (max(1, grey.shape[1] // SCALE), max(1, grey.shape[0] // SCALE))
        half = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        if self._last is not None:
            self._shift = self._shift + SCALE * self._step(self._last, half)
        self._last = half
        return self._shift

    def _step(self, before: Image, after: Image) -> Array:
        """The shift between two frames [px of the half picture]."""
        self.jumped = False
        self._age += 1
        if self._corners is None or self._age >= RENEW_FRAMES or len(self._corners) < FEWEST:
            self._corners = _corners(before)
            self._age = 0
        if self._corners is None or len(self._corners) < FEWEST:
            return np.zeros(2)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            before, after, self._corners, None, winSize=WINDOW_PX, maxLevel=LEVELS
        )
        kept = found.ravel() > 0
        flow = (moved - self._corners).reshape(-1, 2)[kept]
        shift = np.median(flow, axis=0) if len(flow) else np.zeros(2)
        if kept.mean() < FOUND_AGAIN or np.median(np.abs(flow - shift)) > DISAGREEMENT_PX / SCALE:
            self.jumped = True
            self._corners = None
            return np.zeros(2)
        self._corners = moved[kept]
        return np.asarray(shift, dtype=float)


def _corners(picture: Image) -> Image | None:
    """Corners that are no noise, (n, 1, 2); None where there is none."""
    corners = cv2.goodFeaturesToTrack(picture, CORNERS, WEAKEST, APART_PX, blockSize=CORNER_BLOCK)
    if corners is None:
        return None
    u, v = corners.reshape(-1, 2).astype(int).T
    return np.asarray(corners[cv2.cornerMinEigenVal(picture, CORNER_BLOCK)[v, u] >= LEAST_CORNER])
