"""Small targets, moving or hovering: what stands out from its surroundings and changes, in a camera that may shake.

Movement alone cannot find a bird that hovers, and contrast alone finds every sign and chimney too. Here both must
come together, in one number: the contrast in standard deviations of the surroundings, times the part of it that
was not there before, in units of what the air, the codec and the camera's shake change of a thing that stands.

In front of foliage, or beside the edge of a roof, a bird does not stand out; but what it does to the picture stands
out from what the wind does there. So where the camera stands, the difference from all earlier pictures is searched for
specks as well: in the simulated field that finds the bird in 99 % of the frames in which its contrast finds half. Of a
plain bird that flies slowly it finds the front alone; where contrast finds the whole of it, that is the box.
"""

import functools
import math
from dataclasses import replace

import cv2
import numpy as np

from cotarget.detection.base import Detection, box_detection, check_size
from cotarget.detection.cameramotion import CameraMotion
from cotarget.detection.change import AGES_S, History, change
from cotarget.detection.contrast import Speck, find_specks, share
from cotarget.geometry import Array
from cotarget.rig import Frame, Image

# Least contrast, in standard deviations of the surroundings.
LEAST_SIGNAL = 4.5
# So many specks are looked at in a frame, those that stand out most first; it bounds the time of a frame.
MOST_SPECKS = 40
# What is found to have changed of things that stand, nine times in ten less, after each of AGES_S; measured on films of
# the collection that tests/test_real_clips.py names, each seen through air and a codec.
STANDING_CHANGE = (0.05, 0.08, 0.15, 0.20)
# Added to a change before its logarithm is taken: less than this cannot be measured.
LEAST_CHANGE = 0.02
# A speck's score is the logistic function of SLOPE ln(signal x change / EVEN): 0.5 at EVEN. Both fitted to 13 labelled
# films of that collection, a target and something else taken to be equally likely.
SLOPE, EVEN = 3.4, 18.0
# A signal beyond this only says that there is something; it does not make up for a lack of change.
CLEAR_SIGNAL = 20.0
# Specks below this score are not worth telling; a target that stays quiet for a moment is above it.
LEAST_SCORE = 0.02
# From this score on a speck is more likely a target than not.
BELIEVED_SCORE = 0.5
# A speck of which so much was not there at one of AGES_S has come from elsewhere as a whole; of a sign before which a
# bird flies it is a tenth.
ARRIVED = 0.5
# A change since long ago counts at most e to this times as much as the one since a moment ago: what has appeared and
# stands (a cloud uncovers the sun, a door opens) has changed once; a target goes on changing.
MOST_RISE = 1.5
# Least signal of what differs from all earlier pictures, and the one at which its score is 0.5: on the simulated field,
# foliage that sways is above the latter once in six frames, anywhere; a bird before it in nineteen of twenty.
LEAST_DIFFERENCE, EVEN_DIFFERENCE = 7.0, 12.0
# From so many of the AGES_S there must be a picture.
FEWEST_EARLIER = 3
# Pictures are compared as they are where the camera shifted by less between them [px].
STANDING_PX = 0.5
# What usually differs nearby, because a branch sways there, is no news: so many times its mean, with this weight of the
# newest picture and over so many pixels, is taken from the difference.
USUAL_TIMES, USUAL_GAIN, SWAY_PX = 3.0, 0.02, 5
# What the border cuts has half of its surroundings outside, so that a swaying twig looks as if it stood alone: it may
# carry on a track, not begin one.
MOST_CLIPPED_SCORE = 0.45
# Nothing is told before the history goes back so far [s].
WARM_UP_S = AGES_S[1]


class SpeckDetector:
    """Finds small targets by contrast and change, and says how sure it is of each."""

    def __init__(self) -> None:
        """Begin with no history."""
        self._camera = CameraMotion()
        self._history = History()
        self._usual: Image | None = None  # float32: the mean of what differs from earlier pictures
        self._shape: tuple[int, ...] | None = None
        self.mask: Image | None = None

    def detect(self, frame: Frame) -> list[Detection]:
        """Find what stands out and changes, the surest first.

        A frame that repeats the last one tells nothing, and nothing is found in it.

        Raises:
            CotargetError: the image's size changed.
        """
        check_size(self._shape, frame.image)
        self._shape = frame.image.shape
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        shift = self._camera.update(grey)
        if self._camera.jumped:
            self._history.clear()
        references = self._history.references(frame.t)
        fresh = self._history.add(frame.t, grey, shift)
        self.mask = np.zeros(grey.shape, np.uint8)
        if not fresh or self._history.span < WARM_UP_S:
            return []
        found: list[tuple[Speck, Detection]] = []
        arrived: list[tuple[Speck, Detection]] = []
        for speck in find_specks(grey, LEAST_SIGNAL, MOST_SPECKS):
            changes = [
                change(grey, speck.low, speck.size, speck.around, shift, self._history.noise, before)
                if before is not None
                else np.nan
                for before in references
            ]
            detection = box_detection(*speck.low, *speck.size, speck_score(speck.signal, changes), grey.shape)
            if detection.clipped:
                detection = replace(detection, score=min(detection.score, MOST_CLIPPED_SCORE))
            if detection.score >= LEAST_SCORE:
                found.append((speck, detection))
            if detection.score >= BELIEVED_SCORE and np.nanmax(changes) >= ARRIVED:
                arrived.append((speck, detection))
        differing = self._differing(grey, shift, references)
        found = _best_of(found + [_as_a_whole(pair, arrived) for pair in differing])
        for speck, detection in reversed(found):
            (x, y), (w, h) = speck.low, speck.size
            self.mask[y : y + h, x : x + w] = round(255 * detection.score)
        return [detection for _, detection in found]

    def _differing(
        self, grey: Image, shift: Array, references: list[tuple[Image, Array] | None]
    ) -> list[tuple[Speck, Detection]]:
        """Specks in what differs from all earlier pictures, where there are enough of them and the camera stood."""
        earlier = [kept for kept in references if kept is not None]
        if len(earlier) < FEWEST_EARLIER or any(np.abs(then - shift).max() > STANDING_PX for _, then in earlier):
            self._usual = None
            return []
        difference = functools.reduce(cv2.min, (cv2.absdiff(grey, picture) for picture, _ in earlier))
        if self._usual is None:
            self._usual = np.zeros(grey.shape, np.float32)
        nearby = cv2.dilate(self._usual, np.ones((SWAY_PX, SWAY_PX), np.uint8))
        cv2.accumulateWeighted(difference, self._usual, USUAL_GAIN)
        unusual = cv2.subtract(difference, nearby * np.float32(USUAL_TIMES), dtype=cv2.CV_8U)
        found = []
        for speck in find_specks(unusual, LEAST_DIFFERENCE, MOST_SPECKS):
            score = float(1 / (1 + (speck.signal / EVEN_DIFFERENCE) ** -SLOPE)) if speck.contrast > 0 else 0.0
            detection = box_detection(*speck.low, *speck.size, score, grey.shape)
            if detection.clipped:
                detection = replace(detection, score=min(score, MOST_CLIPPED_SCORE))
            if detection.score >= LEAST_SCORE:
                found.append((speck, detection))
        return found


def _as_a_whole(differing: tuple[Speck, Detection], arrived: list[tuple[Speck, Detection]]) -> tuple[Speck, Detection]:
    """What differs from earlier pictures, with the box of the speck that has arrived there and that it is a part of.

    Of a plain target that moves by less than its own length within AGES_S[0] only the front differs. Its contrast shows
    all of it. A thing that stands behind a target differs, but has not arrived.
    """
    speck, detection = differing
    around = [pair for pair in arrived if share(pair[0], speck)]
    if len(around) != 1 or math.prod(around[0][0].size) <= math.prod(speck.size):
        return differing
    whole, box = around[0]
    return whole, replace(box, score=max(box.score, detection.score))


def _best_of(found: list[tuple[Speck, Detection]]) -> list[tuple[Speck, Detection]]:
    """Of those that share a pixel the surest; the surest first."""
    kept: list[tuple[Speck, Detection]] = []
    for speck, detection in sorted(found, key=lambda pair: -pair[1].score):
        if not any(share(speck, other) for other, _ in kept):
            kept.append((speck, detection))
    return kept


def speck_score(signal: float, changes: list[float]) -> float:
    """How sure it is that a speck is a target and not a thing that stands, 0 to 1.

    Args:
        signal: its contrast in standard deviations of its surroundings.
        changes: what has changed of it since each of AGES_S, nan where that is not known.
    """
    ratios = [
        np.log((c + LEAST_CHANGE) / (usual + LEAST_CHANGE))
        for c, usual in zip(changes, STANDING_CHANGE, strict=True)
        if np.isfinite(c)
    ]
    if not ratios:
        return 0.0
    ratios = [min(ratio, ratios[0] + MOST_RISE) for ratio in ratios]
    return float(1 / (1 + np.exp(-SLOPE * (np.log(min(signal, CLEAR_SIGNAL) / EVEN) + np.mean(ratios)))))
