"""Characterize a dome: measure what it does by looking at its own picture while it moves.

A dome says little of itself, and not all of it is true. Its picture does not lie: scenes are far, so that pictures at
several pans and tilts are related by rotations alone.

- Pictures at ten places around the middle give the focal length, one term of distortion, and each rotation (bundle
  adjustment over features, SIFT). The rotations against the reported angles give sign and scale of both axes.
- The fixed camera's picture, which counts as upright, shows whether the dome's is upside down or mirrored. The dome's
  picture alone cannot: upside down, it looks like a picture whose axes both turn the other way.
- Slow turns that are halted on their way give the time from a command to the motion in the picture, and the time to
  stand.
- Pictures at successive zoom positions give the growth from one to the next.

The time from light to a picture and the time from a command to motion are seen as their sum alone. Where positions are
reported they divide it, as if these were of the moment; the pipeline needs no more than that they fit together.
"""

import contextlib
import functools
import itertools
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.sparse import lil_matrix
from scipy.spatial.transform import Rotation

from cotarget.calibration.recorder import wait_for_lens
from cotarget.errors import CalibrationError, DeviceError, EmergencyStopError, StaleFrameError
from cotarget.geometry import Array
from cotarget.latency import AGREEMENT, LONGEST_DELAY, delay_between
from cotarget.rig import Angles, Frame, Image, PanTiltState, Rig

Say = Callable[[str], None]
Pairs = tuple[tuple[float, float], ...]
Got = TypeVar("Got")

REDUCED_PX = 640  # larger width of pictures that are compared
LENS_STANDS_S = 0.8  # longest delay of a picture, after the lens has come to rest [s]
STILL_PX, STILL_S = 0.25, 0.5  # the picture stands if its corners move by no more from frame to frame for so long
AWAIT_S = 2.0  # where the head says that it moves, as between two relative moves, its picture has to stand for so long
UNMOVED_S = 3.0  # a picture that has not moved for so long after a command does not move [s]
BACK_S = 5.0  # longest time without a frame [s]
# Speed to places: nobody knows yet whether positions are late; at the highest, half a second is half of the view.
PLACE_DEG_S = 20.0
RESTLESS_S = 15.0  # longest time on the way to a place [s]
SLOWEST_S = 60.0  # longest time to wait for a picture that stands [s]
CORNERS, WEAKEST, APART_PX = 200, 0.01, 8
# Where the dome looks: parts of the field of view from the middle; each changes both axes.
PLACES = (
    (0.0, 0.0), (0.22, 0.15), (-0.31, 0.2), (0.38, -0.18), (-0.2, -0.28), (0.1, 0.3), (-0.4, -0.05), (0.3, 0.07),
    (-0.12, 0.12), (0.05, -0.33),
)  # fmt: skip
FEWEST_PLACES = 5  # at which the picture must be recognised
FEWEST_MATCHES = 25  # features that two pictures share
MOST_FEATURES, CONTRAST = 2000, 0.02  # of SIFT: half of its usual contrast, for walls
CENTER_SIGMA = 0.02  # of the principal point from the middle, as a share of the width
OF_CAMERA = 7  # unknowns: focal length, distortion, lever, principal point
# The lever is forward, and of unit length: what it is long is in the nearness of points.
LEVER, LEVER_SIGMA, NEARNESS = np.array([0.0, 0.0, 1.0]), 0.3, 0.03
MOST_STEPS = 60
RATIO = 0.75  # of the distances to the nearest and the second nearest feature (Lowe)
OFF_PX = 4.0  # from the homography, which leaves out distortion
# Slow turns: way to their goal, and speed, in pan. They are halted before the half of it, since a steered dome slows
# down at its goal.
SLOW_DEG, SLOW_DEG_S = 18.0, 6.0
TILTED = 0.25  # tilt of these turns, as a part of pan: both axes take the same time
PHASES_S = (0.0, 0.041, 0.013, 0.061, 0.027, 0.087)  # between a frame and their command
HALTS_S = (0.9, 1.03, 0.97)  # from the command to the halt
HALTED_S = 1.5  # longest time for which a halted dome turns on, and its driver obeys no move [s]
# Pictures of a turn are compared with one of it that is no farther than this part of their width: over a quarter of it,
# tiles and shelves are taken for their neighbours.
NEAR = 0.05
BESIDE = 0.05  # of the way of a turn: a picture that seems farther off it was taken for one like it
WHOLE = 0.95  # part of that way beyond which it was not halted
ALONE_DEG = 4.0  # way of a move of pan alone
LATEST_S = 2.0  # longest time from a command to the motion in the picture [s]
LOOK_S = 0.01  # longest wait for a frame before the head's state is read again [s]
APART_S = 100.0  # between turns, where they are compared with reports as if they followed each other [s]
ZOOM_STEPS = 16
# The highest speed is seen at every third of these, by a turn of such a way, that is halted after such a time; with it
# goes a little tilt, for a dome that moves only where both axes change.
SPEED_EVERY, FAST_DEG, FAST_S, TINY = 3, 12.0, 1.5, math.radians(0.3)
TURNED_DEG = 1.0  # by which the picture moves at a zoom whose device turns


@dataclass(frozen=True)
class Characteristics:
    """What a dome was measured to do.

    Attributes:
        moves: whether it goes where it is sent; nothing else is known where it does not.
        orientation: of the picture: "upright", "upside down", "mirrored", or both; empty where it was not seen.
        scale: true angles of pan and tilt over reported ones, negative where they have the other sign.
        focal_px: at the shortest focal length.
        off_deg: rms angle between reported and seen positions, after scale and sign [degrees].
        missed_deg: largest distance of a reported position from the goal.
        both_axes: whether it moves only where pan and tilt change both.
        light_s: from a command to the picture that shows the motion.
        report_s: from light to picture, less the time by which reported positions are late; None without reports.
        stop_s: from a halt to standing, less the time from a command to motion; None where it was not seen.
        turns_at_zoom: whether it turns when only the zoom is sent.
        growths: zoom positions as focal lengths of rig.toml [px], and magnifications.
        speeds: magnifications, and the highest speed of pan that was reported there [rad/s]; empty without reports.
    """

    moves: bool
    orientation: str = ""
    scale: tuple[float, float] = (1.0, 1.0)
    focal_px: float = math.nan
    off_deg: float = math.nan
    missed_deg: float = math.nan
    both_axes: bool = False
    light_s: float = math.nan
    report_s: float | None = None
    stop_s: float | None = None
    turns_at_zoom: bool = False
    growths: tuple[tuple[float, float], ...] = ()
    speeds: tuple[tuple[float, float], ...] = ()

    @property
    def is_whole(self) -> bool:
        """Whether the picture was recognised over the lens's whole range."""
        return len(self.growths) > ZOOM_STEPS


@dataclass(frozen=True)
class Room:
    """Where the dome will turn: middle and largest distance from it, of pan and tilt [rad]."""

    middle: Angles
    reach: Angles

    @property
    def ends_deg(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lowest and highest pan, and tilt [degrees]."""
        pan, tilt = (
            (math.degrees(at - way), math.degrees(at + way)) for at, way in zip(self.middle, self.reach, strict=True)
        )
        return pan, tilt


def room_of(rig: Rig) -> Room:
    """Find the room around where the head stands, moved into its limits."""
    state = rig.head.state()
    width, height = rig.zoom.size
    focal = rig.zoom.focal_range[0]
    middle, reach = [], []
    for at, sides, place, axis in zip(
        (state.pan, state.tilt), (width, height), zip(*PLACES, strict=True), rig.head.limits.axes, strict=True
    ):
        low, high = axis.outermost()
        view = 2 * math.atan(sides / 2 / focal)
        way = min(view * max(map(abs, place)), (high - low) / 2)
        reach.append(way)
        middle.append(min(max(at, low + way), high - way))
    return Room((middle[0], middle[1]), (reach[0], reach[1]))


def characterize(rig: Rig, room: Room, say: Say) -> Characteristics:
    """Turn and zoom a dome, and measure in its picture what it does.

    Args:
        rig: the rig; its lens goes through its whole range, and back to the shortest focal length.
        room: where it may turn.
        say: takes a line of progress.

    Raises:
        CalibrationError: the picture shows too little structure, or does not come to rest.
        DeviceError: the device fails.
        StaleFrameError: frames stopped coming.
    """
    rig.zoom.zoom(rig.zoom.focal_range[0])
    wait_for_lens(rig)
    say("looking around")
    views = _look_around(rig, room)
    if not views:
        return Characteristics(moves=False)
    focal_px, rotations, used = fit_pictures([view.image for view in views], rig.zoom.focal_range[0], rig.zoom.size)
    seen = [views[i] for i in used]
    scale, off = fit_axes(rotations, [(view.state.pan, view.state.tilt) for view in [views[0], *seen]])
    orientation = orientation_of([view.image for view in views], rig.fixed.read().image)
    backward = "upside down" in orientation, "mirrored" in orientation
    signs = (-1.0 if backward[0] != backward[1] else 1.0), (-1.0 if backward[0] else 1.0)
    missed = max(max(abs(view.state.pan - view.goal[0]), abs(view.state.tilt - view.goal[1])) for view in views)
    say("timing the motion")
    light_s, report_s, stop_s = time_turns(rig, room, focal_px, abs(scale[0]))
    _go(rig, room.middle)
    both_axes = not _go(rig, (room.middle[0] + math.radians(ALONE_DEG), room.middle[1]))[1]
    say("zooming")
    turns, growths, speeds = _zoom_through(rig, room, focal_px, say, reports=report_s is not None)
    return Characteristics(
        moves=True,
        orientation=orientation,
        scale=(signs[0] * scale[0], signs[1] * scale[1]),
        focal_px=focal_px,
        off_deg=math.degrees(off),
        missed_deg=math.degrees(missed),
        both_axes=both_axes,
        light_s=light_s,
        report_s=report_s,
        stop_s=stop_s,
        turns_at_zoom=turns,
        growths=growths,
        speeds=tuple((times, abs(scale[0]) * speed) for times, speed in speeds),
    )


# Frames


def _patiently(call: Callable[[], Got]) -> Got:
    """Call a head whose earlier move may have failed: that error is raised once, and one that lasts again."""
    try:
        return call()
    except EmergencyStopError:
        raise
    except DeviceError:
        return call()


def _next(rig: Rig, frame: Frame | None = None) -> Frame:
    """Wait for the zoom camera's next frame, for as long as a stream may take to come back."""
    deadline = rig.clock.now() + BACK_S
    while True:
        try:
            return rig.zoom.read(newer_than=None if frame is None else frame.t)
        except StaleFrameError:
            if rig.clock.now() > deadline:
                raise


def _grey(image: Image) -> Image:
    """Reduce an image to grey of `REDUCED_PX`."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    factor = REDUCED_PX / grey.shape[1]
    return cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else grey


def _motion(before: Image, after: Image) -> float:
    """Median distance by which corners move between two frames [px]; inf where they are lost, 0 without corners."""
    corners = cv2.goodFeaturesToTrack(before, CORNERS, WEAKEST, APART_PX)
    if corners is None:
        return 0.0
    moved, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    ways = np.linalg.norm(moved - corners, axis=-1)[seen.ravel() > 0]
    return float(np.median(ways)) if len(ways) > len(corners) / 3 else math.inf


def _settled(rig: Rig, unmoved_s: float = UNMOVED_S) -> tuple[Image, bool]:
    """Wait until the picture stands after a command; return its mean since then, grey, and whether it has moved.

    Args:
        rig: the rig.
        unmoved_s: time after which a picture that has not moved does not move [s].
    """
    begin = rig.clock.now()
    frame = _next(rig)
    stack, moved, still, halts_at = [_grey(frame.image)], False, begin, begin + RESTLESS_S
    while rig.clock.now() < begin + SLOWEST_S:
        if rig.clock.now() > halts_at:  # a dome that stops late may swing about its goal
            _patiently(rig.head.halt)
            halts_at = math.inf
        frame = _next(rig, frame)
        grey, now = _grey(frame.image), rig.clock.now()
        if _motion(stack[-1], grey) > STILL_PX:
            stack, moved, still = [], True, now
        stack.append(grey)
        stands_s = STILL_S if moved else unmoved_s
        if _patiently(rig.head.state).moving:
            stands_s = max(stands_s, AWAIT_S)
        if now - still > stands_s:
            _patiently(rig.head.halt)  # it stands, and its driver may not know that
            _patiently(rig.head.state)  # that its move did not arrive is no error of what comes next
            return np.mean(stack, axis=0).round().astype(np.uint8), moved
    raise CalibrationError(
        f"the zoom camera's picture does not come to rest within {SLOWEST_S:g} s; point it at something that stands "
        "still, and see that nothing else moves the dome"
    )


# Signs, scales, focal length


@dataclass(frozen=True, eq=False)
class _View:
    image: Image
    state: PanTiltState
    goal: Angles


def _goal(room: Room, place: Angles) -> Angles:
    most = tuple(max(abs(each[i]) for each in PLACES) for i in range(2))
    pan, tilt = (at + way * part / end for at, way, part, end in zip(room.middle, room.reach, place, most, strict=True))
    return pan, tilt


def _look_around(rig: Rig, room: Room) -> list[_View]:
    """Take a picture at each place; empty where the picture never moves."""
    views, moved = [], 0
    for i, place in enumerate(PLACES):
        goal = _goal(room, place)
        sent = _patiently(functools.partial(rig.head.move, *goal, speed=math.radians(PLACE_DEG_S)))
        image, has_moved = _settled(rig)
        views.append(_View(image, _patiently(rig.head.state), sent))
        moved += has_moved
        if i == 3 and not moved:
            return []
    return views


def matches(a: Image, b: Image) -> tuple[Array, Array]:
    """Find features of one picture in another that fit a homography: (n, 2) each; none where they are too few."""
    x, y, _ = _matches(_features(a), _features(b))
    return x, y


def _features(image: Image) -> tuple[Array, Array]:
    """Find features: places (n, 2), and descriptions (n, 128)."""
    at, described = cv2.SIFT.create(MOST_FEATURES, contrastThreshold=CONTRAST).detectAndCompute(image, None)
    return np.array([each.pt for each in at]).reshape(-1, 2), np.empty((0, 128)) if described is None else described


def _matches(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """Match features; returns their places in both pictures, and their numbers in the first."""
    none = np.empty((0, 2)), np.empty((0, 2)), np.empty(0, int)
    if min(len(a[0]), len(b[0])) < FEWEST_MATCHES:
        return none
    pairs = cv2.BFMatcher().knnMatch(a[1], b[1], k=2)
    good = [first for first, second in pairs if first.distance < RATIO * second.distance]
    if len(good) < FEWEST_MATCHES:
        return none
    at = np.array([match.queryIdx for match in good])
    x, y = a[0][at], b[0][[match.trainIdx for match in good]]
    _, kept = cv2.findHomography(x, y, cv2.RANSAC, OFF_PX)
    inside = np.zeros(len(good), bool) if kept is None else kept.ravel() > 0
    return (x[inside], y[inside], at[inside]) if np.count_nonzero(inside) >= FEWEST_MATCHES else none


def _undistorted(x: Array, k1: float) -> Array:
    """Invert x (1 + k1 r^2), (n, 2)."""
    undone = x
    for _ in range(10):
        undone = x / (1 + k1 * np.sum(undone**2, axis=1, keepdims=True))
    return undone


def fit_pictures(
    images: Sequence[Image], guess_px: float, size: tuple[int, int]
) -> tuple[float, list[Rotation], list[int]]:
    """Find the focal length and the rotations of pictures by a camera that turns about a point near it.

    A point at x in the first picture is at R (x + n l) - n l in another: l is the lever from that point to the camera,
    and n the point's nearness, 0 for one that is far. Without them a room would make the focal length wrong by 7 %. A
    principal point 1 % of the width off the middle, where it were not fitted, would make the angles wrong by 0.5 %.

    Args:
        images: grey pictures of a camera, the first of which shares a part with each other one.
        guess_px: rough focal length of the camera [px].
        size: (width, height) of its frames [px]; the pictures may be smaller.

    Returns:
        The focal length [px]; rotations from the camera at the first picture to that at others; their indices.

    Raises:
        CalibrationError: too few pictures are recognised.
    """
    factor = images[0].shape[1] / size[0]
    center, guess = (np.array(images[0].shape[1::-1]) - 1) / 2, guess_px * factor
    wander = CENTER_SIGMA * images[0].shape[1]
    first = _features(images[0])
    found = [(i, *_matches(first, _features(image))) for i, image in enumerate(images[1:], 1)]
    found = [each for each in found if len(each[1])]
    if len(found) < FEWEST_PLACES:
        raise CalibrationError(
            f"the zoom camera's picture is recognised at {len(found)} of {len(images) - 1} places; point it at "
            "something with structure all over the picture, that stands still and is some metres away"
        )
    view = np.concatenate([np.full(len(x), i) for i, (_, x, *_) in enumerate(found)])
    known, point = np.unique(np.concatenate([at for *_, at in found]), return_inverse=True)
    x, y = first[0][known] - center, np.concatenate([y for _, _, y, _ in found]) - center

    def rays(x: Array, focal: float, k1: float) -> Array:
        return np.column_stack([_undistorted(x / focal, k1), np.ones(len(x))])

    def residuals(unknown: Array) -> Array:
        focal, k1, lever = guess * math.exp(unknown[0]), unknown[1], unknown[2:5]
        off = wander * unknown[5:7]
        turns = Rotation.from_rotvec(unknown[OF_CAMERA : -len(x)].reshape(-1, 3)).as_matrix()
        near = unknown[-len(x) :, None]
        pivoted = rays(x - off, focal, k1) + near * lever
        turned = np.einsum("nij,nj->ni", turns[view], pivoted[point]) - near[point] * lever
        flat = turned[:, :2] / np.maximum(turned[:, 2:], 0.1)
        seen = focal * flat * (1 + k1 * np.sum(flat**2, axis=1, keepdims=True)) + off
        priors = (lever - LEVER) / LEVER_SIGMA, unknown[5:7], near.ravel() / NEARNESS
        return np.concatenate([(seen - y).ravel(), *priors])

    start = [_aligned(rays(a - center, guess, 0.0), rays(b - center, guess, 0.0)).as_rotvec() for _, a, b, _ in found]
    fit = least_squares(
        residuals,
        np.concatenate([[0.0, 0.0], LEVER, [0.0, 0.0], *start, np.zeros(len(x))]),
        loss="soft_l1",
        x_scale="jac",
        jac_sparsity=_dependence(view, point, len(found), len(x)),
        max_nfev=MOST_STEPS,
    )
    turns = [Rotation.from_rotvec(turn) for turn in fit.x[OF_CAMERA : -len(x)].reshape(-1, 3)]
    return guess * math.exp(fit.x[0]) / factor, turns, [i for i, *_ in found]


def _dependence(view: Any, point: Any, views: int, points: int) -> Any:
    """Make the matrix of which residual depends on which unknown, see `fit_pictures`."""
    seen, columns = 2 * len(view), OF_CAMERA + 3 * views
    depends = lil_matrix((seen + 5 + points, columns + points), dtype=int)
    depends[:seen, :OF_CAMERA] = 1
    for row, (i, j) in enumerate(zip(view, point, strict=True)):
        turn = OF_CAMERA + 3 * i
        depends[2 * row : 2 * row + 2, turn : turn + 3] = 1
        depends[2 * row : 2 * row + 2, columns + j] = 1
    depends[seen : seen + 5, 2:OF_CAMERA] = np.eye(5, dtype=int)
    depends[seen + 5 :, columns:] = np.eye(points, dtype=int)
    return depends


def _aligned(a: Array, b: Array) -> Rotation:
    """Find the rotation that brings rays a to rays b, (n, 3)."""
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (a, b))
    return Rotation.align_vectors(b, a)[0]


def fit_axes(rotations: Sequence[Rotation], angles: Sequence[Angles]) -> tuple[tuple[float, float], float]:
    """Find true angles over reported ones of pan and tilt, as if the picture were upright.

    The camera turns by R = M C(pan, tilt) C(pan0, tilt0)^T M^T with C = Rx(-tilt) Ry(-pan). M, the camera in its
    housing, is a small roll and yaw, and the true tilt0 is unknown.

    Args:
        rotations: from the first picture to the others.
        angles: reported pan and tilt, the first picture's first [rad].

    Returns:
        The scales of pan and tilt, and the rms angle that they leave [rad].

    Raises:
        CalibrationError: the camera lies on its side.
    """
    first, *others = np.array(angles)
    ways = np.array(others) - first
    turns = np.array([turn.as_rotvec() for turn in rotations])
    rough, *_ = np.linalg.lstsq(ways, turns, rcond=None)  # (2, 3)
    if abs(rough[0, 0]) > abs(rough[0, 1]):
        raise CalibrationError("the zoom camera lies on its side: pan moves the picture up and down; turn it upright")

    def turned(parameters: Array) -> Rotation:
        pan_scale, tilt_scale, tilt0, roll, yaw = parameters
        camera = Rotation.from_euler("zy", [roll, yaw])
        tilts = tilt0 + tilt_scale * np.concatenate([[0.0], ways[:, 1]])
        pans = pan_scale * np.concatenate([[0.0], ways[:, 0]])
        looks = camera * _about(0, -tilts) * _about(1, -pans)
        return looks[1:] * looks[0].inv()

    def residuals(parameters: Array) -> Array:
        seen = Rotation.from_rotvec(turns)
        return (seen * turned(parameters).inv()).as_rotvec().ravel()

    start = np.array([-rough[0, 1], -rough[1, 0], 0.0, 0.0, 0.0])
    fit = least_squares(residuals, start, loss="soft_l1", f_scale=math.radians(0.1))
    left = residuals(fit.x).reshape(-1, 3)
    return (float(fit.x[0]), float(fit.x[1])), float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


def _about(axis: int, angles: Array) -> Rotation:
    return Rotation.from_rotvec(angles[:, None] * np.eye(3)[axis])


def orientation_of(images: Sequence[Image], fixed: Image) -> str:
    """Say how the zoom camera's picture is turned against the fixed camera's; empty where they share too little.

    Args:
        images: grey pictures of the zoom camera; one that shows what the fixed camera shows is enough.
        fixed: picture of the fixed camera, (H, W, 3) BGR.
    """
    best, said = 0, ""
    upright = _grey(fixed)
    for image, mirrored in itertools.product(images, (False, True)):
        x, y = matches(image[:, ::-1].copy() if mirrored else image, upright)
        if len(x) > best:
            similarity, _ = cv2.estimateAffinePartial2D(x, y)
            if similarity is None:
                continue
            best, over = len(x), abs(math.atan2(similarity[1, 0], similarity[0, 0])) > math.pi / 2
            words = (["upside down"] if over else []) + (["mirrored"] if mirrored else [])
            said = " and ".join(words) or "upright"
    return said


# Delays


@dataclass(frozen=True, eq=False)
class _Turn:
    """A turn that was halted: its frames, and how far the picture has moved in each.

    Attributes:
        t: time of the command [s].
        halted_s: time of the halt after the command [s].
        times: of the frames [s], (n,).
        angles: by which the picture has moved since the command [rad], (n,).
        states: of the head.
    """

    t: float
    halted_s: float
    times: Array
    angles: Array
    states: Sequence[PanTiltState]

    @property
    def way(self) -> float:
        """Angle by which it has moved in the end [rad]."""
        return _end(self.angles)


def _end(angles: Array) -> float:
    return float(np.median(angles[-5:]))


def _turn(rig: Rig, goal: Angles, focal_px: float, phase_s: float, halt_s: float) -> _Turn:
    """Turn slowly towards a goal from where the picture stands, halt, and watch until it stands again.

    Args:
        rig: the rig.
        goal: pan and tilt [rad].
        focal_px: focal length [px].
        phase_s: time between a frame and the command [s].
        halt_s: time after the command at which the head is halted [s].
    """
    frame, rests = _next(rig), rig.clock.now() + HALTED_S
    while rig.clock.now() < rests:
        frame = _next(rig, frame)
    rig.clock.sleep_until(rig.clock.now() + phase_s)
    rate, t = math.radians(SLOW_DEG_S), rig.clock.now()
    _patiently(lambda: rig.head.move(*goal, speed=(rate, rate * TILTED)))
    frames, states, moved, still, halted_s = [(frame.t, _grey(frame.image))], list[PanTiltState](), False, t, math.nan
    while rig.clock.now() < t + SLOWEST_S:
        if math.isnan(halted_s) and rig.clock.now() >= t + halt_s:
            halted_s = rig.clock.now() - t
            _patiently(rig.head.halt)
        states.append(_patiently(rig.head.state))
        with contextlib.suppress(StaleFrameError):
            frame = rig.zoom.read(newer_than=frame.t, timeout=LOOK_S)
            frames.append((frame.t, _grey(frame.image)))
            if _motion(frames[-2][1], frames[-1][1]) > STILL_PX:
                moved, still = True, rig.clock.now()
        if not math.isnan(halted_s) and rig.clock.now() - still > (STILL_S if moved else UNMOVED_S):
            break
    images = [grey for _, grey in frames]
    reduced_px = focal_px * images[0].shape[1] / rig.zoom.size[0]
    angles = _turned(images, reduced_px) if moved else np.zeros(len(images))
    on_its_way = np.isfinite(angles)
    return _Turn(t, halted_s, np.array([t for t, _ in frames])[on_its_way], angles[on_its_way], states)


def _turned(images: Sequence[Image], focal_px: float) -> Array:
    """Measure by which angles pictures of one turn are turned against the first [rad], (n,).

    Nan for one that was taken for another place like it.
    """
    near, size = images[0].astype(np.float32), images[0].shape[::-1]
    window = cv2.createHanningWindow(size, cv2.CV_32F)
    turned, here = [], np.zeros(2)
    for image in images:
        shift = np.array(cv2.phaseCorrelate(near, image.astype(np.float32), window)[0])
        # What both pictures show is as far from the middle in one as in the other.
        turned.append(here + 2 * np.arctan(shift / 2 / focal_px))
        if float(np.linalg.norm(shift)) > NEAR * size[0]:
            near, here = image.astype(np.float32), turned[-1]
    angles = np.array(turned)
    end = np.median(angles[-5:], axis=0)
    angles = angles @ end / max(float(np.linalg.norm(end)), 1e-9)
    return np.where(np.abs(angles / _end(angles) - 0.5) < 0.5 + BESIDE, angles, np.nan)


def start_of_turns(turns: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Find when turns begin and how fast they are; they are alike, and even over half of the shortest way.

    Args:
        turns: times after the command [s], and angles [rad], (n,) each.

    Returns:
        The start after the command [s], and the speed [rad/s].
    """
    way = min(_end(angles) for _, angles in turns)
    times, angles = (np.concatenate(each) for each in zip(*turns, strict=True))
    half = np.minimum(angles / way, 0.5)

    def left(unknown: Any) -> float:
        there = np.clip((times - unknown[0]) / math.exp(unknown[1]), 0.0, 0.5)
        return float(np.mean(np.sqrt(1 + ((half - there) / 0.02) ** 2)))

    tried = itertools.product(np.arange(0.0, LATEST_S, 0.02), np.linspace(math.log(0.02), math.log(4.0), 30))
    start, takes = min(tried, key=left)
    simplex = np.array([[start, takes], [start + 0.01, takes], [start, takes + 0.1]])
    fit = minimize(left, simplex[0], method="Nelder-Mead", options={"initial_simplex": simplex})
    return float(fit.x[0]), way * math.exp(-fit.x[1])


def time_turns(rig: Rig, room: Room, focal_px: float, scale: float) -> tuple[float, float | None, float | None]:
    """Halt slow turns; return `Characteristics.light_s`, `report_s` and `stop_s`.

    Args:
        rig: the rig.
        room: where it may turn.
        focal_px: focal length [px].
        scale: true angle over reported one of pan.

    Raises:
        CalibrationError: the picture does not move.
    """
    turns, late = list[_Turn](), rig.spec.zoom.latency_s
    for phase_s, halt_s, side in zip(PHASES_S, itertools.cycle(HALTS_S), itertools.cycle((1, -1)), strict=False):
        _go(rig, _beside(room, -side * SLOW_DEG / 2))
        turns.append(_turn(rig, _beside(room, side * SLOW_DEG / 2), focal_px, phase_s, halt_s))
    # One that something cut short, such as a frame that came too late for the watchdog, shows nothing.
    shortest = statistics.median(turn.way for turn in turns) / 2
    if not shortest:
        raise CalibrationError(
            f"the zoom camera's picture does not move where the dome is sent on at {SLOW_DEG_S:g} degrees/s: see that "
            "nothing else halts it, and that it can turn so slowly"
        )
    turns = [turn for turn in turns if turn.way > shortest]
    start, rate = start_of_turns([(turn.times + late - turn.t, turn.angles) for turn in turns])
    longest = scale * math.radians(WHOLE * SLOW_DEG)
    stops = [turn.way / rate - turn.halted_s for turn in turns if turn.way < longest]
    return start, _report_s(turns, late), statistics.median(stops) if len(stops) > len(turns) / 2 else None


def _report_s(turns: Sequence[_Turn], late: float) -> float | None:
    """Compare the picture with the reports; None where the head reports nothing that moves so."""
    seen, said = list[tuple[Array, Array]](), list[tuple[Array, Array]]()
    for i, turn in enumerate(turns):
        states = [state for state in turn.states if not state.sigma]  # others are reckoned from the commands
        if len(states) < len(turn.states) / 2:
            return None
        after = APART_S * i - turn.t
        times, fresh = np.unique([state.t for state in states], return_index=True)
        ways = np.abs(np.array([state.pan for state in states])[fresh] - states[0].pan)
        if not ways[-1]:
            return None
        stands = LONGEST_DELAY + BACK_S  # before the first report, and after the last
        parts = np.array([0, *ways, ways[-1]]) / ways[-1]
        said.append((np.array([times[0] - stands, *times, times[-1] + stands]) + after, parts))
        seen.append((turn.times + after, turn.angles / turn.way))
    found = delay_between(*map(np.concatenate, zip(*seen, strict=True)), *map(np.concatenate, zip(*said, strict=True)))
    return late + found.seconds if found.agreement >= AGREEMENT else None


def _beside(room: Room, way_deg: float) -> Angles:
    """Place at an angle from the middle, most of it of pan [degrees]."""
    way = math.radians(way_deg)
    return room.middle[0] + way, room.middle[1] + way * TILTED


def _go(rig: Rig, goal: Angles) -> tuple[Image, bool]:
    """Go to a place; return the picture there, grey, and whether it has moved."""
    _patiently(lambda: rig.head.move(*goal, speed=math.radians(PLACE_DEG_S)))
    return _settled(rig)


# The lens


def growth_of(before: Image, after: Image) -> tuple[float, float] | None:
    """Find how much larger a picture is than another one at its middle, and by how much it has moved [px].

    The growth is x' = s (1 + q r^2) R x + t, since distortion changes with zoom. None where they share too little.
    """
    x, y = matches(before, after)
    if not len(x):
        return None
    similarity, _ = cv2.estimateAffinePartial2D(x, y, ransacReprojThreshold=OFF_PX)
    if similarity is None:
        return None
    center = (np.array(before.shape[::-1]) - 1) / 2
    x, y = x - center, y - center
    radius = float(np.linalg.norm(center))
    a, b = similarity[0, 0], similarity[1, 0]

    def residuals(unknown: Array) -> Array:
        matrix = np.array([[unknown[0], -unknown[1]], [unknown[1], unknown[0]]])
        bent = x * (1 + unknown[4] * np.sum((x / radius) ** 2, axis=1, keepdims=True))
        return np.asarray(bent @ matrix.T + unknown[2:4] - y).ravel()

    fit = least_squares(residuals, [a, b, 0.0, 0.0, 0.0], loss="soft_l1")
    return math.hypot(*fit.x[:2]), math.hypot(*fit.x[2:4])


def _zoom_through(rig: Rig, room: Room, focal_px: float, say: Say, *, reports: bool) -> tuple[bool, Pairs, Pairs]:
    """Zoom from end to end; return `Characteristics.turns_at_zoom`, `growths` and `speeds`, of the head's reports."""
    shortest, longest = rig.zoom.focal_range
    steps = np.geomspace(shortest, longest, ZOOM_STEPS + 1)[1:].tolist()
    before, _ = _go(rig, _goal(room, PLACES[3]))
    try:
        _zoom(rig, steps[0])
    except EmergencyStopError:
        raise
    except DeviceError as error:
        say(f"the lens does not go where it is sent: {error}")
        return False, ((shortest, 1.0),), ()
    again = growth_of(before, _zoom(rig, shortest))
    turned_px = math.tan(math.radians(TURNED_DEG)) * focal_px * before.shape[1] / rig.zoom.size[0]
    turns = again is None or again[1] > turned_px
    if not turns:
        _go(rig, room.middle)
    before = _zoom(rig, shortest)
    growths, speeds = [(shortest, 1.0)], list[tuple[float, float]]()
    for i, focal in enumerate(steps):
        if reports and i % SPEED_EVERY == 0:
            speeds.append((growths[-1][1], _highest_speed(rig, room)))
            before, _ = _go(rig, room.middle)
        reached = rig.zoom.zoom(focal)
        after = _zoom(rig, focal)
        found = growth_of(before, after)
        if found is None:
            break
        growths.append((reached, growths[-1][1] * found[0]))
        before = after
    rig.zoom.zoom(shortest)
    wait_for_lens(rig)  # the halt at the end would stop it where it is
    return turns, tuple(growths), tuple(speeds)


def _highest_speed(rig: Rig, room: Room) -> float:
    """Turn at full speed for a while; return the highest speed of pan that the head reports [rad/s]."""
    frame, end, states = _next(rig), rig.clock.now() + FAST_S, list[PanTiltState]()
    _patiently(lambda: rig.head.move(room.middle[0] + math.radians(FAST_DEG), room.middle[1] + TINY))
    while rig.clock.now() < end:
        states.append(_patiently(rig.head.state))
        with contextlib.suppress(StaleFrameError):
            frame = rig.zoom.read(newer_than=frame.t, timeout=LOOK_S)
    _patiently(rig.head.halt)
    return max(
        (abs(b.pan - a.pan) / (b.t - a.t) for a, b in itertools.combinations(states, 2) if b.t - a.t > FAST_S / 10),
        default=0.0,
    )


def _zoom(rig: Rig, focal_px: float) -> Image:
    """Zoom, and return the picture when it stands, grey."""
    rig.zoom.zoom(focal_px)
    wait_for_lens(rig)
    return _settled(rig, LENS_STANDS_S)[0]
