"""Hold what is known of one target, in one record that all steps of the pipeline share."""

import math
from dataclasses import dataclass, field

import numpy as np

from cotarget.estimation import Estimate, TargetFilter
from cotarget.geometry import Array
from cotarget.tracking.track import Track


@dataclass(eq=False)
class Target:
    """What is known of one target.

    Attributes:
        track: its track in the fixed camera, after the newest frame.
        filter: its 3D filter; None while others are more important, see `FusionSettings.most_filters`.
        largest_area_px: area of the largest box that showed all of it [px^2]; None before there is one.
        part_since_t: time since which its boxes show parts of it [s]; inf while they show all of it.
        whole_px: usual width and height when a box last showed all of it, (2,) [px].
        seen_well_s: time for which the head has shown it well in the close-up [s].
        unlikely: whether its size, or where the head sees it, contradicts the priors.
        unreachable: whether the head could not point at it.
    """

    track: Track
    filter: TargetFilter | None = None
    largest_area_px: float | None = None
    part_since_t: float = math.inf
    whole_px: Array = field(default_factory=lambda: np.zeros(2))
    seen_well_s: float = 0.0
    unlikely: bool = False
    unreachable: bool = False

    @property
    def id(self) -> int:
        """Id of its track."""
        return self.track.id

    def estimate(self, t: float) -> Estimate | None:
        """Estimate it at time t [s]; None if it has no filter, or no measurement by then."""
        return None if self.filter is None else self.filter.estimate(t)
