"""Single pan-tilt-zoom camera that finds, follows and finds again its target, after Cai and Dinh.

It scans a given field at the shortest focal length until it detects something. The pipeline's tracker confirms a
detection by the same rule as for the pair's fixed camera; until then the camera waits, or turns back to a detection
made while it moved. Then it centres the target, leads it by a constant velocity, and zooms in as far as the uncertainty
allows. A target out of sight is predicted for a moment, then searched around the prediction at the shortest focal
length, then scanned for everywhere. During the search any detection is accepted at once. Head and lens use the pair's
controllers and delays. Their state at a frame's exposure is taken from ground truth, which makes this camera better
than a real one.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.config import TargetProfile
from cotarget.control.controller import NO_CHANGE
from cotarget.control.head import HeadController
from cotarget.control.zoom import ZoomController
from cotarget.detection import Detector
from cotarget.errors import UnreachableError
from cotarget.estimation import Appearance, filter_settings
from cotarget.geometry import Array
from cotarget.pantilt import base_head, nearest, solve
from cotarget.rig import Angles, Detection, Frame, Rig
from cotarget.sim.truth import Truth
from cotarget.tracking.track import AxisFilter, tracking_settings
from cotarget.tracking.tracker import Tracker

COAST_S = 0.6  # longest prediction of a target out of sight [s]
SIZE_SIGMA = 0.1  # relative standard deviation of a size, for the zoom controller
FIRST_INTERVAL_S = 0.04  # frame interval before the second frame [s]
OVERLAP = 0.1  # overlap of neighbouring views of a scan
RING = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))  # search pattern in half views
SEARCH_S = 3.0  # longest search around the prediction [s]
SIZES_S = 0.5  # window of the size estimate, a wing beat or a step [s]
# Duration of a manoeuvre as white acceleration [s], by the target's motion model. The choice is in docs/design-notes.md
# (Experiments). A book that is carried accelerates more than its motion model says.
LASTS_S = {"standing": 2.0, "walking": 0.25, "flying": 0.1}
CLIPPED = 9.0  # factor on the variance of a centre that the image's border cuts


@dataclass(frozen=True)
class Sighting:
    """Detection as directions."""

    t: float  # time [s]
    pan: float  # pan that centres it [rad]
    tilt: float  # tilt that centres it [rad]
    sides: tuple[float, float]  # width and height over the focal length
    clipped: bool  # whether the image's border cuts it


class Course:
    """Target's pan and tilt, each filtered with constant velocity."""

    def __init__(self, target: TargetProfile, noise_px: float) -> None:
        """Start without a sighting; detections' centres have this noise."""
        self._target, self._noise_px = target, noise_px
        self._settings = filter_settings(target)
        self._axes: list[AxisFilter] = []
        self._sizes: list[Sighting] = []
        self.seen_t = -math.inf
        self.whole = False  # whether the last sighting was not clipped

    @property
    def known(self) -> bool:
        """Whether the target was ever sighted."""
        return bool(self._axes)

    @property
    def sides(self) -> tuple[float, float]:
        """Width and height as tangents: the largest of the window for wings, else the median."""
        sides = np.array([each.sides for each in self._sizes])
        w, h = sides.max(axis=0) if self._target.largest_over_time else np.median(sides, axis=0)
        return float(w), float(h)

    @property
    def size(self) -> float:
        """The dimension with a known size, as a tangent."""
        w, h = self.sides
        return self._target.length(w, h)

    @property
    def range(self) -> float:
        """Distance from the known size [m]."""
        return self._target.size / self.size

    def saw(self, seen: Sighting, focal_px: float) -> None:
        """Update with a sighting; one after a long gap restarts the filter."""
        self.whole = not seen.clipped
        if self.whole:
            past = [each for each in self._sizes if each.t >= seen.t - SIZES_S and not each.clipped]
            self._sizes = [*past, seen]
        else:  # the visible part is a lower limit of the size
            w, h = seen.sides if not self._sizes else map(max, zip(seen.sides, self.sides, strict=True))
            self._sizes = [replace(seen, sides=(w, h))]
        motion, distance = self._settings.motion, self.range
        by_size = self._settings.noise_of_size * max(seen.sides)
        variance = (self._noise_px / focal_px) ** 2 + by_size**2 * (CLIPPED if seen.clipped else 1.0)
        places = (seen.pan, seen.tilt)
        if not self.known or seen.t - self.seen_t > SEARCH_S:
            self._axes = [AxisFilter(place, variance, (motion.speed / distance) ** 2) for place in places]
        else:
            for axis, place in zip(self._axes, places, strict=True):
                axis.predict(seen.t - self.seen_t, self._noise(distance))
                axis.correct(place, variance)
        self.seen_t = seen.t

    def at(self, t: float) -> tuple[Angles, Angles]:
        """Predict pan and tilt at a time, with their variances."""
        dt = t - self.seen_t
        spread = [axis.predicted_covariance(dt, self._noise(self.range))[0] for axis in self._axes]
        (pan, tilt) = (axis.position + dt * axis.velocity for axis in self._axes)
        return (pan, tilt), (spread[0], spread[1])

    @property
    def rates(self) -> Angles:
        """Rates of pan and tilt [rad/s]."""
        pan, tilt = self._axes
        return pan.velocity, tilt.velocity

    def _noise(self, distance: float) -> float:
        """Give the white acceleration of an angle [rad^2/s^3] that stands for manoeuvres at constant velocity."""
        return LASTS_S[self._target.motion] * (self._settings.motion.acceleration / distance) ** 2


class LoneCamera:
    """Control of one pan-tilt-zoom camera after one target.

    Attributes:
        mode: current behaviour: "scanning", "waiting", "following" or "searching".
    """

    def __init__(
        self,
        rig: Rig,
        truth: Truth,
        calibration: Calibration,
        target: TargetProfile,
        detector: Detector,
        delay_s: float,
        noise_px: float,
        field: Sequence[Angles],
    ) -> None:
        """Start a scan of the field's poses (see `scan_of`) at the one that is nearest to the current pose.

        The rig's fixed camera is not used; ground truth gives head and lens at a frame's time. A command takes
        ``delay_s`` until motion. For ``noise_px`` see `Course`.
        """
        self._rig, self._truth, self._calibration, self._target = rig, truth, calibration, target
        self._detector, self._delay_s, self._field = detector, delay_s, list(field)
        self._zoom = calibration.zoom_head.lens
        self._shortest, longest = (self._zoom.at(f).focal_px[0] for f in rig.zoom.focal_range)
        self._policy = ZoomController((self._shortest, longest), rig.zoom.size)
        self._head_controller = HeadController(rig.head.limits)
        self._course, self._tracker = Course(target, noise_px), Tracker(tracking_settings(target))
        self._focal = rig.zoom.zoom(rig.zoom.focal_range[0])
        self._next, self._round, self._set_out = 0, self._field, -math.inf
        self.mode = ""

    def run(self, seconds: float) -> Iterator[Frame]:
        """Run for some seconds; yield each frame of the zoom camera after it was processed."""
        end, last = self._rig.clock.now() + seconds, None
        while self._rig.clock.now() < end:
            frame = self._rig.zoom.read(newer_than=last)
            interval = FIRST_INTERVAL_S if last is None else frame.t - last
            last = frame.t
            found = [self._sighting(frame.t, each) for each in self._detector.detect(frame).boxes]
            doubted = self._take(frame.t, found)
            unseen = frame.t - self._course.seen_t
            if self._course.known and unseen <= COAST_S:
                mode = "following"
                self._follow(interval)
            elif doubted is not None:
                mode = "waiting"
                if self._rig.head.state().moving and self.mode != mode:
                    self._go((doubted.pan, doubted.tilt))
            else:
                mode = "searching" if unseen <= SEARCH_S else "scanning"
                self._look_around(mode, frame.t)
            self.mode = mode
            yield frame

    def _take(self, t: float, found: Sequence[tuple[Sighting, float]]) -> Sighting | None:
        """Process a frame's sightings; give the one that is not confirmed, if there is one."""
        boxes = [Detection(*self._at_shortest(seen), 1.0, seen.clipped) for seen, _ in found]
        tracks = self._tracker.update(boxes, t)
        if not found:
            return None
        believed = any(track.confirmed and not track.missed for track in tracks)
        if believed or t - self._course.seen_t <= SEARCH_S:
            self._course.saw(*found[0])
            return None
        return found[0][0]

    def _at_shortest(self, seen: Sighting) -> tuple[Array, Array]:
        """Give centre and sides in an unbounded view at the shortest focal length, (2,) [px] each."""
        return self._shortest * np.array([seen.pan, -seen.tilt]), self._shortest * np.array(seen.sides)

    def _sighting(self, t: float, found: Detection) -> tuple[Sighting, float]:
        """Convert a detection to directions; also give the focal length at its time [px]."""
        (pan, tilt), nominal = self._truth.head_at(t), self._truth.nominal_at(t)
        lens = self._zoom.at(nominal)
        (fx, fy), (w, h) = lens.focal_px, found.size_px.tolist()
        sides = (w / fx, h / fy)
        distance = self._course.range if self._course.known else self._target.size / max(sides)
        ray = lens.ray(found.center_px)
        hand = self._calibration.zoom_head.hand_eye(nominal)
        x_base = (base_head(pan, tilt, self._calibration.zoom_head.axes) * hand).apply(
            ray / np.linalg.norm(ray) * distance
        )
        limits = self._rig.head.limits
        ways = solve(
            x_base,
            self._calibration.zoom_head.hand_eye(),
            self._calibration.zoom_head.axes,
            lens.ray(lens.image_center_px),
            pupil=self._zoom.pupil_at(nominal),
        )
        try:
            pointing = nearest(ways, limits.pan.range, limits.tilt.range, (pan, tilt), self._calibration.zoom_head.axes)
            pan, tilt = float(pointing.pan), float(pointing.tilt)
        except UnreachableError:  # beyond the head's limits: clip
            pan, tilt = limits.clip(pan, tilt)
        return Sighting(t, pan, tilt, sides, found.clipped), fx

    def _follow(self, interval: float) -> None:
        """Command the head towards the target, and the focal length that keeps it in view."""
        course, rig = self._course, self._rig
        now = rig.clock.now()
        effect = now + self._delay_s
        self._head_controller.head.add_report(rig.head.state())
        wanted, _ = course.at(effect)
        true_px = self._zoom.at(self._focal).focal_px[0]
        field = rig.zoom.size[0] / true_px
        lead_s = effect - course.seen_t
        lead = lead_s * course.rates[0], lead_s * course.rates[1]
        command = self._head_controller.decide(effect, interval, wanted, course.rates, field, lead, lead_s)
        if command is not None:
            rig.head.move(command.pan, command.tilt, command.speed)
        exposed = effect + interval
        (pan, tilt), (pan_variance, tilt_variance) = course.at(exposed)
        (head_pan, _), (head_tilt, _) = self._head_controller.head.motion_at(exposed)
        scale = math.cos(tilt)
        seen = Appearance(  # in tangents: at a focal length of 1
            offset_px=np.array([(pan - head_pan) * scale, head_tilt - tilt]),
            covariance=np.diag([pan_variance * scale**2, tilt_variance]),
            size_px=1.0,
            size_sigma=SIZE_SIGMA,
            focal_px=np.ones(2),
            sides=course.sides,
        )
        now_px = self._zoom.at(rig.zoom.state().focal_px).focal_px[0]
        wanted_px = self._target.wanted_px / course.size
        if not course.whole:  # do not zoom in before the whole target was seen
            wanted_px = min(wanted_px, true_px)
        focal_px, _ = self._policy.choose(seen, wanted_px, true_px, now, now_px)
        if abs(focal_px / true_px - 1) > NO_CHANGE:
            self._focal = rig.zoom.zoom(self._zoom.nominal_for(focal_px))

    def _look_around(self, mode: str, frame_t: float) -> None:
        """At the shortest focal length, go to the next pose once a frame from the current one has shown nothing."""
        rig = self._rig
        shortest = rig.zoom.focal_range[0]
        if self._focal > shortest:
            self._focal = rig.zoom.zoom(shortest)
        if mode != self.mode:
            self._round = self._field if mode == "scanning" else self._about(frame_t)
            self._next, self._set_out = 0, -math.inf
            if mode == "scanning":
                away = np.subtract(self._round, (rig.head.state().pan, rig.head.state().tilt))
                self._next = int(np.argmin(np.abs(away).max(axis=1)))
            self._go(self._round[self._next])
            return
        now, state = rig.clock.now(), rig.head.state()
        if now <= self._set_out + self._delay_s or state.moving:
            self._arrived = math.inf
        elif math.isinf(self._arrived):
            self._arrived = state.t
        if frame_t > self._arrived:
            self._next = (self._next + 1) % len(self._round)
            self._go(self._round[self._next])

    def _go(self, pose: Angles) -> None:
        """Move the head to a pose at full speed."""
        self._rig.head.move(*pose)
        self._set_out, self._arrived = self._rig.clock.now(), math.inf

    def _about(self, t: float) -> list[Angles]:
        """Give poses around the predicted target, half a view apart."""
        (pan, tilt), _ = self._course.at(t)
        width, height = self._rig.zoom.size
        steps = math.atan(width / 2 / self._shortest), math.atan(height / 2 / self._shortest)
        limits = self._rig.head.limits
        return [limits.clip(pan + across * steps[0], tilt + down * steps[1]) for across, down in RING]


def scan_of(rig: Rig, calibration: Calibration) -> list[Angles]:
    """Give poses [rad] whose overlapping views at the shortest focal length cover the fixed camera's field, by rows."""
    width, height = rig.zoom.size
    fx, fy = calibration.zoom_head.lens.stops[0].focal_px
    views = (1 - OVERLAP) * 2 * math.atan(width / 2 / fx), (1 - OVERLAP) * 2 * math.atan(height / 2 / fy)
    fixed = calibration.fixed.lens
    width, height = fixed.size
    edges = fixed.ray(
        np.array([[0.0, height / 2], [width - 1.0, height / 2], [width / 2, 0.0], [width / 2, height - 1]])
    )
    axis_base = calibration.zoom_head.T_base_fixed.rotation.apply(edges)
    pans, tilts = np.arctan2(axis_base[:2, 0], axis_base[:2, 2]), np.arctan2(-axis_base[2:, 1], axis_base[2:, 2])
    stops = []
    for angles, view, axis in zip((pans, tilts), views, rig.head.limits.axes, strict=True):
        begin, end = float(angles.min()), float(angles.max())
        count = max(1, math.ceil((end - begin) / view))
        middle, step = (begin + end) / 2, (end - begin) / count
        stops.append([axis.clip(middle + (i - (count - 1) / 2) * step) for i in range(count)])
    rows = [[(pan, tilt) for pan in stops[0]] for tilt in stops[1]]
    return [pose for i, row in enumerate(rows) for pose in (row[::-1] if i % 2 else row)]
