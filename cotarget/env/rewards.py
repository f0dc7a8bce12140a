"""Rewards of the environments of version 1."""

import math
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cotarget.control.policy import ZOOM_UNIT
from cotarget.geometry import Array
from cotarget.metrics import Closeup

Reward = Literal["yield", "dense", "shaped"]
REWARDS: tuple[Reward, ...] = get_args(Reward)


def closeness(off: npt.ArrayLike, size_ratio: npt.ArrayLike) -> Array:
    """How near a close-up is to a centred target of the wanted size, 0 to 1; half for one of twice or half that size.

    Args:
        off: distance of the target from the image's centre in half-widths of the close-up; infinite behind the camera.
        size_ratio: size over the wanted size; 0 behind the camera.
    """
    with np.errstate(divide="ignore"):
        wrong_size = np.abs(np.log2(size_ratio))
    return 1 / ((1 + np.asarray(off)) * (1 + wrong_size))


def closeness_of(judged: Closeup) -> float:
    """Closeness of one close-up."""
    width, height = judged.width_px, judged.height_px
    off_px = math.hypot(judged.u_px - (width - 1) / 2, judged.v_px - (height - 1) / 2)
    off = math.inf if math.isnan(off_px) else 2 * off_px / width
    return float(closeness(off, judged.size_ratio))


def shaped(
    reward: Array | float, gamma: float, before: Array | float, after: Array | float, terminated: npt.ArrayLike = False
) -> Array:
    """Add potential-based shaping to a reward (Ng, Harada, Russell 1999), which keeps the best policies.

    Args:
        reward: reward of a step.
        gamma: discount of the learner.
        before: potential of the state before the step.
        after: potential of the state after it.
        terminated: whether the episode terminated there. The potential counts as 0 then, and not at a truncation, where
            the learner goes on by its own estimate of the state.
    """
    return np.asarray(reward + gamma * np.where(terminated, 0.0, after) - before)


def commanded_way(before: Array, after: Array, width_px: int) -> Array:
    """How far apart two commands are: pan and tilt in half-widths of the close-up, and focal lengths in zoom units.

    Args:
        before: pan, tilt [rad] and logarithm of the nominal focal length [px] of a command, (3, ...).
        after: the same of the next command.
        width_px: width of the zoom image.
    """
    pan, tilt, focal = np.abs(after - before)
    return np.asarray((pan + tilt) * np.exp(after[2]) / (width_px / 2) + focal / ZOOM_UNIT)
