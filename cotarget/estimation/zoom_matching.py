"""Register the fixed camera's patch of a target in the zoom image.

`look` cuts out patch, weights and centre of the body. They are warped to the zoom image's scale and rotation by
the Jacobian of (2) at the target's depth and matched by weighted normalised correlation, first coarsely, then finely. A
place counts only if it leads the next best one. The source of the numbers: docs/design-notes.md.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration import Calibration
from cotarget.config import TargetProfile
from cotarget.estimation.correlation import Samples, correlate, resample, summit
from cotarget.estimation.measurement_model import Pose
from cotarget.estimation.motion_model import GATE
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image

# Standard deviation of the body's centre along u and v, in parts of the box's sides, by the target profile's matcher;
# None where the outline is not known. Measured on simulated targets.
BODY_SIGMA = {"box": (0.01, 0.01), "upright": (0.03, 0.006), "outline": (0.05, 0.12), None: (0.08, 0.18)}
# Standard deviation of the body's centre by an outline in the zoom image, along u and v each, in parts of the outline's
# larger side. Measured on simulated birds.
THICKEST_SIGMA = 0.03
# Least median of the squared distance of an outline's colours from the background, in the background's variances: five
# standard deviations. Blotches of foliage come to 17.
DISTINCT = 5.0**2
# Step for derivatives, in parts of the depth.
STEP = 1e-3
LEAST_SQUARE = 8  # smallest square with an outline and its surroundings [samples]
Pixels = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class MatchingSettings:
    """Settings of the registration in the zoom image.

    Attributes:
        margin: margin around the target's box that counts, as a part of its larger side.
        margin_weight: weight of the box's pixels that are not the target's, which falls to 0 across the margin: they
            show its outline, but the background appears displaced in the other camera.
        foreground: parts of the box that a usable foreground fills: less is none, and more shows the place but not the
            outline. Otherwise the pixels whose colour differs from the surroundings are used, or else an ellipse.
        least_spread: least standard deviation of the background's colours [grey levels].
        coarse_samples: samples along the target's larger side, for the whole search.
        fine_samples: the same around the coarse result.
        widest_search: largest search to each side, in coarse samples.
        blur_px: blur of the fixed camera's lens, pixels and coding, one standard deviation; chosen on rendered books
            [px].
        least_lead: least lead of the best place over the next best.
        least_seen: least part of the target inside the zoom image.
        least_score: least normalised correlation of a match.
        sigma_px: standard deviation of a registration, in pixels of the fixed image and in samples each; measured on
            the simulated targets.
        least_sigma_px: least standard deviation of the expected place, from lens, head and frame times [px].
        longest_apart_s: largest time between the two frames of a registration: limbs and wings move [s].
        latest_s: largest delay of one camera's frames against the other's; fixed frames are kept for that long [s].
    """

    margin: float = 0.2
    margin_weight: float = 0.1
    foreground: tuple[float, float] = (0.15, 0.9)
    least_spread: float = 10.0
    coarse_samples: float = 14.0
    fine_samples: float = 40.0
    widest_search: int = 48
    blur_px: float = 0.7
    least_lead: float = 0.12
    least_seen: float = 0.6
    least_score: float = 0.6
    sigma_px: float = 0.08
    least_sigma_px: float = 1.0
    longest_apart_s: float = 0.1
    latest_s: float = 1.2


@dataclass(frozen=True, eq=False)
class FixedView:
    """The target as one fixed-camera frame shows it.

    Attributes:
        t: exposure time [s].
        body_px: centre of the body (u, v), (2,).
        body_sigma_px: standard deviation of that centre along u and v, (2,).
        size_px: width and height of the bounding box, (2,).
        patch: image around the box, (h, w, 3) BGR.
        corner_px: the patch's top-left pixel in the frame (u, v), (2,).
        weight: weight of each pixel of the patch, 0 to 1, (h, w).
        whitening: colour transform that gives the background unit variance in every direction of colour, (3, 3). The
            background's own texture then counts for little.
        turn: angle from the v axis to the target's own vertical axis [rad].
    """

    t: float
    body_px: Array
    body_sigma_px: Array
    size_px: Array
    patch: Image
    corner_px: Array
    weight: Samples
    whitening: Array
    turn: float

    @property
    def side_px(self) -> float:
        """Larger side of the box [px]."""
        return float(self.size_px.max())

    def at_pitch(self, pitch_px: float) -> tuple[Samples, Samples, Array]:
        """Resample patch and weights every ``pitch_px`` pixels of the fixed image, around the body's centre.

        Returns:
            Template (h, w, 3), weights (h, w), and the body's centre in samples (u, v), (2,).
        """
        first = np.floor((self.corner_px - self.body_px) / pitch_px)
        last = np.ceil((self.corner_px + np.array(self.patch.shape[1::-1]) - 1 - self.body_px) / pitch_px)
        width, height = (last - first + 1).astype(int).tolist()
        A = np.column_stack([pitch_px * np.eye(2), self.body_px + first * pitch_px - self.corner_px])
        template, _ = resample(self.patch, A, (width, height))
        weight, inside = resample(self.weight, A, (width, height))
        return template, weight if inside is None else weight * inside, -first


def look(
    frame: Frame,
    detection: Detection,
    mask: Image | None,
    target: TargetProfile,
    settings: MatchingSettings = MatchingSettings(),
    roll: float = 0.0,
) -> FixedView | None:
    """Cut the target out of a fixed-camera frame.

    Args:
        frame: frame of the fixed camera.
        detection: detection of the target in it.
        mask: foreground of the detector, (H, W), or None.
        target: target profile; its matcher decides where the centre of the body is.
        settings: settings of the registration.
        roll: angle from the v axis to the pan axis, as the image shows it, see `TargetProfile.turn` [rad].

    Returns:
        The cut-out; None if the box holds no pixel of the frame.
    """
    center, size = np.asarray(detection.center_px, dtype=float), np.maximum(detection.size_px, 1.0)
    if not (np.isfinite(center).all() and np.isfinite(size).all()):
        return None
    margin = settings.margin * size.max()
    limit = np.array(frame.image.shape[1::-1])
    low = np.maximum(np.floor(center - size / 2 - margin).astype(int), 0)
    high = np.minimum(np.ceil(center + size / 2 + margin).astype(int) + 1, limit)
    if (high - low < 1).any():  # box and margin are outside the frame
        return None
    here = slice(low[1], high[1]), slice(low[0], high[0])
    patch = frame.image[here].copy()
    u, v = (np.arange(first, last, dtype=np.float32) for first, last in zip(low, high, strict=True))
    du, dv = 2 * np.abs(u - center[0]) / size[0], 2 * np.abs(v - center[1])[:, None] / size[1]
    in_box = np.maximum(du, dv) <= 1
    if not in_box.any():
        return None
    background = patch[~in_box]
    whitening = _whitening(background, settings)
    foreground = np.zeros_like(in_box) if mask is None else (mask[here] > 0) & in_box
    if not _is_outline(foreground, in_box, settings) and len(background):
        away = (patch - np.median(background, axis=0)) @ whitening
        foreground = (np.sum(away**2, axis=2) > GATE) & in_box
    is_outline = _is_outline(foreground, in_box, settings)
    turn = target.turn(float(size[0]), float(size[1]), roll)
    body, sigma = _body(target, center, size, (u, v), foreground if is_outline else None, turn)
    if not is_outline:
        foreground = du**2 + dv**2 <= 1
    if detection.clipped:  # the hidden part may be as large again
        sigma = np.hypot(sigma, size / 2)
    # Distance from the box along each axis, negative inside [px].
    beyond_u, beyond_v = np.abs(u - center[0]) - size[0] / 2, np.abs(v - center[1])[:, None] - size[1] / 2
    around = np.clip(1 - np.maximum(beyond_u, beyond_v) / margin, 0, 1)  # falls to 0 at the patch's border
    weight = np.where(foreground, 1.0, settings.margin_weight * around).astype(np.float32)
    return FixedView(frame.t, body, sigma, size, patch, low.astype(float), weight, whitening, turn)


def _body(
    target: TargetProfile, center: Array, size: Array, pixels: tuple[Array, Array], outline: Pixels | None, turn: float
) -> tuple[Array, Array]:
    """Locate the centre of the body in a box; return it and its standard deviation, (2,) [px] each.

    `pixels` are u of the patch's columns and v of its rows; `outline`, (h, w), is None where it is not known. `turn` is
    the angle from the v axis to the vertical axis of an upright target [rad].
    """
    known = target.matcher == "box" or outline is not None
    sigma = np.array(BODY_SIGMA[target.matcher if known else None]) * size
    if target.matcher == "box" or outline is None:
        return center, sigma
    (u, v), (rows, columns) = pixels, outline.nonzero()
    if target.matcher != "upright":
        return np.array([np.median(u[columns]), np.median(v[rows])], dtype=float), sigma
    c, s = math.cos(turn), math.sin(turn)
    across = np.array([c, -s])
    off = float(np.median(c * (u[columns] - center[0]) - s * (v[rows] - center[1])))
    squares = np.array([[c * c, s * s], [s * s, c * c]])  # variances turn with the squares
    own = np.sqrt(squares @ np.square(size)) * BODY_SIGMA["upright"]
    return center + off * across, np.sqrt(squares @ np.square(own))


def _is_outline(foreground: Pixels, in_box: Pixels, settings: MatchingSettings) -> bool:
    """Whether a foreground shows the target's outline: it fills neither too little nor nearly all of the box."""
    part = np.count_nonzero(foreground) / max(int(np.count_nonzero(in_box)), 1)
    least, most = settings.foreground
    return bool(least < part < most)


def _whitening(background: Image, settings: MatchingSettings) -> Array:
    """Compute the transform, (3, 3), that whitens background colours (n, 3)."""
    if len(background) < 2:
        return np.eye(3) / settings.least_spread
    variances, directions = np.linalg.eigh(np.cov(background.T) + settings.least_spread**2 * np.eye(3))
    return (directions / np.sqrt(variances)) @ directions.T


# Registration at known scale and rotation


@dataclass(frozen=True)
class ZoomMeasurement:
    """Measurement of the body's centre in a zoom image, by registration.

    Attributes:
        center_px: the centre in the zoom image (u, v), (2,).
        sigma_px: standard deviation against the same point in the fixed image, along u and v each [px].
        body_sigma_px: standard deviation of that point against the body's true centre, along u and v, (2,) [px].
        t: exposure time of the zoom frame [s].
    """

    center_px: Array
    sigma_px: float
    body_sigma_px: Array
    t: float


def register(
    frame: Frame, fixed_view: FixedView, A: Array, covariance: Array, settings: MatchingSettings
) -> ZoomMeasurement | None:
    """Find a target's cut-out in a zoom frame, first coarsely, then finely.

    Args:
        frame: frame of the zoom camera.
        fixed_view: the target in the fixed image.
        A: affine map from the fixed image around the target's centre to the zoom image, (2, 3); see
            `CloseupFinder.affine_map`.
        covariance: covariance of the target's expected centre in the zoom image [px^2], (2, 2).
        settings: settings of the registration.

    Returns:
        The measurement; None if nothing correlates, if two places do, or if the maximum lies beyond the gate.
    """
    J = A[:, :2]
    scale = math.sqrt(abs(float(np.linalg.det(J))))  # zoom pixels per pixel of the fixed image
    coarse, fine = (
        max(fixed_view.side_px / samples, 1 / scale) for samples in (settings.coarse_samples, settings.fine_samples)
    )
    center_px = _search(frame.image, fixed_view, A, coarse, covariance, settings)
    if center_px is None:
        return None
    A = np.column_stack([J, center_px])
    center_px = _search(frame.image, fixed_view, A, fine, math.ceil(coarse / fine / 2), settings)
    if center_px is None:
        return None
    return ZoomMeasurement(
        center_px=center_px,
        sigma_px=settings.sigma_px * (1 + fine) * scale,
        body_sigma_px=np.abs(J) @ fixed_view.body_sigma_px,
        t=frame.t,
    )


def _search(
    image: Image, fixed_view: FixedView, A: Array, pitch: float, within: Array | int, settings: MatchingSettings
) -> Array | None:
    """Find the place of highest correlation with a cut-out sampled every ``pitch`` fixed pixels, (2,) [px].

    Args:
        image: zoom image, (H, W, 3) BGR.
        fixed_view: the target in the fixed image.
        A: affine map from the fixed image around the target's centre to the zoom image, (2, 3).
        pitch: distance of the samples [px of the fixed image].
        within: number of samples searched to each side of the expected centre; the place must correlate well. Or
            covariance of that centre [px^2], (2, 2), for all samples inside the gate; the place must lead the next best
            one.
        settings: settings of the registration.
    """
    template, weight, middle = fixed_view.at_pitch(pitch)
    step = A[:, :2] * pitch  # zoom pixels per sample
    spread = None
    if isinstance(within, int):
        sides = np.full(2, within + 1)  # and the neighbours of a maximum
    else:
        back = np.linalg.inv(step)
        spread = back @ within @ back.T + np.diag((fixed_view.body_sigma_px / pitch) ** 2)
        sides = np.minimum(np.ceil(np.sqrt(GATE * np.diag(spread))).astype(int), settings.widest_search) + 1
    first_px = A[:, 2] - step @ (middle + sides)
    width, height = (np.array(weight.shape[::-1]) + 2 * sides).tolist()
    samples, inside = resample(image, np.column_stack([step, first_px]), (width, height))
    if pitch < 1:  # blur the zoom samples as the fixed camera does, where the sampling resolves it
        samples = cv2.GaussianBlur(samples, (0, 0), settings.blur_px / pitch)
    mix = fixed_view.whitening
    likeness, seen = correlate(cv2.transform(samples, mix), inside, cv2.transform(template, mix), weight)
    allowed = seen >= settings.least_seen
    if spread is not None:
        v, u = np.mgrid[-sides[1] : sides[1] + 1, -sides[0] : sides[0] + 1]
        off = np.stack([u, v], axis=-1)
        allowed &= np.einsum("ijk,kl,ijl->ij", off, np.linalg.inv(spread), off) <= GATE
    score = np.where(allowed, likeness, -1.0)
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(score)), score.shape))
    # A score that still rises beyond the gate is another object.
    top = summit(likeness, (row, column))
    if not allowed[row, column] or top is None:
        return None
    best = float(likeness[row, column])
    if spread is None:
        is_sure = best >= settings.least_score
    else:
        is_sure = best - _next_best(score, (row, column), fixed_view.size_px / pitch) >= settings.least_lead
    return np.asarray(first_px + step @ (middle + top)) if is_sure else None


def _next_best(score: np.ndarray, place: tuple[int, int], size: Array) -> float:
    """Return the highest score, at least 0, where a box of a size (u, v), (2,), does not overlap that at a place."""
    row, column = place
    low = np.maximum(np.ceil([column - size[0], row - size[1]]), 0).astype(int)
    high = np.floor([column + size[0], row + size[1]]).astype(int) + 1
    others = score.copy()
    others[low[1] : high[1], low[0] : high[0]] = -1.0
    return max(float(others.max()), 0.0)


@dataclass(frozen=True, eq=False)
class Outline:
    """Outline of a target in the zoom image.

    Attributes:
        size_px: width and height, (2,).
        body_px: centre of the largest circle inside: a bird's body, wherever its wings are (u, v), (2,).
    """

    size_px: Array
    body_px: Array

    def refine(self, found: ZoomMeasurement) -> ZoomMeasurement:
        """Take the body's centre from this outline, unless it is three standard deviations from where it was found."""
        sigma_px = np.full(2, THICKEST_SIGMA * float(self.size_px.max()))
        off = (self.body_px - found.center_px) / np.hypot(found.body_sigma_px, sigma_px)
        return found if off @ off > GATE else replace(found, center_px=self.body_px, body_sigma_px=sigma_px)


def outline_in(
    image: Image, center_px: Array, expected_px: float, settings: MatchingSettings = MatchingSettings()
) -> Outline | None:
    """Measure the outline of a target before a plain background in the zoom image.

    The outline is the largest region whose colour differs from that at the border of a square about the target, if most
    of it differs clearly.

    Args:
        image: zoom image, (H, W, 3) BGR.
        center_px: a place in the target's box (u, v), (2,) [px].
        expected_px: expected larger side of the box [px]; the square reaches as far to each side.
        settings: settings of the registration.

    Returns:
        The outline; None if it reaches the border, lies elsewhere, or is too full or too empty for a target's.
    """
    low = np.maximum(np.floor(center_px - expected_px).astype(int), 0)
    high = np.minimum(np.ceil(center_px + expected_px).astype(int) + 1, image.shape[1::-1])
    sides = ((high - low) / max(expected_px / settings.fine_samples, 1.0)).astype(int)
    if (sides < LEAST_SQUARE).any():
        return None
    patch = cv2.resize(image[low[1] : high[1], low[0] : high[0]], sides.tolist(), interpolation=cv2.INTER_AREA)
    border = np.ones(patch.shape[:2], dtype=bool)
    border[1:-1, 1:-1] = False
    background = patch[border]
    away = (patch - np.median(background, axis=0)) @ _whitening(background, settings)
    contrast = np.sum(away**2, axis=2)
    differs = contrast > GATE
    count, labels, stats, _ = cv2.connectedComponentsWithStats(differs.astype(np.uint8))
    if count == 1:  # the background alone
        return None
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    left, top, width, height, area = stats[largest].tolist()
    first, size, at = np.array([left, top]), np.array([width, height]), (center_px - low) * sides / (high - low)
    least, most = settings.foreground
    is_whole = (first > 0).all() and (first + size < sides).all()
    is_there = (at >= first).all() and (at <= first + size).all()
    inside = labels == largest
    if not (is_whole and is_there and least < area / size.prod() < most and np.median(contrast[inside]) > DISTINCT):
        return None
    depth = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    thickest = np.array(cv2.minMaxLoc(depth)[3])
    pitch_px = (high - low) / sides
    return Outline(size * pitch_px, low + (thickest + 0.5) * pitch_px - 0.5)


class Finder(Protocol):
    """Finds the followed target in zoom images; `CloseupFinder` describes the methods."""

    def store(self, frame: Frame, detection: Detection, mask: Image | None = None) -> FixedView | None:
        """Store the target as a fixed-camera frame shows it."""

    def fixed_view_at(self, t: float) -> object | None:
        """Return the stored cut-out nearest to time t [s]; None if none is near enough."""

    def find(self, frame: Frame, x_fixed: Array, covariance: Array, pose: Pose) -> ZoomMeasurement | None:
        """Find the target in a zoom frame."""


class CloseupFinder:
    """Register the fixed camera's detections of one target in the zoom image."""

    def __init__(
        self, calibration: Calibration, target: TargetProfile, settings: MatchingSettings = MatchingSettings()
    ) -> None:
        """Create a finder without cut-outs.

        Args:
            calibration: calibration of the rig, for the streams in use.
            target: target profile.
            settings: settings of the registration.

        Raises:
            CalibrationError: the calibration has no T.
        """
        self._calibration = calibration
        calibration.zoom_head.hand_eye()  # raises without T
        self._target, self._settings = target, settings
        self._fixed_views: deque[FixedView] = deque()

    def store(self, frame: Frame, detection: Detection, mask: Image | None = None) -> FixedView | None:
        """Store the target as a fixed-camera frame shows it.

        Args:
            frame: frame of the fixed camera.
            detection: detection of the target in that frame.
            mask: foreground of the detector, (H, W); without it, the colours or an ellipse in the box are used.

        Returns:
            The cut-out, with the centre of the body; None if the box holds no pixel of the frame.
        """
        head, found = self._calibration.zoom_head, self._calibration.fixed.lens.tangents(detection.center_px)
        roll = 0.0 if found is None else head.fixed_roll(*found[0].tolist())
        fixed_view = look(frame, detection, mask, self._target, self._settings, roll)
        if fixed_view is not None:
            self._fixed_views.append(fixed_view)
            kept_s = self._settings.latest_s + self._settings.longest_apart_s
            while self._fixed_views[0].t < fixed_view.t - kept_s:
                self._fixed_views.popleft()
        return fixed_view

    def fixed_view_at(self, t: float) -> FixedView | None:
        """Return the stored cut-out nearest to time t [s]; None if none is within `longest_apart_s`."""
        near, apart_s = None, self._settings.longest_apart_s
        for fixed_view in reversed(self._fixed_views):  # the newest first
            if abs(fixed_view.t - t) <= apart_s:
                near, apart_s = fixed_view, abs(fixed_view.t - t)
        return near

    def find(self, frame: Frame, x_fixed: Array, covariance: Array, pose: Pose) -> ZoomMeasurement | None:
        """Find the target in a zoom frame.

        Args:
            frame: frame of the zoom camera.
            x_fixed: expected position of the target [m], (3,).
            covariance: covariance of its place in the zoom image [px^2], (2, 2).
            pose: head and lens at the frame's time; the angles are the reported ones plus their estimated bias.

        Returns:
            The measurement; None if the target is not found, or not with certainty.
        """
        fixed_view, A = self.fixed_view_at(frame.t), self.affine_map(x_fixed, pose)
        if fixed_view is None or A is None or not np.isfinite(covariance).all():
            return None
        return register(frame, fixed_view, A, covariance, self._settings)

    def affine_map(self, x_fixed: Array, pose: Pose) -> Array | None:
        """Map the fixed image around a target to the zoom image.

        Args:
            x_fixed: position of the target [m], (3,).
            pose: head and lens; the true angles, as far as they are known.

        Returns:
            Jacobian at the target's depth, zoom pixels per fixed pixel, and place of the target in the zoom image [px],
            (2, 3); None behind a camera or outside its lens model.
        """
        x = np.asarray(x_fixed, dtype=float)
        if not (np.isfinite(x).all() and x[2] > 0):
            return None
        # A small cross at the target, parallel to the fixed image plane, for numerical derivatives.
        cross = x + STEP * x[2] * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
        zoom = self._calibration.zoom_head.project(cross, pose.pan, pose.tilt, pose.nominal_px)
        fixed = self._calibration.fixed.project(cross)
        if not (np.isfinite(zoom).all() and np.isfinite(fixed).all()):
            return None
        J = (zoom[1:3] - zoom[3:5]).T @ np.linalg.inv((fixed[1:3] - fixed[3:5]).T)
        return np.column_stack([J, zoom[0]])
