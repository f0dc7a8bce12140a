"""What the environments are given, checked: whoever gives something else is told so in one line."""

import math
import reprlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path

import numpy as np

from cotarget.calibration import Calibration, load_calibration
from cotarget.config import RigConfig, check_config, load_config
from cotarget.errors import ConfigError, choices
from cotarget.eyes import PATIENCE_S
from cotarget.oracle import TruthNoise
from cotarget.sim.fieldpaths import SECONDS, in_view
from cotarget.sim.room import part_seen
from cotarget.simconfig import SimConfig, SimEffects, Size, Waypoint

# Sides of pictures: fewer pixels show nothing, and more are hardly meant, as one such picture takes 50 MB.
SMALLEST_PX, LARGEST_PX = 8, 4096
# Of the ways of a few episodes, this part at least is to be seen in another scene than the one that they are made for.
TRIED_SEEDS, LEAST_SEEN, EVERY_KNOT = range(3), 0.5, 5
# The rig where none is given: the default one, without what makes pictures costly.
DEFAULT_RIG = RigConfig(
    sim=SimConfig(effects=SimEffects(noise=False, jpeg=False, distortion=False, blur=False, multisampling=False))
)


def told(given: object) -> str:
    """What was given, for messages: on one line, and not all of it where that is long."""
    return " ".join(reprlib.repr(given).split())


def name_of(what: str, given: object, known: Collection[str]) -> str:
    """A name of those that there are.

    Raises:
        ConfigError: it is another.
    """
    if isinstance(given, str) and given in known:
        return given
    raise ConfigError(f"{what}: unknown {told(given)}; there {'are' if len(known) > 1 else 'is'}: {choices(known)}")


def rig_of(given: object) -> RigConfig:
    """The simulated rig that is meant: one, or its rig.toml; the default one for None.

    Its head goes no farther than the soft limits.

    Raises:
        ConfigError: it is none, not simulated, impossible, or too slow.
    """
    if isinstance(given, Path | str):
        given = load_config(Path(given))
    config = DEFAULT_RIG if given is None else given
    if not isinstance(config, RigConfig):
        raise ConfigError(f"rig: {told(given)} is neither a cotarget.config.RigConfig nor the path of a rig.toml")
    if config.backend != "sim":
        raise ConfigError(f"rig: its backend is '{config.backend}'; environments are on 'sim' alone")
    if given is not None:
        check_config(config)  # one made in Python was not
        _check_waits(config.sim)
    pan_deg, tilt_deg = config.head_limits_deg
    head = replace(config.sim.head, pan_deg=pan_deg, tilt_deg=tilt_deg)
    return replace(config, sim=replace(config.sim, head=head))


def _check_waits(sim: SimConfig) -> None:
    """Refuse cameras whose frames are longer in coming than anybody waits."""
    waits_s = {"fixed.rate_hz": 1 / sim.fixed.rate_hz}
    if sim.effects.latency:
        waits_s |= {"fixed.latency_s": sim.fixed.latency_s, "zoom.latency_s": sim.zoom.latency_s}
    for name, wait_s in waits_s.items():
        if wait_s > PATIENCE_S:
            raise ConfigError(f"rig: sim.{name}: makes a frame {wait_s:g} s late; nobody waits above {PATIENCE_S:g} s")


def check_scene(sim: SimConfig, name: str, paths: Callable[[str, int], Mapping[str, Sequence[Waypoint]]]) -> None:
    """Refuse a scene in which a target is seldom to be seen, where it would be in the outdoor one.

    Args:
        sim: its scene.
        name: of the target.
        paths: the ways of an episode, by name and seed.

    Raises:
        ConfigError: it is such a scene.
    """
    if sim.scene == SimConfig.scene:
        return
    ways = [way[::EVERY_KNOT] for seed in TRIED_SEEDS for way in paths(name, seed).values()]
    places = np.array([x for way in ways for t, *x in way if 0 <= t <= SECONDS])
    seen = part_seen(sim, places[in_view(places)])
    if seen < LEAST_SEEN:
        raise ConfigError(
            f"rig: in the scene '{sim.scene}' {seen:.0%} of a {name}'s ways can be seen; they are made for "
            f"'{SimConfig.scene}': fixed_mount at (0, 0, 1.6), looking along +y and 9 degrees up, over open ground"
        )


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
    whole = all(isinstance(side, int | np.integer) and SMALLEST_PX <= side <= LARGEST_PX for side in size)
    if len(size) != 2 or not whole:
        raise ConfigError(
            f"image_size: {told(given)} is not (width, height) of {SMALLEST_PX} to {LARGEST_PX} pixels each"
        )
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
    if given is not None and not (isinstance(given, Mapping) and not given):
        first = next(iter(given)) if isinstance(given, Mapping) else given
        raise ConfigError(f"options: reset knows no {told(first)}; it takes a seed only")
