"""Evaluate Steps and calibrations by the simulation's ground truth, which the pipeline cannot see.

`observe` and `pointing_errors` evaluate. `TruthDetector` and `true_calibration` replace detector and calibration
by the truth with noise, for runs that need neither rendering nor boards.
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
from cotarget.config import TargetProfile, split_name
from cotarget.detection import Detections
from cotarget.errors import ConfigError, UnreachableError
from cotarget.geometry import Array
from cotarget.metrics import WHOLLY_VISIBLE, Closeup, Row
from cotarget.pantilt import HeadGeometry
from cotarget.pipeline import Step
from cotarget.rig import Detection, Frame, to_step
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.sim.targets import KINDS
from cotarget.sim.targets.target import marker_of
from cotarget.sim.truth import Appearances, CameraName, Silhouette, Truth
from cotarget.sim.world import SimWorld
from cotarget.targeting import Method, Reach, aim
from cotarget.tracking.track import Track


def true_calibration(world: SimWorld, stops: int = 8) -> Calibration:
    """Make the calibration of a world's rig without any error, with zoom samples even in the logarithm."""
    sim, truth = world.config.sim, world.truth()
    nominal = tuple(float(f) for f in np.geomspace(*truth.focal_range, stops))
    lenses = [truth.zoom_lens_for(f) for f in nominal]
    fixed, *zooms = (
        Intrinsics(lens.size, lens.focal_px, lens.center_px, lens.distortion) for lens in (truth.fixed_lens, *lenses)
    )
    real = sim.effects.axes
    return Calibration(
        fixed=FixedCamera(fixed),
        zoom_head=ZoomHead(
            ZoomLens(nominal, tuple(zooms), tuple(lens.pupil for lens in lenses)),
            sim.T_zoom0_fixed,
            sim.T_head_zoom,
            HeadGeometry(sim.head.axis_offset_mm / 1000 * real, np.radians(sim.head.squareness_deg) * real),
        ),
        pitch_mm=sim.zoom.pitch_mm,
    )


# Gives the random numbers of a time [s]; draw them before those of another time are requested.
NumbersAt = Callable[[float], np.random.Generator]


def counted(seed: int) -> NumbersAt:
    """Make random numbers that depend on the seed and the time alone, by one counter-based generator."""
    bits = np.random.Philox(key=seed)
    rng, begin = np.random.Generator(bits), bits.state

    def at(t: float) -> np.random.Generator:
        begin["state"]["counter"][1] = microseconds(t)  # the generator counts in [0], which never overflows here
        bits.state = begin
        return rng

    return at


def microseconds(t: float) -> int:
    """Round a time [s] to whole microseconds, as a key."""
    return round(t * 1e6)


@dataclass(frozen=True)
class TruthNoise:
    """Errors of a simulated detector.

    Attributes:
        center_px: standard deviation of the box's centre along each axis [px].
        size: relative standard deviation of the box's sides.
        miss: part of the frames in which a target is not detected.
        smallest_px: least larger side of a detected target [px].

    Raises:
        ConfigError: a number is below 0, or `miss` is above 1.
    """

    center_px: float = 0.5
    size: float = 0.08
    miss: float = 0.05
    smallest_px: float = 4.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (isinstance(value, Real) and 0 <= float(value) < math.inf):
                raise ConfigError(f"noise.{name}: {value!r} is not a number from 0 on")
        if self.miss > 1:
            raise ConfigError(f"noise.miss: {self.miss!r} is not within 0 to 1")


class TruthDetector:
    """Detect the targets by ground truth with noise, without an image and without clutter.

    The detections of a frame depend on the seed and the frame's time alone. Occlusion is not considered.
    """

    def __init__(
        self,
        truth: Appearances,
        seed: int,
        noise: TruthNoise = TruthNoise(),
        camera: CameraName = "fixed",
    ) -> None:
        """Create a detector of all targets in the frames of one camera."""
        self._camera = camera
        self._truth, self._noise, self._numbers_at = truth, noise, counted(seed)
        self._names = tuple(truth.targets)

    def detect(self, frame: Frame, held: object = ()) -> Detections:
        """Detect the targets, largest first."""
        noise, size = self._noise, self._truth.lens(self._camera, frame.t).size
        rng = self._numbers_at(frame.t)
        found = []
        for name in self._names:
            # Drawn for every target, seen or not, so that none changes another's noise.
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
        return Detections(sorted(found, key=lambda detection: -math.prod(detection.size_px.tolist())))


# Depths of the targets for which pointing errors are stated, over the whole fixed image [m].
POINTING_DEPTHS = (4.0, 30.0)
# Dictionary of the simulated targets' markers; sim_assets/make_assets.py draws them.
MARKERS = cv2.aruco.DICT_4X4_50
# A marker is searched in its target's true box, widened on each side by a part of the larger side and some pixels, for
# motion blur and the windows of the marker detector.
SEARCH_MARGIN, SEARCH_PX = 0.25, 8.0
ENLARGED = 2  # magnification for the marker detector, which needs some eight pixels per cell where four are readable


def add_row(rows: list[Row], step: Step, truth: Truth, name: str, target: TargetProfile) -> None:
    """Append a Step's row, unless its zoom frame has a row already.

    A zoom camera slower than the fixed one has no new frame in some Steps; those frames would count twice. The other
    arguments are those of `observe`.
    """
    if not rows or step.zoom.t > rows[-1].t_s:
        rows.append(observe(step, truth, name, target))


def observe(step: Step, truth: Truth, name: str, target: TargetProfile) -> Row:
    """Compare a Step with the ground truth: its zoom frame and its fixed frame, each at its own time.

    Args:
        step: step of the pipeline.
        truth: ground truth of the simulated world.
        name: name of the followed target.
        target: target profile, for the dimension and the wanted size.
    """
    t, t_fixed = step.zoom.t, step.fixed.t
    outline = truth.silhouette(name, "zoom", t)
    seen = _closeup(truth, name, target, t, outline)
    wide_px = truth.pixel("fixed", truth.center(name, t_fixed), t_fixed)
    wide_outlines = {each: truth.silhouette(each, "fixed", t_fixed) for each in truth.targets}
    wide_outline = wide_outlines[name]
    marker = marker_of(name) if split_name(name)[0] in KINDS else None  # a user's own target has no marker
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


def closeup_of(truth: Appearances, name: str, target: TargetProfile, t: float) -> Closeup:
    """Return the ground truth of a target in the zoom camera at a time [s]; arguments as for `observe`."""
    return _closeup(truth, name, target, t, truth.silhouette(name, "zoom", t))


def _closeup(truth: Appearances, name: str, target: TargetProfile, t: float, outline: Silhouette | None) -> Closeup:
    """Compute the close-up by the target's outline in the zoom image, which is None behind the camera."""
    lens = truth.lens("zoom", t)
    u, v = truth.center_px(name, "zoom", t).tolist()
    size = math.nan
    if outline is not None:
        width, height = outline.upright_px.tolist()
        if target.largest_over_time:
            size = truth.largest_side_px(name, "zoom", t)
        else:
            size = height if target.is_vertical() else width
    longest = size * truth.longest_px / lens.focal_px[0]
    return Closeup(
        u_px=u,
        v_px=v,
        width_px=lens.size[0],
        height_px=lens.size[1],
        size_px=size,
        wanted_px=longest if longest < target.wanted_px else target.wanted_px,
        visible=0.0 if outline is None else outline.visible,
        hidden=outline is not None and outline.unhidden < WHOLLY_VISIBLE,
    )


def decodes(frame: Frame, outline: Silhouette | None, marker: int) -> bool:
    """Return whether a target's marker, an id of `MARKERS`, can be read in a frame.

    Only the surroundings of the true outline are searched: that is fast, and a marker outside is another target's.
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
    """List the ids of reported tracks that are on no target, by the true outlines in the fixed frame."""
    found = [outline for outline in outlines if outline is not None]
    return [track.id for track in tracks if track.reported and not any(_is_on(track, each) for each in found)]


def on_target(tracks: Iterable[Track], outlines: Mapping[str, Silhouette | None]) -> list[tuple[int, str]]:
    """List confirmed tracks with an unshared detection, each with every target that it is on, the nearest first.

    A coasting track is no evidence, and one that shares a box with others would be on all of them.
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
    """Return whether a track is at most the outline's larger side from the centre of its box."""
    return _off_px(track, outline) <= float(outline.size_px.max())


def _off_px(track: Track, outline: Silhouette) -> float:
    """Return the distance of a track from the centre of an outline's box [px]."""
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
    """Compute pointing errors of a calibration, for exact pixels and depths.

    Args:
        calibration: calibration to evaluate.
        truth: ground truth of the simulated world.
        reach: limits of head and lens.
        rng: draws the targets, uniform over the fixed image and over depth.
        count: number of targets.
        method: the exact inverse, or the paper's shortcut.
        nominal_px: nominal focal length of the zoom camera [px]; the shortest by default.
        step: step to which the head's angles are rounded [rad]; 0 for none, as pointing errors are defined.

    Returns:
        Angle between the line of sight and the true target, for each reachable target [rad], (n,), n <= count.
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
