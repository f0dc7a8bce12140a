"""Detect motion with an adaptive Gaussian mixture of the background, morphology and connected components.

It detects persons and birds, and is robust against shadows, changes of light and swaying foliage; `plain` gives the
paper's settings. The reasons for the settings: docs/design-notes.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np

from cotarget.detection.base import Detections, box_detection, check_size, flood, is_clipped, moved
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image

if TYPE_CHECKING:
    from cotarget.tracking.track import Track

# Values in MOG2's mask: 255 is foreground, 127 a shadow.
FOREGROUND = 255
STANDING = np.zeros(2)  # shift of the scene before a camera that stands [px]
# Time for which foreground may fill the image, as after a change of light or a nudge, before the background is learnt
# again [s]. The mixture alone would take as long as its history, and targets would not be seen meanwhile.
FLOODED_S = 0.2


@dataclass(frozen=True)
class BackgroundSettings:
    """Settings of the background mixture and of the targets' size and shape.

    Attributes:
        history_s: memory of the background mixture [s].
        background_part: the colours that make up this part of a pixel's history are its background. Many colours
            (0.9) hide foliage, but a target that stops then fades after a tenth of the history.
        warm_up_s: time for which the background is learnt before anything is detected [s].
        threshold: squared distance to the background, in variances, from which a pixel is foreground.
        shadows: whether to separate shadows from the target.
        brightest: largest factor by which the background may brighten, as when the sun comes out, and stay background,
            if that explains most of the foreground beside held targets; the mixture knows shadows but no light. 1 for
            none.
        sway_px: distance by which the background sways [px]: a pixel is background if its colour lies between the
            darkest and the brightest background colour within this distance; 0 for a rigid background.
        opening_px: foreground thinner than this is removed; 0 for none.
        bridge_px: (width, height) of gaps that are closed within one target.
        smallest_px: least width and height of a target.
        smallest_area_px: fewest foreground pixels of a target.
        widest: largest width as a multiple of the height.
        largest: largest side of a target as a part of the image's.
        flat: parts of a wide component thinner than this part of its height lie on the ground, such as the edge of a
            shadow, and are no part of the target; 0 for none.
        wide: a component wider than this part of its height may be a target and something flat.
        rim_px: thinner foreground within this distance of what the opening leaves is kept: feet and rotors.
        edged: whether a target must have a sharp edge in the image, unlike a cloud or the place that one has left.
        image_px: images are halved until they are at most this wide; 0 for never. All lengths are in pixels of the
            result.
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
    wide: float = 0.7
    rim_px: int = 0
    edged: bool = False
    image_px: int = 960


# Interval at which the background is learnt beside what is held [s].
LEARNING_INTERVAL_S = 0.2
# Interval at which the background image is read from the mixture, a third of a frame's work [s].
BACKGROUND_UPDATE_S = 0.25
# Half the width of a target's edge, on which a target is distinguished from the place that one has left [px].
EDGE_PX = 1
# Width of the edge from which it is that of a cloud [px], the part of foreground with less difference to the background
# than counts, and the part of a box with less slope: the edge is as wide as that difference over that slope.
SOFT_PX, CONTRAST_PART, SLOPE_PART = 4.0, 0.9, 0.98
# Largest edge in the image over that in the background, where a target has left.
GHOST = 0.7
# Part of the image up to which it is faster to process foreground pixels one by one, and too few for a change of light.
FEW = 0.01
# Part of what is held from which light explains it, so that it is no target but lit ground.
LIT = 0.8
# Margin beside the background's range [grey levels]: five standard deviations of a sensor's noise of 2, and coding.
MARGIN = 15
# What is left of a component without its flat parts is no wider than this part of its height, unlike for example the
# middle of a cloud.
UPRIGHT = 1.0
# Memory of OpenCV's default mixture, 120 frames at 30 a second [s].
PLAIN_HISTORY_S = 4.0
# A bird may be as small as four pixels, so nothing is opened; it casts no shadow on the sky.
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
# A person stops at times, casts a shadow, falls apart into limbs and trunk above each other, and stands upright. A
# ratio of 1.3 admits two or three persons side by side, but no patch of light on the ground.
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
# A target of unknown shape may be as wide as it likes, so it may be a patch of light on the ground.
GENERAL = replace(PERSON, bridge_px=(9, 9), smallest_px=(6, 6), smallest_area_px=40, widest=np.inf, flat=0.0)

# Large targets of any kind, such as people and cars. What stands side by side is not bridged.
LARGE = replace(
    GENERAL,
    warm_up_s=0.2,
    threshold=20.0,
    bridge_px=(1, 9),
    smallest_px=(3, 3),
    smallest_area_px=25,
    wide=0.6,
    rim_px=2,
    edged=True,
    image_px=480,
)


def plain(settings: BackgroundSettings) -> BackgroundSettings:
    """Give the paper's detector: the mixture with OpenCV's background ratio, and nothing against sway or light.

    The paper does not say how foreground is grouped or how large a target may be, so these settings stay.
    """
    return replace(
        settings,
        history_s=PLAIN_HISTORY_S,
        background_part=0.9,
        threshold=25.0,
        brightest=1.0,
        sway_px=0,
        flat=0.0,
        image_px=0,
    )


class BackgroundDetector:
    """Detect what differs from an adaptive Gaussian mixture of the background (Zivkovic 2004)."""

    def __init__(self, settings: BackgroundSettings, rate_hz: float) -> None:
        """Create a detector without a background.

        Args:
            settings: settings of the mixture and of the targets.
            rate_hz: nominal frame rate, for frames whose times do not increase [Hz].
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
        self._since: float | None = None  # time since which foreground fills the image
        self._known: tuple[Image, float] | None = None  # background image, and when it was read from the mixture
        self._range: tuple[Image, Image] | None = None
        self._range_of: Image | None = None
        self._shape: tuple[int, ...] | None = None

    def detect(self, frame: Frame, held: Sequence["Track"] = ()) -> Detections:
        """Detect moving targets, largest first; the background is learnt everywhere, as in the paper.

        Raises:
            CotargetError: the image's size changed.
        """
        return self.subtract(frame)

    def subtract(
        self, frame: Frame, places: Sequence[tuple[Array, Array]] = (), shift_px: Array = STANDING
    ) -> Detections:
        """Detect as `detect` does, also with a camera that moves a little.

        Args:
            frame: frame of the camera.
            places: centre and size of places whose background is not learnt, (2,) each [px].
            shift_px: shift of the scene since the background was begun (du, dv) [px], (2,).
        """
        check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        image, factor = frame.image, 1
        while self._settings.image_px and image.shape[1] > self._settings.image_px:
            image = np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
            factor *= 2
        shift = shift_px / factor
        image = moved(image, -shift)
        held = _reduced_boxes(places, shift_px, factor)
        mask = self._subtract(image, frame.t, held)
        if self._settings.shadows:
            mask = cv2.threshold(mask, FOREGROUND - 1, FOREGROUND, cv2.THRESH_BINARY)[1]
        if self._settings.brightest > 1.0:
            mask = self._unlit(mask, image, held)
        if self._settings.sway_px:
            mask = _outside(mask, image, self._sway())
        if self._settings.opening_px:
            opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((self._settings.opening_px,) * 2, np.uint8))
            near = cv2.dilate(opened, np.ones((2 * self._settings.rim_px + 1,) * 2, np.uint8))
            mask = np.asarray(cv2.bitwise_and(mask, near), dtype=np.uint8)
        if shift.any():  # what has come into view is not known
            seen = _moved_mask(np.full(mask.shape, FOREGROUND, np.uint8), -shift)
            mask = np.asarray(cv2.bitwise_and(mask, cv2.compare(seen, FOREGROUND, cv2.CMP_EQ)), dtype=np.uint8)
        make_mask = partial(_full_size, _moved_mask(mask, shift), frame.image.shape)
        if self._learnt < self._settings.warm_up_s:
            return Detections([], make_mask)
        if flood(mask):
            self._since = frame.t if self._since is None else self._since
            if frame.t - self._since >= FLOODED_S:
                self.forget()
            return Detections([], make_mask)
        self._since = None
        boxes = [
            replace(
                each,
                center_px=factor * (each.center_px + shift) + (factor - 1) / 2,
                size_px=factor * each.size_px,
                # By the image's border, or by that of the background that is known.
                clipped=each.clipped or is_clipped(each.center_px + shift, each.size_px, mask.shape),
            )
            for each in self._boxes(mask)
            if not self._settings.edged or self._has_edge(image, mask, _rows_and_columns(each))
        ]
        return Detections(boxes, make_mask)

    def _subtract(self, image: Image, t: float, held: Sequence[tuple[slice, slice]]) -> Image:
        """Find the foreground at time ``t`` [s], and learn the background but for what is held."""
        if not held or not self._learnt:
            return np.asarray(self._model.apply(image, learningRate=self._rate(t)))
        mask = np.asarray(self._model.apply(image, learningRate=0))
        if self._t is None or not 0 <= t - self._t < LEARNING_INTERVAL_S:
            kept = np.zeros(mask.shape, np.uint8)
            for box in held:
                if not self._is_ghost(image, mask, box):
                    kept[box] = FOREGROUND
            self._model.apply(image, knownForegroundMask=kept, learningRate=self._rate(t))
        return mask

    def _is_ghost(self, image: Image, mask: Image, box: tuple[slice, slice]) -> bool:
        """Whether the edge of the foreground in a box is an edge of the background and not of the image.

        A target that stood there when the background was learnt, and has left, leaves such a place.
        """
        box = _enlarged(box)
        if not mask[box].any():
            return False
        nearby = np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)
        edge = cv2.morphologyEx(mask[box], cv2.MORPH_GRADIENT, nearby)
        now, before = (
            sum(cv2.mean(cv2.morphologyEx(each[box], cv2.MORPH_GRADIENT, nearby), edge))
            for each in (image, self._background())
        )
        return now < GHOST * before

    def _has_edge(self, image: Image, mask: Image, box: tuple[slice, slice]) -> bool:
        """Whether the foreground in a box has a sharp edge, and not only because it has one in the background.

        The edge lies just outside of the box where the rim of a dark target counts as shadow.
        """
        around = _enlarged(box)
        now, before = (
            cv2.cvtColor(each[around], cv2.COLOR_BGR2GRAY).astype(np.float32) for each in (image, self._background())
        )
        difference = now - before
        contrast = np.quantile(np.abs(difference[mask[around] != 0]), CONTRAST_PART)
        slopes = cv2.magnitude(*(cv2.Sobel(difference, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (0, 1)))
        return contrast < SOFT_PX * np.quantile(slopes, SLOPE_PART) and not self._is_ghost(image, mask, box)

    def forget(self) -> None:
        """Learn the background again from the next image on."""
        self._learnt, self._t, self._since, self._known = 0.0, None, None, None

    def _rate(self, t: float) -> float:
        """Learning rate for a frame at ``t`` [s]: high while little has been learnt."""
        dt = self._interval if self._t is None else t - self._t
        self._t = t
        if dt <= 0:
            dt = self._interval
        first, self._learnt = not self._learnt, self._learnt + dt
        if first:  # discard whatever the mixture learnt before
            return 1.0
        return min(1.0, dt / min(self._settings.history_s, 2 * self._learnt))

    def _background(self) -> Image:
        """Background image, at most `BACKGROUND_UPDATE_S` old."""
        learnt, known = self._learnt, self._known
        if known is None or not BACKGROUND_UPDATE_S <= learnt <= known[1] + BACKGROUND_UPDATE_S:
            known = self._known = self._model.getBackgroundImage(), learnt
        return known[0]

    def _unlit(self, mask: Image, image: Image, held: Sequence[tuple[slice, slice]]) -> Image:
        """Remove background in a brighter light from a mask, if that explains most of it outside of held targets."""
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
        lit, free = np.zeros_like(mask), mask.copy()
        lit.ravel()[there[same]] = FOREGROUND
        for box in held:
            if cv2.countNonZero(lit[box]) < LIT * cv2.countNonZero(mask[box]):
                free[box] = 0
        count = cv2.countNonZero(free)
        if count >= FEW * mask.size and 2 * cv2.countNonZero(cv2.bitwise_and(free, lit)) > count:
            mask[lit != 0] = 0
        return mask

    def _sway(self) -> tuple[Image, Image]:
        """Darkest and brightest background colours nearby, the range of a swaying background."""
        background = self._background()
        if self._range is None or self._range_of is not background:
            nearby = np.ones((2 * self._settings.sway_px + 1,) * 2, np.uint8)
            margin = (MARGIN,) * 3
            darkest = cv2.subtract(cv2.erode(background, nearby), (*margin, 0))
            brightest = cv2.add(cv2.dilate(background, nearby), (*margin, 0))
            self._range, self._range_of = (darkest, brightest), background
        return self._range

    def _boxes(self, mask: Image) -> list[Detection]:
        """Find the boxes of the connected components, largest first."""
        settings = self._settings
        height, width = mask.shape
        found = []
        largest_w, largest_h = settings.largest * width, settings.largest * height
        for x, y, w, h in pieces(mask, settings.bridge_px):
            # The component's gaps are bridged, so its box is that of the mask's own pixels.
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
        """Find the column ranges of a component that stand upright, without what lies flat."""
        height, width = piece.shape
        if not self._settings.flat or width <= self._settings.wide * height:
            return [(0, width)]
        stands = cv2.morphologyEx(
            piece, cv2.MORPH_OPEN, np.ones((max(1, round(self._settings.flat * height)), 1), np.uint8)
        )
        columns = cv2.dilate(stands, np.ones((1, self._settings.bridge_px[0]), np.uint8)).any(axis=0)
        edges = np.flatnonzero(np.diff(columns, prepend=False, append=False)).tolist()
        return list(zip(edges[::2], edges[1::2], strict=True))


def _rows_and_columns(box: Detection) -> tuple[slice, slice]:
    """Give the part of an image that a box of whole pixels covers."""
    first = np.rint(box.center_px - (box.size_px - 1) / 2).astype(int)
    u, v = (slice(a, b) for a, b in zip(first, first + box.size_px.astype(int), strict=True))
    return v, u


def _enlarged(box: tuple[slice, slice]) -> tuple[slice, slice]:
    """Enlarge a part of an image by EDGE_PX to each side, up to the image's border."""
    rows, columns = (slice(max(0, each.start - EDGE_PX), each.stop + EDGE_PX) for each in box)
    return rows, columns


def _reduced_boxes(places: Sequence[tuple[Array, Array]], shift_px: Array, factor: int) -> list[tuple[slice, slice]]:
    """Find the rows and columns of places, given by centre and size, in an image moved back and reduced."""
    boxes = []
    for center, size in places:
        (left, top), (right, bottom) = (
            np.maximum(np.rint((center - shift_px + sign * size / 2) / factor), 0).astype(int).tolist()
            for sign in (-1, 1)
        )
        boxes.append((slice(top, bottom + 1), slice(left, right + 1)))
    return boxes


def _full_size(mask: Image, shape: tuple[int, ...]) -> Image:
    """Enlarge a mask to an image of a shape (H, W, 3), if it is smaller."""
    if mask.shape == shape[:2]:
        return mask
    return np.asarray(cv2.resize(mask, shape[1::-1], interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _moved_mask(mask: Image, shift: Array) -> Image:
    """Move a mask by (du, dv) [px]; 0 fills what is uncovered."""
    if not shift.any():
        return mask
    matrix = np.column_stack([np.eye(2), shift])
    return np.asarray(cv2.warpAffine(mask, matrix, mask.shape[1::-1]), dtype=np.uint8)


def pieces(mask: Image, bridge_px: tuple[int, int]) -> list[Sequence[int]]:
    """Find the connected components of a mask (H, W), as left, top, width and height [px].

    Gaps of up to (across, down) are closed, and half a gap is included on each side.
    """
    left, top, width, height = cv2.boundingRect(mask)  # mostly small, which saves processing the rest
    if not width:
        return []
    across, down = bridge_px
    x, y = max(left - across // 2, 0), max(top - down // 2, 0)
    near = mask[y : top + height + down // 2, x : left + width + across // 2]
    joined = cv2.dilate(near, np.ones((down, across), np.uint8))
    contours = cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE, offset=(x, y))[0]
    return [cv2.boundingRect(contour) for contour in contours]


def _outside(mask: Image, image: Image, colours: tuple[Image, Image]) -> Image:
    """Restrict a mask (H, W), 0 or 255, to pixels whose colour is outside a range."""
    if cv2.countNonZero(mask) > FEW * mask.size:
        return cv2.subtract(mask, cv2.inRange(image, *colours))
    there = np.flatnonzero(mask != 0)  # of booleans, which is ten times as fast as of bytes
    if len(there):
        pixels, darkest, brightest = (
            each.reshape(-1, 3).take(there, axis=0).reshape(-1, 1, 3) for each in (image, *colours)
        )
        mask.ravel()[there] = cv2.bitwise_not(cv2.inRange(pixels, darkest, brightest)).ravel()
    return mask
