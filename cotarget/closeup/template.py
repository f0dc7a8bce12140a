"""What the wide view shows of the target: a patch of it, how much each of its pixels counts, and the body's middle."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.closeup.matching import Samples, resample
from cotarget.config import TargetConfig
from cotarget.detection import Detection
from cotarget.geometry import Array
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
class Sight:
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


def look(frame: Frame, detection: Detection, mask: Image | None, target: TargetConfig) -> Sight | None:
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
    return Sight(frame.t, body, sigma, size, patch, low.astype(float), foreground, outside)


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
