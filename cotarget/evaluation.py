"""Puts Steps and calibrations beside a simulated world's truth, which the pipeline cannot see.

What a pipeline may be told by the simulation's truth, where it shall not find out by itself.

Detections and finds without pictures, and a calibration without error: for runs that need neither rendering nor boards.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from numbers import Real

import cv2
import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import TARGETS, TargetConfig, split_name
from cotarget.detection import Detection
from cotarget.errors import ConfigError, UnreachableError
from cotarget.estimation.zoom_matching import GATE_SIGMAS, CloseupFinder, Expected, ZoomMeasurement
from cotarget.geometry import Array
from cotarget.metrics import WHOLLY_VISIBLE, Closeup, Row
from cotarget.pantilt import HeadGeometry
from cotarget.pipeline import Step
from cotarget.rig import Frame, Image, to_step
from cotarget.sim.targets.target import marker_of
from cotarget.sim.truth import Appearances, CameraName, Silhouette, Truth
from cotarget.sim.world import SimWorld
from cotarget.targeting import Method, Reach, aim
from cotarget.tracking.track import Track


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

    def update_fixed(self, frame: Frame, detection: Detection, mask: Image | None = None) -> None:
        """Nothing of it is remembered."""

    def sight_at(self, t: float) -> bool:
        """The truth is there at any time."""
        return True

    def find(self, frame: Frame, expected: Expected) -> ZoomMeasurement | None:
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
        return ZoomMeasurement(at, self.SIGMA_PX, np.full(2, self.SIGMA_PX), 1.0, 1.0, np.ptp(box, axis=0), frame.t)


# Pointing error is stated for targets at these depths, all over the wide view [m].
POINTING_DEPTHS = (4.0, 30.0)
# Whence the markers are that the simulated targets carry; sim_assets/make_assets.py draws them.
MARKERS = cv2.aruco.DICT_4X4_50
# A marker is sought in its target's true box, widened on each side by this part of the larger side ...
SEARCH_MARGIN = 0.25
SEARCH_PX = 8.0  # ... and by this, for what a moving target smears and the finder's windows need [px]
ENLARGED = 2  # times for the finder, which wants some eight pixels a cell of what can be read at four


def add_row(rows: list[Row], step: Step, truth: Truth, name: str, target: TargetConfig) -> None:
    """Append a Step's row, unless its zoom frame is the one that the last row is of.

    A zoom camera slower than the fixed one has no new frame in some Steps; those frames would count twice.

    Args:
        rows: of the Steps before, oldest first; grows by one where the zoom frame is new.
        step: of the loop.
        truth: of the simulated world.
        name: of the target that is followed.
        target: gives its dimension and the size wanted.
    """
    if not rows or step.zoom.t > rows[-1].t_s:
        rows.append(observe(step, truth, name, target))


def observe(step: Step, truth: Truth, name: str, target: TargetConfig) -> Row:
    """Put a Step beside the truth: its zoom frame, and its fixed frame, each at its own time.

    Args:
        step: of the loop.
        truth: of the simulated world.
        name: of the target that is followed.
        target: gives its dimension and the size wanted.
    """
    t, t_fixed = step.zoom.t, step.fixed.t
    outline = truth.silhouette(name, "zoom", t)
    seen = _closeup(truth, name, target, t, outline)
    wide_px = truth.pixel("fixed", truth.center(name, t_fixed), t_fixed)
    wide_outlines = {each: truth.silhouette(each, "fixed", t_fixed) for each in truth.targets}
    wide_outline = wide_outlines[name]
    marker = marker_of(name) if split_name(name)[0] in TARGETS else None  # a user's own carries none
    pan, tilt = truth.head_at(t)
    followed = step.target
    alone = followed is not None and not followed.missed and not followed.shared
    detected = followed.box.center_px if followed is not None and alone else (math.nan, math.nan)
    return Row(
        t_s=t,
        t_fixed_s=t_fixed,
        state=str(step.state),
        track=-1 if step.target is None else step.target.id,
        **dataclasses.asdict(seen),
        in_wide=wide_outline is not None and wide_outline.visible >= WHOLLY_VISIBLE,
        u_wide_px=float(wide_px[0]),
        v_wide_px=float(wide_px[1]),
        u_detected_px=float(detected[0]),
        v_detected_px=float(detected[1]),
        decoded=marker is not None and decodes(step.zoom, outline, marker),
        decoded_wide=marker is not None and decodes(step.fixed, wide_outline, marker),
        off_target=" ".join(str(i) for i in off_target(step.tracks, wide_outlines.values())),
        range_m=float(np.linalg.norm(truth.center(name, t) - truth.T_world_camera("zoom", t).translation)),
        depth_m=math.nan if step.aim is None else step.aim.depth,
        pan_commanded_deg=math.degrees(step.commanded[0]),
        tilt_commanded_deg=math.degrees(step.commanded[1]),
        focal_commanded_px=step.commanded[2],
        pan_deg=math.degrees(pan),
        tilt_deg=math.degrees(tilt),
        focal_px=truth.lens("zoom", t).focal_px[0],
        target=name,
        head_commands=step.head_commands,
        lens_commands=step.lens_commands,
        on_target=" ".join(f"{i}:{each}" for i, each in on_target(step.tracks, wide_outlines)),
    )


def closeup_of(truth: Appearances, name: str, target: TargetConfig, t: float) -> Closeup:
    """What the zoom camera shows of a target at a time.

    Args:
        truth: of the simulated world.
        name: of the target.
        target: gives its dimension and the size wanted.
        t: the zoom frame's [s].
    """
    return _closeup(truth, name, target, t, truth.silhouette(name, "zoom", t))


def _closeup(truth: Appearances, name: str, target: TargetConfig, t: float, outline: Silhouette | None) -> Closeup:
    """The same by the target's outline."""
    lens = truth.lens("zoom", t)
    u, v = truth.center_px(name, "zoom", t).tolist()
    size = math.nan
    if outline is not None:
        width, height = outline.size_px.tolist()
        sides = {"width": width, "height": height}
        size = sides[target.dimension] if target.dimension in sides else truth.largest_side_px(name, "zoom", t)
    longest = size * truth.longest_px / lens.focal_px[0]
    return Closeup(
        u_px=u,
        v_px=v,
        width_px=lens.size[0],
        height_px=lens.size[1],
        size_px=size,
        wanted_px=longest if longest < target.wanted_px else target.wanted_px,
        visible=0.0 if outline is None else outline.visible,
    )


def decodes(frame: Frame, outline: Silhouette | None, marker: int) -> bool:
    """Whether a target's marker can be read in a frame.

    It is sought about the target's true box only: that is quick, and a marker elsewhere is not this target's.

    Args:
        frame: of either camera.
        outline: the target's true one in it.
        marker: its number in MARKERS.
    """
    if outline is None or outline.visible <= 0:
        return False
    margin = SEARCH_PX + SEARCH_MARGIN * float(outline.size_px.max())
    size = np.array(frame.image.shape[1::-1])
    left, top = np.clip(np.floor(outline.low_px - margin), 0, size).astype(int)
    right, bottom = np.clip(np.ceil(outline.high_px + margin) + 1, 0, size).astype(int)
    grey = cv2.cvtColor(frame.image[top:bottom, left:right], cv2.COLOR_BGR2GRAY)
    grey = cv2.resize(grey, None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
    finder = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(MARKERS))
    _, found, _ = finder.detectMarkers(grey)
    return found is not None and marker in found


def off_target(tracks: Iterable[Track], outlines: Iterable[Silhouette | None]) -> list[int]:
    """Numbers of the confirmed tracks that are on no target.

    Args:
        tracks: at a fixed frame's time.
        outlines: the targets' true ones in it; a track is off a target when it is farther from the middle of its box
            than the box's larger side.
    """
    found = [outline for outline in outlines if outline is not None]
    return [track.id for track in tracks if track.confirmed and not any(_is_on(track, each) for each in found)]


def on_target(tracks: Iterable[Track], outlines: Mapping[str, Silhouette | None]) -> list[tuple[int, str]]:
    """Confirmed tracks that a frame shows alone, each with every target that it is on, the nearest first.

    One that coasts is where nobody looks, and one in a box with others is on them all.

    Args:
        tracks: at a fixed frame's time.
        outlines: the targets' true ones in it, by name.
    """
    seen = [track for track in tracks if track.confirmed and not track.missed and not track.shared]
    return [
        (track.id, name)
        for track in seen
        for _, name in sorted(
            (_off_px(track, outline), name)
            for name, outline in outlines.items()
            if outline is not None and _is_on(track, outline)
        )
    ]


def _is_on(track: Track, outline: Silhouette) -> bool:
    """Whether a track is no farther from the middle of an outline's box than the box's larger side."""
    return _off_px(track, outline) <= float(outline.size_px.max())


def _off_px(track: Track, outline: Silhouette) -> float:
    """From the middle of an outline's box to a track [px]."""
    return float(np.linalg.norm(track.center_px - (outline.low_px + outline.high_px) / 2))


def pointing_errors(
    calibration: Calibration,
    truth: Truth,
    reach: Reach,
    rng: np.random.Generator,
    count: int,
    method: Method = "exact",
    nominal_px: float | None = None,
    step: float = 0.0,
) -> Array:
    """Pointing error of a calibration: pixel and depth given exactly.

    Args:
        calibration: to be judged.
        truth: of the simulated world that it is of.
        reach: limits of head and lens.
        rng: draws the targets, evenly over the wide image and over depth.
        count: how many targets.
        method: the exact inverse, or the paper's shortcut.
        nominal_px: what the zoom camera's device calls the focal length [px]; the shortest by default.
        step: to which the head's angles are rounded [rad]; 0 for not at all, which is how the error is stated.

    Returns:
        Angle between the line of sight and the true target for each that can be reached [rad], (n,), n <= count.
    """
    lens = truth.fixed_lens
    errors = []
    for _ in range(count):
        pixel = rng.uniform(-0.5, np.array(lens.size) - 0.5)
        depth = rng.uniform(*POINTING_DEPTHS)
        x_world = truth.T_world_fixed.apply(np.append(lens.directions(pixel), 1.0) * depth)
        try:
            found = aim(calibration, calibration.fixed.ray(pixel) * depth, reach, nominal_px=nominal_px, method=method)
        except UnreachableError:
            continue
        pan, tilt = (to_step(angle, step) for angle in (found.pan, found.tilt))
        errors.append(truth.line_of_sight_miss(pan, tilt, found.nominal_px, x_world))
    return np.array(errors)
