"""Rigs as people mount them, and the effect of an error in the close-up; shared by the experiments on simpler models.

The zoom camera is mounted beside the fixed one, at a given baseline in any direction at most 30 degrees out of the
fixed camera's image plane, with axes parallel by eye. It is mounted on its head by eye too, with a lever of up to 0.15
m. Lenses, axis offset and squareness vary as in `experiments.calibration.random_rigs`.
"""

from dataclasses import replace

import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_TARGETS
from cotarget.geometry import Array, RigidTransform, Rotation
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera, ZoomHead
from experiments.calibration.random_rigs import OUT_OF_PLANE, any_direction, any_lens
from experiments.calibration.synthetic.rig import LONGEST_PX, NOMINAL_PX, SIZE, Lens, Truth, undistorted

MOUNTED_DEG = 1.5  # standard deviation of each angle of a mounting by eye; the default rig's mounting is of that size
LEVER = 0.15  # [m]
TARGET = DEFAULT_TARGETS["bird"]  # 0.8 m, wanted 160 px wide: the close-up is 3.2 m wide within the lens's range


def cell_name(depth: float, baseline: float) -> str:
    """Name a depth [m] with a baseline [m] in summaries, tables and bounds."""
    return f"depth {depth:g} m, baseline {baseline:g} m"


def mounted(rng: np.random.Generator, baseline: float, mounted_deg: float = MOUNTED_DEG) -> Truth:
    """Draw a rig as people mount it, with a baseline [m] and a standard deviation of each angle that should be zero."""
    while abs((direction := any_direction(rng))[2]) > OUT_OF_PLANE:
        pass
    turns = Rotation.from_rotvec(np.radians(rng.normal(0, mounted_deg, (2, 3))))
    return Truth(
        fixed=any_lens(rng, -0.2),
        zoom=any_lens(rng, -0.1),
        gamma=RigidTransform.from_components(baseline * direction, turns[0]).inv(),
        hand=RigidTransform.from_components(LEVER * rng.uniform() * any_direction(rng), turns[1]),
        dz=float(rng.uniform(-0.01, 0.01)),
        eps=float(np.radians(rng.uniform(-0.2, 0.2))),
    )


def idealised(truth: Truth) -> Truth:
    """Give the same rig with head axes that cross at a right angle and the zoom camera's axis at its image's centre."""
    cx, cy = (np.array(SIZE) - 1) / 2
    return replace(truth, dz=0.0, eps=0.0, zoom=replace(truth.zoom, cx=float(cx), cy=float(cy)))


def exact_calibration(truth: Truth) -> Calibration:
    """Give the calibration of a rig without error."""
    return Calibration(
        fixed=FixedCamera(_intrinsics(truth.fixed)),
        zoom_head=ZoomHead(
            ZoomLens((NOMINAL_PX,), (_intrinsics(truth.zoom),)),
            truth.gamma,
            truth.hand,
            HeadGeometry(truth.dz, truth.eps),
        ),
    )


def _intrinsics(lens: Lens) -> Intrinsics:
    k1, k2, p1, p2, k3 = lens.distortion
    return Intrinsics(SIZE, (lens.fx, lens.fy), (lens.cx, lens.cy), (k1, k2, p1, p2, k3))


def at(truth: Truth, pixels: Array, depths: Array | float) -> Array:
    """Give the true positions of targets seen at pixels (n, 2) and depths [m], in the fixed frame, (n, 3) [m]."""
    return np.asarray(np.c_[undistorted(pixels, truth.fixed), np.ones(len(pixels))] * np.reshape(depths, (-1, 1)))


def wanted_focal_px(
    truth: Truth, x_fixed: Array, size: float = TARGET.size, wanted_px: float = TARGET.wanted_px
) -> Array:
    """Give focal lengths (n,) [px] that show targets (n, 3) [m] of a size [m] as large as wanted.

    They are limited to the lens's range.
    """
    reach = np.linalg.norm(truth.gamma.apply(x_fixed), axis=1)
    return np.clip(wanted_px * reach / size, truth.zoom.fx, LONGEST_PX)


def off_px(angles: Array, focal_px: Array) -> Array:
    """Convert pointing errors [rad] to offsets from the image's centre at these focal lengths [px]."""
    return np.asarray(focal_px * np.tan(np.minimum(angles, np.radians(89.0))))
