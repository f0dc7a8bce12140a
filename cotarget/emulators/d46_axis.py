"""One axis as the unit's firmware sees it: what it believes of its position, its limits, speeds and ramps."""

import math
from collections.abc import Generator
from dataclasses import dataclass

from cotarget.emulators.d46_profiles import Range, UnitProfile
from cotarget.emulators.plant import AxisPlant

# Stands for "at once": a step motor that starts below its base speed needs no ramp [steps/s^2].
INSTANT = 1e6
# Steps that a step of each mode W is divided into, against half steps: full, half, quarter, eighth, automatic (which
# counts in its finest steps).
FINENESS = {"F": 0.5, "H": 1.0, "Q": 2.0, "E": 4.0, "A": 4.0}

# A command that takes time yields what it prints meanwhile, "" for nothing yet, and returns its answer.
Task = Generator[str, None, str]


def plain_acceleration(distance: float, speed: float, base: float, acceleration: float) -> float:
    """Acceleration of the plain trapezoid that takes as long, from rest, as one that starts and ends at a base speed.

    The plant knows no base speed; this keeps the duration of its moves.

    Args:
        distance: of the move [steps].
        speed: highest on the way [steps/s].
        base: reached at once [steps/s].
        acceleration: above it [steps/s^2].
    """
    if base <= 0:
        return acceleration
    if speed <= base or distance <= 0:
        return INSTANT
    ramps = (speed**2 - base**2) / acceleration  # distance on both ramps
    if distance >= ramps:
        duration = 2 * (speed - base) / acceleration + (distance - ramps) / speed
    else:
        duration = 2 * (math.sqrt(base**2 + acceleration * distance) - base) / acceleration
    plain = 4 * distance / duration**2
    if plain * distance > speed**2:  # it would be faster than allowed halfway
        plain = speed / (duration - distance / speed)
    return min(plain, INSTANT)


@dataclass
class AxisSettings:
    """What can be set of an axis, and saved by DS; in positions of its step mode, and seconds."""

    speed: int
    acceleration: int
    base: int
    upper: int
    lower: int
    user_lowest: int
    user_highest: int
    hold: str = "REGULAR"
    move: str = "REGULAR"
    step_mode: str = "H"


class UnitAxis:
    """An axis of the unit.

    Args:
        name: "Pan" or "Tilt".
        plant: its mechanics, in half steps.
        unit: the model of the unit.
        limits: lowest and highest position that a reset finds [half steps].
    """

    def __init__(self, name: str, plant: AxisPlant, unit: UnitProfile, limits: Range) -> None:
        self.name = name
        self.letter = name[0]
        self.plant = plant
        self.settings = AxisSettings(
            unit.speed, unit.acceleration, unit.base_speed, unit.highest_speed, unit.lowest_speed, *limits
        )
        self.calibrated = True
        self.pending: int | None = None  # goal that waits for A or I
        self.velocity = 0  # desired, in pure velocity mode
        self.endless = False  # continuous pan of a slip ring
        self._unit = unit
        self._limits = limits
        self._goal: int | None = None  # None where it was halted
        self._shift = 0  # what the count is above the truth, after steps were lost or the power was gone
        self._into_stop = 0  # direction in which the present move meets a stop

    @property
    def fineness(self) -> float:
        """Positions a half step."""
        return FINENESS[self.settings.step_mode]

    @property
    def resolution(self) -> float:
        """Of a position [arc seconds]."""
        return self._unit.step / self.fineness

    @property
    def factory_limits(self) -> Range:
        """Lowest and highest position that the reset found; both 0 before a reset."""
        if not self.calibrated:
            return 0, 0
        if self.endless:
            turn = round(360 * 3600 / self.resolution)
            return 1 - turn, turn
        return int(self._limits[0] * self.fineness), int(self._limits[1] * self.fineness)

    @property
    def position(self) -> int:
        """Where the unit believes to be."""
        return round(self.plant.position() * self.fineness) + self._shift

    @property
    def speed(self) -> float:
        """How fast it turns, signed [positions/s]."""
        return self.plant.speed() * self.fineness

    @property
    def desired(self) -> int:
        """Where it is to go, now or on A or I."""
        if self.pending is not None:
            return self.pending
        return self.position if self._goal is None else self._goal

    def moving(self) -> bool:
        """Whether it turns, or is about to."""
        return self.plant.moving()

    def go(self, goal: int, speed: int | None = None) -> None:
        """Move to a position, on the fly; a stop on the way is run into."""
        self._goal, self.pending = goal, None
        self._set_out(goal, self.settings.speed if speed is None else speed)

    def change_speed(self) -> None:
        """Let the present move go on at the speed that is set now."""
        if self._goal is not None and self.moving():
            self._set_out(self._goal, self.settings.speed)

    def drive(self, velocity: int, limits: Range | None) -> None:
        """Turn at a signed speed, until the limit or, without one, the stop; 0 halts."""
        self.velocity = velocity
        if velocity == 0:
            self.halt()
            return
        side = velocity > 0
        if limits is not None:
            self.go(limits[side], abs(velocity))
        else:  # a step past the stop, so that it is met
            past = self._stops()[side] + (1 if side else -1)
            self.go(round(past * self.fineness) + self._shift, abs(velocity))

    def halt(self) -> None:
        """Brake, and forget the goal."""
        speed, base, acceleration = abs(self.speed), self.settings.base, float(self.settings.acceleration)
        if 0 < base < speed:  # the braking distance of a motor that stands as soon as it is down to its base speed
            acceleration *= speed**2 / (speed**2 - base**2)
        elif base >= speed:
            acceleration = INSTANT if base else acceleration
        self._goal = self.pending = None
        self._into_stop = 0
        self.plant.halt(min(acceleration / self.fineness, INSTANT))

    def stopped_at_stop(self) -> bool:
        """Whether the present move has just met its stop; steps were lost then."""
        if not self._into_stop or self.moving():
            return False
        self.lose_steps(self._into_stop)
        return True

    def lose_steps(self, direction: int) -> None:
        """Stand against something: the motor was driven on in ``direction``, the axis did not follow."""
        self.plant.halt(INSTANT)
        self._goal = self.pending = None
        self._into_stop = self.velocity = 0
        self._shift += direction * self._unit.slip

    def lose_power(self) -> None:
        """Stand, and take for 0 where that is."""
        self.plant.halt(INSTANT)
        self._goal = self.pending = None
        self._into_stop = self.velocity = 0
        self.calibrated = self.endless = False
        self._shift = 0
        self._shift = -self.position

    def reset(self) -> Task:
        """Run into both stops, find the limits from them, and go to 0."""
        self.velocity = 0
        for stop in self._stops():
            self._send(stop, self._unit.reset_speed)
            while self.moving():
                yield ""
            yield f"!{self.letter}"
        self._shift, self._goal, self.pending, self._into_stop = 0, 0, None, 0
        self.calibrated = True
        self._send(0, self._unit.reset_speed)
        while self.moving():
            yield ""
        return ""

    def _stops(self) -> Range:
        """Where the mechanics end [half steps]."""
        margin = self._unit.stop_margin
        return self._limits[0] - margin, self._limits[1] + margin

    def _set_out(self, goal: int, speed: int) -> None:
        """Move at a speed [positions/s] to where the unit believes a position to be, or to the stop before it."""
        aim = (goal - self._shift) / self.fineness
        lowest, highest = (-math.inf, math.inf) if self.endless else self._stops()
        self._into_stop = (aim > highest) - (aim < lowest)
        self._send(min(max(aim, lowest), highest), speed / self.fineness)

    def _send(self, aim: float, speed: float) -> None:
        """Command the plant: half steps and half steps a second."""
        acceleration, base = self.settings.acceleration / self.fineness, self.settings.base / self.fineness
        distance = abs(aim - self.plant.position())
        self.plant.command(round(aim), speed, plain_acceleration(distance, speed, base, acceleration))
