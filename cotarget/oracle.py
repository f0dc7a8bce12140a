"""What a pipeline may be told by the simulation's truth, where it shall not find out by itself.

Detections and finds without pictures, and a calibration without error: for runs that need neither rendering nor boards.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from numbers import Real

import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.closeup import CloseupFinder, Expected, Found
from cotarget.closeup.registration import GATE_SIGMAS
from cotarget.config import TargetConfig
from cotarget.detection import Detection
from cotarget.errors import ConfigError
from cotarget.pantilt import HeadGeometry
from cotarget.rig import Frame, Image
from cotarget.sim.appearances import Appearances, CameraName
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


# Seeds so far apart are another's random numbers: what a detector and what a finder err by is independent.
FINDER_SEED = 1 << 33
# Gives the random numbers of a time [s]; they are to be drawn before those of another time are asked for.
NumbersAt = Callable[[float], np.random.Generator]


def seeded(seed: int) -> NumbersAt:
    """Random numbers of each time, by a generator of its own."""
    return lambda t: np.random.default_rng((seed, microseconds(t)))


def counted(seed: int) -> NumbersAt:
    """Others, ten times as quick: one generator that counts, and is told for each time where to begin."""
    bits = np.random.Philox(key=seed)
    rng, begin = np.random.Generator(bits), bits.state

    def at(t: float) -> np.random.Generator:
        begin["state"]["counter"][1] = microseconds(t)  # it counts in [0], and never so far
        bits.state = begin
        return rng

    return at


def microseconds(t: float) -> int:
    """A time [s] as a whole number, by which what is of that time is found again."""
    return round(t * 1e6)


@dataclass(frozen=True)
class TruthNoise:
    """How a detector errs.

    Attributes:
        center_px: standard deviation of the box's middle along each axis [px].
        size: standard deviation of its sides, relative.
        miss: part of the frames in which a target is not found.
        smallest_px: a target whose larger side is smaller is not found [px].

    Raises:
        ConfigError: a number is below 0, or misses are more than all.
    """

    center_px: float = 0.5
    size: float = 0.08
    miss: float = 0.05
    smallest_px: float = 4.0

    def __post_init__(self) -> None:
        """Refuse what is no noise."""
        for name, value in asdict(self).items():
            if not (isinstance(value, Real) and 0 <= float(value) < math.inf):
                raise ConfigError(f"noise.{name}: {value!r} is not a number from 0 on")
        if self.miss > 1:
            raise ConfigError(f"noise.miss: {self.miss!r} is not within 0 to 1")


class TruthDetector:
    """Finds the targets where they truly are in a camera, with noise; needs no picture and sees no clutter.

    What it finds in a frame depends on the seed and on the frame's time alone. What hides a target is not considered.
    """

    mask: Image | None = None

    def __init__(
        self,
        truth: Appearances,
        seed: int,
        noise: TruthNoise = TruthNoise(),
        names: Iterable[str] | None = None,
        numbers: Callable[[int], NumbersAt] = seeded,
        camera: CameraName = "fixed",
    ) -> None:
        """Begin.

        Args:
            truth: of the world whose frames are asked about.
            seed: of the noise.
            noise: how it errs.
            names: the targets to find; all by default.
            numbers: makes the random numbers of the seed.
            camera: whose frames are searched; the fixed one's by default.
        """
        self._camera = camera
        self._truth, self._noise, self._numbers_at = truth, noise, numbers(seed)
        self._names = tuple(truth.targets if names is None else names)

    def detect(self, frame: Frame) -> list[Detection]:
        """Find the targets, largest first."""
        noise, size = self._noise, self._truth.lens(self._camera, frame.t).size
        rng = self._numbers_at(frame.t)
        found = []
        for name in self._names:
            # Drawn whether the target is seen or not, so that none changes another's.
            draws, luck = rng.normal(size=4).tolist(), rng.random()
            box = self._truth.box(name, self._camera, frame.t)
            if box is None or luck < noise.miss:
                continue
            middle, sides, clipped = [], [], False
            corners = zip(*(corner.tolist() for corner in box), strict=True)
            # In floats: numpy takes several times as long for so few numbers.
            for (low, high), side, shift, scale in zip(corners, size, draws[:2], draws[2:], strict=True):
                begin, end = max(low, -0.5), min(high, side - 0.5)
                clipped |= low < begin or high > end
                middle.append((begin + end) / 2 + noise.center_px * shift)
                sides.append((end - begin) * max(1 + noise.size * scale, 0.1))
            if min(sides) <= 0 or max(sides) < noise.smallest_px:
                continue
            found.append(Detection(np.array(middle), np.array(sides), 1.0, clipped))
        return sorted(found, key=lambda detection: -math.prod(detection.size_px.tolist()))


class TruthFinder:
    """Finds a target in the zoom view where it truly is, with noise, if it is looked for there; needs no picture.

    To be given to the loop as `FollowSettings.finder`. What it finds is the middle of the body, as the real one means
    to. What hides a target is not considered.
    """

    SIGMA_PX = 1.0  # of the noise; the real finder assumes that lens, head and the times of frames leave as much

    def __init__(
        self,
        calibration: Calibration,
        target: TargetConfig,
        truth: Appearances,
        name: str,
        seed: int,
        missed: Callable[[float], bool] = lambda t: False,
    ) -> None:
        """Begin.

        Args:
            calibration: of the rig.
            target: what is told of the target.
            truth: of the world whose frames are asked about.
            name: of the target.
            seed: of the noise.
            missed: whether it is not found in a frame, by the time when that was exposed [s].
        """
        self._view = CloseupFinder(calibration, target).view
        self._truth, self._name, self._missed = truth, name, missed
        self._numbers_at = counted(seed + FINDER_SEED)

    def see_wide(self, frame: Frame, detection: Detection, mask: Image | None = None) -> None:
        """Nothing of it is remembered."""

    def sight_at(self, t: float) -> bool:
        """The truth is there at any time."""
        return True

    def find(self, frame: Frame, expected: Expected) -> Found | None:
        """Find the target; None where its middle is not in the frame, or not where it is expected."""
        view, box = self._view(expected), self._truth.box(self._name, "zoom", frame.t)
        if view is None or box is None or self._missed(frame.t):
            return None
        at = self._truth.center_px(self._name, "zoom", frame.t) + self.SIGMA_PX * self._numbers_at(frame.t).normal(
            size=2
        )
        off = at - view.center_px
        inside = (at >= 0).all() and (at <= np.array(frame.image.shape[1::-1]) - 1).all()
        if not inside or off @ np.linalg.solve(view.covariance, off) > GATE_SIGMAS**2:
            return None
        return Found(at, self.SIGMA_PX, np.full(2, self.SIGMA_PX), 1.0, 1.0, np.ptp(box, axis=0), frame.t)
