"""Ground-truth detector for the zoom camera that misses more detections while head or lens move the image."""

from dataclasses import replace

import numpy as np

from cotarget.detection import Detection
from cotarget.evaluation import TruthDetector, TruthNoise, counted
from cotarget.rig import Frame, Image
from cotarget.sim.truth import Outlines, Truth

NOISE = TruthNoise()
APART = 1 << 32  # offset of the seed from the detectors' own
MOVED_PX, MOVED_S = 1.0, 0.02  # least shift of a moving image, within this time before and after its exposure


class Shaken:
    """Detector with true positions and noise, and more misses while the image moves."""

    mask: Image | None = None

    def __init__(self, outlines: Outlines, truth: Truth, seed: int, miss: float) -> None:
        """Prepare the detectors at rest and in motion.

        Args:
            outlines: targets' outlines in the world.
            truth: ground truth of head and lens.
            seed: seed of the noise.
            miss: fraction of frames without a detection while the image moves.
        """
        self._still = TruthDetector(outlines, seed, NOISE, camera="zoom")
        self._moving = TruthDetector(outlines, seed, replace(NOISE, miss=miss), camera="zoom")
        self._truth, self._miss, self._numbers_at = truth, miss, counted(seed + APART)

    def detect(self, frame: Frame) -> list[Detection]:
        """Detect the target."""
        return (self._moving if self.moves(frame.t) else self._still).detect(frame)

    def misses(self, t: float) -> bool:
        """Decide whether the target is missed at a time [s], for another detector."""
        return self._numbers_at(t).random() < (self._miss if self.moves(t) else NOISE.miss)

    def moves(self, t: float) -> bool:
        """Check whether head or lens move the image at a time [s]."""
        width = self._truth.lens("zoom", t).size[0]
        before, after = max(t - MOVED_S, 0.0), t + MOVED_S
        focal_px = self._truth.lens("zoom", t).focal_px[0]
        turned = np.subtract(self._truth.head_at(after), self._truth.head_at(before))
        grown = abs(self._truth.nominal_at(after) / self._truth.nominal_at(before) - 1)
        return bool(focal_px * np.abs(turned).max() > MOVED_PX or width / 2 * grown > MOVED_PX)
