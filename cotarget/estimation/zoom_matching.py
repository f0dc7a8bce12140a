"""Where the target is in a zoom frame, by registering the wide view's patch of it there.

Finding the target in the zoom camera's own view: the very patch that the wide view sees, registered at its scale.

Registering the wide view's patch of a target in a zoom image, whose scale and turn there are known.

What the wide view shows of the target: a patch of it, how much each of its pixels counts, and the body's middle.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration import Calibration
from cotarget.config import TargetConfig
from cotarget.detection import Detection
from cotarget.estimation.correlation import Likeness, Samples, correlate, resample, summit
from cotarget.geometry import Array
from cotarget.pantilt import base_head
from cotarget.rig import Frame, Image

# Around the target's box counts a margin of this part of its larger side, and at least so many pixels, ...
MARGIN, LEAST_MARGIN_PX = 0.2, 2.0
# ... but little: it tells the outline, and belongs to a background that the other camera sees displaced.
MARGIN_WEIGHT = 0.1
# The pixels at the outline are partly the target's, and missing from the foreground as often as not.
RIM_WEIGHT = 0.3
# A foreground that fills less of the box than this is none, and one that fills all of it tells where the target is but
# not its outline; then what is not coloured as its surroundings is taken for it, and, failing that, an ellipse.
LEAST_FOREGROUND, MOST_FOREGROUND = 0.15, 0.9
STANDS_OUT = 3.0  # standard deviations of the surroundings' colours
# The background's colours are taken for spread by no less than this, one standard deviation [grey levels]; and from
# fewer of its pixels than these nothing is learnt.
LEAST_SPREAD, LEAST_BACKGROUND = 10.0, 12
# How far the true middle of the body is from where it is taken to be, one standard deviation in parts of the box's
# sides, measured on the simulated targets. Whoever stands upright is in the middle of the height, and across it where
# half of the foreground lies on either side, whatever the limbs reach for. A bird's wings move the box by twice as
# much as they move the foreground's median.
BOX_SIGMA = np.array([0.08, 0.18])
UPRIGHT_SIGMA = np.array([0.03, 0.006])
FLYING_SIGMA = np.array([0.05, 0.12])
COLOUR_SIGMA = np.array([0.01, 0.01])
Pixels = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FixedView:
    """The target as one wide frame shows it. What only a search for it needs is worked out when it is asked for.

    Attributes:
        t: when [s].
        body_px: the middle of its body there (u, v), (2,).
        body_sigma_px: how far off that may be along u and v, one standard deviation, (2,).
        size_px: width and height of its box, (2,).
        patch: the image around it, (h, w, 3) BGR.
        corner_px: the patch's top-left pixel in the frame, (2,).
        foreground: the pixels of the patch that are the target's, (h, w).
        outside_px: how far beyond its box each pixel of the patch lies [px], (h, w); none inside it.
    """

    t: float
    body_px: Array
    body_sigma_px: Array
    size_px: Array
    patch: Image
    corner_px: Array
    foreground: Pixels
    outside_px: Samples

    @property
    def side_px(self) -> float:
        """The larger side of its box [px]."""
        return float(self.size_px.max())

    @cached_property
    def weight(self) -> Samples:
        """How much each pixel of the patch counts, (h, w), 0 to 1."""
        around = MARGIN_WEIGHT * np.clip(1 - self.outside_px / _margin(self.size_px), 0, 1)
        return np.maximum(np.where(self.foreground, 1.0, RIM_WEIGHT * self._grown), around).astype(np.float32)

    @cached_property
    def whitening(self) -> Array:
        """Mixes the colours so that the background varies by one in each direction of colour, (3, 3).

        What looks like the background's own variety then counts for little.
        """
        return _whitening(self.patch[self._grown == 0])

    @cached_property
    def _grown(self) -> Image:
        """The foreground and its rim, (h, w), 1 or 0."""
        return cv2.dilate(self.foreground.astype(np.uint8), np.ones((3, 3), np.uint8))

    def at_pitch(self, pitch_px: float) -> tuple[Samples, Samples, Array]:
        """The patch and its weights, sampled every ``pitch_px`` of the frame's pixels about the body's middle.

        Returns:
            Template (h, w, 3), weights (h, w), and the sample (u, v) where the body's middle is, (2,).
        """
        first = np.floor((self.corner_px - self.body_px) / pitch_px)
        last = np.ceil((self.corner_px + np.array(self.patch.shape[1::-1]) - 1 - self.body_px) / pitch_px)
        width, height = (last - first + 1).astype(int).tolist()
        A = np.column_stack([pitch_px * np.eye(2), self.body_px + first * pitch_px - self.corner_px])
        template, _ = resample(self.patch, A, (width, height))
        weight, inside = resample(self.weight, A, (width, height))
        return template, weight if inside is None else weight * inside, -first


def look(frame: Frame, detection: Detection, mask: Image | None, target: TargetConfig) -> FixedView | None:
    """Cut the target out of a wide frame.

    Args:
        frame: the wide view's.
        detection: of the target in it.
        mask: the detector's foreground there, (H, W), or None.
        target: which dimension of it is known, and how it is found.

    Returns:
        None where the box holds no pixel of the frame.
    """
    center, size = np.asarray(detection.center_px, dtype=float), np.maximum(detection.size_px, 1.0)
    if not (np.isfinite(center).all() and np.isfinite(size).all()):
        return None
    margin = _margin(size)
    limit = np.array(frame.image.shape[1::-1])
    low = np.maximum(np.floor(center - size / 2 - margin).astype(int), 0)
    high = np.minimum(np.ceil(center + size / 2 + margin).astype(int) + 1, limit)
    if (high - low < 1).any():  # nor does its surroundings
        return None
    here = slice(low[1], high[1]), slice(low[0], high[0])
    patch = frame.image[here].copy()
    u, v = (np.arange(first, last, dtype=np.float32) for first, last in zip(low, high, strict=True))
    beyond = np.abs(u - center[0]) - size[0] / 2, np.abs(v - center[1])[:, None] - size[1] / 2
    outside = np.maximum(np.maximum(*beyond), 0)
    in_box = outside == 0
    if not in_box.any():
        return None
    foreground = np.zeros_like(in_box) if mask is None else (mask[here] > 0) & in_box
    if not _is_outline(foreground, in_box):
        foreground = _stands_out(patch, in_box)
    masked = _is_outline(foreground, in_box)
    body, sigma = center, BOX_SIGMA * size
    if target.detector == "colour":
        sigma = COLOUR_SIGMA * size
    elif masked:
        rows, columns = foreground.nonzero()
        middle = np.array([np.median(u[columns]), np.median(v[rows])], dtype=float)
        upright = target.dimension == "height"
        body = np.array([middle[0], center[1]]) if upright else middle
        sigma = (UPRIGHT_SIGMA if upright else FLYING_SIGMA) * size
    if not masked:
        du, dv = (2 * (each + side / 2) / side for each, side in zip(beyond, size, strict=True))
        foreground = du**2 + dv**2 <= 1
    if detection.clipped:  # the hidden part may be as large again
        sigma = np.hypot(sigma, size / 2)
    return FixedView(frame.t, body, sigma, size, patch, low.astype(float), foreground, outside)


def _margin(size: Array) -> float:
    """How much of a box's surroundings counts [px]."""
    return max(LEAST_MARGIN_PX, MARGIN * float(size.max()))


def _is_outline(foreground: Pixels, in_box: Pixels) -> bool:
    """Whether a foreground is the target's outline: neither next to nothing nor all of its box."""
    part = np.count_nonzero(foreground) / max(int(np.count_nonzero(in_box)), 1)
    return bool(LEAST_FOREGROUND < part < MOST_FOREGROUND)


def _stands_out(patch: Image, in_box: Pixels) -> Pixels:
    """Where the colours in the box are none that are around it."""
    background = patch[~in_box]
    if len(background) < LEAST_BACKGROUND or np.ptp(patch) == 0:
        return np.zeros_like(in_box)
    away = (patch - np.median(background, axis=0)) @ _whitening(background)
    return np.asarray((np.sum(away**2, axis=2) > STANDS_OUT**2) & in_box)


def _whitening(background: Image) -> Array:
    """The mix of colours, (3, 3), in which colours (n, 3) vary by no more than one in any direction."""
    if len(background) < LEAST_BACKGROUND:
        return np.eye(3) / LEAST_SPREAD
    variances, directions = np.linalg.eigh(np.cov(background.T) + LEAST_SPREAD**2 * np.eye(3))
    return (directions / np.sqrt(variances)) @ directions.T


# --- registration ---

# The target is looked for where it is expected, within this many standard deviations.
GATE_SIGMAS = 3.0
# First with few samples along its larger side, everywhere; then with more, around what was found.
COARSE_SAMPLES, FINE_SAMPLES = 14.0, 40.0
# No finer than this many samples a pixel of the wide view: there is no more in it.
FINEST = 4.0
# How far to search to each side, at most, in coarse samples; and in fine ones, beside half a coarse one.
WIDEST_SEARCH, FINE_SEARCH = 48, 1
# What the wide view's lens, pixels and coding blur together, one standard deviation [px]; chosen on rendered books.
WIDE_BLUR_PX = 0.7
# The best place leads the next best by this much, and no more of the target is out of view.
LEAST_LEAD, LEAST_SEEN = 0.12, 0.6
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


@dataclass(frozen=True)
class ZoomView:
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
class Place:
    """The best place of a search.

    Attributes:
        center_px: where the sight's middle is in the zoom frame, (2,).
        score: how alike both are there, -1 to 1.
        lead: by how much more than elsewhere.
        seen: the part of the target that is inside the zoom frame, 0 to 1.
        sigma_px: standard deviation of the place along u and v each [px].
    """

    center_px: Array
    score: float
    lead: float
    seen: float
    sigma_px: float = math.nan


def register(image: Image, sight: FixedView, view: ZoomView) -> Place | None:
    """Find the place in a zoom image that is most alike to a sight of the target: first coarsely, then finely.

    Returns:
        None where nothing is alike, two places are, or what is alike goes on beyond the gate.
    """
    finest = max(1 / FINEST, 1 / view.scale)
    coarse, fine = (max(sight.side_px / samples, finest) for samples in (COARSE_SAMPLES, FINE_SAMPLES))
    place = _search(image, sight, view, coarse, view.center_px, None)
    if place is None or place.lead < LEAST_LEAD:
        return None
    place = _search(image, sight, view, fine, place.center_px, FINE_SEARCH + math.ceil(coarse / fine / 2))
    if place is None:
        return None
    lack = max(1 - place.score, LEAST_LACK) / USUAL_LACK
    return replace(place, sigma_px=(SIGMA_PX + SIGMA_SAMPLES * fine) * math.sqrt(lack) * view.scale)


def _search(
    image: Image, sight: FixedView, view: ZoomView, pitch: float, around_px: Array, reach: int | None
) -> Place | None:
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


def _best(likeness: Likeness, distance: Array, apart: Array, origin_px: Array, step: Array) -> Place | None:
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
    return Place(
        center_px=origin_px + step @ top,
        score=float(likeness.score[row, column]),
        lead=best - max(float(score.max()), 0.0),
        seen=float(likeness.seen[row, column]),
    )


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
class ZoomMeasurement:
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

    def update_fixed(self, frame: Frame, detection: Detection, mask: Image | None = None) -> FixedView | None:
        """Remember the target as a wide frame shows it."""

    def sight_at(self, t: float) -> object | None:
        """What the wide view showed of the target at about a time [s]; None where it did not, or has not yet."""

    def find(self, frame: Frame, expected: Expected) -> ZoomMeasurement | None:
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
        self._sights: deque[FixedView] = deque()
        self._usual_score, self._sure_t = 0.0, -math.inf
        self._last_t = -math.inf
        self._last_offset: Array = np.zeros(2)  # beside the expected place, in wide pixels

    def update_fixed(self, frame: Frame, detection: Detection, mask: Image | None = None) -> FixedView | None:
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

    def sight_at(self, t: float) -> FixedView | None:
        """What the wide view showed of the target at about a time [s]; None where it did not, or has not yet."""
        near = min(self._sights, key=lambda sight: abs(sight.t - t), default=None)
        return None if near is None or abs(near.t - t) > LONGEST_APART_S else near

    def find(self, frame: Frame, expected: Expected) -> ZoomMeasurement | None:
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
        return ZoomMeasurement(
            center_px=place.center_px,
            sigma_px=place.sigma_px,
            body_sigma_px=np.abs(view.J) @ sight.body_sigma_px,
            score=place.score,
            seen=place.seen,
            size_px=np.linalg.norm(view.J, axis=0) * sight.size_px,
            t=frame.t,
        )

    def _believes(self, place: Place, sight: FixedView, view: ZoomView, t: float) -> bool:
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

    def view(self, expected: Expected) -> ZoomView | None:
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
        return ZoomView(zoom[0], covariance + LEAST_SIGMA_PX**2 * np.eye(2), J)
