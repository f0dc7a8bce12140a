"""The cameras' inner geometry: intrinsics, range from a known size, and the zoom lens.

Pixels are (u, v), u right and v down, and (0, 0) is the centre of the top-left pixel.
"""

from cotarget.camera.intrinsics import Intrinsics, depth_from_size, focal_for_size
from cotarget.camera.zoomlens import ZoomLens, distortion_growth

__all__ = ["Intrinsics", "ZoomLens", "depth_from_size", "distortion_growth", "focal_for_size"]
