"""Rewards of the environments of version 1."""

from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cotarget.config import GOOD_SIZE
from cotarget.geometry import Array

Reward = Literal["yield", "dense", "shaped"]
REWARDS: tuple[Reward, ...] = get_args(Reward)


def closeness(off: npt.ArrayLike, size_ratio: npt.ArrayLike) -> Array:
    """How near a close-up is to a centred target of the wanted size, 0 to 1.

    Args:
        off: distance of the target from the image's centre in half-widths of the close-up; infinite behind the camera.
        size_ratio: size over the wanted size; 0 behind the camera.
    """
    with np.errstate(divide="ignore"):
        wrong_size = np.abs(np.log(size_ratio)) / np.log(GOOD_SIZE[1])
    return 1 / ((1 + np.asarray(off)) * (1 + wrong_size))


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
