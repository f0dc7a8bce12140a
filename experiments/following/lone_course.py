"""Where a lone camera believes its target to be: pan and tilt at which it is centred, each with a constant velocity."""

import math
from dataclasses import dataclass, replace

import numpy as np

from cotarget.config import TargetConfig
from cotarget.estimation.motion_model import estimation_settings_for
from cotarget.rig import Angles
from cotarget.tracking.track import AxisFilter

SEARCH_S = 3.0  # so long a target out of sight is sought about where it should be [s]
SIZES_S = 0.5  # so far back its size is looked at: a wing's beat or a step [s]
# A manoeuvre, which outlasts what the camera leads by, counts as white acceleration of so long [s], by the dimension of
# what is wanted. Of 0.05, 0.1, 0.15, 0.25, 0.5, 1, 2 and 4 s these gave the most close-ups of seeds 1000 to 1002, each
# for its target, as means of 5 % and of 50 % missed, or 0.003 less, as 0.05 to 0.5 s do for a person. It is the setting
# lasts_s of `experiments.following.single_ptz`. A book is carried at times, and then speeds up more than its own motion
# has it.
LASTS_S = {"width": 2.0, "height": 0.25, "wingspan": 0.1}
CLIPPED = 9.0  # times the variance of a middle of which a part is outside the image


@dataclass(frozen=True)
class Sighting:
    """A detection as directions.

    Attributes:
        t: when [s].
        pan: at which it would be centred [rad]; tilt likewise.
        tilt: [rad].
        sides: width and height over the focal length.
        clipped: whether the image's border cuts it.
    """

    t: float
    pan: float
    tilt: float
    sides: tuple[float, float]
    clipped: bool


class Course:
    """Where a target is, by its own pan and tilt, each with a constant velocity."""

    def __init__(self, target: TargetConfig, noise_px: float, lasts_s: float | None = None) -> None:
        """Begin without a sighting.

        Args:
            target: what is known of it.
            noise_px: standard deviation of a detection's middle [px].
            lasts_s: how long a manoeuvre counts as white acceleration [s]; LASTS_S of such a target by default.
        """
        self._target, self._noise_px = target, noise_px
        self._lasts_s = LASTS_S[target.dimension] if lasts_s is None else lasts_s
        self._settings = estimation_settings_for(target)
        self._axes: list[AxisFilter] = []
        self._sizes: list[Sighting] = []
        self.seen_t = -math.inf
        self.whole = False  # whether the last sighting was

    @property
    def known(self) -> bool:
        """Whether it was ever seen."""
        return bool(self._axes)

    @property
    def sides(self) -> tuple[float, float]:
        """Its width and height as tangents: the largest of the last moment for wings, else the median."""
        sides = np.array([each.sides for each in self._sizes])
        w, h = sides.max(axis=0) if self._target.dimension == "wingspan" else np.median(sides, axis=0)
        return float(w), float(h)

    @property
    def size(self) -> float:
        """The dimension wanted, as a tangent."""
        w, h = self.sides
        return {"width": w, "height": h}.get(self._target.dimension, max(w, h))

    @property
    def range(self) -> float:
        """By its known size [m]."""
        return self._target.size / self.size

    def saw(self, seen: Sighting, focal_px: float) -> None:
        """Take a sighting into account; one after a long time begins anew."""
        self.whole = not seen.clipped
        if self.whole:
            past = [each for each in self._sizes if each.t >= seen.t - SIZES_S and not each.clipped]
            self._sizes = [*past, seen]
        else:  # it is at least as large as what shows of it
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
        """Pan and tilt at a time, and their variances."""
        dt = t - self.seen_t
        spread = [axis.spread.after(dt, self._noise(self.range)).at for axis in self._axes]
        (pan, tilt) = (axis.at + dt * axis.speed for axis in self._axes)
        return (pan, tilt), (spread[0], spread[1])

    @property
    def rates(self) -> Angles:
        """Of pan and tilt [rad/s]."""
        pan, tilt = self._axes
        return pan.speed, tilt.speed

    def _noise(self, distance: float) -> float:
        """White acceleration of an angle [rad^2/s^3] that does to a constant velocity what manoeuvres do."""
        return self._lasts_s * (self._settings.motion.acceleration / distance) ** 2
