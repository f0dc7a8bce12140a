"""Finding a target in a single frame of the wide view: by its colour (the book) or by its motion (person, bird).

Boxes are (u, v) middle and (width, height), in pixels whose (0, 0) is the centre of the top-left one, so that the
box of a single lit pixel at column 3 is centred on u = 3 and 1 wide.
"""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from cotarget.config import TargetConfig
from cotarget.errors import ConfigError, CotargetError
from cotarget.geometry import Array
from cotarget.rig import Frame, Image
from cotarget.templatefit import MARGIN_PX, fit_template

# What MOG2 writes into its mask: 255 is foreground, 127 a shadow.
FOREGROUND = 255
# A target is small: when more of the picture than this changed at once, the light or the camera did.
MOST_FOREGROUND = 0.3


@dataclass(frozen=True)
class Detection:
    """One target seen in one frame.

    Attributes:
        center_px: middle of the box (u, v), (2,).
        size_px: its width and height, (2,).
        score: how sure the detector is, 0 to 1.
        clipped: whether the image's border cuts the box, so that its size is only a lower bound.
    """

    center_px: Array
    size_px: Array
    score: float
    clipped: bool = False


class Detector(Protocol):
    """Finds targets of one kind in the frames of one camera."""

    @property
    def mask(self) -> Image | None:
        """The last frame's foreground, (H, W), 0 to 255; for pictures."""

    def detect(self, frame: Frame) -> list[Detection]:
        """Find the targets, best first; [] where there is none."""


@dataclass(frozen=True)
class MotionSettings:
    """What moves like the target.

    Attributes:
        history_s: how far back the background's colours are remembered [s].
        background_part: the colours that make up this part of a pixel's history are its background. Many colours
            (0.9) hide foliage, but then a target that stops melts away after a tenth of the history.
        warm_up_s: no detection before the background has been learnt for this long [s].
        threshold: squared distance to the background, in variances, from which a pixel counts as foreground.
        shadows: whether to tell shadows apart from the target.
        sway_px: how far the background itself sways [px]: a pixel is no target where its colour lies between the
            darkest and the brightest that the background has within this distance; 0 for a rigid background.
        opening_px: specks thinner than this are removed; 0 for none.
        bridge_px: (width, height) of gaps that are closed within one target.
        smallest_px: smallest width and height of a target.
        smallest_area_px: fewest foreground pixels of a target.
        widest: largest width as a multiple of the height.
        largest: largest side of a target as a fraction of the image's.
    """

    history_s: float
    background_part: float
    warm_up_s: float
    threshold: float
    shadows: bool
    sway_px: int
    opening_px: int
    bridge_px: tuple[int, int]
    smallest_px: tuple[int, int]
    smallest_area_px: int
    widest: float
    largest: float


# The background's range of colours is taken anew this often [s]; it costs a third of a frame's work.
SWAY_UPDATE_S = 0.25
# Levels by which a pixel must leave that range: five standard deviations of the sensor's noise of 2, and coding.
SWAY_MARGIN = 15

# A bird may be as small as four pixels, so that nothing is opened away; it casts no shadow on the sky.
BIRD = MotionSettings(
    history_s=8.0,
    background_part=0.9,
    warm_up_s=0.5,
    threshold=25.0,
    shadows=False,
    sway_px=3,
    opening_px=0,
    bridge_px=(5, 5),
    smallest_px=(2, 2),
    smallest_area_px=5,
    widest=np.inf,
    largest=0.3,
)
# A person stops at times, casts a shadow, falls apart into limbs and trunk one above the other, and stands upright
# (1.3 still lets two or three side by side pass, but not a patch of light on the ground).
PERSON = MotionSettings(
    history_s=20.0,
    background_part=0.7,
    warm_up_s=0.5,
    threshold=16.0,
    shadows=True,
    sway_px=0,
    opening_px=3,
    bridge_px=(5, 15),
    smallest_px=(8, 24),
    smallest_area_px=150,
    widest=1.3,
    largest=0.9,
)


class MotionDetector:
    """What differs from an adaptive Gaussian mixture of the background (Zivkovic 2004), as connected pieces."""

    def __init__(self, settings: MotionSettings, rate_hz: float) -> None:
        """Begin without a background.

        Args:
            settings: what moves like the target.
            rate_hz: the camera's nominal frames a second, for frames whose times do not tell.
        """
        self._settings = settings
        self._interval = 1.0 / rate_hz
        self._model = cv2.createBackgroundSubtractorMOG2(
            history=max(1, round(settings.history_s * rate_hz)),
            varThreshold=settings.threshold,
            detectShadows=settings.shadows,
        )
        self._model.setBackgroundRatio(settings.background_part)
        self._t: float | None = None
        self._learnt = 0.0
        self._range: tuple[Image, Image] | None = None
        self._range_learnt = 0.0
        self._shape: tuple[int, ...] | None = None
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """Find what moves, largest first.

        Raises:
            CotargetError: the image's size changed.
        """
        _check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        mask = self._model.apply(frame.image, learningRate=self._rate(frame.t))
        if self._settings.shadows:
            mask = cv2.compare(mask, FOREGROUND, cv2.CMP_EQ)
        if self._settings.sway_px:
            mask = cv2.bitwise_and(mask, self._outside_sway(frame.image))
        if self._settings.opening_px:
            mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((self._settings.opening_px,) * 2, np.uint8))
        self.mask = mask
        if self._learnt < self._settings.warm_up_s or cv2.countNonZero(mask) > MOST_FOREGROUND * mask.size:
            return []
        return self._boxes(mask)

    def _rate(self, t: float) -> float:
        """Learning rate for a frame at ``t`` [s]: fast while there is little to remember."""
        dt = self._interval if self._t is None else t - self._t
        self._t = t
        if dt <= 0:
            dt = self._interval
        self._learnt += dt
        return min(1.0, dt / min(self._settings.history_s, 2 * self._learnt))

    def _outside_sway(self, image: Image) -> Image:
        """Where an image leaves the range of colours that the background has nearby: what sways does not."""
        if self._range is None or self._learnt - self._range_learnt > SWAY_UPDATE_S or self._learnt < SWAY_UPDATE_S:
            background = self._model.getBackgroundImage()
            nearby = np.ones((2 * self._settings.sway_px + 1,) * 2, np.uint8)
            margin = (SWAY_MARGIN,) * 3
            darkest = cv2.subtract(cv2.erode(background, nearby), (*margin, 0))
            brightest = cv2.add(cv2.dilate(background, nearby), (*margin, 0))
            self._range = darkest, brightest
            self._range_learnt = self._learnt
        return cv2.bitwise_not(cv2.inRange(image, *self._range))

    def _boxes(self, mask: Image) -> list[Detection]:
        """Boxes of the connected pieces, largest first."""
        settings = self._settings
        height, width = mask.shape
        bridge_w, bridge_h = settings.bridge_px
        closed = cv2.dilate(mask, np.ones((bridge_h, bridge_w), np.uint8))
        contours = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
        found = []
        for contour in contours:
            x, y, w, h = cv2.boundingRect(contour)
            # The dilation only joined the pieces: the box is that of the mask's own pixels inside.
            inside = mask[y : y + h, x : x + w]
            area = cv2.countNonZero(inside)
            if area < settings.smallest_area_px:
                continue
            dx, dy, w, h = cv2.boundingRect(inside)
            x, y = x + dx, y + dy
            if w < settings.smallest_px[0] or h < settings.smallest_px[1]:
                continue
            if w > settings.largest * width or h > settings.largest * height or w > settings.widest * h:
                continue
            found.append((area, _detection(x, y, w, h, area / (area + settings.smallest_area_px), mask.shape)))
        found.sort(key=lambda pair: -pair[0])
        return [detection for _, detection in found]


def _detection(x: int, y: int, w: int, h: int, score: float, shape: tuple[int, ...]) -> Detection:
    """Make a detection of a box of whole pixels."""
    clipped = x <= 0 or y <= 0 or x + w >= shape[1] or y + h >= shape[0]
    return Detection(np.array([x + (w - 1) / 2, y + (h - 1) / 2]), np.array([w, h], dtype=float), score, clipped)


def _check_size(shape: tuple[int, ...] | None, image: Image) -> None:
    if shape is not None and image.shape != shape:
        raise CotargetError(
            f"the image's size changed from {shape[1]}x{shape[0]} to {image.shape[1]}x{image.shape[0]}; "
            "the detector needs one camera with one size"
        )


# A template whose mean colour is closer to grey than this tells nothing by its colour [grey levels].
LEAST_CHROMA = 20.0
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


class ColourDetector:
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
            ConfigError: the template is grey.
        """
        pixels = template.reshape(-1, 3).astype(float)
        chroma = (pixels - pixels.mean(axis=1, keepdims=True)).mean(axis=0)
        length = float(np.linalg.norm(chroma))
        if length < LEAST_CHROMA:
            raise ConfigError("the colour template is almost grey; give a picture of the target with a strong colour")
        self._along = chroma / length
        across = np.cross(np.full(3, 1 / np.sqrt(3)), self._along)
        plane = template.astype(float) @ self._along
        self._plane = (plane / np.percentile(plane, 75)).astype(np.float32)
        tests = np.vstack([self._along, HUE_TANGENT * self._along - across, HUE_TANGENT * self._along + across])
        self._tests = tests * CHROMA_BYTE / np.percentile(plane, 75)
        self._shape: tuple[int, ...] | None = None
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """Find what has the template's colour and shape, the best likeness first.

        Raises:
            CotargetError: the image's size changed.
        """
        _check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        tests = cv2.transform(frame.image, self._tests)  # saturates at 0: a wrong hue fails one of the last two
        self.mask = cv2.inRange(tests, (LEAST_WEIGHT * CHROMA_BYTE, 1, 1), (255, 255, 255))
        joined = cv2.dilate(self.mask, np.ones((3, 3), np.uint8))
        found = []
        for contour in cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]:
            x, y, w, h = cv2.boundingRect(contour)
            inside = self.mask[y : y + h, x : x + w]
            if cv2.countNonZero(inside) < LEAST_PIXELS:
                continue
            dx, dy, w, h = cv2.boundingRect(inside)
            if max(w / self.mask.shape[1], h / self.mask.shape[0]) <= LARGEST_COLOURED:
                found.append(self._refine(frame.image, _detection(x + dx, y + dy, w, h, 0.0, self.mask.shape)))
        return sorted((d for d in found if d.score >= LEAST_FIT), key=lambda d: -d.score)

    def _refine(self, image: Image, coarse: Detection) -> Detection:
        """Locate the target in its coarse box to a fraction of a pixel."""
        low = np.maximum(0, np.rint(coarse.center_px - coarse.size_px / 2 - MARGIN_PX)).astype(int)
        high = np.rint(coarse.center_px + coarse.size_px / 2 + MARGIN_PX).astype(int) + 1
        part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32) @ self._along.astype(np.float32)
        fit = fit_template(self._plane, part, coarse.center_px - low, coarse.size_px)
        if fit is None:
            return coarse
        center, size, likeness = fit
        return Detection(center + low, size, likeness, coarse.clipped)


def make_detector(target: TargetConfig, rate_hz: float, template: Image | None = None) -> Detector:
    """Make the detector that a target's configuration asks for.

    Args:
        target: the target.
        rate_hz: the camera's nominal frames a second.
        template: (h, w, 3) BGR picture of the target, for one that is found by its colour; the configured
            picture by default.

    Raises:
        ConfigError: a colour target without a usable template.
    """
    if target.detector == "motion":
        return MotionDetector(BIRD if target.dimension == "wingspan" else PERSON, rate_hz)
    if template is None:
        if target.template is None:
            raise ConfigError('a target with detector = "colour" needs a template, a picture of the target')
        read = cv2.imread(str(target.template), cv2.IMREAD_COLOR) if target.template.is_file() else None
        if read is None:
            raise ConfigError(f"{target.template}: is not a picture; a target's template is a PNG or JPEG of it")
        template = read.astype(np.uint8)
    return ColourDetector(template)
