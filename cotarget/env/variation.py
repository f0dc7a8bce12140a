"""Differences between episodes beside the target's path and size: delays, noise, lens, calibration error, path."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from numbers import Real
from typing import Any

import numpy as np

from cotarget.calibration import Calibration
from cotarget.camera import ZoomLens
from cotarget.config import SimConfig, Waypoint
from cotarget.env.common import number_in, require
from cotarget.errors import ConfigError
from cotarget.evaluation import TruthNoise

LARGEST_FACTOR = 10.0


@dataclass(frozen=True)
class Variation:
    """What one episode has other than the rig's configuration.

    Attributes:
        delay: factor of the cameras' latencies and of the delay of commands.
        noise: factor of the detections' noise and misses.
        lens: factor of the lens's speed.
        pan_deg: error of the calibrated pan [degrees].
        tilt_deg: error of the calibrated tilt [degrees].
        focal: factor of the calibrated focal length of the zoom camera.
        x_m: shift of the target's path to the right, along the world's x [m].
        y_m: shift away from the cameras, along the world's y [m].
        z_m: shift upwards [m].
    """

    delay: float = 1.0
    noise: float = 1.0
    lens: float = 1.0
    pan_deg: float = 0.0
    tilt_deg: float = 0.0
    focal: float = 1.0
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0

    def with_options(self, options: object) -> "Variation":
        """Replace what the options of a reset name.

        Raises:
            ConfigError: an option is unknown or no number.
        """
        names = [f.name for f in fields(self)]
        given = {} if options is None else options
        known = isinstance(given, Mapping) and set(given) <= set(names)
        require(known, "options", options, f"a mapping with some of: {', '.join(names)}")
        assert isinstance(given, Mapping)
        for name, value in given.items():
            if name in ("delay", "noise", "lens", "focal"):
                wanted = f"a number above 0 and up to {LARGEST_FACTOR:g}"
                require(number_in(value, 0.0, LARGEST_FACTOR), f"options.{name}", value, wanted)
            else:
                finite = isinstance(value, Real) and math.isfinite(value)
                require(finite, f"options.{name}", value, "a finite number")
        return replace(self, **{name: float(value) for name, value in given.items()})

    def sim(self, sim: SimConfig) -> SimConfig:
        """Vary delays, lens and paths of a simulation."""
        by = self.delay
        return replace(
            sim,
            fixed=replace(sim.fixed, latency_s=by * sim.fixed.latency_s),
            zoom=replace(sim.zoom, latency_s=by * sim.zoom.latency_s, lens_speed=self.lens * sim.zoom.lens_speed),
            head=replace(sim.head, command_delay_s=by * sim.head.command_delay_s),
            paths={name: self.shifted(path) for name, path in sim.paths.items()},
        )

    def shifted(self, path: tuple[Waypoint, ...]) -> tuple[Waypoint, ...]:
        """Shift a path."""
        return tuple((t, x + self.x_m, y + self.y_m, z + self.z_m) for t, x, y, z in path)

    def noises(self, noise: TruthNoise) -> TruthNoise:
        """Vary the noise of the detections."""
        by = self.noise
        miss = min(by * noise.miss, 1.0)
        return replace(noise, center_px=by * noise.center_px, size=by * noise.size, miss=miss)

    def calibrated(self, calibration: Calibration) -> Calibration:
        """Put errors into a calibration."""
        if (self.pan_deg, self.tilt_deg, self.focal) == (0.0, 0.0, 1.0):
            return calibration
        head = calibration.zoom_head
        pan_zero, tilt_zero = head.axes.pan_zero + math.radians(self.pan_deg), head.axes.tilt_zero
        axes = replace(head.axes, pan_zero=pan_zero, tilt_zero=tilt_zero + math.radians(self.tilt_deg))
        lens = ZoomLens(
            head.lens.nominal_px, tuple(stop.scaled(self.focal) for stop in head.lens.stops), head.lens.pupil
        )
        return replace(calibration, zoom_head=replace(head, axes=axes, lens=lens))


@dataclass(frozen=True)
class Randomization:
    """Ranges from which the `Variation` of an episode is drawn.

    Factors are drawn evenly in the logarithm, from 1 / (1 + x) to 1 + x; errors and shifts evenly from -x to x.

    Attributes:
        delay: of the cameras' latencies and of the delay of commands.
        noise: of the detections' noise and misses.
        lens: of the lens's speed.
        pointing_deg: of the calibrated pan and of the calibrated tilt [degrees].
        focal: of the calibrated focal length.
        path_m: of the path, along each axis [m].

    Raises:
        ConfigError: a number is not within 0 to 9.
    """

    delay: float = 0.5
    noise: float = 0.5
    lens: float = 0.3
    pointing_deg: float = 0.1
    focal: float = 0.02
    path_m: float = 0.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not (isinstance(value, Real) and 0 <= float(value) <= LARGEST_FACTOR - 1):
                raise ConfigError(f"randomize.{name}: {value!r} is not a number from 0 to {LARGEST_FACTOR - 1:g}")

    def draw(self, rng: np.random.Generator) -> Variation:
        """Draw an episode's variation."""
        delay, noise, lens, pan, tilt, focal, x, y, z = rng.uniform(-1.0, 1.0, 9).tolist()
        return Variation(
            delay=(1 + self.delay) ** delay,
            noise=(1 + self.noise) ** noise,
            lens=(1 + self.lens) ** lens,
            pan_deg=self.pointing_deg * pan,
            tilt_deg=self.pointing_deg * tilt,
            focal=(1 + self.focal) ** focal,
            x_m=self.path_m * x,
            y_m=self.path_m * y,
            z_m=self.path_m * z,
        )


def randomization_of(given: Any) -> Randomization | None:
    """Resolve the argument `randomize`: a Randomization, True for the usual one, False or None for none.

    Raises:
        ConfigError: it is something else.
    """
    if given is None or given is False:
        return None
    given = Randomization() if given is True else given
    require(isinstance(given, Randomization), "randomize", given, "True, False or a cotarget.env.Randomization")
    found: Randomization = given
    return found
