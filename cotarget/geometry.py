"""Coordinate frames, rigid transforms and rotation conventions; boxes in an image.

Frames (names as in code, the paper's in braces):

- ``fixed`` {L}: the fixed camera
- ``zoom0`` {R0}: the zoom camera at pan = tilt = 0
- ``zoom`` {R}: the zoom camera at the present pan and tilt
- ``base`` {O}: the part of the pan-tilt head that does not move
- ``head`` {P}: the moving platform of the head
- ``world``: the scene, in the simulation only

``T_a_b`` maps coordinates in b to coordinates in a, so that names chain: ``x_a = T_a_b T_b_c x_c``. Cameras look
along +z, with x right and y down. Lengths are in metres and angles in radians. Every transform is a
``scipy.spatial.transform.RigidTransform``.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import RigidTransform, Rotation

Array = npt.NDArray[np.float64]

__all__ = [
    "FARTHEST_M",
    "Array",
    "RigidTransform",
    "Rotation",
    "angle_between",
    "intersection_areas",
    "pose",
    "pose_dict",
]

FARTHEST_M, WHOLE_TURN_DEG = 1e6, 360.0  # a configured pose beyond these is a mistake, such as a wrong unit


def pose(translation: Sequence[float] | Array, rotvec_deg: Sequence[float] | Array) -> RigidTransform:
    """Make a transform from a translation [m], (3,), and a rotation vector [degrees], (3,).

    Raises:
        ValueError: a component of the translation exceeds `FARTHEST_M`, or one of the rotation vector a whole turn.
    """
    if np.abs(translation).max() > FARTHEST_M:
        raise ValueError(f"translation: {list(translation)} is farther than {FARTHEST_M:g} m")
    if np.abs(rotvec_deg).max() > WHOLE_TURN_DEG:
        raise ValueError(f"rotvec_deg: {list(rotvec_deg)} is more than a whole turn, {WHOLE_TURN_DEG:g} degrees")
    return RigidTransform.from_components(
        np.asarray(translation, dtype=float), Rotation.from_rotvec(rotvec_deg, degrees=True)
    )


def pose_dict(T: RigidTransform) -> Mapping[str, list[float]]:
    """Convert a transform to a table of translation [m] and rotation vector [degrees], the inverse of `pose`."""
    return {
        "translation": [float(v) for v in T.translation],
        "rotvec_deg": [float(v) for v in T.rotation.as_rotvec(degrees=True)],
    }


def angle_between(a: Array, b: Array) -> Array:
    """Compute the angle between directions [rad], exact for tiny and for near-opposite angles.

    Args:
        a: directions of any length, (..., 3).
        b: directions of any length, (..., 3).

    Returns:
        Angles in 0..pi, (...).
    """
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def within_image(center_px: Array, size_px: Array, image_size: tuple[int, int]) -> tuple[Array, Array]:
    """Return centre and size of the part of a box that lies in an image of a (width, height) [px], (2,) each."""
    first, last = center_px - size_px / 2, center_px + size_px / 2
    first, last = np.maximum(first, -0.5), np.minimum(last, np.array(image_size) - 0.5)
    return (first + last) / 2, np.maximum(last - first, 0.0)


def intersection_areas(center: Array, size: Array, others_center: Array, others_size: Array) -> Array:
    """Compute the areas that boxes share with others.

    Args:
        center: centres of the boxes (u, v), (n, 2) [px].
        size: their widths and heights, (n, 2) [px].
        others_center: centres of the others, (m, 2) [px].
        others_size: their widths and heights, (m, 2) [px].

    Returns:
        Areas [px^2], (n, m).
    """
    low = np.maximum((center - size / 2)[:, None], others_center - others_size / 2)
    high = np.minimum((center + size / 2)[:, None], others_center + others_size / 2)
    sides = np.maximum(high - low, 0.0)
    return np.asarray(sides[..., 0] * sides[..., 1])
