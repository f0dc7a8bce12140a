"""Choose the focal length: as close as wanted while the target surely stays in the image.

The lens zooms in to the wanted size, but no further than the whole target is in the next zoom frame with a probability
of 95 %; it zooms out below 80 %. Probabilities are for the first frame that a command can change, even if the lens
travels longer, because the next frame corrects it on its way. The comparison: docs/design-notes.md.
Where the head turns the slower the longer the lens is, the lens zooms in no further than the head can follow.

No device and no clock are used: angles are tangents at the zoom camera, and the caller gives the times. Focal lengths
are true ones [px].
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

from cotarget.config import GOOD_SIZE
from cotarget.estimation.measurement_model import Appearance, Estimate

# Probability that the whole target is in the image: below it the lens zooms out, from it on the target is seen well.
LIKELY = 0.8


@dataclass(frozen=True)
class ZoomSettings:
    """Settings of the zoom controller.

    Attributes:
        sure: probability that the whole target is in the image up to which the lens zooms in; it zooms out below
            `LIKELY`, and stays between the two.
        rim_px: margin at the image's border that the target must not enter [px].
        deadband: relative change of the focal length below which the lens is not commanded.
        settle_s: time after a forced zoom out in which the lens does not zoom in [s].
        speed_share: part of the head's highest speed that the target may take; the rest is for catching up.
        speed_s: time in which a target's highest speed is forgotten, so that the lens does not hunt [s].
    """

    sure: float = 0.95
    rim_px: float = 4.0
    deadband: float = 0.06
    settle_s: float = 0.3
    speed_share: float = 0.8
    speed_s: float = 3.0


def is_seen_well(
    estimate: Estimate, pan: float, tilt: float, nominal_px: float, longest_px: float, *, shape: float = 1.0
) -> bool:
    """Whether a target is wholly in the close-up and about as large as wanted, by its estimate.

    Args:
        estimate: estimate of the target at the close-up's time.
        pan: pan of the head then [rad].
        tilt: tilt of the head then [rad].
        nominal_px: nominal focal length then [px].
        longest_px: longest nominal focal length [px]; it limits the size wanted of a far target.
        shape: width over height of the target's box.
    """
    seen = estimate.appearance(pan, tilt, nominal_px, shape)
    if seen is None:
        return False
    zoom, focal = estimate.calibration.zoom_head.lens, float(seen.focal_px[0])
    wanted_px = min(estimate.target.wanted_px, seen.size_px * zoom.at(longest_px).focal_px[0] / focal)
    if not GOOD_SIZE[0] * wanted_px <= seen.size_px <= GOOD_SIZE[1] * wanted_px:
        return False
    return chance_inside(seen, focal, zoom.size) >= LIKELY


def chance_inside(seen: Appearance, focal_px: float, size: tuple[int, int], rim_px: float = 0.0) -> float:
    """Probability that the whole target is in the image at a focal length.

    Args:
        seen: predicted target; the uncertainty of its size widens each side, and the axes are independent.
        focal_px: focal length [px].
        size: (width, height) of the image [px].
        rim_px: margin at the border that does not count as image [px].
    """
    chance = 1.0
    for axis in range(2):
        half, variance = float(seen.half[axis]), float(seen.variance[axis])
        room = (size[axis] / 2 - rim_px) / focal_px - half
        sigma = math.hypot(math.sqrt(variance), half * seen.size_sigma)
        offset = abs(float(seen.offset[axis]))
        chance *= max(_below(room - offset, sigma) - _below(-room - offset, sigma), 0.0) if room > 0 else 0.0
    return chance


def longest_focal(
    seen: Appearance,
    chance: float,
    size: tuple[int, int],
    focal_range: tuple[float, float],
    rim_px: float = 0.0,
) -> float:
    """Find the longest focal length at which the whole target is in the image with a given probability.

    Args:
        seen: predicted target.
        chance: probability, 0 to 1.
        size: (width, height) of the image [px].
        focal_range: shortest and longest focal length [px]; the shortest is returned even if it does not suffice.
        rim_px: margin at the border that does not count as image [px].
    """

    def excess(focal_px: float) -> float:
        return chance_inside(seen, focal_px, size, rim_px) - chance

    shortest, longest = focal_range
    if excess(longest) >= 0:
        return longest
    return float(brentq(excess, shortest, longest)) if excess(shortest) > 0 else shortest


class ZoomController:
    """Decide on the focal length in every frame, with hysteresis, so that the lens does not hunt."""

    def __init__(
        self,
        focal_range: tuple[float, float],
        size: tuple[int, int],
        settings: ZoomSettings = ZoomSettings(),
        speeds: Sequence[tuple[float, float]] = (),
    ) -> None:
        """Create a controller without history.

        Args:
            focal_range: shortest and longest focal length [px].
            size: (width, height) of the zoom image [px].
            settings: settings of the controller.
            speeds: (focal length [px], highest speed of the head from there on [rad/s]), by increasing focal length;
                empty for a head whose speed does not depend on the lens.
        """
        self._range = focal_range
        self._size = size
        self._settings = settings
        self._speeds = speeds
        self._out_t = -math.inf
        self._rate, self._rate_t = 0.0, -math.inf  # highest rate of the target, which decays

    def choose(
        self,
        seen: Appearance | None,
        wanted_px: float,
        commanded_px: float,
        t: float,
        now_px: float | None = None,
        rate: float = 0.0,
    ) -> tuple[float, str]:
        """Decide on the focal length.

        Args:
            seen: the target as predicted for the next zoom frame, at any focal length; None if it is lost.
            wanted_px: focal length at which the target has the wanted size [px].
            commanded_px: focal length commanded last [px].
            t: time now [s].
            now_px: focal length now [px]; the commanded one by default.
            rate: angle a second by which the faster axis of the head has to turn after the target [rad/s].

        Returns:
            The focal length [px], and the reason: "wanted", "unsure", "head too slow", "about to be lost", "settling"
            or "lost".
        """
        if seen is None:
            self._out_t = t
            return self._range[0], "lost"
        settings, size = self._settings, self._size
        fast_px = self._longest_for(rate, t)
        wanted = min(max(wanted_px, self._range[0]), fast_px)
        sure = longest_focal(seen, settings.sure, size, self._range, settings.rim_px)
        goal = min(wanted, sure)
        slow = wanted < min(wanted_px, self._range[1])
        reason = "unsure" if wanted > sure else "head too slow" if slow else "wanted"
        change = math.log(goal / commanded_px)
        if change > settings.deadband:
            if t - self._out_t < settings.settle_s:
                # The reason to zoom out may have passed before the lens got there: stop where it is enough now.
                here = commanded_px if now_px is None else now_px
                return max(commanded_px, min(goal, here)), "settling"
            return goal, reason
        if change < 0 and commanded_px > longest_focal(seen, LIKELY, size, self._range, settings.rim_px):
            self._out_t = t
            return goal, "about to be lost"
        if math.log(wanted / commanded_px) < -settings.deadband:
            return goal, reason
        return commanded_px, reason

    def _longest_for(self, rate: float, t: float) -> float:
        """Find the longest focal length at which the head is fast enough for a rate [px]."""
        kept = math.exp(-(t - self._rate_t) / self._settings.speed_s)
        self._rate, self._rate_t = max(rate, kept * self._rate), t
        shortest, longest = self._range
        slow = (px for px, speed in self._speeds if self._settings.speed_share * speed < self._rate)
        # At such a focal length itself the head is slow already.
        return max(min((math.exp(-self._settings.deadband) * px for px in slow), default=longest), shortest)


def _below(value: float, sigma: float) -> float:
    """Probability that a zero-mean normal variable is below a value."""
    if sigma <= 0:
        return 1.0 if value > 0 else 0.0
    return 0.5 * math.erfc(-value / (sigma * math.sqrt(2)))
