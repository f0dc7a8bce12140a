"""The cameras' frusta in the world, and one moment of a world as somebody who watches it from outside sees it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cotarget.geometry import Array, RigidTransform
from cotarget.rig import Image
from cotarget.sim.appearances import CameraName
from cotarget.sim.lens import TrueLens
from cotarget.sim.truth import Truth

# Where a frustum ends that nobody says better of, along the axis [m]; the wide one's before it meets the floor.
FAR: Mapping[CameraName, float] = {"fixed": 4.0, "zoom": 8.0}
SIDE_POINTS = 8  # segments of each side of a frustum's end, which distortion bends


@dataclass(frozen=True)
class Sight:
    """One moment of a world, for a window that shows it.

    Attributes:
        t: on the rig's clock [s].
        caption: what goes on, in words.
        pictures: what each camera shows, (H, W, 3) BGR.
        lines: each camera's frustum, begin and end of each line in the world [m], (n, 2, 3).
    """

    t: float
    caption: str
    pictures: Mapping[CameraName, Image]
    lines: Mapping[CameraName, Array]


def frustum_rim(T_world_camera: RigidTransform, lens: TrueLens, depth: float) -> Array:
    """Where the border of a camera's image is in the world at a depth: the frustum's end.

    Args:
        T_world_camera: pose of the optical centre, in OpenCV's axes.
        lens: the camera's true optics.
        depth: along the camera's axis [m].

    Returns:
        Points around the border [m], (4 n, 3); each n-th is a corner, the first the top left one's.
    """
    width, height = lens.size
    # The image's border, half a pixel outside of the outermost pixels' centres.
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    along = np.linspace(0.0, 1.0, SIDE_POINTS, endpoint=False)[:, None]
    border = np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    x_camera = np.column_stack([lens.directions(border), np.ones(len(border))]) * depth
    return T_world_camera.apply(x_camera)


def frustum_lines(T_world_camera: RigidTransform, lens: TrueLens, depth: float) -> Array:
    """A camera's frustum as lines in the world [m], (n, 2, 3): its end, then its four edges from the optical centre."""
    rim = frustum_rim(T_world_camera, lens, depth)
    corners = rim[::SIDE_POINTS]
    edges = np.stack([np.broadcast_to(T_world_camera.translation, corners.shape), corners], axis=1)
    return np.concatenate([np.stack([rim, np.roll(rim, -1, axis=0)], axis=1), edges])


def frusta_of(truth: Truth, t: float, depths: Mapping[CameraName, float] | None = None) -> dict[CameraName, Array]:
    """Both cameras' frusta as they truly are at a time [s]; the zoom camera's follows pan, tilt and focal length.

    Args:
        truth: of the world.
        t: up to now [s].
        depths: where they end, along each camera's axis [m].
    """
    ends = {**FAR, **(depths or {})}
    return {name: frustum_lines(truth.T_world_camera(name, t), truth.lens(name, t), end) for name, end in ends.items()}
