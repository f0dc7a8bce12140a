"""What may be asked about where the targets of a simulated world truly appear: `Truth` answers it, and `Outlines`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from cotarget.geometry import Array
from cotarget.sim.lens import TrueLens
from cotarget.sim.targets import Target

CameraName = Literal["fixed", "zoom"]


@dataclass(frozen=True)
class Silhouette:
    """A target's true outline in one image, not clipped to it.

    Attributes:
        low_px: top-left corner of its box, (2,).
        high_px: bottom-right corner, (2,).
        visible: fraction of the target that shows: of its outline's area, the fraction inside the image, times, of
            its parts (geoms, each counting the same whatever its size), the fraction whose middle a ray from the
            camera reaches with nothing but the target itself in the way. Hence exact for a target that is cut by the
            image's border only; for one behind something it goes in steps of a part, and the two fractions are
            taken to be independent. A board shown to the cameras and the rig itself hide nothing.
    """

    low_px: Array
    high_px: Array
    visible: float

    @property
    def size_px(self) -> Array:
        """(width, height) of the box."""
        return self.high_px - self.low_px


class Appearances(Protocol):
    """Where targets appear in both cameras, at any time up to now."""

    @property
    def targets(self) -> Mapping[str, Target]:
        """By name."""

    @property
    def fixed_lens(self) -> TrueLens:
        """The wide camera's optics."""

    @property
    def longest_px(self) -> float:
        """The zoom camera's true focal length at its longest, in pixels along the rows."""

    def lens(self, camera: CameraName, t: float) -> TrueLens:
        """A camera's optics at time t."""

    def center_px(self, name: str, camera: CameraName, t: float) -> Array:
        """A target's body centre in a camera at time t, (2,) [px]; nan behind it."""

    def box(self, name: str, camera: CameraName, t: float) -> tuple[Array, Array] | None:
        """Top-left and bottom-right corner of a target's outline at time t, (2,) [px] each; None behind the camera."""

    def silhouette(self, name: str, camera: CameraName, t: float) -> Silhouette | None:
        """A target's outline in a camera at time t; None behind the camera."""

    def largest_side_px(self, name: str, camera: CameraName, t: float) -> float:
        """The larger side of the box, the maximum over one wing beat at the pose of time t [px]; nan behind."""
