"""What has a template's colour, located to a fraction of a pixel (the book).

Fitting a template to a small patch: middle and size to a fraction of a pixel.

The patch is modelled as the template, scaled, slightly turned and blurred, in front of a background that is a plane:
``gain alpha template + (1 - alpha) (b0 + bu u + bv v)``. Gauss-Newton over the five numbers of the pose and the four of
the brightness (Lucas and Kanade's method with a model of the background).
"""

import math

import cv2
import numpy as np

from cotarget.detection.base import Detection, box_detection, check_size
from cotarget.errors import ConfigError
from cotarget.geometry import Array
from cotarget.rig import Frame, Image

# How far beyond a target's coarse box its pixels are looked at [px]: blur and subsampled chroma reach about 3 px.
MARGIN_PX = 4
# The template is prepared at this many samples a pixel of the patch, so that linear interpolation loses nothing.
OVERSAMPLING = 4
# Standard deviation of lens, pixel and coding together [px]; a wrong value blurs all edges alike and biases no size.
BLUR_PX = 1.2
# Steps of the derivative: u, v, width, height [px] and turn [rad]; small against the blur.
DERIVATIVE = np.array([0.1, 0.1, 0.1, 0.1, 0.02])
# The largest change in one iteration, likewise: the linearisation holds within the blur.
LARGEST_STEP = np.array([1.0, 1.0, 1.0, 1.0, 0.1])
ITERATIONS = 12
# Converged when no parameter changes by more [px, rad].
CONVERGED = 0.01
# A result whose sides differ from the coarse ones by more than this factor is no result.
LARGEST_CHANGE = 1.7
# A target is seldom turned by more [rad]; keeps the turn from running away where a few pixels cannot show it.
TURN_SIGMA = 0.15


def fit_template(
    template: np.ndarray, patch: np.ndarray, center: Array, size: Array
) -> tuple[Array, Array, float] | None:
    """Fit a template to a patch.

    Args:
        template: (h, w) picture of the target alone, cut to its outline.
        patch: (H, W) a small part of an image around it.
        center: coarse middle in the patch (u, v) [px], (2,).
        size: coarse width and height [px], (2,).

    Returns:
        Middle and size [px], (2,) each, of the target itself, as if it were not turned; and the part of the
        patch's variation that is explained, 0 to 1. None when the fit does not converge.
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
        # The turn's prior, in the units of the residual, is one more equation.
        noise = max(1e-6, float(np.std(residual)))
        prior = np.zeros(9)
        prior[4] = noise / TURN_SIGMA
        step = np.linalg.lstsq(np.vstack([J, prior]), np.append(residual, -prior[4] * pose[4]), rcond=None)[0][:5]
        pose = pose + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
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
    """The template and its outline, blurred as in the patch, ``OVERSAMPLING`` times as fine, with a margin."""
    width, height = (max(2, round(OVERSAMPLING * float(side))) for side in size)
    small = cv2.resize(template, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    both = np.stack([small, np.ones_like(small)], axis=-1)
    margin = OVERSAMPLING * MARGIN_PX
    both = cv2.copyMakeBorder(both, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0)
    return cv2.GaussianBlur(both, (0, 0), OVERSAMPLING * BLUR_PX)


def _render(source: np.ndarray, pose: Array, plane: np.ndarray) -> np.ndarray:
    """The four basis images of a pose, (pixels, 4): the template, and the background where it is not covered."""
    height, width = source.shape[:2]
    inner = np.array([width, height]) - 2 * OVERSAMPLING * MARGIN_PX
    c, s = np.cos(pose[4]), np.sin(pose[4])
    # From the patch's pixels to the source's: turn back about the middle, then scale.
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


# A template whose mean colour is closer to grey than this tells nothing by its colour [grey levels].
LEAST_CHROMA = 20.0
# The template's strongest colour is that of which this part of it in per cent is weaker.
STRONG = 75
# A pixel is taken for the template's colour when it has at least this part of its chroma ...
LEAST_WEIGHT = 0.35
# ... and its chroma points at most this far away from the template's (tangent of the angle in the chroma plane).
HUE_TANGENT = 0.6
# The template's chroma becomes this value of a byte, so that brighter light does not saturate.
CHROMA_BYTE = 128.0
# Fewest pixels of a target that is found by its colour.
LEAST_PIXELS = 12
# A target this small beside the image is looked for; a larger patch of its colour is the scene.
LARGEST_COLOURED = 0.5
# A detection must explain this part of the variation around it.
LEAST_FIT = 0.3
# A fit takes milliseconds: of all patches of the colour the largest are looked at, and of these the likeliest fitted.
MOST_LOOKED_AT, MOST_FITTED = 100, 8
# Patch and template are compared at this width and height, with this part of their sides around them [px].
LOOK, AROUND = (16, 16), 0.25
# A patch whose larger side is longer is fitted at a scale at which it is not [px]: no worse, for its noise is averaged.
LARGEST_FITTED_PX = 48.0


class ColorTemplateDetector:
    """What has a template's colour, located to a fraction of a pixel by fitting the template to it.

    Everything happens in one plane: a pixel's chroma along the template's mean chroma. It is linear in the colour,
    so that blur, mixed pixels at the border and subsampled chroma bias nothing, and it is zero for grey, so that
    shadows and white walls do not matter.
    """

    def __init__(self, template: Image) -> None:
        """Learn the colour and what of the template has it.

        Args:
            template: (h, w, 3) BGR picture of the target, cut to its outline; its scale does not matter.

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
        self._shape: tuple[int, ...] | None = None
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """Find what has the template's colour and shape, the best likeness first.

        Raises:
            CotargetError: the image's size changed.
        """
        check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        tests = cv2.transform(frame.image, self._tests)  # saturates at 0: a wrong hue fails one of the last two
        self.mask = cv2.inRange(tests, (LEAST_WEIGHT * CHROMA_BYTE, 1, 1), (255, 255, 255))
        joined = cv2.dilate(self.mask, np.ones((3, 3), np.uint8))
        boxes = []
        for contour in cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
            x, y, w, h = cv2.boundingRect(contour)
            inside = self.mask[y : y + h, x : x + w]
            if cv2.countNonZero(inside) < LEAST_PIXELS:
                continue
            dx, dy, w, h = cv2.boundingRect(inside)
            if max(w / self.mask.shape[1], h / self.mask.shape[0]) <= LARGEST_COLOURED:
                boxes.append(box_detection(x + dx, y + dy, w, h, 0.0, self.mask.shape))
        fitted = [self._refine(frame.image, box) for box in self._likeliest(tests[..., 0], boxes)]
        return sorted((d for d in fitted if d is not None and d.score >= LEAST_FIT), key=lambda d: -d.score)

    def _likeliest(self, plane: Image, boxes: list[Detection]) -> list[Detection]:
        """Those that look most like the template in the plane of its colour (H, W): MOST_FITTED at most."""
        if len(boxes) <= MOST_FITTED:
            return boxes

        def likeness(box: Detection) -> float:
            width, height = ((1 + 2 * AROUND) * box.size_px).round().astype(int).tolist()
            part = cv2.getRectSubPix(plane, (width, height), box.center_px.tolist())
            return float(np.sum(self._look * _normalised(cv2.resize(part, LOOK, interpolation=cv2.INTER_AREA))))

        largest = sorted(boxes, key=lambda box: -float(box.size_px.prod()))[:MOST_LOOKED_AT]
        return sorted(largest, key=likeness, reverse=True)[:MOST_FITTED]

    def _refine(self, image: Image, coarse: Detection) -> Detection | None:
        """Locate the target in its coarse box to a fraction of a pixel; None where the template does not fit."""
        scale = math.ceil(float(coarse.size_px.max()) / LARGEST_FITTED_PX)
        low = np.maximum(0, np.rint(coarse.center_px - coarse.size_px / 2 - scale * MARGIN_PX)).astype(int)
        high = np.rint(coarse.center_px + coarse.size_px / 2 + scale * MARGIN_PX).astype(int) + 1
        high = np.minimum(high, image.shape[1::-1])
        high -= (high - low) % scale  # of pixels all alike
        part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32) @ self._along.astype(np.float32)
        if scale > 1:
            width, height = ((high - low) // scale).tolist()
            part = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
            # As blurred as the fit takes it to be; at this scale the camera's own blur is hardly any.
            part = np.asarray(cv2.GaussianBlur(part, (0, 0), BLUR_PX * math.sqrt(1 - 1 / scale**2)), np.float32)
        corner = low + (scale - 1) / 2  # where the first of its pixels has its middle
        fit = fit_template(self._plane, part, (coarse.center_px - corner) / scale, coarse.size_px / scale)
        if fit is None:
            return None
        center, size, likeness = fit
        return Detection(scale * center + corner, scale * size, likeness, coarse.clipped)


def _normalised(picture: Image) -> Array:
    """The same with a mean of 0 and a length of 1; all 0 where nothing is to be seen."""
    off = picture - np.mean(picture)
    return np.asarray(off / max(1e-9, float(np.linalg.norm(off))))
