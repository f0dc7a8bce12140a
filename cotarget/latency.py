"""Measure the latencies of cameras, head and lens from recorded motion.

- Zoom camera against the head's reports: the head wiggles, and its angle and the image's shift show the same motion.
  The shift is the median of tracked corners (Lucas and Kanade), so something small may move in the image.
- Fixed camera against the zoom camera: a board swings in front of both.
- Head against its commands: from a command to the start of the acceleration that follows.
- Lens against its commands: the lens zooms in and out; a similarity through tracked corners gives the scale from frame
  to frame, and the first part of each way, extrapolated back, gives the start.

Two records of one motion are matched by the delay at which one is best explained by the other times a factor, plus a
constant. The choice of intervals: docs/design-notes.md.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from cotarget.board import board_points
from cotarget.calibration import Calibration
from cotarget.calibration.corners import find_corners
from cotarget.calibration.recorder import LENS_TIMEOUT, POLL, wait_for_lens
from cotarget.config import BoardConfig
from cotarget.control.controller import reach_of
from cotarget.errors import CalibrationError, StaleFrameError
from cotarget.geometry import Array, RigidTransform, pose
from cotarget.rig import AxisLimits, Camera, Frame, Image, PanTiltState, Rig, refuse_outside
from cotarget.targeting import aim

GROWTH = 2.0  # zoom factor of a measurement, or the lens's whole range; less than LEAST_GROWTH measures nothing
LEAST_GROWTH = 1.1
WAYS = 6  # number of ways, in and out alternately
BEFORE_S, AFTER_S = 0.5, 1.2  # frames are kept from this long before a command to this long after the lens stands [s]
# Part of a way, in the logarithm of the scale, from which its start is extrapolated: beyond the corners' noise, and
# before most of the way, because no lens travels evenly all the way.
FIRST, LAST = 0.08, 0.5
# Largest relative difference between the image's growth and the lens's report; beyond it something else made it grow.
AS_REPORTED = 0.25
CORNERS, WEAKEST, APART_PX = 200, 0.01, 8
SLOW_PERIODS = 1.6  # longest usual time between frames, in the camera's stated period; beyond it, its rate is wrong
LATE_PERIODS = 2.5  # longest time between two frames or two reports of the head, in their usual times; then one is late
FEWEST_CORNERS = 12  # with fewer corners there is no scale and no shift
REDUCED_PX = 640  # larger width of images whose shift is measured
LEVELS = 4  # of the pyramid, for shifts of some 30 px at that width


def measure_lens(rig: Rig, late_s: float = 0.0) -> float:
    """Measure the lens's command delay from the growth of the image while it zooms in and out.

    Args:
        rig: the rig; its head stays where it is.
        late_s: latency error of the zoom camera, by which its frames are dated too late, see `measure_head` [s].

    Returns:
        Time from a command to the start of the lens's motion, median over all ways [s].

    Raises:
        CalibrationError: the lens hardly zooms or does not come to rest, or the image does not grow as reported.
        StaleFrameError: frames stopped coming.
    """
    shortest, longest = rig.zoom.focal_range
    goal = min(GROWTH * shortest, longest)
    if goal < LEAST_GROWTH * shortest:
        raise CalibrationError(f"the lens zooms by {longest / shortest:.3g} times at most, too little to see when")
    rig.zoom.zoom(shortest)
    before = wait_for_lens(rig).focal_px
    delays: list[float] = []
    for way in range(WAYS):
        frames = _lens_frames(rig, rig.clock.now() + BEFORE_S)
        t = rig.clock.now()
        after = rig.zoom.zoom(shortest if way % 2 else goal)
        frames += _moving_frames(rig, frames)
        grown = log_scales([frame.image for frame in frames])
        reported = math.log(after / before)
        if not abs(grown[-1] - reported) <= AS_REPORTED * abs(reported):
            if late := lateness([frame.t for frame in frames], rig.spec.zoom.rate_hz):
                raise CalibrationError(late)
            seen = "shows too little" if math.isnan(grown[-1]) else f"grows {math.exp(grown[-1]):.2f} times"
            raise CalibrationError(
                f"the zoom camera's picture {seen} where the lens reports {after / before:.2f} times; point it at "
                "something with structure that stands still, all over the picture"
            )
        times = np.array([frame.t for frame in frames]) - late_s
        delays.append(start_of_motion(times, grown / grown[-1]) - t)
        before = after
    return float(np.percentile(delays, 50))


def lateness(frames: Sequence[float], rate_hz: float, states: Sequence[float] = ()) -> str:
    """Describe how late frames of the zoom camera or reports of the head came; empty where none did.

    Args:
        frames: times of the frames [s].
        rate_hz: the camera's frames per second.
        states: times of the head's reports [s].
    """
    late = []
    for what, times in (("frames of the zoom camera", frames), ("reports of the head", np.unique(states))):
        apart = np.diff(times)
        if times is frames and len(apart) and (each := float(np.median(apart))) > SLOW_PERIODS / rate_hz:
            late.append(
                f"{what} come every {each:.3f} s, and not every {1 / rate_hz:.3f} s as hardware.zoom.rate_hz says"
            )
            continue
        usual = 1 / rate_hz if times is frames else max(1 / rate_hz, float(np.median(apart))) if len(apart) else 0.0
        if len(apart) and apart.max() > LATE_PERIODS * usual:
            late.append(f"{what} came {apart.max():.2f} s apart, and not {usual:.2f} s")
    busy = "the machine or the line is too busy; measure again when nothing else runs"
    return f"{' and '.join(late)}: {busy}" if late else ""


def start_of_motion(times: Array, part: Array) -> float:
    """Extrapolate the start of a way whose first part is even [s].

    Args:
        times: times of the frames, increasing [s], (n,).
        part: part of the way done in each frame, 0 to 1, (n,).
    """
    moving = int(np.argmax(part >= LAST))
    standing = int(np.flatnonzero(part[:moving] < FIRST)[-1]) if moving and (part[:moving] < FIRST).any() else 0
    inside = slice(standing + 1, moving + 1)
    if moving - standing < 2:  # it jumps from one frame to the next
        return float((times[standing] + times[moving]) / 2)
    slope, offset = np.polyfit(part[inside], times[inside], 1)
    return float(np.clip(offset, times[standing] - slope * FIRST, times[standing + 1]))


def log_scales(images: Sequence[Image]) -> Array:
    """Logarithm of each image's scale relative to the first one, (n,); nan from where it is unknown."""
    found = [0.0]
    greys = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]
    for one, other in itertools.pairwise(greys):
        found.append(found[-1] + _log_scale(one, other))
    return np.array(found)


def _log_scale(before: Image, after: Image) -> float:
    """Logarithm of the scale between two successive images; nan if too few corners are tracked."""
    corners = cv2.goodFeaturesToTrack(before, CORNERS, WEAKEST, APART_PX)
    if corners is None or len(corners) < FEWEST_CORNERS:
        return math.nan
    moved, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    kept = seen.ravel() > 0
    if np.count_nonzero(kept) < FEWEST_CORNERS:
        return math.nan
    similarity, _ = cv2.estimateAffinePartial2D(corners[kept], moved[kept])
    return math.nan if similarity is None else math.log(math.hypot(similarity[0, 0], similarity[1, 0]))


def _lens_frames(rig: Rig, until: float) -> list[Frame]:
    """Read the zoom camera's frames until a time [s]."""
    frames: list[Frame] = []
    while rig.clock.now() < until:
        frames.append(rig.zoom.read(newer_than=frames[-1].t if frames else None))
    return frames


def _moving_frames(rig: Rig, before: Sequence[Frame]) -> list[Frame]:
    """Read the zoom camera's frames until the lens has stood still for `AFTER_S`."""
    frames, clock = list(before[-1:]), rig.clock
    deadline, rests = clock.now() + LENS_TIMEOUT, math.inf
    while clock.now() < rests:
        try:
            frames.append(rig.zoom.read(newer_than=frames[-1].t))
        except StaleFrameError:
            if clock.now() > deadline:
                raise
            clock.sleep_until(clock.now() + POLL)
        if rig.zoom.state().moving:
            rests = math.inf
        elif rests == math.inf:
            rests = clock.now() + AFTER_S
        if clock.now() > deadline:
            raise CalibrationError(f"the zoom lens still moves after {LENS_TIMEOUT:g} s")
    return frames[1:]


WIGGLE = np.radians(1.5)  # motion of the head, some 18 px of a usual wide lens [rad]
# Times between turns [s]: no multiples of usual frame periods, so that frames fall on all parts of the motion.
TURNS_EVERY = (1.33, 1.17, 1.51)
WIGGLE_SECONDS, SWING_SECONDS = 12.0, 10.0
LOOK = 0.01  # longest wait for a frame before the head's state is read again [s]
LONGEST_DELAY = 1.1  # largest delay searched, of either sign [s]
COARSE = 0.01  # step of the coarse search [s]
FEWEST = 20  # fewest samples of a motion
AGREEMENT = 0.9  # least correlation of two records
EARLY = 0.4  # part of a turn's way in which the head still accelerates
# Largest ratio of true and stated acceleration; from here on, the start of a turn is wrong by more than some 10 ms.
MISFIT = 1.5
FEWEST_REPORTS = 3  # different reports in that part of a turn, to see how the head accelerates
BOARD_SHARE, BOARD_TURNED = 0.35, 15.0  # part of the fixed image's width that the board fills; its turn [degrees]


@dataclass(frozen=True)
class Delay:
    """Delay of one record against another [s], and their agreement (correlation, at most 1)."""

    seconds: float
    agreement: float


@dataclass(frozen=True)
class HeadLatency:
    """Result of wiggling the head.

    Attributes:
        zoom: delay by which the zoom camera's frames are dated too late; to be added to its latency.
        command: time from a command to the start of motion [s].
        frames: number of frames of the zoom camera.
        late: what came late, so that the result is doubtful, see `lateness`.
    """

    zoom: Delay
    command: float
    frames: int
    late: str = ""


def measure_head(rig: Rig, seconds: float = WIGGLE_SECONDS) -> HeadLatency:
    """Measure the latencies of zoom camera and head by wiggling the head.

    Args:
        rig: the rig; its lens goes to the shortest focal length, and its head back to where it was.
        seconds: duration [s].

    Raises:
        CalibrationError: the image does not move with the head: it has no structure, or something in it moves; or the
            head does not accelerate as it should; or frames or reports came too late for either.
        DeviceError: the head stands beyond its limits.
        StaleFrameError: frames stopped coming.
    """
    home = rig.head.state()
    refuse_outside(home, rig.head.limits)
    _zoom_out(rig)
    pan, tilt = rig.head.move(home.pan, home.tilt)  # to where it stands: its goal there, if its driver knows it
    low, high = rig.head.limits.pan.range
    way = WIGGLE if pan + WIGGLE <= high else -WIGGLE
    times: list[float] = []
    shifts: list[float] = []
    states: list[PanTiltState] = []
    starts: list[tuple[float, float, float]] = []
    side = itertools.cycle((1.0, 0.0))
    pauses = itertools.cycle(TURNS_EVERY)
    shift = HorizontalShift()
    end = rig.clock.now() + seconds
    while rig.clock.now() < end:
        goal = min(max(pan + way * next(side), low), high)
        before = rig.head.state().pan
        t = rig.clock.now()
        goal, _ = rig.head.move(goal, tilt)
        starts.append((t, before, goal))
        for frame in _frames(rig, rig.zoom, t + next(pauses), times[-1] if times else None, states):
            times.append(frame.t)
            shifts.append(shift.of(frame.image))
    rig.head.move(pan, tilt, wait=True)
    reported, pans = np.array([(state.t, state.pan) for state in states]).T
    late = lateness(times, rig.spec.zoom.rate_hz, reported)
    if len(times) < FEWEST:
        few = f"the zoom camera gave {len(times)} frames in {seconds:g} s; {FEWEST} are needed"
        raise StaleFrameError("; ".join(filter(None, (few, late))))
    if np.ptp(pans) < abs(way) / 2:
        raise CalibrationError(
            f"the head was sent to and fro by {np.degrees(WIGGLE):.1f} degrees and moved by "
            f"{np.degrees(np.ptp(pans)):.2f}; see that nothing is in its way"
        )
    zoom = delay_between(np.array(times), np.array(shifts), reported, pans)
    if zoom.agreement < AGREEMENT:
        unmoved = (
            f"the zoom camera's picture at pan {np.degrees(pan):z.1f}, tilt {np.degrees(tilt):z.1f} degrees does not "
            f"move with the head (correlation {zoom.agreement:.2f}); point it at something with structure that stands "
            "still, not at the sky"
        )
        raise CalibrationError(late or unmoved)
    try:
        command = command_delay(starts, states, rig.head.limits.pan)
    except CalibrationError as error:
        raise CalibrationError(late or str(error)) from None
    return HeadLatency(zoom, command, len(times), late)


def measure_fixed(rig: Rig, calibration: Calibration, board: BoardConfig, seconds: float = SWING_SECONDS) -> Delay:
    """Measure the latency of the fixed camera against the zoom camera with a swinging board.

    Args:
        rig: the rig, with the latency of its zoom camera already right.
        calibration: calibration of the rig, to look at the board with both cameras.
        board: the board that swings.
        seconds: duration [s].

    Returns:
        Delay by which the fixed camera's frames are dated too late, to be added to its latency.

    Raises:
        CalibrationError: one of the cameras does not see the board often enough, or the records do not agree.
        UnreachableError: the head cannot look there.
    """
    calibration = calibration.for_streams(rig.fixed.size, rig.zoom.size)
    T_fixed_board = in_both_views(calibration, board)
    middle = T_fixed_board.apply(board_points(board).mean(axis=0))
    goal = aim(calibration, middle, reach_of(rig))
    _zoom_out(rig)
    rig.head.move(goal.pan, goal.tilt, wait=True)
    rig.board.swing(T_fixed_board)
    seen: dict[str, list[tuple[float, float]]] = {"fixed": [], "zoom": []}
    begin = rig.clock.now()
    newest: dict[str, float] = {"fixed": begin, "zoom": begin}
    while rig.clock.now() < begin + seconds + rig.board.patience / 2:
        for name, camera in (("fixed", rig.fixed), ("zoom", rig.zoom)):
            for frame in _frames(rig, camera, rig.clock.now() + LOOK, newest[name]):
                newest[name] = frame.t
                corners = find_corners(frame.image, board, thorough=False)
                if corners is not None:
                    seen[name].append((frame.t, float(corners[:, 0].mean())))
    rig.board.present(None)
    for name, found in seen.items():
        if len(found) < FEWEST:
            raise CalibrationError(
                f"the {name} camera saw the swinging board in {len(found)} frames; {FEWEST} are needed: hold it where "
                "both cameras see all of it"
            )
    (t_fixed, u_fixed), (t_zoom, u_zoom) = (np.array(found).T for found in seen.values())
    delay = delay_between(t_fixed, u_fixed, t_zoom, u_zoom)
    if delay.agreement < AGREEMENT:
        raise CalibrationError(
            f"the cameras' views of the swinging board do not agree (correlation {delay.agreement:.2f}); swing "
            "it left and right"
        )
    return delay


def delay_between(t: Array, values: Array, t_other: Array, other: Array) -> Delay:
    """Find the delay by which one record of a motion is dated later than another.

    Args:
        t: times of the record [s], (n,).
        values: the motion at these times, in any unit, (n,).
        t_other: times of the other record, increasing [s], (m,).
        other: the same motion, times any factor plus any constant, (m,).

    Returns:
        The delay d at which other(t - d) best explains values(t); an agreement of 0 if nothing moves.
    """
    if np.ptp(values) == 0 or np.ptp(other) == 0:
        return Delay(0.0, 0.0)

    def disagreement(delay: float) -> float:
        inside = (t - delay >= t_other[0]) & (t - delay <= t_other[-1])
        if inside.sum() < FEWEST:
            return 1.0
        shifted = np.interp(t[inside] - delay, t_other, other)
        if np.ptp(shifted) == 0 or np.ptp(values[inside]) == 0:
            return 1.0
        return 1.0 - float(np.corrcoef(values[inside], shifted)[0, 1] ** 2)

    tried = np.arange(-LONGEST_DELAY, LONGEST_DELAY + COARSE / 2, COARSE)
    best = float(tried[np.argmin([disagreement(delay) for delay in tried])])
    found = minimize_scalar(disagreement, bounds=(best - COARSE, best + COARSE), method="bounded")
    return Delay(float(found.x), float(np.sqrt(1.0 - found.fun)))


class HorizontalShift:
    """Horizontal shift of images against the first one: the median of the corners that are tracked from it.

    Large images are reduced to `REDUCED_PX`: it is faster, and fine texture cannot be tracked over tens of pixels.
    """

    def __init__(self) -> None:
        self._first: Image | None = None
        self._corners: Array | None = None

    def of(self, image: Image) -> float:
        """Measure an image's shift [px]; 0 if too few corners of the first one are found in it."""
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        factor = max(1.0, grey.shape[1] / REDUCED_PX)
        if factor > 1:
            grey = cv2.resize(grey, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
        if self._first is None:
            self._first, self._corners = grey, cv2.goodFeaturesToTrack(grey, CORNERS, WEAKEST, APART_PX)
        if self._corners is None:
            return 0.0
        moved, seen, _ = cv2.calcOpticalFlowPyrLK(self._first, grey, self._corners, None, maxLevel=LEVELS)
        ways = factor * (moved - self._corners)[seen.ravel() > 0, 0, 0]
        return float(np.median(ways)) if len(ways) >= FEWEST_CORNERS else 0.0


def command_delay(
    starts: Sequence[tuple[float, float, float]], states: Sequence[PanTiltState], axis: AxisLimits
) -> float:
    """Delay from a command to the start of the motion that follows, median over all commands [s].

    An axis that starts at t0 has gone acceleration / 2 (t - t0)^2 at t while it accelerates, so each report in the
    first part of the way gives t0, and several give the acceleration.

    Args:
        starts: for each command its time [s], and the axis's start and goal [rad].
        states: reports of the head.
        axis: acceleration of pan, measured too if it is unknown, and the slack within which it may tremble.

    Returns:
        The delay; nan if no report fell into the early part of any turn.

    Raises:
        CalibrationError: the head accelerates otherwise, so that its motion does not give the time of its start.
    """
    times = np.array([state.t for state in states])
    pans = np.array([state.pan for state in states])
    seen, slopes = [], []  # per command: its time, times of early reports, and sqrt(acceleration) (t - t0) for each
    for (t, before, goal), (until, *_) in zip(starts, [*starts[1:], (np.inf, 0.0, 0.0)], strict=True):
        gone = np.abs(pans - before)
        early = (times > t) & (times < until) & (gone > axis.slack) & (gone < EARLY * abs(goal - before))
        roots = np.sqrt(2 * gone[early])
        if early.any():
            seen.append((t, times[early], roots))
        if len(np.unique(roots)) >= FEWEST_REPORTS:
            slopes.append(np.polyfit(times[early], roots, 1)[0])
    measured = float(np.median(slopes) ** 2) if slopes else np.nan
    acceleration = measured if axis.acceleration is None else axis.acceleration
    if slopes and not 1 / MISFIT <= measured / acceleration <= MISFIT:
        raise CalibrationError(
            f"the motion of the head does not fit its acceleration of {np.degrees(acceleration):.0f} degrees/s^2, but "
            f"one of some {np.degrees(measured):.0f}; correct the head's limits"
        )
    found = [np.median(reported - roots / np.sqrt(acceleration)) - t for t, reported, roots in seen]
    return float(np.median(found)) if found else np.nan


def in_both_views(calibration: Calibration, board: BoardConfig) -> RigidTransform:
    """Pose of a board ahead of the fixed camera, of a good size in its image, T_fixed_board."""
    points = board_points(board)
    width = float(np.ptp(points[:, 0]))
    depth = calibration.fixed.lens.focal_px[0] * width / (BOARD_SHARE * calibration.fixed.size[0])
    ray = calibration.fixed.ray(calibration.fixed.lens.image_center_px)
    turned = pose([0.0, 0.0, 0.0], [0.0, BOARD_TURNED, 0.0])
    return RigidTransform.from_translation(ray * depth - turned.apply(points.mean(axis=0))) * turned


def _zoom_out(rig: Rig) -> None:
    """Zoom the lens out and wait until it stands."""
    rig.zoom.zoom(rig.zoom.focal_range[0])
    wait_for_lens(rig)


def _frames(
    rig: Rig, camera: Camera, until: float, newer_than: float | None, states: list[PanTiltState] | None = None
) -> Iterator[Frame]:
    """Yield frames of a camera until a time, and read the head's states in between if they are kept."""
    while rig.clock.now() < until:
        if states is not None:
            state = rig.head.state()
            if not states or state.t > states[-1].t:
                states.append(state)
        try:
            frame = camera.read(newer_than=newer_than, timeout=LOOK)
        except StaleFrameError:
            continue
        newer_than = frame.t
        yield frame
