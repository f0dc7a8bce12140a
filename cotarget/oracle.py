"""What a pipeline may be told by the simulation's truth, where it shall not find out by itself.

Detections without pictures, and a calibration without error: for runs that need neither rendering nor boards.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.detection import Detection
from cotarget.geometry import Array
from cotarget.pantilt import HeadGeometry
from cotarget.rig import Frame, Image
from cotarget.sim.lens import TrueLens
from cotarget.sim.targets import Target
from cotarget.sim.truth import CameraName
from cotarget.sim.world import SimWorld


def true_calibration(world: SimWorld, stops: int = 8) -> Calibration:
    """What a calibration of a world's rig without any error would be, at focal lengths even in the logarithm."""
    sim, truth = world.config.sim, world.truth()
    nominal = tuple(float(f) for f in np.geomspace(*truth.focal_range, stops))
    lenses = [truth.zoom_lens_for(f) for f in nominal]
    fixed, *zooms = (
        Intrinsics(lens.size, lens.focal_px, lens.center_px, lens.distortion) for lens in (truth.fixed_lens, *lenses)
    )
    real = sim.effects.axes
    return Calibration(
        fixed=fixed,
        zoom=ZoomLens(nominal, tuple(zooms), tuple(lens.pupil for lens in lenses)),
        T_zoom0_fixed=sim.T_zoom0_fixed,
        T_head_zoom=sim.T_head_zoom,
        head=HeadGeometry(sim.head.axis_offset_mm / 1000 * real, np.radians(sim.head.squareness_deg) * real),
        pitch_mm=sim.zoom.pitch_mm,
    )


class Boxes(Protocol):
    """Tells where the targets of a world appear; `Truth` does."""

    @property
    def targets(self) -> Mapping[str, Target]:
        """By name."""

    @property
    def fixed_lens(self) -> TrueLens:
        """The wide camera's optics."""

    def box(self, name: str, camera: CameraName, t: float) -> tuple[Array, Array] | None:
        """Top-left and bottom-right corner of a target's outline at a time [s], (2,) [px] each; None behind."""


@dataclass(frozen=True)
class TruthNoise:
    """How a detector errs.

    Attributes:
        center_px: standard deviation of the box's middle along each axis [px].
        size: standard deviation of its sides, relative.
        miss: part of the frames in which a target is not found.
        smallest_px: a target whose larger side is smaller is not found [px].
    """

    center_px: float = 0.5
    size: float = 0.08
    miss: float = 0.05
    smallest_px: float = 4.0


class TruthDetector:
    """Finds the targets where they truly are in the fixed camera, with noise; needs no picture and sees no clutter.

    What it finds in a frame depends on the seed and on the frame's time alone. What hides a target is not considered.
    """

    mask: Image | None = None

    def __init__(
        self, truth: Boxes, seed: int, noise: TruthNoise = TruthNoise(), names: Iterable[str] | None = None
    ) -> None:
        """Begin.

        Args:
            truth: of the world whose frames are asked about.
            seed: of the noise.
            noise: how it errs.
            names: the targets to find; all by default.
        """
        self._truth, self._seed, self._noise = truth, seed, noise
        self._names = tuple(truth.targets if names is None else names)

    def detect(self, frame: Frame) -> list[Detection]:
        """Find the targets, largest first."""
        noise, size = self._noise, np.array(self._truth.fixed_lens.size)
        rng = np.random.default_rng((self._seed, round(frame.t * 1e6)))
        found = []
        for name in self._names:
            # Drawn whether the target is seen or not, so that none changes another's.
            shift, scale, luck = rng.normal(size=2), rng.normal(size=2), rng.random()
            box = self._truth.box(name, "fixed", frame.t)
            if box is None or luck < noise.miss:
                continue
            clipped = bool((box[0] < -0.5).any() or (box[1] > size - 0.5).any())
            low, high = box[0].clip(-0.5, size - 0.5), box[1].clip(-0.5, size - 0.5)
            sides = (high - low) * np.maximum(1 + noise.size * scale, 0.1)
            if (high <= low).any() or sides.max() < noise.smallest_px:
                continue
            found.append(Detection((low + high) / 2 + noise.center_px * shift, sides, 1.0, clipped))
        return sorted(found, key=lambda detection: -float(np.prod(detection.size_px)))
