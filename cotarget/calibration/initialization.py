"""Calibration step by step: intrinsics of each camera, board poses, Gamma and T.

- `calibrate_camera`: intrinsics of one camera (Zhang 2000, by OpenCV).
- `place_boards`: pose of every placement. One view of a flat board has two poses that explain it about equally,
  mirrored at the line of sight; a view by the other camera or from another head pose decides.
- `rough_gamma`, `stereo`: Gamma from placements that both cameras see.
- `rough_hand`: T from the motions of head and camera.
- `sequential`: these steps one after the other, as in the paper's Table 1; kept for comparison.

The joint method starts from these estimates. Nothing is assumed of the head's geometry, the order of the views or the
cameras' mounting.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cotarget.calibration.bundle import Fit, fit, predict_pixels, robust_sigma
from cotarget.calibration.handeye import motions, park_martin, solve_hand_eye_from_motions
from cotarget.calibration.model import BundleModel, CameraName, Rejected, Residuals, Solution, View
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import base_head
from cotarget.rig_geometry import FixedCamera, ZoomHead

# Intrinsics and board pose of one camera

FEWEST_VIEWS = 3  # Zhang's method: two views determine a pinhole, a third the distortion
FEWEST_CORNERS = 4  # of a plane, for its pose
# Views, evenly picked, from which OpenCV computes the start; its time grows with their square.
STARTING_VIEWS = 20
# The start has no tangential distortion, k2 and k3, which a few views near the middle do not determine.
START_FLAGS = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_ASPECT_RATIO


def calibrate_camera(
    camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int], start: Intrinsics | None = None
) -> tuple[Intrinsics, Fit]:
    """Fit one camera's intrinsics: focal lengths, principal point, k1, k2, p1, p2; every view's pose is free.

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
    result = fit(BundleModel(boards, FixedCamera(lens)), alone, points, {"fixed"})
    return result.model.fixed.lens, result


def rough_intrinsics(camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int]) -> Intrinsics:
    """Estimate intrinsics with equal focal lengths and k1 alone from a few views."""
    picked = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, STARTING_VIEWS).round().astype(int))]
    middle = (np.array(size) - 1) / 2
    try:
        _, K, distortion, _, _ = cv2.calibrateCamera(
            [points[view.seen].astype(np.float32) for view in picked],
            [view.corners_px[view.seen].astype(np.float32) for view in picked],
            size,
            np.array([[1.0, 0, middle[0]], [0, 1.0, middle[1]], [0, 0, 1.0]]),
            np.zeros(5),
            flags=START_FLAGS,
        )
    except cv2.error:
        K = np.full((3, 3), np.nan)
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise CalibrationError(
            f"{camera} camera: no intrinsics explain its {len(views)} views; tilt the board in varying directions"
        )
    k1, k2, p1, p2, k3 = np.ravel(distortion)[:5].tolist()
    return Intrinsics(size, (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2])), (k1, k2, p1, p2, k3))


def board_pose(lens: Intrinsics, corners_px: Array, points: Array) -> RigidTransform:
    """Estimate the board's pose in a camera's frame, T_camera_board, from one view."""
    points, corners_px = _seen(points, corners_px)
    ok, rotvec, translation = cv2.solvePnP(
        points, corners_px, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    if not ok or not (np.isfinite(rotvec).all() and np.isfinite(translation).all()):
        raise CalibrationError("no pose of the board explains its corners")
    rotvec, translation = cv2.solvePnPRefineLM(
        points, corners_px, lens.matrix, np.array(lens.distortion), rotvec, translation
    )
    return _transform(rotvec, translation)


def pose_candidates(lens: Intrinsics, corners_px: Array, points: Array) -> list[RigidTransform]:
    """Find the one or two poses T_camera_board that explain a flat board's corners about equally, the better first."""
    points, corners_px = _seen(points, corners_px)
    _, rotvecs, translations, _ = cv2.solvePnPGeneric(
        points, corners_px, lens.matrix, np.array(lens.distortion), flags=cv2.SOLVEPNP_IPPE
    )
    pairs = zip(rotvecs, translations, strict=True)
    found = [_transform(r, t) for r, t in pairs if np.isfinite(r).all() and np.isfinite(t).all()]
    if not found:
        raise CalibrationError("no pose of the board explains its corners")
    return found


def _transform(rotvec: Array, translation: Array) -> RigidTransform:
    """Convert a pose from OpenCV."""
    return RigidTransform.from_components(np.ravel(translation), Rotation.from_rotvec(np.ravel(rotvec)))


def _seen(points: Array, corners_px: Array) -> tuple[Array, Array]:
    """Select the points that are seen, and their corners."""
    seen = np.isfinite(corners_px[:, 0])
    if np.count_nonzero(seen) < FEWEST_CORNERS:
        raise CalibrationError(f"{np.count_nonzero(seen)} corners of the board do not determine its pose")
    return points[seen], corners_px[seen]


# Pose of every placement

ASKED_VIEWS = 2  # views of a placement whose candidate poses are tried on all of its views


def place_boards(model: BundleModel, views: Sequence[View], points: Array) -> BundleModel:
    """Choose the pose of every placement: of the candidates from its views, the one that fits all its views best.

    The model has at least rough intrinsics, Gamma and T. It is returned with the boards of these placements alone.
    """
    boards = {}
    for number, same in by_placement(views).items():
        # The view of each camera that shows most corners; the candidates of the two cameras differ.
        by_camera = {view.camera: view for view in sorted(same, key=lambda view: int(view.seen.sum()))}
        candidates = [T for view in list(by_camera.values())[:ASKED_VIEWS] for T in _suggested(model, view, points)]
        errors = [_misfit(model, number, T, same, points) for T in candidates]
        boards[number] = candidates[int(np.argmin(errors))]
    return replace(model, boards=boards)


def by_placement(views: Iterable[View]) -> dict[int, list[View]]:
    """Group views by the number of their placement."""
    placements: dict[int, list[View]] = defaultdict(list)
    for view in views:
        placements[view.board].append(view)
    return placements


def _suggested(model: BundleModel, view: View, points: Array) -> list[RigidTransform]:
    """Find the candidates of T_fixed_board from one view."""
    poses, stop = pose_candidates(model.lens_of(view), view.corners_px, points), model.stop_of(view)
    if stop is None:
        return poses
    pupil = RigidTransform.from_translation([0.0, 0.0, model.head.lens.pupil[stop]])
    T_fixed_zoom = model.head.T_fixed_zoom(view.pan, view.tilt) * pupil
    return [T_fixed_zoom * T for T in poses]


def _misfit(model: BundleModel, number: int, T: RigidTransform, views: Sequence[View], points: Array) -> float:
    """Compute the mean distance between predicted and seen corners [px]; infinite behind a camera."""
    pixels = predict_pixels(replace(model, boards={number: T}), views, points)
    off = np.concatenate([
        np.linalg.norm(predicted[view.seen] - view.corners_px[view.seen], axis=-1)
        for predicted, view in zip(pixels, views, strict=True)
    ])  # fmt: skip
    return float(np.mean(off)) if np.isfinite(off).all() else np.inf


# Both cameras, Gamma and T

# Ratio of the rms together to the rms alone, and rms, beyond which two cameras contradict each other, because they did
# not stand still. Lenses and boards that differ from the model cost less than twice.
CONTRADICTION, CONTRADICTION_FLOOR_PX = 3.0, 1.0


@dataclass(frozen=True, eq=False)
class Steps:
    """Result of calibrating each camera by itself."""

    model: BundleModel
    fixed_fit: Fit
    zoom_fit: Fit
    views: tuple[View, ...]  # views used
    rejected: tuple[Rejected, ...]  # views left out

    @property
    def has_head(self) -> bool:
        """True if the head ever left home."""
        return any(view.camera == "zoom" and not at_home(view) for view in self.views)

    def residuals(
        self,
        views: Sequence[View],
        rejected: Sequence[Rejected],
        *,
        stereo_px: float | None,
        handeye_px: float | None,
        outliers: int = 0,
    ) -> Residuals:
        """Make the residuals of a calibration that goes on from here, and used these views."""
        zoom_views = sum(view.camera == "zoom" for view in views)
        return Residuals(
            fixed_rms_px=self.fixed_fit.rms_px,
            zoom_rms_px=self.zoom_fit.rms_px,
            stereo_rms_px=stereo_px,
            handeye_rms_px=handeye_px if self.has_head else None,
            fixed_views=len(views) - zoom_views,
            zoom_views=zoom_views,
            pairs=len({view.board for view in pairs_at_home(views)}),
            outliers=outliers,
            rejected=tuple(rejected),
        )


def both_cameras(
    views: Sequence[View], points: Array, sizes: Mapping[CameraName, tuple[int, int]], nominal_px: float | None
) -> Steps:
    """Calibrate each camera by itself, from views at one focal length (step 1 of the sequential method)."""
    fixed, fixed_fit, fixed_views, fixed_rejected = one_camera("fixed", views, points, sizes["fixed"])
    zoom, zoom_fit, zoom_views, zoom_rejected = one_camera("zoom", views, points, sizes["zoom"])
    lens = ZoomLens((nominal_px or zoom.focal_px[0],), (zoom,))
    still = RigidTransform.identity()
    model = BundleModel({}, FixedCamera(fixed), ZoomHead(lens, still, still))
    rejected = (*fixed_rejected, *zoom_rejected)
    return Steps(model, fixed_fit, zoom_fit, (*fixed_views, *zoom_views), rejected)


def stereo(model: BundleModel, pairs: Sequence[View], points: Array) -> Fit:
    """Fit Gamma to pairs at home with the intrinsics held (step 2 of the sequential method)."""
    start = model.with_zoom_head(T_zoom0_fixed=rough_gamma(model, pairs, points))
    return fit(place_boards(start, pairs, points), pairs, points, {"gamma"})


def check_pairs(steps: Steps, together_px: float) -> None:
    """Refuse images of two cameras without a head whose rms with one Gamma is far larger than each camera's alone."""
    alone_px = max(steps.fixed_fit.rms_px, steps.zoom_fit.rms_px)
    if not steps.has_head and together_px > max(CONTRADICTION * alone_px, CONTRADICTION_FLOOR_PX):
        raise CalibrationError(
            f"the two cameras contradict each other: no one offset between them explains the corners to better than "
            f"{together_px:.2g} px, where each camera by itself does to {alone_px:.2g} px; both must stand still from "
            "the first picture to the last, and the two of a pair must show the board in the same place"
        )


# A view whose typical residual exceeds the floor and this many times its camera's usual one is left out; single wrong
# corners are left to the last fit.
OUTLIER_FACTOR = 4.0
OUTLIER_FLOOR_PX = 0.5
HOME_TOLERANCE = np.radians(0.01)  # a fifth of the smallest usual step of a head


def at_home(view: View) -> bool:
    """Check whether the head was at pan = tilt = 0."""
    return max(abs(view.pan), abs(view.tilt)) <= HOME_TOLERANCE


def one_camera(
    camera: CameraName, views: Sequence[View], points: Array, size: tuple[int, int]
) -> tuple[Intrinsics, Fit, tuple[View, ...], list[Rejected]]:
    """Calibrate one camera from its views alone; return also the views used, and those that do not fit the others."""
    mine = tuple(view for view in views if view.camera == camera)
    lens, result = calibrate_camera(camera, mine, points, size)
    typical = np.array([robust_sigma(r[view.seen]) for r, view in zip(result.residuals, mine, strict=True)]) * 2**0.5
    limit = max(OUTLIER_FACTOR * float(np.median(typical)), OUTLIER_FLOOR_PX)
    good = tuple(view for view, value in zip(mine, typical, strict=True) if value <= limit)
    rejected = [
        Rejected(view.name, f"its corners are {value:.2f} px off, where {limit:.2f} px is the limit")
        for view, value in zip(mine, typical, strict=True)
        if value > limit
    ]
    if rejected:
        lens, result = calibrate_camera(camera, good, points, size, start=lens)
    return lens, result, good, rejected


def pairs_at_home(views: Sequence[View]) -> tuple[View, ...]:
    """Select the views of placements that both cameras see with the head at home."""
    return of_both([view for view in views if view.camera == "fixed" or at_home(view)])


def of_both(views: Sequence[View]) -> tuple[View, ...]:
    """Select the views of placements that both cameras see."""
    seen = [{view.board for view in views if view.camera == camera} for camera in ("fixed", "zoom")]
    return tuple(view for view in views if view.board in seen[0] & seen[1])


def rough_gamma(model: BundleModel, views: Sequence[View], points: Array) -> RigidTransform:
    """Estimate Gamma from placements that both cameras see at any head pose: the candidate nearest to all others.

    The model has both cameras, and T where the head has moved.
    """
    T, axes = model.head.hand_eye(), model.head.axes
    candidates = []
    for same in by_placement(views).values():
        boards = [board_pose(model.fixed.lens, v.corners_px, points) for v in same if v.camera == "fixed"]
        for view in same:
            if view.camera == "fixed":
                continue
            T_zoom_board = board_pose(model.lens_of(view), view.corners_px, points)
            T_zoom0_zoom = T.inv() * base_head(view.pan, view.tilt, axes) * T  # Eq. 2 solved for Gamma
            candidates += [T_zoom0_zoom * T_zoom_board * board.inv() for board in boards]
    return _most_central(candidates, scale=float(np.ptp(points, axis=0).max()))


def _most_central(candidates: Sequence[RigidTransform], scale: float) -> RigidTransform:
    """Find the transform nearest to all others by medians, so that a board in its mirrored pose has no influence."""
    t = np.array([T.translation for T in candidates])
    q = Rotation.concatenate([T.rotation for T in candidates])
    far = np.linalg.norm(t[:, None] - t[None], axis=-1) / scale
    turned = np.array([(q * one.inv()).magnitude() for one in q])
    return candidates[int(np.argmin(np.median(far + turned, axis=1)))]


def rough_hand(model: BundleModel, views: Sequence[View], points: Array, *, regularize: bool = False) -> RigidTransform:
    """Estimate T from all motions within each placement, by Park and Martin's method.

    With ``regularize`` it is the smallest turn and shift where the motions leave T undetermined.
    """
    A: list[RigidTransform] = []
    B: list[RigidTransform] = []
    for same in by_placement(view for view in views if view.camera == "zoom").values():
        heads = [base_head(view.pan, view.tilt, model.head.axes) for view in same]
        boards = [board_pose(model.lens_of(view), view.corners_px, points) for view in same]
        a, b = motions(heads, boards)
        A, B = A + a, B + b
    if not A:
        raise CalibrationError(
            "hand-eye: no placement of the board is seen by the zoom camera from two poses of the head; "
            "leave the board where it is while the head turns"
        )
    return solve_hand_eye_from_motions(A, B, regularize=True).X if regularize else park_martin(A, B)


# The sequential method


def sequential(
    views: Sequence[View], points: Array, sizes: Mapping[CameraName, tuple[int, int]], nominal_px: float | None = None
) -> Solution:
    """Calibrate a rig step by step, from zoom views at one focal length.

    1. Intrinsics of each camera by itself, the zoom camera at its shortest focal length.
    2. Gamma = T_zoom0_fixed from the placements that both cameras see at pan = tilt = 0.
    3. T = T_head_zoom from the motions of head and camera, A T = T B (Eqs. 3, 4); then a fit of T, the axis offset dz
       and the squareness eps to the corners.

    Each step holds the results of earlier ones, so errors add up, and the normal matrices of the steps miss most of the
    uncertainty. The method therefore gives no covariance.

    Raises:
        CalibrationError: the views do not determine the rig; the message says what is missing.
    """
    steps = both_cameras(views, points, sizes, nominal_px)
    pairs = pairs_at_home(steps.views)
    if not pairs:
        raise CalibrationError(
            "stereo: no placement of the board is seen by both cameras at pan = tilt = 0, which the sequential method "
            "needs; the joint method does not"
        )
    stereo_fit = stereo(steps.model, pairs, points)
    check_pairs(steps, stereo_fit.rms_px)
    model = steps.model.with_zoom_head(T_zoom0_fixed=stereo_fit.model.head.T_zoom0_fixed)
    zoom_views = [view for view in steps.views if view.camera == "zoom"]
    handeye_px = None
    if steps.has_head:
        model = model.with_zoom_head(T_head_zoom=rough_hand(model, zoom_views, points))
        model = place_boards(model, steps.views, points)
        hand_fit = fit(model, zoom_views, points, {"hand", "head"})
        model, handeye_px = replace(model, zoom_head=hand_fit.model.zoom_head), hand_fit.rms_px
    else:
        model = place_boards(model, of_both(steps.views), points)
    residuals = steps.residuals(steps.views, steps.rejected, stereo_px=stereo_fit.rms_px, handeye_px=handeye_px)
    return Solution(model, residuals, steps.views, steps.has_head)
