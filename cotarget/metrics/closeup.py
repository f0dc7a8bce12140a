"""What one zoom frame truly shows of a target, and whether that is a good close-up."""

import math
from dataclasses import dataclass

# In frame: at least half of the silhouette visible, and at least half as large as wanted.
VISIBLE_IN_FRAME = 0.5
SIZE_IN_FRAME = 0.5
# A close-up is good with the whole target visible at 0.8 to 1.25 of the wanted size.
GOOD_SIZE = (0.8, 1.25)
SERVED_S = 1.0  # of good close-up in all, and a target counts as served
WHOLLY_VISIBLE = 0.999  # the silhouette's area is counted on a grid; a rim of less is rounding


@dataclass(frozen=True)
class Closeup:
    """A target in a zoom frame.

    Attributes:
        u_px: true position of the target's body centre in the zoom image [px]; nan behind the camera.
        v_px: likewise.
        width_px: width of the zoom image [px].
        height_px: its height [px].
        size_px: true size of the wanted dimension in the zoom image [px]; nan behind the camera.
        wanted_px: size wanted, or what the longest focal length gives where that is less [px].
        visible: fraction of the true silhouette visible in the zoom image.
    """

    u_px: float
    v_px: float
    width_px: int
    height_px: int
    size_px: float
    wanted_px: float
    visible: float

    @property
    def inside(self) -> bool:
        """Whether the body centre is inside the image."""
        return -0.5 <= self.u_px <= self.width_px - 0.5 and -0.5 <= self.v_px <= self.height_px - 0.5

    @property
    def size_ratio(self) -> float:
        """True size over the size wanted; 0 for a target behind the camera, which shows nothing of it."""
        return 0.0 if math.isnan(self.size_px) else self.size_px / self.wanted_px

    @property
    def in_frame(self) -> bool:
        """Whether the target is in the close-up, by the definition above."""
        return self.inside and self.visible >= VISIBLE_IN_FRAME and self.size_ratio >= SIZE_IN_FRAME

    @property
    def good(self) -> bool:
        """Whether the whole target is visible at about the wanted size."""
        return self.inside and self.visible >= WHOLLY_VISIBLE and GOOD_SIZE[0] <= self.size_ratio <= GOOD_SIZE[1]

    @property
    def tpo_px(self) -> float:
        """Target point offset: distance from the image's centre; half the diagonal for a frame without it [px]."""
        if not self.inside:
            return math.hypot(self.width_px, self.height_px) / 2
        return math.hypot(self.u_px - (self.width_px - 1) / 2, self.v_px - (self.height_px - 1) / 2)
