"""What the environments are given, checked: whoever gives something else is told so in one line."""

import math
import reprlib
from collections.abc import Mapping
from numbers import Real
from pathlib import Path

import numpy as np

from cotarget.calibration import Calibration, load_calibration
from cotarget.config import RigConfig, load_config
from cotarget.errors import ConfigError
from cotarget.oracle import TruthNoise
from cotarget.sim.fieldpaths import SECONDS
from cotarget.simconfig import SimConfig, SimEffects, Size

SMALLEST_PX = 8
# The rig where none is given: the default one, without what makes pictures costly.
DEFAULT_RIG = RigConfig(
    sim=SimConfig(effects=SimEffects(noise=False, jpeg=False, distortion=False, blur=False, multisampling=False))
)


def told(given: object) -> str:
    """What was given, for messages: on one line, and not all of it where that is long."""
    return " ".join(reprlib.repr(given).split())


def rig_of(given: object) -> RigConfig:
    """The simulated rig that is meant: one, or its rig.toml; the default one for None.

    Raises:
        ConfigError: it is none, or not simulated.
    """
    if isinstance(given, Path | str):
        given = load_config(Path(given))
    config = DEFAULT_RIG if given is None else given
    if not isinstance(config, RigConfig):
        raise ConfigError(f"rig: {told(given)} is neither a cotarget.config.RigConfig nor the path of a rig.toml")
    if config.backend != "sim":
        raise ConfigError(f"rig: its backend is '{config.backend}'; environments are on 'sim' alone")
    return config


def calibration_of(given: object) -> Calibration | None:
    """The calibration that is meant: one, or its file; None for none.

    Raises:
        ConfigError: it is something else.
        CalibrationError: the file is no calibration.
    """
    if isinstance(given, Path | str):
        return load_calibration(Path(given))
    if given is None or isinstance(given, Calibration):
        return given
    raise ConfigError(f"calibration: {told(given)} is neither a cotarget.calibration.Calibration nor the path of one")


def noise_of(given: object) -> TruthNoise:
    """The noise that is meant.

    Raises:
        ConfigError: it is none.
    """
    if isinstance(given, TruthNoise):
        return given
    raise ConfigError(f"noise: {told(given)} is no cotarget.oracle.TruthNoise")


def seconds_of(given: object) -> float:
    """How long an episode takes [s].

    Raises:
        ConfigError: that is no time, or longer than targets have ways for.
    """
    if isinstance(given, Real) and 0 < float(given) <= SECONDS:
        return float(given)
    raise ConfigError(f"seconds: {told(given)} is not above 0 and up to {SECONDS:g}, for which there are ways to go")


def size_of(given: object) -> Size:
    """The size of pictures (width, height) [px].

    Raises:
        ConfigError: it is none.
    """
    size = tuple(given) if isinstance(given, list | tuple) else ()
    whole = all(isinstance(side, int | np.integer) and side >= SMALLEST_PX for side in size)
    if len(size) != 2 or not whole:
        raise ConfigError(f"image_size: {told(given)} is not (width, height) of at least {SMALLEST_PX} pixels each")
    return int(size[0]), int(size[1])


def reward_of(given: object) -> float:
    """A reward.

    Raises:
        ConfigError: it is no finite number.
    """
    if isinstance(given, Real) and math.isfinite(given):
        return float(given)
    raise ConfigError(f"served_reward: {told(given)} is not a finite number")


def check_options(given: object) -> None:
    """Refuse options of an episode; there are none.

    Raises:
        ConfigError: there is one.
    """
    if given:
        first = next(iter(given)) if isinstance(given, Mapping) else given
        raise ConfigError(f"options: reset knows no {told(first)}; it takes a seed only")
