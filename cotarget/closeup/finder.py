"""Where the target is in a zoom frame, by registering the wide view's patch of it there."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cotarget.calibration import Calibration
from cotarget.closeup.registration import Place, View, register
from cotarget.closeup.template import Sight, look
from cotarget.config import TargetConfig
from cotarget.detection import Detection
from cotarget.geometry import Array
from cotarget.pantilt import base_head
from cotarget.rig import Frame, Image

# How far apart in time the two views of a find may be: limbs and wings move [s].
LONGEST_APART_S = 0.1
# By so much one camera's frames may come later than the other's [s]; for so long wide frames are kept.
LATEST_S = 0.5
# A small step for derivatives, as a part of the depth.
STEP = 1e-3
# Lens, head and the times of frames are never known better than this, one standard deviation [px].
LEAST_SIGMA_PX = 1.0
# A find is sure that is at least this much alike, and less alike than finds lately were by no more than this; what
# they were fades by so much a second.
SURE_SCORE, LARGEST_DROP, FADING = 0.7, 0.15, 0.1
# One that is less alike, but by so much, is believed for this long after a sure one [s], where it goes on from the last
# find: that was no longer ago than this [s], and beside the expected place by as much as this one, within so many
# pixels of the wide view and such a part of the target's box.
LEAST_SCORE, BELIEVED_S, LONGEST_GAP_S = 0.55, 0.5, 0.15
STEADY_PX, STEADY_OF_SIDE = 0.5, 0.15


@dataclass(frozen=True)
class Expected:
    """Where the target is expected when a zoom frame was exposed, and how the zoom camera stood then.

    Attributes:
        x_fixed: the target in the fixed camera's frame [m], (3,).
        covariance: of where that appears in the zoom frame [px^2], (2, 2).
        pan: as the head reports it, its known bias taken into account [rad].
        tilt: likewise.
        nominal_px: focal length as the lens reports it [px].
    """

    x_fixed: Array
    covariance: Array
    pan: float
    tilt: float
    nominal_px: float


@dataclass(frozen=True)
class Found:
    """The target in a zoom frame: one point of it, taken for the middle of its body, as both views show it.

    Attributes:
        center_px: that point in the zoom frame (u, v), (2,).
        sigma_px: how far it may be from the same point in the wide view, along u and v each, one standard deviation.
        body_sigma_px: how far it may be from the true middle of the body, likewise, (2,).
        score: how alike both views are there, 0 to 1.
        seen: the part of the target that is inside the zoom frame, 0 to 1.
        size_px: the width and height of the wide view's box as large as the zoom frame shows them, (2,).
        t: when the zoom frame was exposed [s].
    """

    center_px: Array
    sigma_px: float
    body_sigma_px: Array
    score: float
    seen: float
    size_px: Array
    t: float


class Finder(Protocol):
    """Finds the target that is followed in the zoom view; the docstrings of `CloseupFinder` say what is what."""

    def see_wide(self, frame: Frame, detection: Detection, mask: Image | None = None) -> Sight | None:
        """Remember the target as a wide frame shows it."""

    def sight_at(self, t: float) -> object | None:
        """What the wide view showed of the target at about a time [s]; None where it did not, or has not yet."""

    def find(self, frame: Frame, expected: Expected) -> Found | None:
        """Find the target in a zoom frame."""


class CloseupFinder:
    """Finds in the zoom view what the wide view's detector has found; one for each target that is followed."""

    def __init__(self, calibration: Calibration, target: TargetConfig) -> None:
        """Begin without a sight of the target.

        Args:
            calibration: of the rig, for the streams in use.
            target: what is followed.

        Raises:
            CalibrationError: the calibration has no T.
        """
        self._calibration = calibration
        self._T_base_fixed = calibration.T_base_fixed
        self._T_zoom_head = calibration.hand_eye().inv()
        self._target = target
        self._sights: deque[Sight] = deque()
        self._usual_score, self._sure_t = 0.0, -math.inf
        self._last_t = -math.inf
        self._last_offset: Array = np.zeros(2)  # beside the expected place, in wide pixels

    def see_wide(self, frame: Frame, detection: Detection, mask: Image | None = None) -> Sight | None:
        """Remember the target as a wide frame shows it.

        Args:
            frame: of the wide view.
            detection: of the target in that very frame.
            mask: the detector's foreground there, (H, W); without it an ellipse in the box.

        Returns:
            What was seen, the middle of the body in particular; None where the box holds no pixel of the frame.
        """
        sight = look(frame, detection, mask, self._target)
        if sight is not None:
            self._sights.append(sight)
            while self._sights[0].t < sight.t - LATEST_S - LONGEST_APART_S:
                self._sights.popleft()
        return sight

    def sight_at(self, t: float) -> Sight | None:
        """What the wide view showed of the target at about a time [s]; None where it did not, or has not yet."""
        near = min(self._sights, key=lambda sight: abs(sight.t - t), default=None)
        return None if near is None or abs(near.t - t) > LONGEST_APART_S else near

    def find(self, frame: Frame, expected: Expected) -> Found | None:
        """Find the target in a zoom frame.

        Args:
            frame: of the zoom camera.
            expected: where it should be.

        Returns:
            None where it is not there, or not for sure.
        """
        sight, view = self.sight_at(frame.t), self.view(expected)
        if sight is None or view is None:
            return None
        place = register(frame.image, sight, view)
        if place is None or not self._believes(place, sight, view, frame.t):
            return None
        return Found(
            center_px=place.center_px,
            sigma_px=place.sigma_px,
            body_sigma_px=np.abs(view.J) @ sight.body_sigma_px,
            score=place.score,
            seen=place.seen,
            size_px=np.linalg.norm(view.J, axis=0) * sight.size_px,
            t=frame.t,
        )

    def _believes(self, place: Place, sight: Sight, view: View, t: float) -> bool:
        """Whether a place is sure, or goes on from what was; remembers it if so."""
        offset = np.asarray(np.linalg.solve(view.J, place.center_px - view.center_px), dtype=float)
        usual = self._usual_score - FADING * abs(t - self._sure_t)
        if place.score >= max(SURE_SCORE, usual - LARGEST_DROP):
            self._usual_score, self._sure_t = max(place.score, usual), t
        else:
            recent = abs(t - self._sure_t) <= BELIEVED_S and abs(t - self._last_t) <= LONGEST_GAP_S
            steady = np.linalg.norm(offset - self._last_offset) <= STEADY_PX + STEADY_OF_SIDE * sight.side_px
            if not (place.score >= LEAST_SCORE and recent and steady):
                return False
        self._last_t, self._last_offset = t, offset
        return True

    def view(self, expected: Expected) -> View | None:
        """Where in the zoom frame the target is expected; None behind a camera or beyond its lens."""
        x, covariance = np.asarray(expected.x_fixed, dtype=float), np.asarray(expected.covariance, dtype=float)
        if not (np.isfinite(x).all() and np.isfinite(covariance).all() and x[2] > 0):
            return None
        # A small cross at the target, parallel to the wide image.
        cross = x + STEP * x[2] * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
        calibration, nominal = self._calibration, expected.nominal_px
        T_base_head = base_head(expected.pan, expected.tilt, calibration.head)
        x_head = T_base_head.inv().apply(self._T_base_fixed.apply(cross))
        pupil = np.array([0.0, 0.0, calibration.zoom.pupil_at(nominal)])
        zoom = calibration.zoom.at(nominal).project(self._T_zoom_head.apply(x_head) - pupil)
        wide = calibration.fixed.project(cross)
        if not (np.isfinite(zoom).all() and np.isfinite(wide).all()):
            return None
        J = (zoom[1:3] - zoom[3:5]).T @ np.linalg.inv((wide[1:3] - wide[3:5]).T)
        return View(zoom[0], covariance + LEAST_SIGMA_PX**2 * np.eye(2), J)
