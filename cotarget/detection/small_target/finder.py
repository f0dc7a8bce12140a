"""Find small targets by contrast and change, each with a score, and in the difference from earlier images."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from cotarget.detection.base import QUIET_PART, Detections, halvings, moved
from cotarget.detection.small_target.camera_motion import CameraMotion
from cotarget.detection.small_target.change import AGES_S, History, Reference, changes
from cotarget.detection.small_target.contrast import (
    INNER_PX,
    LEAST_ROUGHNESS,
    OUTER_HALF_PX,
    SCALES,
    SmallTarget,
    find_small_targets,
    mostly_in,
    pyramid,
    share,
)
from cotarget.detection.small_target.plain import find_wholes
from cotarget.detection.small_target.score import WEIGHTS, Weights, small_target_score
from cotarget.geometry import Array
from cotarget.rig import Detection, Frame, Image

# Least contrast, in standard deviations of the surroundings.
LEAST_SIGNAL = 4.5
# Least score of a detection. The tracker begins no track with so little; a target that hovers before trees keeps it.
LEAST_SCORE = 0.005
# Score and change from which a region has arrived as a whole: it is more likely a target than not, and half of it was
# not there before. Of a sign with a bird flying in front of it, a tenth has changed.
ARRIVED = 0.5
# Least signal in the difference from all earlier images, and the signal with a score of 0.5. In the simulated field,
# swaying foliage is above the latter once in six frames, anywhere; a bird in front of it in nineteen of twenty.
LEAST_DIFFERENCE, EVEN_DIFFERENCE = 7.0, 12.0
# Fewest of the AGES_S for which there must be an image.
FEWEST_EARLIER = 3
# Shift of the camera between two images up to which they are subtracted [px].
SHAKING_PX = 5.0
# Usual difference, such as of a swaying branch, subtracted from the difference: its factor, the time constant of its
# mean [s], and the width over which it spreads [px].
USUAL_TIMES, USUAL_S, SWAY_PX = 3.0, 2.0, 5
# Largest score of a clipped box, which may continue a track but not begin one: half of its surroundings are outside the
# image, so a swaying twig looks isolated.
MOST_CLIPPED_SCORE = 0.45
# Images are halved until they are at most this wide [px]; targets are outlined in full resolution. Small images are
# doubled while their larger side stays within it, at most twice: a bird of one pixel then fills more of the finest
# scale, INNER_PX.
WIDEST_PX, MOST_TIMES = 960, 4
# Least contrast in an image that was doubled twice and has more noise than LEAST_ROUGHNESS: its finest scale lies
# within one pixel of the camera, so the mean does not reduce the noise.
NOISY_SIGNAL = 5.5
# Least span of the history before anything is detected: at first, when it has an image of the shortest age; and after a
# cut, whose new scene must be seen for a while [s].
WARM_UP_S, AFTER_CUT_S = 0.09, AGES_S[1]

Found = tuple[SmallTarget, Detection]  # a region and its box


class SmallTargetFinder:
    """Find small targets by contrast and change, each with a score."""

    def __init__(self, weights: Weights = WEIGHTS, least_score: float = LEAST_SCORE) -> None:
        """Start without history; ``least_score`` is that of a detection."""
        self._least_score, self._weights = least_score, weights
        self.camera = CameraMotion()
        self._history = History()
        self._warm_up_s = WARM_UP_S
        self._usual: Image | None = None  # mean difference from earlier images, float32
        self._usual_t = 0.0  # its time
        self.shift: Array = np.zeros(2)  # of the camera since the first frame [px], (2,)
        self.repeated = False  # whether the last frame repeats the one before

    def find(self, frame: Frame, exposure: float = 1.0) -> tuple[list[SmallTarget], Detections]:
        """Find regions that stand out and change, none in a frame that repeats the last one.

        Args:
            frame: frame of the camera.
            exposure: its brightness relative to a reference.

        Returns:
            The regions, in the enlarged image of a small one, and their boxes, best first.
        """
        grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        *finer, grey = halvings(grey, WIDEST_PX)
        unit = 2 ** len(finer)
        shift = self.camera.update(grey, frame.t)  # measured without enlargement, in which soft scenes have no corners
        self.shift = unit * shift
        grey, times = (grey, 1) if finer else _enlarged(grey)
        shift = times * shift
        if self.camera.jumped:
            self._history.clear()
            self._warm_up_s = AFTER_CUT_S
        references = self._history.references(frame.t, shift)
        self.repeated = not self._history.add(frame.t, grey, shift, exposure)
        if self.repeated or self._history.span < self._warm_up_s:
            return [], Detections([], functools.partial(_mask, [], frame.image.shape, times))
        self._warm_up_s = WARM_UP_S
        shape = tuple(times * side for side in frame.image.shape[:2])
        found: list[Found] = []
        arrived: list[Found] = []
        noisy = times == MOST_TIMES and self._history.noise > LEAST_ROUGHNESS
        levels, first = pyramid([*finer, grey], len(finer) + SCALES + 1), len(finer)
        small = find_small_targets(levels, NOISY_SIGNAL if noisy else LEAST_SIGNAL, first=first)
        for target in [*find_wholes(levels[first:], unit), *small]:
            low = target.low[0] // unit, target.low[1] // unit
            size = -(-target.size[0] // unit), -(-target.size[1] // unit)
            since = changes(grey, low, size, target.around, self._history.noise, references)
            target = target._replace(since=tuple(since))
            score = small_target_score(target.signal, since, target.beside, self._weights)
            detection = _boxed(target, score, shape, times)
            if detection.score >= self._least_score:
                found.append((target, detection))
            if detection.score >= ARRIVED and any(change >= ARRIVED for change in since):
                arrived.append((target, detection))
        differing = self._differing(frame.t, grey, unit, times, references)
        found += [_as_a_whole(pair, arrived) for pair in differing]
        arrived.sort(key=lambda pair: -math.prod(pair[0].size))
        wholes = _apart([pair for pair in arrived if pair[0].whole], mostly_in)
        found = [pair for pair in found if not any(mostly_in(pair[0], whole) for whole, _ in wholes)]
        found = wholes + _apart(sorted(found, key=_by_score), share)
        found.sort(key=_by_score)
        boxes = [detection for _, detection in found]
        return [target for target, _ in found], Detections(
            boxes, functools.partial(_mask, found, frame.image.shape, times)
        )

    def _differing(
        self,
        t: float,
        grey: Image,
        unit: int,
        times: int,
        references: Sequence[Reference | None],
    ) -> list[Found]:
        """Find regions in the difference from all earlier images, if there are enough and the camera hardly moved.

        The difference of an image enlarged by a factor ``times`` is halved: a twig sways over more of its pixels.
        """
        earlier = [kept for kept in references if kept is not None]
        shifts = [max(map(abs, kept.shift)) for kept in earlier]
        if len(earlier) < FEWEST_EARLIER or max(shifts) > times * SHAKING_PX:
            self._usual = None
            return []
        registered = (
            kept.image if shift <= QUIET_PART * grey.shape[1] else moved(kept.image, -np.array(kept.shift))
            for kept, shift in zip(earlier, shifts, strict=True)
        )
        difference = functools.reduce(cv2.min, (cv2.absdiff(grey, picture) for picture in registered))
        pixel = unit  # side of a pixel of the difference
        if times > 1:
            pixel = 2
            difference = cv2.resize(difference, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        if self._usual is None:
            self._usual, self._usual_t = np.zeros(difference.shape, np.float32), t
        usual = cv2.dilate(cv2.convertScaleAbs(self._usual, alpha=USUAL_TIMES), np.ones((SWAY_PX, SWAY_PX), np.uint8))
        cv2.accumulateWeighted(difference, self._usual, 1 - math.exp((self._usual_t - t) / USUAL_S))
        self._usual_t = t
        unusual = cv2.subtract(difference, usual)
        # A sky is zero but for the target; its surroundings are needed as well.
        least = LEAST_DIFFERENCE * LEAST_ROUGHNESS
        there = cv2.threshold(cv2.blur(unusual, (INNER_PX,) * 2), least, 255, cv2.THRESH_BINARY)[1]
        left, top, width, height = cv2.boundingRect(there)
        if not width:
            return []
        side = 2**SCALES  # of a pixel of the image in which the largest ring is measured
        reach = side * OUTER_HALF_PX
        left, top, right, bottom = left - reach, top - reach, left + width + reach, top + height + reach
        left, top = max(0, left) // side * side, max(0, top) // side * side
        found = []
        for target in find_small_targets([unusual[top:bottom, left:right]], LEAST_DIFFERENCE, of_difference=True):
            score = float(1 / (1 + (EVEN_DIFFERENCE / target.signal) ** self._weights[0]))
            (x, y), (w, h) = target.low, target.size
            target = target._replace(
                low=(pixel * (left + x), pixel * (top + y)), size=(pixel * w, pixel * h), beside=math.inf
            )
            found.append((target, _boxed(target, score, (unit * grey.shape[0], unit * grey.shape[1]), times)))
        return found


def _enlarged(grey: Image) -> tuple[Image, int]:
    """Double an image while its larger side stays within WIDEST_PX; return it and its factor."""
    times = next((n for n in (MOST_TIMES, 2) if n * max(grey.shape) <= WIDEST_PX), 1)
    enlarged = cv2.resize(grey, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
    return np.asarray(enlarged, dtype=np.uint8), times


def _mask(found: Sequence[Found], shape: tuple[int, ...], times: int) -> Image:
    """Draw regions of an image enlarged by a factor ``times`` into one of a shape (H, W, 3), by their scores."""
    mask = np.zeros(shape[:2], np.uint8)
    for target, detection in reversed(found):
        (x, y), (w, h) = target.low, target.size
        rows, columns = slice(y // times, -(-(y + h) // times)), slice(x // times, -(-(x + w) // times))
        mask[rows, columns] = round(255 * detection.score)
    return mask


def _boxed(target: SmallTarget, score: float, shape: tuple[int, ...], times: int) -> Detection:
    """Make a detection of a region of an image of a shape (H, W), enlarged by a factor ``times``."""
    (x, y), (w, h) = target.low, target.size
    # A box that leaves one pixel of the camera beside it has no surroundings there; interpolation spreads each over
    # ``times`` pixels.
    rim = 2 * times
    clipped = x < rim or y < rim or x + w > shape[1] - rim or y + h > shape[0] - rim
    center = np.array([(x + w / 2) / times - 0.5, (y + h / 2) / times - 0.5])
    most = MOST_CLIPPED_SCORE if clipped else 1.0
    return Detection(center, np.array([w / times, h / times]), min(score, most), clipped)


def _as_a_whole(differing: Found, arrived: list[Found]) -> Found:
    """Replace a region of the difference by the arrived region that contains it, if there is one.

    Of a plain target that moves by less than its own length within AGES_S[0], only the front differs; its contrast
    shows all of it. A standing thing behind a target differs as well, but has not arrived.
    """
    target, detection = differing
    around = [pair for pair in arrived if share(pair[0], target)]
    if len(around) != 1 or math.prod(around[0][0].size) <= math.prod(target.size):
        return differing
    whole, box = around[0]
    return whole, replace(box, score=max(box.score, detection.score))


def _by_score(pair: Found) -> float:
    """Key that sorts regions by their score, the best first."""
    return -pair[1].score


def _apart(found: Sequence[Found], overlap: Callable[[SmallTarget, SmallTarget], bool]) -> list[Found]:
    """Keep the first of regions that overlap."""
    kept: list[Found] = []
    for pair in found:
        if not any(overlap(pair[0], other) for other, _ in kept):
            kept.append(pair)
    return kept
