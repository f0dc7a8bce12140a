"""Where the target is in a zoom frame, by registering the wide view's patch of it there."""

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from cotarget.calibration import Calibration
from cotarget.closeup.matching import Likeness, correlate, resample, summit
from cotarget.closeup.template import Sight, look
from cotarget.config import TargetConfig
from cotarget.detection import Detection
from cotarget.geometry import Array
from cotarget.pantilt import base_head
from cotarget.rig import Frame, Image

# Wide frames that are kept, and how far apart in time the two views may be: limbs and wings move [s].
KEPT_SIGHTS, LONGEST_APART_S = 8, 0.1
# The target is looked for where it is expected, within this many standard deviations ...
GATE_SIGMAS = 3.0
# ... none of which is less than this: lens, head and frame times are never better [px].
LEAST_SIGMA_PX = 1.0
# First with few samples along its larger side, everywhere; then with more, around what was found.
COARSE_SAMPLES, FINE_SAMPLES = 14.0, 40.0
# No finer than this many samples a pixel of the wide view: there is no more in it.
FINEST = 4.0
# How far to search to each side, at most, in coarse samples; and in fine ones, beside half a coarse one.
WIDEST_SEARCH, FINE_SEARCH = 48, 1
# What the wide view's lens, pixels and coding blur together, one standard deviation [px]; chosen on rendered books.
WIDE_BLUR_PX = 0.7
# A find is at least this much alike, by this much more than the next best place, and no more of it is out of view.
LEAST_SCORE, LEAST_LEAD, LEAST_SEEN = 0.7, 0.12, 0.6
# Nor is it less alike than finds lately were by more than this; what they were fades by so much a second.
LARGEST_DROP, FADING = 0.15, 0.1
# Both cameras show it with a similar contrast.
LOWEST_GAIN, HIGHEST_GAIN = 0.25, 4.0
# A place away from the expected one counts as less alike, by this times its squared distance in standard deviations.
PRIOR_WEIGHT = 0.01
# Two places that are apart by less than this part of the target's box are one.
ONE_PLACE = 0.5
# Standard deviation of a registration, in pixels of the wide view and in samples, where likeness is lacking by as much
# as is usual; measured on the simulated targets.
SIGMA_PX, SIGMA_SAMPLES = 0.08, 0.08
USUAL_LACK, LEAST_LACK = 0.1, 0.04  # 1 - score
# A small step for derivatives, as a part of the depth.
STEP = 1e-3


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
        sigma_px: how far it may be from the point that ``wide_px`` shows, along u and v each, one standard deviation.
        body_sigma_px: how far it may be from the true middle of the body, likewise, (2,).
        score: how alike both views are there, 0 to 1.
        seen: the part of the target that is inside the zoom frame, 0 to 1.
        size_px: the width and height of the wide view's box as large as the zoom frame shows them, (2,).
        wide_px: the same point in the wide view, (2,), and ...
        wide_t: ... when that view was exposed [s].
    """

    center_px: Array
    sigma_px: float
    body_sigma_px: Array
    score: float
    seen: float
    size_px: Array
    wide_px: Array
    wide_t: float


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
        self._T_base_fixed = calibration.hand_eye() * calibration.T_zoom0_fixed  # (6)
        self._T_zoom_head = calibration.hand_eye().inv()
        self._target = target
        self._sights: deque[Sight] = deque(maxlen=KEPT_SIGHTS)
        self._usual_score, self._usual_t = 0.0, -math.inf

    def see_wide(self, frame: Frame, detection: Detection, mask: Image | None = None) -> None:
        """Remember the target as a wide frame shows it.

        Args:
            frame: of the wide view.
            detection: of the target in that very frame.
            mask: the detector's foreground there, (H, W); without it an ellipse in the box.
        """
        sight = look(frame, detection, mask, self._target)
        if sight is not None:
            self._sights.append(sight)

    def find(self, frame: Frame, expected: Expected) -> Found | None:
        """Find the target in a zoom frame.

        Args:
            frame: of the zoom camera.
            expected: where it should be.

        Returns:
            None where it is not there, or not for sure.
        """
        near = [sight for sight in self._sights if abs(sight.t - frame.t) <= LONGEST_APART_S]
        view = self._view(expected)
        if not near or view is None:
            return None
        found = _register(frame.image, min(near, key=lambda sight: abs(sight.t - frame.t)), view)
        if found is None:
            return None
        usual = self._usual_score - FADING * abs(frame.t - self._usual_t)
        if found.score < usual - LARGEST_DROP:
            return None
        self._usual_score, self._usual_t = max(found.score, usual), frame.t
        return found

    def _view(self, expected: Expected) -> "_View | None":
        """Project what is expected; None where that is behind a camera or beyond its lens."""
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
        return _View(zoom[0], covariance + LEAST_SIGMA_PX**2 * np.eye(2), J)


@dataclass(frozen=True)
class _View:
    """How the wide view's surroundings of the target appear in a zoom frame.

    Attributes:
        center_px: where the target is expected, (2,).
        covariance: of that [px^2], (2, 2).
        J: zoom pixels a wide pixel at the target's depth, (2, 2).
    """

    center_px: Array
    covariance: Array
    J: Array

    @property
    def scale(self) -> float:
        """Zoom pixels a wide pixel."""
        return math.sqrt(abs(float(np.linalg.det(self.J))))


@dataclass(frozen=True)
class _Place:
    """The best place of a search: where in the zoom frame, how alike, by how much more than elsewhere, how visible."""

    center_px: Array
    score: float
    lead: float
    seen: float


def _register(image: Image, sight: Sight, view: _View) -> Found | None:
    """Register a sight of the target in a zoom image, first coarsely, then finely."""
    finest = max(1 / FINEST, 1 / view.scale)
    coarse, fine = (max(sight.side_px / samples, finest) for samples in (COARSE_SAMPLES, FINE_SAMPLES))
    place = _search(image, sight, view, coarse, view.center_px, None)
    if place is None or place.lead < LEAST_LEAD:
        return None
    place = _search(image, sight, view, fine, place.center_px, FINE_SEARCH + math.ceil(coarse / fine / 2))
    if place is None or place.score < LEAST_SCORE:
        return None
    lack = max(1 - place.score, LEAST_LACK) / USUAL_LACK
    return Found(
        center_px=place.center_px,
        sigma_px=(SIGMA_PX + SIGMA_SAMPLES * fine) * math.sqrt(lack) * view.scale,
        body_sigma_px=np.abs(view.J) @ sight.body_sigma_px,
        score=place.score,
        seen=place.seen,
        size_px=np.linalg.norm(view.J, axis=0) * sight.size_px,
        wide_px=sight.body_px,
        wide_t=sight.t,
    )


def _search(
    image: Image, sight: Sight, view: _View, pitch: float, around_px: Array, reach: int | None
) -> _Place | None:
    """Find the place in a zoom image that is most alike to a sight, sampled every ``pitch`` wide pixels.

    Args:
        image: the zoom frame's.
        sight: the target.
        view: how the wide view appears in the zoom frame.
        pitch: [px of the wide view].
        around_px: middle of the search in the zoom frame, (2,).
        reach: how many samples to each side; None for all of the gate, which alone then counts.
    """
    template, weight, middle = sight.at_pitch(pitch)
    step = view.J * pitch  # zoom pixels a sample
    back = np.linalg.inv(step)
    spread = back @ view.covariance @ back.T + np.diag((sight.body_sigma_px / pitch) ** 2)
    sides = np.full(2, WIDEST_SEARCH if reach is None else reach)
    if reach is None:
        sides = np.minimum(np.ceil(GATE_SIGMAS * np.sqrt(np.diag(spread))).astype(int) + 1, sides)
    A = np.column_stack([step, around_px - step @ (middle + sides)])
    width, height = (np.array(weight.shape[::-1]) + 2 * sides).tolist()
    samples, inside = resample(image, A, (width, height))
    if pitch < 1:  # the wide view's blur, in samples, where they show it
        samples = cv2.GaussianBlur(samples, (0, 0), WIDE_BLUR_PX / pitch)
    mix = sight.whitening
    likeness = correlate(cv2.transform(samples, mix), inside, cv2.transform(template, mix), weight)
    v, u = np.mgrid[-sides[1] : sides[1] + 1, -sides[0] : sides[0] + 1]
    inverse = np.linalg.inv(spread)
    distance = inverse[0, 0] * u * u + 2 * inverse[0, 1] * u * v + inverse[1, 1] * v * v
    if reach is not None:
        distance = np.zeros_like(distance)
    return _best(likeness, distance, ONE_PLACE * sight.size_px / pitch, around_px - step @ sides, step)


def _best(likeness: Likeness, distance: Array, apart: Array, origin_px: Array, step: Array) -> _Place | None:
    """The best place of a search, if it is one.

    Args:
        likeness: at every place.
        distance: squared, of every place from the expected one, in standard deviations.
        apart: two places so far apart along u or v are two, (2,) [samples].
        origin_px: where the first place is in the zoom frame, (2,).
        step: from one place to the next, (2, 2) [px].
    """
    allowed = (likeness.gain > LOWEST_GAIN) & (likeness.gain < HIGHEST_GAIN)
    allowed &= (likeness.seen >= LEAST_SEEN) & (distance <= GATE_SIGMAS**2)
    score = np.where(allowed, likeness.score - PRIOR_WEIGHT * distance, -1.0)
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(score)), score.shape))
    # The expectation may have drawn it one sample aside; what goes on rising, beyond the gate, is something else.
    top = summit(likeness.score, (row, column))
    if not allowed[row, column] or top is None:
        return None
    low = np.maximum(np.ceil([column - apart[0], row - apart[1]]), 0).astype(int)
    high = np.floor([column + apart[0], row + apart[1]]).astype(int) + 1
    best = float(score[row, column])
    score[low[1] : high[1], low[0] : high[0]] = -1.0
    return _Place(
        center_px=origin_px + step @ top,
        score=float(likeness.score[row, column]),
        lead=best - max(float(score.max()), 0.0),
        seen=float(likeness.seen[row, column]),
    )
