"""A rig made of numbers: its truth, what its cameras see of a board, and how far off a calibration of it points.

Nothing here uses the package's camera or head model: corners come from OpenCV's projections and written-out matrices.
The truth can have what a model lacks: lenses of other kinds, a head that sags, lags, scatters or counts wrongly, a
lever that gives way.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration import Calibration, View
from cotarget.calibration.model import CameraName
from cotarget.geometry import Array, RigidTransform, Rotation, pose
from cotarget.simconfig import DEFAULT_GAMMA, DEFAULT_T

SIZE = (640, 480)
SIZES: Mapping[CameraName, tuple[int, int]] = {"fixed": SIZE, "zoom": SIZE}
NOMINAL_PX = 667.0  # what the zoom camera's device calls its shortest focal length
LONGEST_PX = 7155.0  # the focal length at which errors are stated in pixels
TARGET_DEPTHS = (4.0, 30.0)  # [m]
BOARD_DEPTHS = (2.5, 8.0)  # [m]
MARGIN_PX = 40.0  # the middle of a board stays so far inside the wide view
NEAREST = 0.2  # [m]; no camera sees anything nearer
WIDEST = 1.2  # tangent of the angle off the axis beyond which distortion may have folded back
# Of the head in use: pan and tilt [rad].
HEAD_LIMITS = ((np.radians(-158.9), np.radians(158.9)), (np.radians(-46.6), np.radians(31.1)))
CELLS = (5, 3)  # of the wide view, in columns and rows, over which boards are spread
CELL_STEP = 7  # cells are taken in this step, so that a few boards reach all over as well
FLATTEST = np.cos(np.radians(65.0))  # a board is not found that is seen at a flatter angle
FARTHER = 0.03  # by which a board moves away that is not wholly seen, relative to its depth
GOLDEN = (np.sqrt(5) - 1) / 2  # multiples of it, modulo 1, are evenly spread from the first on
LOOKS_DRAWN = 80  # head poses among which those far apart are chosen
FEWEST_CORNERS = 12  # of a board seen in part, through a longer focal length
TRIES = 200  # head poses drawn for a placement
PLACEMENT_TRIES = 100_000
NEWTON_STEPS = 50
SOLVED = 1e-10  # [rad] or normalised; far below the smallest error of interest, 1e-6
DIFFERENCE = 1e-6  # step of central differences


@dataclass(frozen=True)
class Lens:
    """True intrinsics.

    Attributes:
        fx: focal length [px]; fy likewise.
        cx: principal point [px]; cy likewise.
        distortion: OpenCV's coefficients, 4, 5, 8 (rational) or 12 (thin prism) of them; the 4 of `cv2.fisheye`.
        fisheye: whether they are those.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False

    @property
    def K(self) -> Array:
        """The camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, x_camera: Array) -> Array:
        """Pixels (n, 2) of points (n, 3)."""
        project = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        x = np.ascontiguousarray(np.asarray(x_camera, float).reshape(-1, 1, 3))
        px, _ = project(x, np.zeros((3, 1)), np.zeros((3, 1)), self.K, np.array(self.distortion, float))
        return np.asarray(px).reshape(-1, 2)

    def inside(self, x_camera: Array, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Which of the points (n, 3) are in front of the camera, unfolded, and inside the image."""
        x_camera = np.asarray(x_camera, float)
        ahead = x_camera[:, 2] >= NEAREST
        ahead &= np.abs(x_camera[:, :2]).max(axis=1) <= WIDEST * np.abs(x_camera[:, 2])
        px = self.project(np.where(ahead[:, None], x_camera, [0.0, 0.0, 1.0]))
        return np.asarray(ahead & ((px >= margin) & (px <= np.array(SIZE) - 1 - margin)).all(axis=1))

    def sees(self, x_camera: Array, margin: float = 0.0) -> bool:
        """Whether all points are seen."""
        return bool(self.inside(x_camera, margin).all())


@dataclass(frozen=True)
class Stop:
    """The zoom lens at another focal length: by the device's account [px], in truth, and where its pupil is [m]."""

    nominal_px: float
    lens: Lens
    pupil: float = 0.0


@dataclass(frozen=True)
class Truth:
    """A whole rig, and the matrices of its head written out.

    The matrices take the axes' true angles; `stands` says what these are where the head reports others.

    Attributes:
        fixed: the fixed camera.
        zoom: the zoom camera at its shortest focal length.
        gamma: T_zoom0_fixed.
        hand: T_head_zoom.
        dz: from the pan axis to the tilt axis [m].
        eps: how far the tilt axis leans [rad].
        stops: the zoom lens's further stops.
        pan_scale: true turn over the reported one; tilt_scale likewise.
        sag: by how much the tilt gives way to the camera's weight when it is level [rad].
        play: backlash of both axes [rad]; they lag half of it behind.
        jitter: standard deviation of where either axis really stops, at every move anew [rad].
        give: how far the camera shifts on the head per radian of tilt [m].
    """

    fixed: Lens = Lens(686.0, 684.0, 325.0, 239.0, (-0.2, 0.0, 0.0, 0.0, 0.0))
    zoom: Lens = Lens(692.0, 693.0, 326.0, 235.0, (-0.1, 0.0, 0.0, 0.0, 0.0))
    gamma: RigidTransform = DEFAULT_GAMMA
    hand: RigidTransform = DEFAULT_T
    dz: float = 0.005
    eps: float = np.radians(0.1)
    stops: tuple[Stop, ...] = ()
    pan_scale: float = 1.0
    tilt_scale: float = 1.0
    sag: float = 0.0
    play: float = 0.0
    jitter: float = 0.0
    give: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def stands(
        self, reported: Array, before: Array | None = None, rng: np.random.Generator | None = None
    ) -> tuple[float, float]:
        """The axes' true pan and tilt [rad].

        Args:
            reported: pan and tilt as the head says [rad], (2,).
            before: where it came from, likewise; for the backlash.
            rng: for the jitter.
        """
        true = np.array([self.pan_scale, self.tilt_scale]) * np.asarray(reported, float)
        if before is not None:
            true = true - self.play / 2 * np.sign(np.subtract(reported, before))
        if rng is not None and self.jitter:
            true = true + rng.normal(0, self.jitter, 2)
        return float(true[0]), float(true[1] + self.sag * np.cos(true[1]))

    def base_head(self, pan: Array | float, tilt: Array | float) -> Array:
        """T_base_head at true angles (...), (..., 4, 4)."""
        pan, tilt = np.broadcast_arrays(np.asarray(pan, float), np.asarray(tilt, float))
        o, i = np.zeros(pan.shape), np.ones(pan.shape)
        c, s = np.cos(pan), np.sin(pan)
        Y = _stacked([[c, o, s, o], [o, i, o, o], [-s, o, c, o], [o, o, o, i]])
        ce, se = np.cos(self.eps), np.sin(self.eps)
        Z = np.array([[ce, -se, 0, 0], [se, ce, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        c, s = np.cos(tilt), np.sin(tilt)
        X = _stacked([[i, o, o, o], [o, c, -s, o], [o, s, c, o], [o, o, o, i]])
        D = np.eye(4)
        D[2, 3] = self.dz
        return Y @ D @ Z @ X @ Z.T @ np.linalg.inv(D)

    def zoom_fixed(self, pan: Array | float, tilt: Array | float) -> Array:
        """T_zoom_fixed at true angles (...), (..., 4, 4)."""
        T = self.hand.as_matrix()
        given = np.tile(np.eye(4), (*np.shape(tilt), 1, 1))
        given[..., :3, 3] = np.multiply.outer(tilt, self.give)
        T_head_zoom = given @ T
        return np.linalg.inv(T_head_zoom) @ np.linalg.inv(self.base_head(pan, tilt)) @ T @ self.gamma.as_matrix()

    def in_zoom(self, x_fixed: Array, pan: Array | float, tilt: Array | float) -> Array:
        """Points (..., 3) in the moved zoom camera's frame; one pair of true angles for all, or one for each."""
        M = self.zoom_fixed(pan, tilt)
        return np.asarray(np.einsum("...ij,...j->...i", M[..., :3, :3], x_fixed) + M[..., :3, 3])


def _stacked(rows: Sequence[Sequence[Array]]) -> Array:
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def truth_of(calibration: Calibration) -> Truth:
    """The rig that a calibration describes, at its shortest focal length."""
    fixed, zoom = (
        Lens(*lens.focal_px, *lens.center_px, lens.distortion)
        for lens in (calibration.fixed, calibration.zoom.stops[0])
    )
    head = calibration.head
    return Truth(
        fixed=fixed,
        zoom=zoom,
        gamma=calibration.T_zoom0_fixed,
        hand=calibration.hand_eye(),
        dz=head.axis_offset,
        eps=head.squareness,
        pan_scale=head.pan_scale,
        tilt_scale=head.tilt_scale,
    )


def other_rig() -> Truth:
    """A wide baseline, toed in, with a long lever and a rolled camera."""
    return Truth(gamma=pose([-1.5, 0.1, -0.1], [1.0, 12.0, 5.0]), hand=pose([0.1, -0.15, 0.08], [2.0, 1.5, 5.0]))


def with_lever_shifted(truth: Truth, shift: Sequence[float]) -> Truth:
    """The rig after the camera has slipped on the head by a shift in the head's frame [m], (3,)."""
    hand = RigidTransform.from_translation(np.array(shift, float)) * truth.hand
    return replace(truth, hand=hand, gamma=hand.inv() * truth.hand * truth.gamma)


def synthetic_views(
    truth: Truth,
    points: Array,
    rng: np.random.Generator,
    boards: int = 30,
    noise_px: float = 0.1,
    moved: int = 3,
    pan_range: float = 0.5,
    tilt_range: float = 0.4,
    far: float = BOARD_DEPTHS[1],
    shape: Array | None = None,
    first: int = 0,
) -> list[View]:
    """Views of boards held at random where the fixed camera sees them, home and moved.

    Args:
        truth: the rig.
        points: the board's corners as everybody believes them to be [m], (N, 3).
        rng: draws everything.
        boards: how many placements.
        noise_px: standard deviation of a corner's coordinate.
        moved: how many head poses for each placement, besides one at home where that sees it.
        pan_range: how far the head turns either way [rad].
        tilt_range: likewise.
        far: the farthest depth [m].
        shape: where the corners really are on the board [m], (N, 3); by default the same.
        first: number of the first placement.
    """
    views: list[View] = []
    center = points.mean(axis=0)
    true_points = points if shape is None else shape
    number, stood = first, np.zeros(2)
    for _ in range(PLACEMENT_TRIES):
        if number == first + boards:
            break
        depth = np.exp(rng.uniform(np.log(BOARD_DEPTHS[0]), np.log(far)))
        uv = rng.uniform(MARGIN_PX, np.array(SIZE) - MARGIN_PX)
        ray = np.array([(uv[0] - truth.fixed.cx) / truth.fixed.fx, (uv[1] - truth.fixed.cy) / truth.fixed.fy, 1.0])
        R = Rotation.from_rotvec(np.radians(rng.uniform([-35, -35, -20], [35, 35, 20])))
        x_fixed = R.apply(true_points - center) + ray * depth
        if not truth.fixed.sees(x_fixed):
            continue
        reach = [pan_range, tilt_range]
        poses = np.concatenate([np.zeros((1, 2)), rng.uniform(np.negative(reach), reach, (TRIES, 2))])
        seen = poses[seen_from(truth, x_fixed, poses)]
        if not len(seen) or (len(seen) < 2 and moved):
            continue
        views.append(View("fixed", noisy(truth.fixed.project(x_fixed), noise_px, rng), number))
        for reported in seen[: moved + 1]:
            views.append(zoom_view(truth, x_fixed, number, reported, stood, noise_px, rng))
            stood = reported
        number += 1
    return views


@dataclass(frozen=True)
class Placing:
    """Where boards are put, and from where they are looked at.

    Attributes:
        boards: how many placements, one in each cell of the wide view in turn.
        looks: head poses for each placement, as far apart as the zoom camera's view and the head's limits allow; the
            one at home is among them where it sees the board.
        depths: of the boards, even in their logarithm [m].
        turned: how far a board is turned out of the direction halfway between both cameras [rad].
        limits: of pan and of tilt [rad].
    """

    boards: int = 15
    looks: int = 4
    depths: tuple[float, float] = BOARD_DEPTHS
    turned: float = np.radians(45.0)
    limits: tuple[tuple[float, float], tuple[float, float]] = HEAD_LIMITS


DEFAULT_PLACING = Placing()


def spread_views(
    truth: Truth,
    points: Array,
    rng: np.random.Generator,
    noise_px: float,
    placing: Placing = DEFAULT_PLACING,
    shape: Array | None = None,
) -> list[View]:
    """Views of boards all over the wide view, each looked at from head poses that bring it all over the zoom view.

    Args:
        truth: the rig.
        points: the board's corners as everybody believes them to be [m], (N, 3).
        rng: draws everything.
        noise_px: standard deviation of a corner's coordinate.
        placing: where boards are put.
        shape: where the corners really are on the board [m], (N, 3); by default the same.

    Raises:
        AssertionError: there is no room for a board.
    """
    views: list[View] = []
    stood = np.zeros(2)
    for number in range(placing.boards):
        x_fixed, poses = placed(truth, points if shape is None else shape, rng, placing, number)
        views.append(View("fixed", noisy(truth.fixed.project(x_fixed), noise_px, rng), number))
        for reported in poses:
            views.append(zoom_view(truth, x_fixed, number, reported, stood, noise_px, rng))
            stood = reported
    return views


def placed(truth: Truth, points: Array, rng: np.random.Generator, placing: Placing, number: int) -> tuple[Array, Array]:
    """Find a place for a board: its corners in the fixed camera's frame [m], (N, 3), and head poses (n, 2) [rad].

    A board too near for its cell moves away from the camera; a cell that the zoom camera cannot see gives way to any.

    Raises:
        AssertionError: there is none.
    """
    centered = points - points.mean(axis=0)
    row, column = divmod(number * CELL_STEP % (CELLS[0] * CELLS[1]), CELLS[0])
    near, far = np.log(np.array(placing.depths))
    depth = near + (far - near) * (GOLDEN * number % 1)
    zoom_at = truth.gamma.inv().translation
    for i in range(PLACEMENT_TRIES // TRIES):
        cell = np.array([column, row]) + rng.uniform(0, 1, 2) if i < TRIES else rng.uniform([0, 0], CELLS)
        x = np.append(undistorted(cell / CELLS * (np.array(SIZE) - 1.0), truth.fixed), 1.0) * np.exp(depth)
        facing = _unit(_unit(x) + _unit(x - zoom_at))
        turn = Rotation.from_rotvec(rng.uniform(-1, 1, 3) * placing.turned)
        x_fixed = (turn * _towards(facing)).apply(centered) + x
        normal = turn.apply(facing)
        sideways = min(normal @ _unit(x), normal @ _unit(x - zoom_at)) < FLATTEST
        if sideways or not truth.fixed.sees(x_fixed):
            depth = min(depth + FARTHER, far) if depth < far else rng.uniform(near, far)
            continue
        looking = np.concatenate([np.zeros((1, 2)), _looks(truth, x, rng)])
        inside = ((looking >= np.array(placing.limits)[:, 0]) & (looking <= np.array(placing.limits)[:, 1])).all(axis=1)
        seen = looking[inside]
        seen = seen[seen_from(truth, x_fixed, seen)]
        if len(seen) >= placing.looks:
            return x_fixed, _apart(seen, placing.looks)
        depth = rng.uniform(near, far)
    raise AssertionError("no room for a board that both cameras see")


def _looks(truth: Truth, x_fixed: Array, rng: np.random.Generator) -> Array:
    """Head poses that bring a point (3,) to pixels all over the zoom view, (n, 2)."""
    pixels = rng.uniform([0, 0], np.array(SIZE) - 1.0, (LOOKS_DRAWN, 2))
    rays = np.c_[(pixels - [truth.zoom.cx, truth.zoom.cy]) / [truth.zoom.fx, truth.zoom.fy], np.ones(LOOKS_DRAWN)]
    return aimed(truth, np.tile(x_fixed, (LOOKS_DRAWN, 1)), rays)


def _apart(poses: Array, count: int) -> Array:
    """So many of the poses (n, 2), the first one and each time the one farthest from all taken."""
    taken = [0]
    while len(taken) < count:
        away = np.linalg.norm(poses[:, None] - poses[taken][None], axis=-1).min(axis=1)
        taken.append(int(np.argmax(away)))
    return poses[taken]


def _towards(direction: Array) -> Rotation:
    """The smallest rotation that turns +z into a direction (3,)."""
    return Rotation.align_vectors(direction[None], np.array([[0.0, 0.0, 1.0]]))[0]


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def seen_from(truth: Truth, x_fixed: Array, poses: Array) -> npt.NDArray[np.bool_]:
    """From which head poses (n, 2) the zoom camera sees all points (N, 3)."""
    x_zoom = truth.in_zoom(x_fixed, poses[:, :1], poses[:, 1:])
    inside = truth.zoom.inside(x_zoom.reshape(-1, 3)).reshape(x_zoom.shape[:2])
    return np.asarray(inside.all(axis=1))


def zoom_view(
    truth: Truth,
    x_fixed: Array,
    number: int,
    reported: Array,
    before: Array | None,
    noise_px: float,
    rng: np.random.Generator,
    stop: Stop | None = None,
) -> View:
    """What the zoom camera sees of a board's corners (N, 3), in part perhaps, from a pose that the head reports.

    Args:
        truth: the rig.
        x_fixed: where the corners are [m], (N, 3).
        number: of the placement.
        reported: pan and tilt [rad], (2,).
        before: where the head came from, likewise.
        noise_px: standard deviation of a corner's coordinate.
        rng: draws noise and jitter.
        stop: the zoom lens's; the shortest focal length by default.
    """
    lens, pupil, nominal = (truth.zoom, 0.0, NOMINAL_PX) if stop is None else (stop.lens, stop.pupil, stop.nominal_px)
    x = truth.in_zoom(x_fixed, *truth.stands(reported, before, rng)) - [0.0, 0.0, pupil]
    px = noisy(lens.project(x), noise_px, rng)
    if stop is not None:
        px = np.where(lens.inside(x)[:, None], px, np.nan)
    return View("zoom", px, number, float(reported[0]), float(reported[1]), focal_px=nominal)


def views_at_stops(
    truth: Truth, placements: Sequence[Array], rng: np.random.Generator, noise_px: float = 0.1, looks: int = 2
) -> list[View]:
    """Views of boards through the zoom lens's further stops, seen in part where they fill more than the image.

    Args:
        truth: with stops.
        placements: corners of each placement in the fixed camera's frame [m], (N, 3); their numbers count from 0.
        rng: draws which corner is looked at, and the noise.
        noise_px: standard deviation of a corner's coordinate.
        looks: how many head poses for each placement and stop.
    """
    views: list[View] = []
    before = np.zeros(2)
    for stop in truth.stops:
        for number, x_fixed in enumerate(placements):
            for _ in range(looks):
                reported = aimed(truth, x_fixed[rng.integers(len(x_fixed))][None], np.array([0.0, 0.0, 1.0]))[0]
                view = zoom_view(truth, x_fixed, number, reported, before, noise_px, rng, stop)
                if np.isfinite(reported).all() and view.seen.sum() >= FEWEST_CORNERS:
                    views.append(view)
                    before = reported
    return views


def noisy(corners_px: Array, noise_px: float, rng: np.random.Generator) -> Array:
    """Corners (N, 2) with Gaussian noise."""
    return corners_px + rng.normal(0, noise_px, corners_px.shape)


def aim(calibration: Calibration, x_fixed: Array) -> Array:
    """Pan and tilt that bring points to the middle of the zoom image, by the calibration; solved numerically.

    Args:
        calibration: whose word is taken for the truth.
        x_fixed: points in the fixed camera's frame [m], (3,) or (n, 3).

    Returns:
        As the head reports them [rad], (2,) or (n, 2); nan where there is no such pose.
    """
    head = calibration.head
    model = truth_of(calibration)
    lens = calibration.zoom.stops[0]
    q = aimed(model, np.atleast_2d(x_fixed), lens.ray(lens.image_center_px))
    q = (q - [head.pan_zero, head.tilt_zero]) / [head.pan_scale, head.tilt_scale]
    return q if np.ndim(x_fixed) > 1 else q[0]


def aimed(model: Truth, x_fixed: Array, ray: Array) -> Array:
    """True pan and tilt at which a ray (3,) or (n, 3) of the zoom camera meets points (n, 3) [rad], (n, 2).

    Newton's method, from where a head without levers would look; nan where there is no such pose.
    """
    x_base = (model.hand * model.gamma).apply(x_fixed)
    look = model.hand.rotation.apply(ray)

    def off(q: Array) -> Array:
        x = model.in_zoom(x_fixed, q[:, 0], q[:, 1])
        return x[:, :2] / np.abs(x[:, 2:]) - ray[..., :2] / ray[..., 2:]

    pan = np.arctan2(x_base[:, 0], x_base[:, 2]) - np.arctan2(look[..., 0], look[..., 2])
    tilt = np.arctan2(-x_base[:, 1], np.hypot(x_base[:, 0], x_base[:, 2])) + np.arctan2(look[..., 1], look[..., 2])
    found = np.full((len(x_fixed), 2), np.nan)
    for nudge in ([0.0, 0.0], [0.3, 0.0], [-0.3, 0.0], [0.0, 0.3], [0.0, -0.3]):
        q = np.stack([pan, tilt], axis=-1) + nudge
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                J = [(off(q + d) - off(q - d)) / (2 * DIFFERENCE) for d in DIFFERENCE * np.eye(2)]
                (a, c), (b, d) = (j.T for j in J)
                u, v = off(q).T
                step = np.stack([d * u - b * v, a * v - c * u], axis=-1) / (a * d - b * c)[:, None]
                q = q - np.clip(step, -0.5, 0.5)
                if not (np.abs(step) > SOLVED).any():
                    break
            x = model.in_zoom(x_fixed, q[:, 0], q[:, 1])
            good = (np.abs(off(q)).max(axis=1) < SOLVED) & (x[:, 2] > 0) & np.isnan(found[:, 0])
        found[good] = q[good]
        if np.isfinite(found).all():
            break
    return (found + np.pi) % (2 * np.pi) - np.pi


def undistorted(pixel: Array | Sequence[float], lens: Lens) -> Array:
    """Image-plane coordinates x / z, y / z of pixels (..., 2), by Newton's method on the projection."""
    pixel = np.asarray(pixel, float)
    wanted = pixel.reshape(-1, 2)

    def project(xy: Array) -> Array:
        return lens.project(np.c_[xy, np.ones(len(xy))])

    xy = (wanted - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    for _ in range(NEWTON_STEPS):
        J = np.stack([(project(xy + d) - project(xy - d)) / (2 * DIFFERENCE) for d in DIFFERENCE * np.eye(2)], axis=-1)
        step = np.linalg.solve(J, (project(xy) - wanted)[..., None])[..., 0]
        xy = xy - step
        if np.abs(step).max() < SOLVED / 100:
            break
    return xy.reshape(pixel.shape)


def draw_targets(
    rng: np.random.Generator, count: int, depths: tuple[float, float] = TARGET_DEPTHS
) -> tuple[Array, Array]:
    """Pixels (n, 2) all over the wide view, and depths (n,) [m], even in their logarithm."""
    drawn = [
        (rng.uniform([0, 0], np.array(SIZE) - 1.0), np.exp(rng.uniform(*np.log(np.array(depths)))))
        for _ in range(count)
    ]
    return np.array([pixel for pixel, _ in drawn]), np.array([depth for _, depth in drawn])


def pointing_errors(calibration: Calibration, truth: Truth, rng: np.random.Generator, count: int = 200) -> Array:
    """Angles between where the true zoom camera looks and the true target [degrees], (count,).

    Targets lie all over the wide view; see `draw_targets` and `misses`.

    Raises:
        AssertionError: a target cannot be reached.
    """
    errors = np.degrees(misses(calibration, truth, *draw_targets(rng, count), rng))
    assert np.isfinite(errors).all(), "no pan and tilt found for a target"
    return errors


def misses(
    calibration: Calibration,
    truth: Truth,
    pixels: Array,
    depths: Array,
    rng: np.random.Generator | None = None,
    *,
    by_distance: bool = False,
) -> Array:
    """Angles between where the true zoom camera looks and true targets, one after the other [rad], (n,).

    Pixel and depth are known exactly, and the head goes where it is told as well as the true one does. The camera
    looks along the true ray through the middle of its image, at its shortest focal length.

    Args:
        calibration: by which the head is sent.
        truth: the rig.
        pixels: of the targets in the wide view, (n, 2).
        depths: of the targets [m], (n,).
        rng: for the head's jitter.
        by_distance: whether the calibration is told the targets' distance in place of their depth. That serves where
            the true lens follows another model, whose axis the calibration cannot know.

    Returns:
        nan where the calibration finds no pose.
    """
    x_true = np.c_[undistorted(pixels, truth.fixed), np.ones(len(pixels))] * depths[:, None]
    x_believed = calibration.fixed.ray(pixels) * depths[:, None]
    if by_distance:
        x_believed *= np.linalg.norm(x_true, axis=1, keepdims=True) / np.linalg.norm(x_believed, axis=1, keepdims=True)
    return looking_off(truth, x_true, aim(calibration, x_believed), rng)


def looking_off(truth: Truth, x_fixed: Array, q: Array, rng: np.random.Generator | None = None) -> Array:
    """Angles between where the true zoom camera looks and points, one after the other [rad], (n,).

    Args:
        truth: the rig; its camera looks along the true ray through the middle of its image, at its shortest focal
            length.
        x_fixed: the points in the fixed camera's frame [m], (n, 3).
        q: pan and tilt told to the head for each of them [rad], (n, 2).
        rng: for the head's jitter.

    Returns:
        nan where q is.
    """
    before = np.concatenate([np.zeros((1, 2)), q[:-1]])
    stood = np.array([truth.stands(*pair, rng) for pair in zip(q, before, strict=True)])
    x = truth.in_zoom(x_fixed, stood[:, 0], stood[:, 1])
    look = np.append(middle_of(truth.zoom), 1.0)
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(x, look), axis=1), x @ look))


def middle_of(lens: Lens) -> Array:
    """Image-plane coordinates of the middle of a camera's image, (2,)."""
    return undistorted((np.array(SIZE) - 1) / 2, lens)
