"""Detect targets that have a template's colour, located to a fraction of a pixel by a fit of the template.

The fit models a patch as the template, scaled, slightly turned and blurred, in front of a background that is a plane:
``gain alpha template + (1 - alpha) (b0 + bu u + bv v)``. It is a Gauss-Newton iteration over the five numbers of the
pose and the four of the brightness (the method of Lucas and Kanade, with a model of the background).
"""

import math

import cv2
import numpy as np

from cotarget.detection.base import Detections, SizeCheck, Tracks, box_detection, pieces
from cotarget.errors import ConfigError
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image

# Margin around a target's coarse box that is included [px]: blur and subsampled chroma reach about 3 px.
MARGIN_PX = 4
# Samples of the template per pixel of the patch, so that linear interpolation loses nothing.
OVERSAMPLING = 4
# Standard deviation of lens, pixel and coding together [px]; a wrong value blurs all edges alike and biases no size.
BLUR_PX = 1.2
# Steps of the numerical derivatives: u, v, width, height [px] and turn [rad]; small against the blur.
DERIVATIVE = np.array([0.1, 0.1, 0.1, 0.1, 0.02])
ITERATIONS = 12
# Largest change of a parameter after convergence [px, rad].
CONVERGED = 0.01
# Largest factor between fitted and coarse sides; beyond it the fit is rejected.
LARGEST_CHANGE = 1.7
# Standard deviation of a target's turn [rad]; it keeps the turn bounded where a few pixels cannot determine it.
TURN_SIGMA = 0.15


def fit_template(
    template: np.ndarray, patch: np.ndarray, center: Array, size: Array
) -> tuple[Array, Array, float] | None:
    """Fit a template to a patch.

    Args:
        template: picture of the target alone, cut to its outline, (h, w).
        patch: part of an image around the target, (H, W).
        center: coarse centre in the patch (u, v), (2,) [px].
        size: coarse width and height, (2,) [px].

    Returns:
        Centre and size of the target [px], (2,) each, as if it were not turned; and the explained part of the patch's
        variance, 0 to 1. None if the fit does not converge.
    """
    source = _prepare(template, size)
    height, width = patch.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    plane = np.stack([np.ones_like(u), u / width - 0.5, v / height - 0.5], axis=-1)
    pose = np.array([*center, *size, 0.0])
    brightness = np.zeros(4)
    step = np.full(5, np.inf)
    for _ in range(ITERATIONS):
        basis = _render(source, pose, plane)
        brightness = np.linalg.lstsq(basis, patch.ravel(), rcond=None)[0]
        residual = patch.ravel() - basis @ brightness
        columns = [
            (_render(source, pose + d, plane) @ brightness - basis @ brightness) / d.sum() for d in np.diag(DERIVATIVE)
        ]
        J = np.column_stack([*columns, basis])
        # The prior on the turn is one more equation, in units of the residual.
        noise = max(1e-6, float(np.std(residual)))
        prior = np.zeros(9)
        prior[4] = noise / TURN_SIGMA
        step = np.linalg.lstsq(np.vstack([J, prior]), np.append(residual, -prior[4] * pose[4]), rcond=None)[0][:5]
        pose = pose + np.clip(step, -BLUR_PX, BLUR_PX)  # the linearisation holds within the blur
        if (pose[2:4] > size * LARGEST_CHANGE).any() or (pose[2:4] < size / LARGEST_CHANGE).any():
            return None
        if np.abs(step).max() < CONVERGED:
            break
    else:
        if np.abs(step).max() > DERIVATIVE.max():
            return None
    if (np.abs(pose[:2] - center) > size).any() or brightness[0] <= 0:
        return None
    basis = _render(source, pose, plane)
    residual = patch.ravel() - basis @ np.linalg.lstsq(basis, patch.ravel(), rcond=None)[0]
    return pose[:2], pose[2:4], float(max(0.0, 1.0 - residual.var() / max(1e-9, float(patch.var()))))


def _prepare(template: np.ndarray, size: Array) -> np.ndarray:
    """Resample the template and its outline ``OVERSAMPLING`` times as fine as the patch, with its blur and a margin."""
    width, height = (max(2, round(OVERSAMPLING * float(side))) for side in size)
    small = cv2.resize(template, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    both = np.stack([small, np.ones_like(small)], axis=-1)
    margin = OVERSAMPLING * MARGIN_PX
    both = cv2.copyMakeBorder(both, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0)
    return cv2.GaussianBlur(both, (0, 0), OVERSAMPLING * BLUR_PX)


def _render(source: np.ndarray, pose: Array, plane: np.ndarray) -> np.ndarray:
    """Render the four basis images of a pose, (pixels, 4): the template, and the background that it does not cover."""
    height, width = source.shape[:2]
    inner = np.array([width, height]) - 2 * OVERSAMPLING * MARGIN_PX
    c, s = np.cos(pose[4]), np.sin(pose[4])
    # From the patch's pixels to the source's: turn back about the centre, then scale.
    A = np.array([[c, s], [-s, c]]) * (inner / pose[2:4])[:, None]
    shift = (np.array([width, height]) - 1) / 2 - A @ pose[:2]
    seen = cv2.warpAffine(
        source,
        np.column_stack([A, shift]),
        (plane.shape[1], plane.shape[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    basis = np.concatenate([seen[..., :1], (1 - seen[..., 1:]) * plane], axis=-1)
    return basis.reshape(-1, 4).astype(float)


# Least chroma of the template's mean colour; a greyer one cannot be found by colour [grey levels].
LEAST_CHROMA = 20.0
# Percentile of the template's chroma that counts as its strongest colour.
STRONG = 75
# Least part of the template's chroma of a pixel of its colour ...
LEAST_WEIGHT = 0.35
# ... and the largest deviation of its hue (tangent of the angle in the chroma plane).
HUE_TANGENT = 0.6
# Byte value of the template's chroma, so that brighter light does not saturate.
CHROMA_BYTE = 128.0
# Fewest pixels of a target.
LEAST_PIXELS = 12
# Largest side of a target as a part of the image's; a larger region of its colour is the scene.
LARGEST_COLOURED = 0.5
# Least explained variance of a detection.
LEAST_FIT = 0.3
# Most regions compared with the template, the largest first, and most fitted, the likeliest first: a fit takes
# milliseconds.
MOST_LOOKED_AT, MOST_FITTED = 100, 8
# Size at which a region is compared with the template [px], and the margin around both, in parts of their sides.
LOOK, AROUND = (16, 16), 0.25
# Longest side of a region that is fitted at full scale [px]; a larger one is reduced, which averages its noise.
LARGEST_FITTED_PX = 48.0


class ColorTemplateDetector:
    """Detect targets by a template's colour, and locate them to a fraction of a pixel by fitting the template.

    All computations use one plane: a pixel's chroma along the template's mean chroma. It is linear in the colour, so
    blur, mixed pixels at the border and subsampled chroma cause no bias. It is zero for grey, so shadows and white
    walls do not matter.
    """

    def __init__(self, template: Image) -> None:
        """Learn the template's colour, and which parts of it have that colour.

        Args:
            template: picture of the target, cut to its outline, (h, w, 3) BGR; its scale does not matter.

        Raises:
            ConfigError: the template is grey, or most of it is.
        """
        pixels = template.reshape(-1, 3).astype(float)
        chroma = (pixels - pixels.mean(axis=1, keepdims=True)).mean(axis=0)
        length = float(np.linalg.norm(chroma))
        if length < LEAST_CHROMA:
            raise ConfigError("the colour template is almost grey; give a picture of the target with a strong colour")
        self._along = chroma / length
        across = np.cross(np.full(3, 1 / np.sqrt(3)), self._along)
        plane = template.astype(float) @ self._along
        strong = float(np.percentile(plane, STRONG))
        if strong < LEAST_CHROMA:
            raise ConfigError("most of the colour template is grey; cut it to the coloured part of the target")
        self._plane = (plane / strong).astype(np.float32)
        h, w = plane.shape
        top, left = round(AROUND * h), round(AROUND * w)
        framed = cv2.copyMakeBorder(self._plane, top, top, left, left, cv2.BORDER_CONSTANT, value=0)
        self._look = _normalised(cv2.resize(framed, LOOK, interpolation=cv2.INTER_AREA))
        tests = np.vstack([self._along, HUE_TANGENT * self._along - across, HUE_TANGENT * self._along + across])
        self._tests = tests * CHROMA_BYTE / strong
        self._size = SizeCheck()

    def detect(self, frame: Frame, held: Tracks = ()) -> Detections:
        """Detect targets of the template's colour and shape.

        Raises:
            CotargetError: the image's size changed.
        """
        self._size.check(frame.image)
        tests = cv2.transform(frame.image, self._tests)  # saturates at 0, so a wrong hue fails one of the last two
        mask = np.asarray(cv2.inRange(tests, (LEAST_WEIGHT * CHROMA_BYTE, 1, 1), (255, 255, 255)), dtype=np.uint8)
        boxes = []
        for x, y, w, h in pieces(mask, (3, 3)):
            inside = mask[y : y + h, x : x + w]
            if cv2.countNonZero(inside) < LEAST_PIXELS:
                continue
            dx, dy, w, h = cv2.boundingRect(inside)
            if max(w / mask.shape[1], h / mask.shape[0]) <= LARGEST_COLOURED:
                boxes.append(box_detection(x + dx, y + dy, w, h, 0.0, mask.shape))
        fitted = [self._refine(frame.image, box) for box in self._likeliest(tests[..., 0], boxes)]
        good = (each for each in fitted if each is not None and each.score >= LEAST_FIT)
        return Detections(sorted(good, key=lambda each: -each.score), lambda: mask)

    def _likeliest(self, plane: Image, boxes: list[Detection]) -> list[Detection]:
        """Select at most MOST_FITTED boxes that look most like the template in the plane of its colour (H, W)."""
        if len(boxes) <= MOST_FITTED:
            return boxes

        def likeness(box: Detection) -> float:
            width, height = ((1 + 2 * AROUND) * box.size_px).round().astype(int).tolist()
            part = cv2.getRectSubPix(plane, (width, height), box.center_px.tolist())
            return float(np.sum(self._look * _normalised(cv2.resize(part, LOOK, interpolation=cv2.INTER_AREA))))

        largest = sorted(boxes, key=lambda box: -float(box.size_px.prod()))[:MOST_LOOKED_AT]
        return sorted(largest, key=likeness, reverse=True)[:MOST_FITTED]

    def _refine(self, image: Image, coarse: Detection) -> Detection | None:
        """Locate the target in its coarse box to a fraction of a pixel; None if the template does not fit."""
        scale = math.ceil(float(coarse.size_px.max()) / LARGEST_FITTED_PX)
        low = np.maximum(0, np.rint(coarse.center_px - coarse.size_px / 2 - scale * MARGIN_PX)).astype(int)
        high = np.rint(coarse.center_px + coarse.size_px / 2 + scale * MARGIN_PX).astype(int) + 1
        high = np.minimum(high, image.shape[1::-1])
        high -= (high - low) % scale  # so that all reduced pixels are alike
        part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32) @ self._along.astype(np.float32)
        if scale > 1:
            width, height = ((high - low) // scale).tolist()
            part = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
            # Blur as much as the fit assumes; at this scale the camera's own blur is negligible.
            part = np.asarray(cv2.GaussianBlur(part, (0, 0), BLUR_PX * math.sqrt(1 - 1 / scale**2)), np.float32)
        corner = low + (scale - 1) / 2  # centre of the first reduced pixel
        fit = fit_template(self._plane, part, (coarse.center_px - corner) / scale, coarse.size_px / scale)
        if fit is None:
            return None
        center, size, likeness = fit
        return Detection(scale * center + corner, scale * size, likeness, coarse.clipped)


def _normalised(picture: Image) -> Array:
    """Normalise an image to a mean of 0 and a length of 1; all 0 for a uniform one."""
    off = picture - np.mean(picture)
    return np.asarray(off / max(1e-9, float(np.linalg.norm(off))))
