"""The PTU-D46 behind its commands: profiles of units, and an axis as the firmware counts it.

Sources: S1 = PTU-D46 manual v2.14.0 (2006), S2 = Command Reference Manual v3.00D (2008).
"""

import math
from collections.abc import Generator
from dataclasses import dataclass

from cotarget.emulators.plant import AxisPlant
from cotarget.errors import ConfigError

# Arc seconds in a degree.
ARCSEC = 3600.0
# Tolerance [steps] for limits given in degrees to count as whole steps: a rig's step has a few digits only.
STEP_SLACK = 0.02
# Largest position of any unit: ten times that of the finest step of any series over a whole turn.
MOST_COUNTS = 1_000_000
Range = tuple[int, int]


@dataclass(frozen=True)
class UnitProfile:
    """A model of pan-tilt unit, with its settings at power-up."""

    step: float  # resolution of both axes [arc seconds]
    pan: Range  # lowest and highest pan position that the reset finds [steps]
    tilt: Range  # lowest and highest tilt position that the reset finds [steps]
    # Reply to the query of the version, and banner when the unit gets power.
    title: str = "Pan-Tilt Controller v2.14.0(C14/E), (C)2006 Directed Perception, Inc., All Rights Reserved"
    resolution_digits: int = 4  # decimals of the resolution in replies
    stop_margin: int = 30  # distance from those positions to the mechanical stops [steps]
    slip: int = 8  # steps lost when an axis meets an obstacle
    speed: int = 1000  # desired speed [steps/s]
    # Moves up to this speed have no ramp; ramps of faster moves begin at 0 here, and at it on a real unit [steps/s].
    base_speed: int = 1000
    lowest_speed: int = 31  # [steps/s]
    highest_speed: int = 2902  # [steps/s]
    acceleration: int = 2000  # [steps/s^2]
    reset_speed: int = 1000  # speed of the reset [steps/s]
    boot_s: float = 1.0  # time from power to readiness, without a reset [s]

    @property
    def resolution(self) -> str:
        """Resolution in replies [arc seconds]."""
        return f"{self.step:.{self.resolution_digits}f}"

    @classmethod
    def from_degrees(
        cls, pan: tuple[float, float], tilt: tuple[float, float], step: float, speed: float, acceleration: float
    ) -> "UnitProfile":
        """Make a profile of a head whose range is known in degrees, such as a simulated rig's.

        Its ramps start from rest (base speed 0), as the simulated head's do. Its stops are its limits, so that even a
        reset stays within them.

        Args:
            pan: lowest and highest [degrees].
            tilt: lowest and highest [degrees].
            step: resolution of both axes [degrees].
            speed: highest speed, and speed of moves at power-up [degrees/s].
            acceleration: of both axes [degrees/s^2].

        Raises:
            ConfigError: the step is not positive, or the range has too many steps for such a unit.
        """
        if not step > 0 or max(abs(angle) for angle in (*pan, *tilt)) / step > MOST_COUNTS:
            raise ConfigError(f"head.step: {step:g} degrees is no step of a PTU-D46; 0.0514286 is its usual one")

        def counts(limits: tuple[float, float]) -> Range:
            return math.ceil(limits[0] / step - STEP_SLACK), math.floor(limits[1] / step + STEP_SLACK)

        fastest = max(round(speed / step), 1)
        return cls(
            step=step * ARCSEC,
            pan=counts(pan),
            tilt=counts(tilt),
            resolution_digits=6,
            stop_margin=0,
            speed=fastest,
            base_speed=0,
            lowest_speed=min(31, fastest),
            highest_speed=fastest,
            acceleration=max(round(acceleration / step), 1),
            reset_speed=fastest,
        )


# A PTU-D46-17.5 with factory settings: half steps, limits of the examples in S1 and S2.
D46_STOCK = UnitProfile(step=185.1428, pan=(-3090, 3090), tilt=(-907, 604))
# The paper's range, +-180 and -80..+30 degrees, which needs the extended-range option, on an older firmware.
D46_PAPER = UnitProfile(
    step=185.1428,
    pan=(-3500, 3500),
    tilt=(-1555, 583),
    title="Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved",
    base_speed=57,
    highest_speed=1985,
)


# Stands for "at once" [steps/s^2].
INSTANT = 1e6
# A command that takes time: yields text to print meanwhile, "" for nothing yet, and returns its answer.
Task = Generator[str, None, str]


class UnitAxis:
    """One axis of the unit, "Pan" or "Tilt", as its firmware counts it; a reset finds its ``limits``."""

    def __init__(self, name: str, plant: AxisPlant, unit: UnitProfile, limits: Range) -> None:
        self.name, self.letter, self.plant = name, name[0], plant
        self.speed = unit.speed  # of moves [steps/s]
        self._unit, self._limits = unit, limits
        self._calibrated = True
        self._goal: int | None = None  # None after a halt
        self._shift = 0  # count less true position, after steps were lost or power failed

    @property
    def limits(self) -> Range:
        """Lowest and highest position that the reset found; both 0 before a reset."""
        return self._limits if self._calibrated else (0, 0)

    @property
    def position(self) -> int:
        """Position by the unit's own count."""
        return self.plant.position() + self._shift

    @property
    def desired(self) -> int:
        """Commanded position."""
        return self.position if self._goal is None else self._goal

    def go(self, goal: int) -> None:
        """Move to a position, even during a move."""
        self._goal = goal
        lowest, highest = self._stops()
        self._command(min(max(goal - self._shift, lowest), highest), self.speed)

    def set_speed(self, speed: int) -> None:
        """Set the speed of moves, and continue the present one at it."""
        self.speed = speed
        if self._goal is not None and self.plant.moving():
            self.go(self._goal)

    def halt(self) -> None:
        """Brake, and drop the goal."""
        self._goal = None
        self.plant.halt(self._acceleration(abs(self.plant.speed())))

    def lose_steps(self, direction: int) -> None:
        """Stop at an obstacle: the count goes on in ``direction``, the axis does not."""
        self._stop()
        self._shift += direction * self._unit.slip

    def lose_power(self) -> None:
        """Stop, count the present position as 0, and forget the speed."""
        self._stop()
        self._calibrated = False
        self._shift = -self.plant.position()
        self.speed = self._unit.speed

    def reset(self) -> Task:
        """Run into both stops, set the limits from them, and go to 0."""
        for stop in self._stops():
            self._command(stop, self._unit.reset_speed)
            while self.plant.moving():
                yield ""
            yield f"!{self.letter}"
        self._shift, self._goal, self._calibrated = 0, 0, True
        self._command(0, self._unit.reset_speed)
        while self.plant.moving():
            yield ""
        return ""

    def _stop(self) -> None:
        self.plant.halt(INSTANT)
        self._goal = None

    def _stops(self) -> Range:
        """Return the true positions of the mechanical stops."""
        margin = self._unit.stop_margin
        return self._limits[0] - margin, self._limits[1] + margin

    def _command(self, aim: int, speed: int) -> None:
        """Command the plant to a true position."""
        self.plant.command(aim, speed, self._acceleration(speed))

    def _acceleration(self, speed: float) -> float:
        """Return the acceleration of a change of speed, which needs no ramp up to the base speed."""
        return INSTANT if speed <= self._unit.base_speed else self._unit.acceleration
