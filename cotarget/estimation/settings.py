"""What is assumed of a target and of the rig before anything is measured, for each kind of target.

Accelerations and time constants were chosen on simulated tracks, by the error of the prediction 0.2 and 0.6 s ahead as
long as its covariance stayed honest; `cotarget.estimation` says against what.
"""

import functools
import math
from dataclasses import dataclass, field, replace

import numpy as np

from cotarget.calibration import Calibration, predicted_pointing
from cotarget.config import TargetConfig

# What the head's rounding, its play and the middle of a box leave of bias, whatever the calibration says [rad].
LEAST_BIAS = 5e-4
# The bias of a rig whose calibration does not say how good it is: 0.04 degrees [rad].
USUAL_BIAS = 7e-4
# Nearer than this many of its own sizes a target spans more than a right angle: it fills the view of any lens that the
# fixed camera is likely to have, and no pointing at it helps.
NEAREST_SIZES = 0.5
USUAL_DEPTH = 15.0  # [m]; a target whose size is not seen, at first


@dataclass(frozen=True)
class Jump:
    """How a target moves that was found elsewhere than it could be: a hand carries it, or it was mistaken.

    Attributes:
        speed: standard deviation, across the line of sight, of its velocity when it is found [m/s]
        acceleration: ... and of its acceleration [m/s^2], then and ...
        seconds: ... for so long: whoever carries it speeds up and brakes [s].
        by_hand_s: how long an acceleration lasts meanwhile of what is carried by hand [s]; None of what goes by itself,
            of which they last as long as always.
    """

    speed: float = 3.0
    acceleration: float = 10.0
    seconds: float = 1.5
    by_hand_s: float | None = None


@dataclass(frozen=True)
class MotionSettings:
    """How a target moves, and how slowly what is unknown about it and the head changes.

    Attributes:
        acceleration: standard deviation of the acceleration along each axis [m/s^2].
        manoeuvre_s: how long an acceleration lasts [s]; much less than between frames makes the velocity a random
            walk ("constant velocity"), much more the acceleration constant.
        speed: standard deviation of the velocity along each axis [m/s].
        size_sigma: of the true size over the told one, relative; constant for one target.
        attitude_mean: of the logarithm of the apparent size over the true one; negative where it is foreshortened.
        attitude_sigma: its standard deviation.
        attitude_s: how long an attitude lasts [s].
        bias_sigma: of the head's pan and tilt each [rad].
        bias_s: how long such a bias lasts [s].
        nearest: no target is nearer to the fixed camera than this, along its axis [m].
        jump: how it moves when it was found elsewhere than it could be.
    """

    acceleration: float
    manoeuvre_s: float
    speed: float
    size_sigma: float
    attitude_mean: float = 0.0
    attitude_sigma: float = 0.02
    attitude_s: float = 0.5
    bias_sigma: float = USUAL_BIAS
    bias_s: float = 60.0
    nearest: float = 0.1
    jump: Jump = field(default_factory=Jump)

    @property
    def fading_s(self) -> float:
        """The time constant of a velocity that its own acceleration then holds at the speed above [s]."""
        return self.speed**2 / (self.acceleration**2 * self.manoeuvre_s) + self.manoeuvre_s


@dataclass(frozen=True)
class EstimationSettings:
    """How a target moves, how well it is measured, and what is done about measurements that do not fit.

    Attributes:
        motion: how it moves.
        noise_px: standard deviation of the middle of a box in the wide view that does not depend on its size [px].
        noise_of_size: the part that does, as a fraction of the box's side (limbs and wings that move).
        noise_s: how long an error of that middle lasts [s].
        size_noise: standard deviation of a box's side, relative.
        size_noise_px: the part that does not depend on its size [px].
        size_s: how long an error of the side lasts [s]; half a wing beat or step.
        unsized_s: how long a velocity along the axis lasts while the wide view shows a piece of the target only [s]:
            long enough for a moment behind a post; whoever fills the view has mostly stopped.
        head_sigma: of the angles that the head reports for a frame [rad]; rounding of 0.05 degrees leaves that.
        gate: largest squared innovation, in variances, of a middle; 99.9 % of a chi-square with two degrees of freedom.
        jump_gate: beyond this it is either wrong or elsewhere: ten standard deviations. Between the two it counts less.
        size_gate: likewise of a size; 99.7 % with one.
        misses: so many measurements beyond jump_gate on end are believed.
        zoom_misses: likewise in the zoom view, while the wide view has no surprise: then size or head is doubted.
        calm: a mean surprise below which the wide view counts as having none.
        lean_gain: weight of the newest innovation in the zoom view in their mean, in standard deviations.
        most_lean: largest such mean; beyond it size and head are doubted too. Of white noise it is 0.23 for each axis.
        depth_sigma: of the depth's logarithm, before a size is seen.
        depth_doubt: what is added to it where the target has jumped, or looks of quite another size.
        size_doubt: what is added to the sigma of size and depth together, where the zoom view contradicts them.
        bias_doubt: what is then added to the sigma of the head's bias [rad].
        surprise_gain: weight of the newest measurement in the mean surprise.
        most_boost: most by which surprise multiplies the acceleration's variance.
        history_s: how late a measurement may come after the newest one [s].
    """

    motion: MotionSettings
    noise_px: float = 0.4
    noise_of_size: float = 0.04
    noise_s: float = 0.03
    size_noise: float = 0.05
    size_noise_px: float = 1.0
    size_s: float = 0.2
    unsized_s: float = 0.5
    head_sigma: float = 3e-4
    gate: float = 13.8
    jump_gate: float = 100.0
    size_gate: float = 9.0
    misses: int = 3
    zoom_misses: int = 8
    calm: float = 2.0
    lean_gain: float = 0.1
    most_lean: float = 1.0
    depth_sigma: float = 1.0
    depth_doubt: float = 0.3
    size_doubt: float = 0.3
    bias_doubt: float = 5e-3
    surprise_gain: float = 0.2
    most_boost: float = 30.0
    history_s: float = 1.5

    @property
    def jump_boost(self) -> float:
        """By what the acceleration's variance is larger than usual where it was found elsewhere."""
        return max(1.0, (self.motion.jump.acceleration / self.motion.acceleration) ** 2)

    @functools.cached_property
    def jump_motion(self) -> MotionSettings:
        """How it moves when it was found elsewhere, the larger acceleration aside."""
        by_hand_s = self.motion.jump.by_hand_s
        return self.motion if by_hand_s is None else replace(self.motion, manoeuvre_s=by_hand_s)


# A hand that reaches somewhere speeds up and brakes within a second or so.
HAND = Jump(acceleration=5.0, seconds=1.25, by_hand_s=0.15)
BOOK = EstimationSettings(
    MotionSettings(0.5, 0.5, 0.7, 0.01, attitude_sigma=0.01, attitude_s=2.0, jump=HAND),
    noise_px=0.2,
    noise_of_size=0.01,
    noise_s=0.0,
    size_noise=0.01,
    size_noise_px=0.3,
    misses=2,
)
PERSON = EstimationSettings(MotionSettings(0.8, 0.7, 1.2, 0.04))
# The larger side of a bird's box is anything from its body's length to its wingspan.
BIRD = EstimationSettings(
    MotionSettings(6.5, 2.5, 7.0, 0.075, attitude_mean=-0.35, attitude_sigma=0.3, attitude_s=1.0),
    noise_of_size=0.06,
    noise_s=0.1,  # half a wing beat
    size_noise=0.1,
    size_s=0.06,  # a quarter of a wing beat
)


# How a target moves that is told to stand (but for being carried elsewhere), walk or fly.
KINDS = {"standing": BOOK, "walking": PERSON, "flying": BIRD}


def estimation_settings_for(target: TargetConfig, calibration: Calibration | None = None) -> EstimationSettings:
    """Choose the settings for a target's kind; a calibration that knows its own error gives the head's bias.

    How well it is measured, and in what attitudes it shows itself, follows from its detector and dimension; how it
    moves does too, unless that is told.

    Args:
        target: the target.
        calibration: of the rig.
    """
    settings = PERSON
    if target.detector == "colour":
        settings = BOOK
    elif target.dimension == "wingspan":
        settings = BIRD
    told = settings.motion if target.motion is None else KINDS[target.motion].motion
    motion = replace(
        settings.motion,
        acceleration=told.acceleration,
        manoeuvre_s=told.manoeuvre_s,
        speed=told.speed,
        jump=told.jump,
        nearest=NEAREST_SIZES * target.size,
    )
    settings = replace(settings, motion=motion)
    if calibration is None or calibration.covariance is None:
        return settings
    middle = calibration.fixed.image_center_px
    sigma = float(predicted_pointing(calibration, middle, USUAL_DEPTH)) / math.sqrt(2)  # of one axis
    if not np.isfinite(sigma):
        return settings
    return replace(settings, motion=replace(settings.motion, bias_sigma=math.hypot(LEAST_BIAS, sigma)))
