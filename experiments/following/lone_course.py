"""Motion estimate of a single pan-tilt-zoom camera: the target's pan and tilt, each with constant velocity."""

import math
from dataclasses import dataclass, replace

import numpy as np

from cotarget.config import TargetProfile
from cotarget.estimation.motion_model import filter_settings
from cotarget.rig import Angles
from cotarget.tracking.track import AxisFilter

SEARCH_S = 3.0  # longest search around the prediction [s]
SIZES_S = 0.5  # window of the size estimate, a wing beat or a step [s]
# Duration of a manoeuvre as white acceleration [s], by the target's motion model. The choice is in docs/design-notes.md
# (Experiments). It is the setting lasts_s of `experiments.following.single_ptz`. A book that is carried accelerates
# more than its motion model says.
LASTS_S = {"standing": 2.0, "walking": 0.25, "flying": 0.1}
CLIPPED = 9.0  # factor on the variance of a centre that the image's border cuts


@dataclass(frozen=True)
class Sighting:
    """Detection as directions.

    Attributes:
        t: time [s].
        pan: pan that centres it [rad].
        tilt: tilt that centres it [rad].
        sides: width and height over the focal length.
        clipped: whether the image's border cuts it.
    """

    t: float
    pan: float
    tilt: float
    sides: tuple[float, float]
    clipped: bool


class Course:
    """Target's pan and tilt, each filtered with constant velocity."""

    def __init__(self, target: TargetProfile, noise_px: float, lasts_s: float | None = None) -> None:
        """Start without a sighting.

        Args:
            target: configuration of the target.
            noise_px: standard deviation of a detection's centre [px].
            lasts_s: duration of a manoeuvre as white acceleration [s]; by default that of the target's motion model.
        """
        self._target, self._noise_px = target, noise_px
        self._lasts_s = LASTS_S[target.motion] if lasts_s is None else lasts_s
        self._settings = filter_settings(target)
        self._axes: list[AxisFilter] = []
        self._sizes: list[Sighting] = []
        self.seen_t = -math.inf
        self.whole = False  # whether the last sighting was not clipped

    @property
    def known(self) -> bool:
        """Whether the target was ever sighted."""
        return bool(self._axes)

    @property
    def sides(self) -> tuple[float, float]:
        """Width and height as tangents: the largest of the window for wings, else the median."""
        sides = np.array([each.sides for each in self._sizes])
        w, h = sides.max(axis=0) if self._target.largest_over_time else np.median(sides, axis=0)
        return float(w), float(h)

    @property
    def size(self) -> float:
        """The dimension with a known size, as a tangent."""
        w, h = self.sides
        return h if self._target.is_vertical(w, h) else w

    @property
    def range(self) -> float:
        """Distance from the known size [m]."""
        return self._target.size / self.size

    def saw(self, seen: Sighting, focal_px: float) -> None:
        """Update with a sighting; one after a long gap restarts the filter."""
        self.whole = not seen.clipped
        if self.whole:
            past = [each for each in self._sizes if each.t >= seen.t - SIZES_S and not each.clipped]
            self._sizes = [*past, seen]
        else:  # the visible part is a lower limit of the size
            w, h = seen.sides if not self._sizes else map(max, zip(seen.sides, self.sides, strict=True))
            self._sizes = [replace(seen, sides=(w, h))]
        motion, distance = self._settings.motion, self.range
        by_size = self._settings.noise_of_size * max(seen.sides)
        variance = (self._noise_px / focal_px) ** 2 + by_size**2 * (CLIPPED if seen.clipped else 1.0)
        places = (seen.pan, seen.tilt)
        if not self.known or seen.t - self.seen_t > SEARCH_S:
            self._axes = [AxisFilter(place, variance, (motion.speed / distance) ** 2) for place in places]
        else:
            for axis, place in zip(self._axes, places, strict=True):
                axis.predict(seen.t - self.seen_t, self._noise(distance))
                axis.correct(place, variance)
        self.seen_t = seen.t

    def at(self, t: float) -> tuple[Angles, Angles]:
        """Predict pan and tilt at a time, with their variances."""
        dt = t - self.seen_t
        spread = [axis.covariance.predicted(dt, self._noise(self.range)).position for axis in self._axes]
        (pan, tilt) = (axis.position + dt * axis.velocity for axis in self._axes)
        return (pan, tilt), (spread[0], spread[1])

    @property
    def rates(self) -> Angles:
        """Rates of pan and tilt [rad/s]."""
        pan, tilt = self._axes
        return pan.velocity, tilt.velocity

    def _noise(self, distance: float) -> float:
        """Give the white acceleration of an angle [rad^2/s^3] that stands for manoeuvres at constant velocity."""
        return self._lasts_s * (self._settings.motion.acceleration / distance) ** 2
