"""Find large targets by an adaptive Gaussian mixture of the background, in an image of reduced size.

Shadows and lit ground are no part of a target, clouds and places that a target has left are none, and what the tracker
holds is not learnt. The reasons for the numbers: docs/design-notes.md.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from cotarget.detection.base import (
    FOREGROUND,
    LASTING_S,
    Detections,
    box_detection,
    flood,
    halvings,
    is_clipped,
    moved,
    pieces,
)
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image

# Images are halved until they are at most this wide [px]; the lengths below are in pixels of the result.
WIDEST_PX = 480
# The mixture: its memory [s]; the part of a pixel's history that is its background; and the squared distance to it, in
# variances, from which a pixel is foreground. Beside what is held, the background is learnt and its image is read every
# LASTING_S, because that is a third of a frame's work.
HISTORY_S = 20.0
BACKGROUND_PART, THRESHOLD = 0.7, 20.0
# Foreground thinner than the first is removed, but not that within the second of what is left: feet and rotors. Gaps
# (across, down) that are closed within a target: what stands side by side is not bridged [px].
OPENING_PX, RIM_PX, BRIDGE_PX = 3, 2, (1, 9)
# Legs and neck of a person up to the first of these heights are thinner; they hang together with the rest over gaps
# below the second [px].
TALL_PX, GAP_PX = 40, 3
# Least larger side of a target, in parts of the image's width.
LEAST_PART = 24 / 640
# Score of a large target: alone it confirms no track, but together with the track's travel.
SCORE = 0.3
# Of an upright target, parts of a component that are thinner than the first part of its height lie on the ground, such
# as the edge of a shadow, if it is wider than the second part. What is left is no wider than it is high.
FLAT, WIDE = 0.1, 0.6
# Width of the edge from which it is that of a cloud [px], the part of foreground with less difference to the background
# than counts, and the part of a box with less slope: the edge is as wide as that difference over that slope.
SOFT_PX, CONTRAST_PART, SLOPE_PART = 4.0, 0.9, 0.98
# Largest edge in the image over that in the background, where a target has left.
GHOST = 0.7
# Light: most by which sun or exposure brighten the ground, and part of the image up to which foreground is too little
# for a change of light.
BRIGHTEST, FEW = 1.5, 0.01
# Margin beside the background's colour [grey levels]: five standard deviations of a sensor's noise of 2, and coding.
MARGIN = 15


class LargeTargetFinder:
    """Find what differs from an adaptive Gaussian mixture of the background (Zivkovic 2004)."""

    def __init__(self, rate_hz: float, upright: bool = False) -> None:
        """Start without a background.

        Args:
            rate_hz: nominal frame rate, for frames whose times do not increase [Hz].
            upright: whether targets stand upright, so that what lies flat at their feet is no part of them.
        """
        self._upright = upright
        self._interval = 1.0 / rate_hz
        self._model = cv2.createBackgroundSubtractorMOG2(
            history=max(1, round(HISTORY_S * rate_hz)), varThreshold=THRESHOLD, detectShadows=True
        )
        self._model.setBackgroundRatio(BACKGROUND_PART)
        self._model.setShadowValue(0)
        self._t: float | None = None
        self._learnt = 0.0
        self._since: float | None = None  # time since which foreground fills the image
        self._known: tuple[Image, float] | None = None  # background image, and when it was read from the mixture

    def find(
        self,
        frame: Frame,
        places: Sequence[tuple[Array, Array]] = (),
        shift_px: Array | None = None,
        exposure: float = 1.0,
        images: Sequence[Image] | None = None,
    ) -> Detections:
        """Find large targets, the largest first.

        Args:
            frame: frame of the camera.
            places: centre and size of places whose background is not learnt, (2,) each [px].
            shift_px: shift of the scene since the background was begun (du, dv) [px], (2,); None for a camera that
                stands.
            exposure: relative brightness of the image, which is undone.
            images: the frame's image and its halvings to `WIDEST_PX`, where they are made already.
        """
        images = images or halvings(frame.image, WIDEST_PX)
        factor = 2 ** (len(images) - 1)
        shift_px = np.zeros(2) if shift_px is None else shift_px
        shift = shift_px / factor
        image = moved(np.asarray(cv2.convertScaleAbs(images[-1], alpha=1 / exposure), dtype=np.uint8), -shift)
        foreground = self._subtract(image, frame.t, _reduced_boxes(places, shift_px, factor))
        if shift.any():  # what has come into view is not known
            seen = _moved_mask(np.full(foreground.shape, FOREGROUND, np.uint8), -shift)
            foreground = np.asarray(cv2.bitwise_and(foreground, cv2.compare(seen, FOREGROUND, cv2.CMP_EQ)))
        opened = cv2.morphologyEx(foreground, cv2.MORPH_OPEN, np.ones((OPENING_PX,) * 2, np.uint8))
        near = cv2.dilate(opened, np.ones((2 * RIM_PX + 1,) * 2, np.uint8))
        mask = np.asarray(cv2.bitwise_and(foreground, near), dtype=np.uint8)
        make_mask = partial(_full_size, _moved_mask(mask, shift), frame.image.shape)
        if self._learnt < LASTING_S:
            return Detections([], make_mask)
        if flood(mask):
            self._since = frame.t if self._since is None else self._since
            if frame.t - self._since >= LASTING_S:  # the mixture alone would take as long as its memory
                self.forget()
            return Detections([], make_mask)
        self._since = None
        found = [each for each in self._boxes(mask) if self._has_edge(image, mask, _rows_and_columns(each))]
        if self._upright:
            found = [_with_limbs(each, mask, foreground) for each in found]
        boxes = [
            replace(
                each,
                center_px=factor * (each.center_px + shift) + (factor - 1) / 2,
                size_px=factor * each.size_px,
                # By the image's border, or by that of the background that is known.
                clipped=each.clipped or is_clipped(each.center_px + shift, each.size_px, mask.shape),
            )
            for each in found
        ]
        return Detections(boxes, make_mask)

    def _subtract(self, image: Image, t: float, held: Sequence[tuple[slice, slice]]) -> Image:
        """Find the foreground at time ``t`` [s] without lit ground, and learn the background but for what is held."""
        at_once = not held or not self._learnt
        mask = np.asarray(self._model.apply(image, learningRate=self._rate(t) if at_once else 0), dtype=np.uint8)
        lit = self._lit(mask, image, held)
        if not at_once and (self._t is None or not 0 <= t - self._t < LASTING_S):
            kept = np.zeros(mask.shape, np.uint8)
            for box in held:
                if not self._is_ghost(image, mask, box):
                    kept[box] = FOREGROUND
            kept[lit != 0] = 0
            self._model.apply(image, knownForegroundMask=kept, learningRate=self._rate(t))
        return np.asarray(cv2.subtract(mask, lit))

    def _is_ghost(self, image: Image, mask: Image, box: tuple[slice, slice]) -> bool:
        """Whether the edge of the foreground in a box is an edge of the background and not of the image.

        A target that stood there when the background was learnt, and has left, leaves such a place.
        """
        box = _enlarged(box)
        if not mask[box].any():
            return False
        nearby = np.ones((3, 3), np.uint8)
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
        return min(1.0, dt / min(HISTORY_S, 2 * self._learnt))

    def _background(self) -> Image:
        """Background image, at most `LASTING_S` old."""
        learnt, known = self._learnt, self._known
        if known is None or not LASTING_S <= learnt <= known[1] + LASTING_S:
            known = self._known = self._model.getBackgroundImage(), learnt
        return known[0]

    def _lit(self, mask: Image, image: Image, held: Sequence[tuple[slice, slice]]) -> Image:
        """Find background in a brighter light, if that explains most of a mask outside of held targets."""
        lit = np.zeros_like(mask)
        if cv2.countNonZero(mask) < FEW * mask.size:
            return lit
        there = np.flatnonzero(mask != 0)
        now, before = (each.reshape(-1, 3)[there].astype(np.float32) for each in (image, self._background()))
        light = np.einsum("ij,ij->i", now, before) / np.maximum(np.einsum("ij,ij->i", before, before), 1.0)
        same = (np.abs(now - light[:, None] * before) < MARGIN).all(axis=1) & (light > 1.0) & (light < BRIGHTEST)
        free = mask.copy()
        lit.ravel()[there[same]] = FOREGROUND
        for box in held:
            if 2 * cv2.countNonZero(lit[box]) < cv2.countNonZero(mask[box]):  # it is a target and no lit ground
                free[box] = 0
        count = cv2.countNonZero(free)
        explained = count >= FEW * mask.size and 2 * cv2.countNonZero(cv2.bitwise_and(free, lit)) > count
        return lit if explained else np.zeros_like(mask)

    def _boxes(self, mask: Image) -> list[Detection]:
        """Find the boxes of the connected components, largest first."""
        found = []
        for x, y, w, h in pieces(mask, BRIDGE_PX):
            # The component's gaps are bridged, so its box is that of the mask's own pixels.
            for first, last in self._standing(mask[y : y + h, x : x + w]):
                inside = mask[y : y + h, x + first : x + last]
                dx, dy, box_w, box_h = cv2.boundingRect(inside)
                if max(box_w, box_h) < LEAST_PART * mask.shape[1]:
                    continue
                if last - first == w or box_w <= box_h:
                    box = box_detection(x + first + dx, y + dy, box_w, box_h, SCORE, mask.shape)
                    found.append((cv2.countNonZero(inside), box))
        found.sort(key=lambda pair: -pair[0])
        return [detection for _, detection in found]

    def _standing(self, piece: Image) -> list[tuple[int, int]]:
        """Find the column ranges of a component that stand upright, without what lies flat."""
        height, width = piece.shape
        if not self._upright or width <= WIDE * height:
            return [(0, width)]
        stands = cv2.morphologyEx(piece, cv2.MORPH_OPEN, np.ones((max(1, round(FLAT * height)), 1), np.uint8))
        edges = np.flatnonzero(np.diff(stands.any(axis=0), prepend=False, append=False)).tolist()
        return list(zip(edges[::2], edges[1::2], strict=True))


def _with_limbs(box: Detection, mask: Image, foreground: Image) -> Detection:
    """Extend the box of an upright target, in its columns, by thin foreground that hangs together with it.

    Args:
        box: box of whole pixels.
        mask: foreground without what is thin, (H, W).
        foreground: all foreground, (H, W).
    """
    rows, columns = _rows_and_columns(box)
    reach = TALL_PX - (rows.stop - rows.start)  # up and down
    if reach <= 0:
        return box
    top = max(rows.start - reach, 0)
    limbs = foreground[top : rows.stop + reach, columns]
    grown = np.zeros_like(limbs)
    grown[rows.start - top : rows.stop - top] = mask[rows, columns]
    for _ in range(round(reach / GAP_PX)):
        grown = np.asarray(cv2.bitwise_and(cv2.dilate(grown, np.ones((2 * GAP_PX + 1, 3), np.uint8)), limbs))
    _, first, _, height = cv2.boundingRect(grown)
    return box_detection(columns.start, top + first, limbs.shape[1], height, box.score, mask.shape)


def _rows_and_columns(box: Detection) -> tuple[slice, slice]:
    """Give the part of an image that a box of whole pixels covers."""
    first = np.rint(box.center_px - (box.size_px - 1) / 2).astype(int)
    u, v = (slice(a, b) for a, b in zip(first, first + box.size_px.astype(int), strict=True))
    return v, u


def _enlarged(box: tuple[slice, slice]) -> tuple[slice, slice]:
    """Enlarge a part of an image by a pixel to each side, up to the image's border."""
    rows, columns = (slice(max(0, each.start - 1), each.stop + 1) for each in box)
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
    """Enlarge a mask to an image of a shape (H, W, 3)."""
    return np.asarray(cv2.resize(mask, shape[1::-1], interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _moved_mask(mask: Image, shift: Array) -> Image:
    """Move a mask by (du, dv) [px]; 0 fills what is uncovered."""
    if not shift.any():
        return mask
    matrix = np.column_stack([np.eye(2), shift])
    return np.asarray(cv2.warpAffine(mask, matrix, mask.shape[1::-1]), dtype=np.uint8)
