"""How far to zoom in: as close as is wanted while the target surely stays in the image, and out before it is lost.

Pure: everything is in tangents at the zoom camera and in times that the caller gives. Focal lengths are true ones [px].

Chances are for the first frame that a command can change, though the lens may travel on for a second: the next frame
corrects it on its way. Counting with what may become of the target until the lens arrives, unseen all the while, keeps
it too wide: of birds 25 m away that are in frame all the time as it is, 56 % of the frames were good close-ups, and not
69 %; counting with a fifth of the whole way out besides, 22 %. For persons it changed nothing.
"""

import math
from dataclasses import dataclass

import numpy as np

from cotarget.estimation.measurement_model import Appearance, Estimate
from cotarget.geometry import Array
from cotarget.tracking.track import Track

# Halvings of the range of focal lengths, tenfold or so, until it is known to a thousandth.
HALVINGS = 12
# Well seen is whoever is wholly in the image with this chance, at such a part of the wanted size; as `cotarget.metrics`
# has a good close-up.
SEEN_WELL, GOOD_SIZE = 0.8, (0.8, 1.25)


@dataclass(frozen=True)
class ZoomSettings:
    """When to zoom in and out.

    Attributes:
        sure: chance that the whole target is in the image with which the lens zooms in ...
        unsure: ... and below which it zooms out; between them it stays.
        rim_px: so near to the image's border the target shall not come [px].
        deadband: a smaller relative change of the focal length is not worth moving the lens for.
        settle_s: for so long after it had to zoom out the lens does not zoom in [s].
    """

    sure: float = 0.95
    unsure: float = 0.8
    rim_px: float = 4.0
    deadband: float = 0.06
    settle_s: float = 0.3


@dataclass(frozen=True)
class ExpectedTarget:
    """The target as it will stand to the line of sight when the next frame is exposed.

    Attributes:
        offset: where its middle will be from the image's centre, that is the way that the head has still to go, right
            and down [tangent], (2,).
        covariance: of that [tangent^2], (2, 2).
        half: half its width and height [tangent], (2,).
        size_sigma: relative standard deviation of these.
    """

    offset: Array
    covariance: Array
    half: Array
    size_sigma: float = 0.0


@dataclass(frozen=True)
class ZoomChoice:
    """What the lens shall do.

    Attributes:
        focal_px: where it shall be [px].
        chance: that the whole target is then in the image.
        reason: why, in a word or two: "wanted", "unsure", "about to be lost", "settling" or "lost".
    """

    focal_px: float
    chance: float
    reason: str


def shape_of(track: Track) -> float:
    """A track's usual width over its height."""
    width, height = track.size_px.tolist()
    return float(width / height)


def expect(
    estimate: Estimate, pan: float, tilt: float, nominal_px: float, *, shape: float = 1.0
) -> ExpectedTarget | None:
    """Work out how a target will stand to the line of sight.

    Args:
        estimate: of the target, for the time when the next frame is exposed.
        pan: where the head will be then [rad].
        tilt: likewise.
        nominal_px: any focal length near the one in question; it only matters for the lens's centre.
        shape: width over height of the target's box.

    Returns:
        None where it will be behind the zoom camera.
    """
    seen = estimate.appearance(pan, tilt, nominal_px)
    return None if seen is None else _expected(estimate, seen, shape)


def _expected(estimate: Estimate, seen: Appearance, shape: float) -> ExpectedTarget:
    focal = seen.focal_px
    sides = {
        "height": (shape, 1.0),
        "width": (1.0, 1 / shape),
        "wingspan": (min(shape, 1.0), min(1 / shape, 1.0)),
    }[estimate.target.dimension]
    return ExpectedTarget(
        seen.offset_px / focal,
        seen.covariance / (focal[:, None] * focal),
        0.5 * seen.size_px / focal * np.array(sides),
        seen.size_sigma,
    )


def is_seen_well(
    estimate: Estimate, pan: float, tilt: float, nominal_px: float, longest_px: float, *, shape: float = 1.0
) -> bool:
    """Whether a target is wholly in the close-up and about as large as wanted, as far as is known.

    Args:
        estimate: of the target, for the time of that close-up.
        pan: where the head was then [rad].
        tilt: likewise.
        nominal_px: what the lens told then [px].
        longest_px: the most that it can tell [px]; a target that is too far off for the wanted size need not have it.
        shape: width over height of the target's box.
    """
    seen = estimate.appearance(pan, tilt, nominal_px)
    if seen is None:
        return False
    zoom, focal = estimate.calibration.zoom, float(seen.focal_px[0])
    wanted_px = min(estimate.target.wanted_px, seen.size_px * zoom.at(longest_px).focal_px[0] / focal)
    if not GOOD_SIZE[0] * wanted_px <= seen.size_px <= GOOD_SIZE[1] * wanted_px:
        return False
    return chance_inside(_expected(estimate, seen, shape), focal, zoom.size) >= SEEN_WELL


def chance_inside(expected: ExpectedTarget, focal_px: float, size: tuple[int, int], rim_px: float = 0.0) -> float:
    """The chance that the whole target is in the image.

    Args:
        expected: how it stands to the line of sight; its size's doubt widens each side, and both axes count alone.
        focal_px: focal length [px].
        size: (width, height) of the image [px].
        rim_px: that is not counted as image, all around [px].
    """
    chance = 1.0
    for axis in range(2):
        room = (size[axis] / 2 - rim_px) / focal_px - float(expected.half[axis])
        sigma = math.hypot(
            math.sqrt(float(expected.covariance[axis, axis])), float(expected.half[axis]) * expected.size_sigma
        )
        offset = abs(float(expected.offset[axis]))
        chance *= max(_below(room - offset, sigma) - _below(-room - offset, sigma), 0.0) if room > 0 else 0.0
    return chance


def longest_focal(
    expected: ExpectedTarget,
    chance: float,
    size: tuple[int, int],
    focal_range: tuple[float, float],
    rim_px: float = 0.0,
) -> float:
    """The longest focal length at which the whole target is in the image with some chance.

    Args:
        expected: how it stands to the line of sight.
        chance: that is asked for, 0 to 1.
        size: (width, height) of the image [px].
        focal_range: shortest and longest focal length [px]; the shortest is the answer also where it does not do.
        rim_px: that is not counted as image, all around [px].
    """
    low, high = focal_range
    if chance_inside(expected, high, size, rim_px) >= chance:
        return high
    for _ in range(HALVINGS):
        middle = math.sqrt(low * high)
        if chance_inside(expected, middle, size, rim_px) >= chance:
            low = middle
        else:
            high = middle
    return low


class ZoomController:
    """Decides on the lens from one frame to the next, with hysteresis, so that it does not hunt."""

    def __init__(
        self, focal_range: tuple[float, float], size: tuple[int, int], settings: ZoomSettings = ZoomSettings()
    ) -> None:
        """Begin without a history.

        Args:
            focal_range: shortest and longest focal length [px].
            size: (width, height) of the zoom image [px].
            settings: when to zoom in and out.
        """
        self._range = focal_range
        self._size = size
        self._settings = settings
        self._out_t = -math.inf

    def choose(
        self,
        expected: ExpectedTarget | None,
        wanted_px: float,
        commanded_px: float,
        t: float,
        now_px: float | None = None,
    ) -> ZoomChoice:
        """Decide where the lens shall be.

        Args:
            expected: how the target will stand to the line of sight; None where it is lost.
            wanted_px: focal length at which it is as large as wanted [px].
            commanded_px: where the lens was last sent [px].
            t: the time now [s].
            now_px: where the lens is now [px]; there by default.
        """
        if expected is None:
            self._out_t = t
            return ZoomChoice(self._range[0], 0.0, "lost")
        settings = self._settings
        wanted = min(max(wanted_px, self._range[0]), self._range[1])

        def longest(chance: float) -> float:
            return longest_focal(expected, chance, self._size, self._range, settings.rim_px)

        def choice(focal_px: float, reason: str) -> ZoomChoice:
            return ZoomChoice(focal_px, chance_inside(expected, focal_px, self._size, settings.rim_px), reason)

        sure = longest(settings.sure)
        goal = min(wanted, sure)
        reason = "wanted" if wanted <= sure else "unsure"
        change = math.log(goal / commanded_px)
        if change > settings.deadband:
            if t - self._out_t < settings.settle_s:
                # What it had to zoom out for may have passed before it got there: no farther out than is needed now.
                here = commanded_px if now_px is None else now_px
                return choice(max(commanded_px, min(goal, here)), "settling")
            return choice(goal, reason)
        if commanded_px > longest(settings.unsure) and change < 0:
            self._out_t = t
            return choice(goal, "about to be lost")
        if math.log(wanted / commanded_px) < -settings.deadband:
            return choice(goal, reason)
        return choice(commanded_px, reason)


def _below(value: float, sigma: float) -> float:
    """The chance that a normal variable with that sigma is below a value."""
    if sigma <= 0:
        return 1.0 if value > 0 else 0.0
    return 0.5 * math.erfc(-value / (sigma * math.sqrt(2)))
