"""What moves: an adaptive Gaussian mixture of the background, morphology and connected pieces (person, bird)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cotarget.detection.base import Detection, box_detection, check_size, flood
from cotarget.rig import Frame, Image

# What MOG2 writes into its mask: 255 is foreground, 127 a shadow.
FOREGROUND = 255
# A light that was switched on or a camera that was nudged stays so: after so long [s] the background is learnt anew.
# Left to itself the mixture would take as long as it remembers, and what moves meanwhile would not be seen.
FLOODED_S = 0.2


@dataclass(frozen=True)
class BackgroundSettings:
    """What moves like the target.

    Attributes:
        history_s: how far back the background's colours are remembered [s].
        background_part: the colours that make up this part of a pixel's history are its background. Many colours
            (0.9) hide foliage, but then a target that stops melts away after a tenth of the history.
        warm_up_s: no detection before the background has been learnt for this long [s].
        threshold: squared distance to the background, in variances, from which a pixel counts as foreground.
        shadows: whether to tell shadows apart from the target.
        brightest: the background in a light up to so many times brighter, when the sun comes out, is no target where
            most of what changed is that: the mixture tells shadows, but nothing that is brighter; 1 for not at all.
        sway_px: how far the background itself sways [px]: a pixel is no target where its colour lies between the
            darkest and the brightest that the background has within this distance; 0 for a rigid background.
        opening_px: specks thinner than this are removed; 0 for none.
        bridge_px: (width, height) of gaps that are closed within one target.
        smallest_px: smallest width and height of a target.
        smallest_area_px: fewest foreground pixels of a target.
        widest: largest width as a multiple of the height.
        largest: largest side of a target as a fraction of the image's.
        flat: what is thinner than this part of the height of a wide piece lies on the ground, such as the edge of a
            shadow, and is no part of the target; 0 for nothing.
    """

    history_s: float
    background_part: float
    warm_up_s: float
    threshold: float
    shadows: bool
    brightest: float
    sway_px: int
    opening_px: int
    bridge_px: tuple[int, int]
    smallest_px: tuple[int, int]
    smallest_area_px: int
    widest: float
    largest: float
    flat: float


# The background's colours are taken out of the mixture this often [s]; it costs a third of a frame's work.
BACKGROUND_UPDATE_S = 0.25
# Up to this part of the picture its foreground pixels are quicker looked up one by one than the picture is as a whole.
FEW = 0.01
# Levels by which a pixel must leave the background's range: five standard deviations of the sensor's noise of 2, and
# coding.
MARGIN = 15
# A piece wider than this part of its height may be a target and what lies flat. Without that it is none if it is wider
# than high, such as the middle of a cloud.
WIDE, UPRIGHT = 0.7, 1.0
# The plain mixture remembers 120 frames at 30 a second [s].
PLAIN_HISTORY_S = 4.0
# A bird may be as small as four pixels, so that nothing is opened away; it casts no shadow on the sky.
BIRD = BackgroundSettings(
    history_s=8.0,
    background_part=0.9,
    warm_up_s=0.5,
    threshold=25.0,
    shadows=False,
    brightest=1.0,
    sway_px=3,
    opening_px=0,
    bridge_px=(5, 5),
    smallest_px=(2, 2),
    smallest_area_px=5,
    widest=np.inf,
    largest=0.3,
    flat=0.0,
)
# A person stops at times, casts a shadow, falls apart into limbs and trunk one above the other, and stands upright
# (1.3 still lets two or three side by side pass, but not a patch of light on the ground).
PERSON = BackgroundSettings(
    history_s=20.0,
    background_part=0.7,
    warm_up_s=0.5,
    threshold=16.0,
    shadows=True,
    brightest=1.5,
    sway_px=0,
    opening_px=3,
    bridge_px=(5, 15),
    smallest_px=(8, 24),
    smallest_area_px=150,
    widest=1.3,
    largest=0.9,
    flat=0.1,
)


def plain(settings: BackgroundSettings) -> BackgroundSettings:
    """The paper's detector: the mixture with OpenCV's part of the background; nothing against sway or light.

    What of the foreground is taken together, and how large a target may be, the paper does not say: that is as here.
    """
    return replace(
        settings,
        history_s=PLAIN_HISTORY_S,
        background_part=0.9,
        threshold=25.0,
        brightest=1.0,
        sway_px=0,
        flat=0.0,
    )


class BackgroundDetector:
    """What differs from an adaptive Gaussian mixture of the background (Zivkovic 2004), as connected pieces."""

    def __init__(self, settings: BackgroundSettings, rate_hz: float) -> None:
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
        self._since: float | None = None  # when so much changed that it is no target
        self._known: tuple[Image, float] | None = None  # background, and when it was taken out of the mixture
        self._range: tuple[Image, Image] | None = None
        self._range_of: Image | None = None
        self._shape: tuple[int, ...] | None = None
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """Find what moves, largest first.

        Raises:
            CotargetError: the image's size changed.
        """
        check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        mask = self._model.apply(frame.image, learningRate=self._rate(frame.t))
        if self._settings.shadows:
            mask = cv2.compare(mask, FOREGROUND, cv2.CMP_EQ)
        if self._settings.brightest > 1.0:
            mask = self._unlit(mask, frame.image)
        if self._settings.sway_px:
            mask = _outside(mask, frame.image, self._sway())
        if self._settings.opening_px:
            mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((self._settings.opening_px,) * 2, np.uint8))
        self.mask = mask
        if self._learnt < self._settings.warm_up_s:
            return []
        if flood(mask):
            self._since = frame.t if self._since is None else self._since
            if frame.t - self._since >= FLOODED_S:
                self._forget()
            return []
        self._since = None
        return self._boxes(mask)

    def _forget(self) -> None:
        """Learn the background anew from the next picture on."""
        self._learnt, self._t, self._since, self._known = 0.0, None, None, None

    def _rate(self, t: float) -> float:
        """Learning rate for a frame at ``t`` [s]: fast while there is little to remember."""
        dt = self._interval if self._t is None else t - self._t
        self._t = t
        if dt <= 0:
            dt = self._interval
        anew, self._learnt = not self._learnt, self._learnt + dt
        if anew:  # nothing of what the mixture may have learnt before
            return 1.0
        return min(1.0, dt / min(self._settings.history_s, 2 * self._learnt))

    def _background(self) -> Image:
        """The background's colours, of a moment ago at most."""
        learnt, known = self._learnt, self._known
        if known is None or not BACKGROUND_UPDATE_S <= learnt <= known[1] + BACKGROUND_UPDATE_S:
            known = self._known = self._model.getBackgroundImage(), learnt
        return known[0]

    def _unlit(self, mask: Image, image: Image) -> Image:
        """A mask without the background in a brighter light, where most of what changed is that."""
        if cv2.countNonZero(mask) < FEW * mask.size:
            return mask
        there = np.flatnonzero(mask != 0)
        now, before = (each.reshape(-1, 3)[there].astype(np.float32) for each in (image, self._background()))
        light = np.einsum("ij,ij->i", now, before) / np.maximum(np.einsum("ij,ij->i", before, before), 1.0)
        same = (
            (np.abs(now - light[:, None] * before) < MARGIN).all(axis=1)
            & (light > 1.0)
            & (light < self._settings.brightest)
        )
        if 2 * np.count_nonzero(same) > len(there):
            mask.ravel()[there[same]] = 0
        return mask

    def _sway(self) -> tuple[Image, Image]:
        """The darkest and the brightest that the background has nearby: what sways does not leave that range."""
        background = self._background()
        if self._range is None or self._range_of is not background:
            nearby = np.ones((2 * self._settings.sway_px + 1,) * 2, np.uint8)
            margin = (MARGIN,) * 3
            darkest = cv2.subtract(cv2.erode(background, nearby), (*margin, 0))
            brightest = cv2.add(cv2.dilate(background, nearby), (*margin, 0))
            self._range, self._range_of = (darkest, brightest), background
        return self._range

    def _boxes(self, mask: Image) -> list[Detection]:
        """Boxes of the connected pieces, largest first."""
        settings = self._settings
        height, width = mask.shape
        found = []
        largest_w, largest_h = settings.largest * width, settings.largest * height
        for x, y, w, h in pieces(mask, settings.bridge_px):
            # Their gaps were only bridged: the box is that of the mask's own pixels inside.
            for first, last in self._upright(mask[y : y + h, x : x + w]):
                inside = mask[y : y + h, x + first : x + last]
                area = cv2.countNonZero(inside)
                if area < settings.smallest_area_px:
                    continue
                dx, dy, box_w, box_h = cv2.boundingRect(inside)
                if box_w < settings.smallest_px[0] or box_h < settings.smallest_px[1]:
                    continue
                widest = settings.widest if last - first == w else UPRIGHT
                if box_w > largest_w or box_h > largest_h or box_w > widest * box_h:
                    continue
                score = area / (area + settings.smallest_area_px)
                found.append((area, box_detection(x + first + dx, y + dy, box_w, box_h, score, mask.shape)))
        found.sort(key=lambda pair: -pair[0])
        return [detection for _, detection in found]

    def _upright(self, piece: Image) -> list[tuple[int, int]]:
        """From which column to which a piece of a mask is a target: where it is wide, without what lies flat."""
        height, width = piece.shape
        if not self._settings.flat or width <= WIDE * height:
            return [(0, width)]
        stands = cv2.morphologyEx(
            piece, cv2.MORPH_OPEN, np.ones((max(1, round(self._settings.flat * height)), 1), np.uint8)
        )
        columns = cv2.dilate(stands, np.ones((1, self._settings.bridge_px[0]), np.uint8)).any(axis=0)
        edges = np.flatnonzero(np.diff(columns, prepend=False, append=False)).tolist()
        return list(zip(edges[::2], edges[1::2], strict=True))


def pieces(mask: Image, bridge_px: tuple[int, int]) -> list[Sequence[int]]:
    """Left, top, width and height of the connected pieces of a mask, (H, W) [px], half a gap on each side included.

    Gaps of up to (across, down) count as none.
    """
    left, top, width, height = cv2.boundingRect(mask)  # mostly small, and all the rest needs no look
    if not width:
        return []
    across, down = bridge_px
    x, y = max(left - across // 2, 0), max(top - down // 2, 0)
    near = mask[y : top + height + down // 2, x : left + width + across // 2]
    joined = cv2.dilate(near, np.ones((down, across), np.uint8))
    contours = cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE, offset=(x, y))[0]
    return [cv2.boundingRect(contour) for contour in contours]


def _outside(mask: Image, image: Image, colours: tuple[Image, Image]) -> Image:
    """The part of a mask, (H, W), 0 or 255, where an image leaves a range of colours."""
    if cv2.countNonZero(mask) > FEW * mask.size:
        return cv2.subtract(mask, cv2.inRange(image, *colours))
    there = np.flatnonzero(mask != 0)  # of truth values: ten times as quick as of bytes
    if len(there):
        pixels, darkest, brightest = (
            each.reshape(-1, 3).take(there, axis=0).reshape(-1, 1, 3) for each in (image, *colours)
        )
        mask.ravel()[there] = cv2.bitwise_not(cv2.inRange(pixels, darkest, brightest)).ravel()
    return mask
