"""A zoom camera's detector from the simulation's truth, which misses more while head or lens move the picture."""

from dataclasses import replace

import numpy as np

from cotarget.detection import Detection
from cotarget.evaluation import TruthDetector, TruthNoise, counted
from cotarget.rig import Frame, Image
from cotarget.sim.truth import Outlines, Truth

NOISE = TruthNoise()
APART = 1 << 32  # of seeds: other numbers than the detectors'
MOVED_PX, MOVED_S = 1.0, 0.02  # the picture moves that shifts so far within so long before and after its exposure


class Shaken:
    """Finds the target where it truly is, with noise, and misses it more while the picture moves."""

    mask: Image | None = None

    def __init__(self, outlines: Outlines, truth: Truth, seed: int, miss: float) -> None:
        """Begin.

        Args:
            outlines: of the world.
            truth: of its head and lens.
            seed: of the noise.
            miss: part of the frames in which it finds nothing while the picture moves.
        """
        self._still = TruthDetector(outlines, seed, NOISE, numbers=counted, camera="zoom")
        self._moving = TruthDetector(outlines, seed, replace(NOISE, miss=miss), numbers=counted, camera="zoom")
        self._truth, self._miss, self._numbers_at = truth, miss, counted(seed + APART)

    def detect(self, frame: Frame) -> list[Detection]:
        """Find the target."""
        return (self._moving if self.moves(frame.t) else self._still).detect(frame)

    def misses(self, t: float) -> bool:
        """Whether a target is missed at a time [s], for who finds it otherwise."""
        return self._numbers_at(t).random() < (self._miss if self.moves(t) else NOISE.miss)

    def moves(self, t: float) -> bool:
        """Whether head or lens shift the picture at a time [s]."""
        width = self._truth.lens("zoom", t).size[0]
        before, after = max(t - MOVED_S, 0.0), t + MOVED_S
        focal_px = self._truth.lens("zoom", t).focal_px[0]
        turned = np.subtract(self._truth.head_at(after), self._truth.head_at(before))
        grown = abs(self._truth.nominal_at(after) / self._truth.nominal_at(before) - 1)
        return bool(focal_px * np.abs(turned).max() > MOVED_PX or width / 2 * grown > MOVED_PX)
