"""Small targets, moving or hovering: what stands out from its surroundings and changes, in a camera that may shake.

Movement alone cannot find a bird that hovers, and contrast alone finds every sign and chimney too. Here both must
come together, in one number: the contrast in standard deviations of the surroundings, times the part of it that
was not there before, in units of what the air, the codec and the camera's shake change of a thing that stands.
"""

from dataclasses import replace

import cv2
import numpy as np

from cotarget.detection.base import Detection, box_detection, check_size
from cotarget.detection.cameramotion import CameraMotion
from cotarget.detection.change import AGES_S, History, change
from cotarget.detection.contrast import Speck, find_specks
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
# A change since long ago counts at most e to this times as much as the one since a moment ago: what has appeared and
# stands (a cloud uncovers the sun, a door opens) has changed once; a target goes on changing.
MOST_RISE = 1.5
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
        found = []
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
                found.append(detection)
                self._paint(speck, detection.score)
        found.sort(key=lambda detection: -detection.score)
        return found

    def _paint(self, speck: Speck, score: float) -> None:
        """Paint a speck's box into the mask, as bright as its score."""
        (x, y), (w, h) = speck.low, speck.size
        assert self.mask is not None
        self.mask[y : y + h, x : x + w] = round(255 * score)


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
