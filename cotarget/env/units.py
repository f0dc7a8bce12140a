"""What commands and states of a rig are as numbers between -1 and 1."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gymnasium
import numpy as np
import numpy.typing as npt

from cotarget.config import RigConfig
from cotarget.env.arguments import told
from cotarget.errors import ConfigError
from cotarget.rig import PanTiltState, ZoomState

Vector = npt.NDArray[np.float32]
Command = tuple[float, float, float]  # pan and tilt [rad], nominal focal length [px]

LONGEST_AGE_S = 1.0  # ages are told up to this [s]


def box(ranges: Iterable[tuple[float, float]], rows: int | None = None) -> gymnasium.spaces.Box:
    """A space of numbers within these ranges (lowest, highest), (n,), or of so many rows of them, (rows, n)."""
    low, high = np.array(list(ranges), dtype=np.float32).T
    if rows is not None:
        low, high = np.tile(low, (rows, 1)), np.tile(high, (rows, 1))
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


def within(values: Sequence[float] | Sequence[Sequence[float]], space: gymnasium.spaces.Box) -> Vector:
    """Values as an element of a space, clipped to its ranges."""
    return np.minimum(np.maximum(np.array(values, dtype=np.float32), space.low), space.high)


@dataclass(frozen=True)
class Units:
    """The ranges of head and lens, which -1 to 1 stand for.

    Attributes:
        pan: lowest and highest [rad].
        tilt: likewise.
        focal_px: shortest and longest nominal focal length [px]; between them evenly in the logarithm.
    """

    pan: tuple[float, float]
    tilt: tuple[float, float]
    focal_px: tuple[float, float]

    @classmethod
    def of(cls, config: RigConfig) -> "Units":
        """Those of a rig: the head's limits, the soft ones included."""
        return cls(*config.head_limits, config.focal_range_px)

    def command(self, action: npt.ArrayLike) -> Command:
        """What an action (pan, tilt, focal length) from -1 to 1 commands; beyond that it is clipped.

        Raises:
            ConfigError: it is not three finite numbers.
        """
        try:
            given = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            given = np.empty(0)
        if given.shape != (3,) or not all(map(math.isfinite, given.tolist())):
            raise ConfigError(f"action: {told(action)} is not three finite numbers, of pan, tilt and focal length")
        parts = [(min(max(number, -1.0), 1.0) + 1) / 2 for number in given.tolist()]
        (low_pan, high_pan), (low_tilt, high_tilt), (short, long) = self.pan, self.tilt, self.focal_px
        return (
            low_pan + parts[0] * (high_pan - low_pan),
            low_tilt + parts[1] * (high_tilt - low_tilt),
            short * (long / short) ** parts[2],
        )

    def action(self, command: Command) -> Vector:
        """The action that commands this, (3,)."""
        return np.array(self.numbers(*command), dtype=np.float32)

    def numbers(self, pan: float, tilt: float, focal_px: float) -> tuple[float, float, float]:
        """Pan, tilt [rad] and nominal focal length [px] as numbers, which are from -1 to 1 within the ranges."""
        (low_pan, high_pan), (low_tilt, high_tilt), (short, long) = self.pan, self.tilt, self.focal_px
        return (
            2 * (pan - low_pan) / (high_pan - low_pan) - 1,
            2 * (tilt - low_tilt) / (high_tilt - low_tilt) - 1,
            2 * math.log(focal_px / short) / math.log(long / short) - 1,
        )


# What a rig tells of itself, and the range of each number.
RIG_FEATURES = {
    "pan": (-1.0, 1.0),  # of the head, as in an action
    "tilt": (-1.0, 1.0),
    "focal": (-1.0, 1.0),  # of the lens, as in an action
    "pan_commanded": (-1.0, 1.0),  # what was commanded last, after rounding to steps
    "tilt_commanded": (-1.0, 1.0),
    "focal_commanded": (-1.0, 1.0),
    "head_moves": (0.0, 1.0),
    "lens_moves": (0.0, 1.0),
    "age_s": (0.0, LONGEST_AGE_S),  # of the wide camera's frame
    "closeup_age_s": (0.0, LONGEST_AGE_S),  # of the zoom camera's
    "gone": (0.0, 1.0),  # part of the episode
}


def rig_numbers(
    units: Units, head: PanTiltState, lens: ZoomState, commanded: Command, ages_s: tuple[float, float], gone: float
) -> list[float]:
    """The numbers of RIG_FEATURES.

    Args:
        units: of the rig.
        head: its state.
        lens: likewise.
        commanded: last.
        ages_s: of the wide camera's newest frame and of the zoom camera's [s].
        gone: part of the episode.
    """
    return [
        *units.numbers(head.pan, head.tilt, lens.focal_px),
        *units.numbers(*commanded),
        float(head.moving),
        float(lens.moving),
        *ages_s,
        gone,
    ]
