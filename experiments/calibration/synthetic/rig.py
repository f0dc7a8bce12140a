"""Truth of a synthetic rig: its lenses, its head's explicit matrices, and the faults of its parts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from cotarget.calibration import Calibration
from cotarget.calibration.model import CameraName
from cotarget.config import DEFAULT_GAMMA, DEFAULT_T
from cotarget.geometry import Array, RigidTransform, pose

SIZE = (640, 480)
SIZES: Mapping[CameraName, tuple[int, int]] = {"fixed": SIZE, "zoom": SIZE}
NOMINAL_PX = 667.0  # shortest nominal focal length of the zoom camera
LONGEST_PX = 7155.0  # focal length at which errors are given in pixels
WIDEST = 1.2  # tangent of the off-axis angle beyond which distortion may have folded back
NEAREST = 0.2  # least distance of a visible point [m]
NEWTON_STEPS = 50
SOLVED = 1e-10  # convergence [rad] or normalised; far below the smallest error of interest, 1e-6
DIFFERENCE = 1e-6  # step of central differences


@dataclass(frozen=True)
class Lens:
    """True intrinsics."""

    fx: float  # focal length along the rows [px]
    fy: float  # focal length along the columns [px]
    cx: float  # principal point along u [px]
    cy: float  # principal point along v [px]
    # OpenCV's coefficients: 4, 5, 8 (rational) or 12 (thin prism); with ``fisheye`` the 4 of `cv2.fisheye`.
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False  # whether the coefficients are those of `cv2.fisheye`

    @property
    def K(self) -> Array:
        """Camera matrix, (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, x_camera: Array) -> Array:
        """Project points (n, 3) to pixels (n, 2)."""
        project = cv2.fisheye.projectPoints if self.fisheye else cv2.projectPoints
        x = np.ascontiguousarray(np.asarray(x_camera, float).reshape(-1, 1, 3))
        px, _ = project(x, np.zeros((3, 1)), np.zeros((3, 1)), self.K, np.array(self.distortion, float))
        return np.asarray(px).reshape(-1, 2)

    def inside(self, x_camera: Array, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Check for each point (n, 3) that it is in front of the camera, before the fold, and inside the image."""
        x_camera = np.asarray(x_camera, float)
        ahead = x_camera[:, 2] >= NEAREST
        ahead &= np.abs(x_camera[:, :2]).max(axis=1) <= WIDEST * np.abs(x_camera[:, 2])
        px = self.project(np.where(ahead[:, None], x_camera, [0.0, 0.0, 1.0]))
        return np.asarray(ahead & ((px >= margin) & (px <= np.array(SIZE) - 1 - margin)).all(axis=1))

    def sees(self, x_camera: Array, margin: float = 0.0) -> bool:
        """Check that all points are visible."""
        return bool(self.inside(x_camera, margin).all())


@dataclass(frozen=True)
class Stop:
    """Zoom sample: nominal focal length [px], true lens, and position of the pupil along the axis [m]."""

    nominal_px: float
    lens: Lens
    pupil: float = 0.0


@dataclass(frozen=True)
class Truth:
    """Whole rig, with explicit matrices of its head.

    The matrices take the axes' true angles; `stands` gives these from the reported ones.
    """

    fixed: Lens = Lens(686.0, 684.0, 325.0, 239.0, (-0.2, 0.0, 0.0, 0.0, 0.0))  # lens of the fixed camera
    # Lens of the zoom camera at its shortest focal length.
    zoom: Lens = Lens(692.0, 693.0, 326.0, 235.0, (-0.1, 0.0, 0.0, 0.0, 0.0))
    gamma: RigidTransform = DEFAULT_GAMMA  # T_zoom0_fixed
    hand: RigidTransform = DEFAULT_T  # T_head_zoom
    dz: float = 0.005  # offset from the pan axis to the tilt axis [m]
    eps: float = np.radians(0.1)  # deviation of the tilt axis from a right angle with the pan axis [rad]
    stops: tuple[Stop, ...] = ()  # further zoom samples
    pan_scale: float = 1.0  # true over reported pan
    tilt_scale: float = 1.0  # true over reported tilt
    sag: float = 0.0  # deflection of the tilt by the camera's weight at level tilt [rad]
    play: float = 0.0  # backlash of both axes [rad]; they lag by half of it
    jitter: float = 0.0  # standard deviation of an axis's position, drawn for every move [rad]
    give: tuple[float, float, float] = (0.0, 0.0, 0.0)  # shift of the camera on the head per radian of tilt [m]

    def stands(
        self, reported: Array, before: Array | None = None, rng: np.random.Generator | None = None
    ) -> tuple[float, float]:
        """Give the axes' true pan and tilt [rad] for the reported ones, (2,) [rad].

        Backlash acts where the pose before the move is given, jitter where its source is.
        """
        true = np.array([self.pan_scale, self.tilt_scale]) * np.asarray(reported, float)
        if before is not None:
            true = true - self.play / 2 * np.sign(np.subtract(reported, before))
        if rng is not None and self.jitter:
            true = true + rng.normal(0, self.jitter, 2)
        return float(true[0]), float(true[1] + self.sag * np.cos(true[1]))

    def base_head(self, pan: Array | float, tilt: Array | float) -> Array:
        """Compute T_base_head at true angles (...), (..., 4, 4)."""
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
        """Compute T_zoom_fixed at true angles (...), (..., 4, 4)."""
        T = self.hand.as_matrix()
        given = np.tile(np.eye(4), (*np.shape(tilt), 1, 1))
        given[..., :3, 3] = np.multiply.outer(tilt, self.give)
        T_head_zoom = given @ T
        return np.linalg.inv(T_head_zoom) @ np.linalg.inv(self.base_head(pan, tilt)) @ T @ self.gamma.as_matrix()

    def in_zoom(self, x_fixed: Array, pan: Array | float, tilt: Array | float) -> Array:
        """Transform points (..., 3) to the moved zoom camera's frame; one pair of true angles for all, or for each."""
        M = self.zoom_fixed(pan, tilt)
        return np.asarray(np.einsum("...ij,...j->...i", M[..., :3, :3], x_fixed) + M[..., :3, 3])


def _stacked(rows: Sequence[Sequence[Array]]) -> Array:
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def truth_of(calibration: Calibration) -> Truth:
    """Make the rig that a calibration describes, at its shortest focal length."""
    fixed, zoom = (
        Lens(*lens.focal_px, *lens.center_px, lens.distortion)
        for lens in (calibration.fixed.lens, calibration.zoom_head.lens.stops[0])
    )
    head = calibration.zoom_head.axes
    return Truth(
        fixed=fixed,
        zoom=zoom,
        gamma=calibration.zoom_head.T_zoom0_fixed,
        hand=calibration.zoom_head.hand_eye(),
        dz=head.axis_offset,
        eps=head.squareness,
        pan_scale=head.pan_scale,
        tilt_scale=head.tilt_scale,
    )


def other_rig() -> Truth:
    """Make a rig with a wide baseline, toed in, with a long lever and a rolled camera."""
    return Truth(gamma=pose([-1.5, 0.1, -0.1], [1.0, 12.0, 5.0]), hand=pose([0.1, -0.15, 0.08], [2.0, 1.5, 5.0]))


def with_lever_shifted(truth: Truth, shift: Sequence[float]) -> Truth:
    """Make the rig after the camera has slipped on the head by a shift in the head's frame [m], (3,)."""
    hand = RigidTransform.from_translation(np.array(shift, float)) * truth.hand
    return replace(truth, hand=hand, gamma=hand.inv() * truth.hand * truth.gamma)


def undistorted(pixel: Array | Sequence[float], lens: Lens) -> Array:
    """Undistort pixels (..., 2) to image-plane coordinates x / z, y / z, by Newton's method on the projection."""
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


def middle_of(lens: Lens) -> Array:
    """Give the image-plane coordinates of an image's centre, (2,)."""
    return undistorted((np.array(SIZE) - 1) / 2, lens)
