"""Where a fit starts: each camera by itself, T from motions, Gamma from every placement that both cameras see.

Whatever of a head's geometry, of the order of the views and of the cameras' places is known or not, these starts need
none of it.

One camera's intrinsics from views of the board, and the board's pose in one view (Zhang 2000, by OpenCV).

Where each placement's board is, told by all of its views together.

One view of a flat board has two poses that explain it about equally, mirrored at the line of sight. Another view, by
the other camera or from another pose of the head, tells them apart.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cotarget.calibration.bundle import Fit, fit, predict_pixels, robust_sigma
from cotarget.calibration.handeye import motions, park_martin, solve_hand_eye_from_motions
from cotarget.calibration.model import CameraName, Rejected, RigModel, View, stop_of
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head, zoom_fixed

FEWEST_VIEWS = 3  # Zhang's method: two views determine a pinhole, a third the distortion
FEWEST_CORNERS = 4  # of a plane, for its pose
# OpenCV starts the fit from this many views, evenly picked: its time grows with their square.
STARTING_VIEWS = 20
# A start only: no tangential distortion nor k2, k3, which a few views near the middle do not determine.
START_FLAGS = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO


def calibrate_camera(
    camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int], start: Intrinsics | None = None
) -> tuple[Intrinsics, Fit]:
    """Fit one camera's intrinsics: focal lengths, principal point, k1, k2, p1, p2; every view's pose is free.

    Args:
        camera: which one.
        views: its views, all at one focal length.
        points: the board's corners in its frame [m], (N, 3).
        size: (width, height) [px].
        start: where to start, if that is known.

    Raises:
        CalibrationError: too few views, or OpenCV finds no camera that explains them.
    """
    if len(views) < FEWEST_VIEWS:
        raise CalibrationError(
            f"{camera} camera: {len(views)} usable views of the board; at least {FEWEST_VIEWS} are needed"
        )
    lens = start or rough_intrinsics(camera, views, points, size)
    alone = [replace(view, camera="fixed", board=i) for i, view in enumerate(views)]
    boards = {i: board_pose(lens, view.corners_px, points) for i, view in enumerate(views)}
    result = fit(RigModel(boards=boards, fixed=lens), alone, points, {"fixed"})
    assert result.model.fixed is not None
    return result.model.fixed, result


def rough_intrinsics(camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int]) -> Intrinsics:
    """A camera with equal focal lengths and k1 alone, from nothing but a few views.

    Raises:
        CalibrationError: OpenCV finds no camera that explains them.
    """
    picked = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, STARTING_VIEWS).round().astype(int))]
    try:
        _, K, distortion, _, _ = cv2.calibrateCamera(
            [points[view.seen].astype(np.float32) for view in picked],
            [view.corners_px[view.seen].astype(np.float32) for view in picked],
            size,
            np.array([[1.0, 0, (size[0] - 1) / 2], [0, 1.0, (size[1] - 1) / 2], [0, 0, 1.0]]),
            np.zeros(5),
            flags=START_FLAGS,
        )
    except cv2.error:
        K = np.full((3, 3), np.nan)
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise CalibrationError(
            f"{camera} camera: no intrinsics explain its {len(views)} views; tilt the board in varying directions"
        )
    k = [float(value) for value in np.ravel(distortion)[:5]]
    return Intrinsics(
        size=size,
        focal_px=(float(K[0, 0]), float(K[1, 1])),
        center_px=(float(K[0, 2]), float(K[1, 2])),
        distortion=(k[0], k[1], k[2], k[3], k[4]),
    )


def board_pose(lens: Intrinsics, corners_px: Array, points: Array) -> RigidTransform:
    """The board's pose in a camera's frame, T_camera_board, from one view.

    Raises:
        CalibrationError: no pose explains the corners.
    """
    points, corners_px = _seen(points, corners_px)
    ok, rotvec, translation = cv2.solvePnP(
        points, corners_px, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    if not ok or not (np.isfinite(rotvec).all() and np.isfinite(translation).all()):
        raise CalibrationError("no pose of the board explains its corners")
    rotvec, translation = cv2.solvePnPRefineLM(
        points, corners_px, lens.matrix, np.array(lens.distortion), rotvec, translation
    )
    return RigidTransform.from_components(np.ravel(translation), Rotation.from_rotvec(np.ravel(rotvec)))


def pose_candidates(lens: Intrinsics, corners_px: Array, points: Array) -> list[RigidTransform]:
    """The one or two poses of a flat board that explain its corners about equally, the better one first.

    Raises:
        CalibrationError: no pose explains the corners.
    """
    points, corners_px = _seen(points, corners_px)
    _, rotvecs, translations, _ = cv2.solvePnPGeneric(
        points, corners_px, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    found = [
        RigidTransform.from_components(np.ravel(t), Rotation.from_rotvec(np.ravel(r)))
        for r, t in zip(rotvecs, translations, strict=True)
        if np.isfinite(r).all() and np.isfinite(t).all()
    ]
    if not found:
        raise CalibrationError("no pose of the board explains its corners")
    return found


def _seen(points: Array, corners_px: Array) -> tuple[Array, Array]:
    """The points that are seen, and where.

    Raises:
        CalibrationError: they are too few for a pose.
    """
    seen = np.isfinite(corners_px[:, 0])
    if np.count_nonzero(seen) < FEWEST_CORNERS:
        raise CalibrationError(f"{np.count_nonzero(seen)} corners of the board do not determine its pose")
    return points[seen], corners_px[seen]


# --- placing ---

ASKED_VIEWS = 2  # of a placement, whose candidates are tried on all of its views


def place_boards(model: RigModel, views: Sequence[View], points: Array) -> RigModel:
    """Give every placement the pose, of those that its views suggest, at which all of its views fit best.

    Args:
        model: with the intrinsics of the cameras that took the views, Gamma and T, at least roughly.
        views: of any placements.
        points: the board's corners in its frame [m], (N, 3).

    Returns:
        The model with these placements' boards and no others.
    """
    placements: dict[int, list[View]] = defaultdict(list)
    for view in views:
        placements[view.board].append(view)
    boards = {}
    for number, same in placements.items():
        # One view of each camera, where there are two cameras: their candidates differ. The one that shows most.
        by_camera = {view.camera: view for view in sorted(same, key=lambda view: int(view.seen.sum()))}
        candidates = [T for view in list(by_camera.values())[:ASKED_VIEWS] for T in _suggested(model, view, points)]
        errors = [_misfit(model, number, T, same, points) for T in candidates]
        boards[number] = candidates[int(np.argmin(errors))]
    return replace(model, boards=boards)


def _suggested(model: RigModel, view: View, points: Array) -> list[RigidTransform]:
    """T_fixed_board as one view may mean it."""
    poses = pose_candidates(model.lens_of(view), view.corners_px, points)
    if view.camera == "fixed":
        return poses
    assert model.zoom is not None
    pupil = RigidTransform.from_translation([0.0, 0.0, model.zoom.pupil[stop_of(model.zoom.nominal_px, view)]])
    T_fixed_zoom = zoom_fixed(view.pan, view.tilt, model.hand, model.gamma, model.head).inv() * pupil
    return [T_fixed_zoom * T for T in poses]


def _misfit(model: RigModel, number: int, T: RigidTransform, views: Sequence[View], points: Array) -> float:
    """Mean distance between predicted and seen corners [px]; infinite behind a camera."""
    pixels = predict_pixels(replace(model, boards={number: T}), views, points)
    off = np.concatenate([
        np.linalg.norm(predicted[view.seen] - view.corners_px[view.seen], axis=-1)
        for predicted, view in zip(pixels, views, strict=True)
    ])  # fmt: skip
    return float(np.mean(off)) if np.isfinite(off).all() else np.inf


@dataclass(frozen=True, eq=False)
class Steps:
    """What the steps before a joint fit found, and their residuals."""

    model: RigModel
    fixed_fit: Fit
    zoom_fit: Fit
    views: tuple[View, ...]
    rejected: tuple[Rejected, ...]

    @property
    def has_head(self) -> bool:
        """Whether the head ever left home."""
        return any(view.camera == "zoom" and not at_home(view) for view in self.views)


def both_cameras(
    views: Sequence[View], points: Array, sizes: Mapping[CameraName, tuple[int, int]], nominal_px: float | None
) -> Steps:
    """Step 1: each camera by itself, from views of one focal length."""
    fixed, fixed_fit, fixed_views, fixed_rejected = one_camera("fixed", views, points, sizes["fixed"])
    zoom, zoom_fit, zoom_views, zoom_rejected = one_camera("zoom", views, points, sizes["zoom"])
    model = RigModel({}, fixed, ZoomLens((nominal_px or zoom.focal_px[0],), (zoom,)))
    rejected = (*fixed_rejected, *zoom_rejected)
    return Steps(model, fixed_fit, zoom_fit, (*fixed_views, *zoom_views), rejected)


def stereo(model: RigModel, pairs: Sequence[View], points: Array) -> Fit:
    """Step 2: Gamma with the intrinsics as they are, from pairs at home."""
    start = replace(model, gamma=rough_gamma(model, pairs, points))
    return fit(place_boards(start, pairs, points), pairs, points, {"gamma"})


def check_pairs(steps: Steps, together_px: float) -> None:
    """Refuse pictures of two cameras without a head that contradict each other: alone each explains its own far better.

    Args:
        steps: each camera by itself.
        together_px: rms of both with one offset between them [px].

    Raises:
        CalibrationError: they do.
    """
    alone_px = max(steps.fixed_fit.rms_px, steps.zoom_fit.rms_px)
    if not steps.has_head and together_px > max(CONTRADICTION * alone_px, CONTRADICTION_FLOOR_PX):
        raise CalibrationError(
            f"the two cameras contradict each other: no one offset between them explains the corners to better than "
            f"{together_px:.2g} px, where each camera by itself does to {alone_px:.2g} px; both must stand still from "
            "the first picture to the last, and the two of a pair must show the board in the same place"
        )


# Pictures of two cameras that did not stand still are explained so many times worse together than each camera's alone;
# lenses and boards that are not as modelled cost less than twice.
CONTRADICTION, CONTRADICTION_FLOOR_PX = 3.0, 1.0


# A view whose typical corner is off by this many times what is usual for its camera, and above the floor, is left out;
# single wrong corners are left to the last fit.
OUTLIER_FACTOR = 4.0
OUTLIER_FLOOR_PX = 0.5
HOME_TOLERANCE = np.radians(0.01)  # the head is at home within a fifth of the smallest usual step


def at_home(view: View) -> bool:
    """Whether the head was at pan = tilt = 0."""
    return max(abs(view.pan), abs(view.tilt)) <= HOME_TOLERANCE


def one_camera(
    camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int]
) -> tuple[Intrinsics, Fit, tuple[View, ...], list[Rejected]]:
    """One camera's intrinsics from its views alone, without those that do not fit with the others.

    Raises:
        CalibrationError: too few views, or no camera explains them.
    """
    mine = tuple(view for view in views if view.camera == camera)
    lens, result = calibrate_camera(camera, mine, points, size)
    typical = np.array([robust_sigma(r[view.seen]) for r, view in zip(result.residuals, mine, strict=True)]) * 2**0.5
    limit = max(OUTLIER_FACTOR * float(np.median(typical)), OUTLIER_FLOOR_PX)
    good = tuple(view for view, value in zip(mine, typical, strict=True) if value <= limit)
    if len(good) == len(mine):
        return lens, result, mine, []
    rejected = [
        Rejected(view.name, f"its corners are {value:.2f} px off, where {limit:.2f} px is the limit")
        for view, value in zip(mine, typical, strict=True)
        if value > limit
    ]
    lens, result = calibrate_camera(camera, good, points, size, start=lens)
    return lens, result, good, rejected


def pairs_at_home(views: Sequence[View]) -> tuple[View, ...]:
    """The views of those placements that both cameras see with the head at home."""
    return of_both([view for view in views if view.camera == "fixed" or at_home(view)])


def of_both(views: Sequence[View]) -> tuple[View, ...]:
    """The views of those placements that both cameras see."""
    seen = [{view.board for view in views if view.camera == camera} for camera in ("fixed", "zoom")]
    return tuple(view for view in views if view.board in seen[0] & seen[1])


def rough_gamma(model: RigModel, views: Sequence[View], points: Array) -> RigidTransform:
    """Gamma from placements that both cameras see, whatever the head's pose: the candidate nearest to all others.

    Args:
        model: both cameras, and the hand where the head has moved.
        views: of such placements.
        points: the board's corners in its frame [m], (N, 3).
    """
    assert model.fixed is not None
    by_board: dict[int, list[View]] = defaultdict(list)
    for view in views:
        by_board[view.board].append(view)
    candidates = []
    for same in by_board.values():
        boards = [board_pose(model.fixed, v.corners_px, points) for v in same if v.camera == "fixed"]
        for view in same:
            if view.camera == "fixed":
                continue
            T_zoom_board = board_pose(model.lens_of(view), view.corners_px, points)
            head = base_head(view.pan, view.tilt, model.head)
            T_zoom0_zoom = model.hand.inv() * head * model.hand  # Eq. 2 solved for Gamma
            candidates += [T_zoom0_zoom * T_zoom_board * board.inv() for board in boards]
    return _most_central(candidates, scale=float(np.ptp(points, axis=0).max()))


def _most_central(candidates: Sequence[RigidTransform], scale: float) -> RigidTransform:
    """The transform nearest to all others: a board seen in its mirrored pose cannot pull it away."""
    t = np.array([T.translation for T in candidates])
    q = Rotation.concatenate([T.rotation for T in candidates])
    far = np.linalg.norm(t[:, None] - t[None], axis=-1) / scale
    turned = np.array([(q * one.inv()).magnitude() for one in q])
    return candidates[int(np.argmin(np.median(far + turned, axis=1)))]


def rough_hand(model: RigModel, views: Sequence[View], points: Array, *, regularize: bool = False) -> RigidTransform:
    """T by Park and Martin's method from all motions within each placement.

    Args:
        model: with the zoom camera.
        views: of any placements.
        points: the board's corners in its frame [m], (N, 3).
        regularize: whether to take the smallest turn and shift of what the motions leave free.

    Raises:
        CalibrationError: the motions do not determine it, or contradict each other.
    """
    A, B = head_motions(model, views, points)
    return solve_hand_eye_from_motions(A, B, regularize=True).X if regularize else park_martin(A, B)


def head_motions(
    model: RigModel, views: Sequence[View], points: Array
) -> tuple[list[RigidTransform], list[RigidTransform]]:
    """All motions of the head and of the camera within each placement, A and B of A T = T B."""
    assert model.zoom is not None
    placements: dict[int, list[View]] = defaultdict(list)
    for view in views:
        if view.camera == "zoom":
            placements[view.board].append(view)
    A: list[RigidTransform] = []
    B: list[RigidTransform] = []
    for same in placements.values():
        heads = [base_head(view.pan, view.tilt, model.head) for view in same]
        boards = [board_pose(model.lens_of(view), view.corners_px, points) for view in same]
        for more, motion in zip((A, B), motions(heads, boards), strict=True):
            more.extend(motion)
    if not A:
        raise CalibrationError(
            "hand-eye: no placement of the board is seen by the zoom camera from two poses of the head; "
            "leave the board where it is while the head turns"
        )
    return A, B
