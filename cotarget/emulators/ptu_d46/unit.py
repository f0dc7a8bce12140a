"""The PTU-D46 behind its commands: unit profiles, axes, settings, limits, modes and reset.

`UnitProfile` describes a model of unit: limits, resolution, speeds, and the wording of its replies. `UnitAxis` is one
axis as the firmware counts it, in front of an `AxisPlant`. `Unit` holds the state that commands share.

Sources: S1 = PTU-D46 manual v2.14.0 (2006), S2 = Command Reference Manual v3.00D (2008), S3 = PTU-E46 manual; and what
published drivers read from real units. Where these disagree, the profiles do too.
"""

import copy
import math
from collections.abc import Callable, Generator
from dataclasses import dataclass

from cotarget.emulators.plant import AxisPlant
from cotarget.errors import ConfigError

# Arc seconds in a degree.
ARCSEC = 3600.0
# Tolerance [steps] for limits given in degrees to count as whole steps: a rig's step has a few digits only.
STEP_SLACK = 0.02
# Largest position of any unit: ten times that of the finest E-series step over a whole turn.
MOST_COUNTS = 1_000_000
Range = tuple[int, int]


@dataclass(frozen=True)
class Wording:
    """Replies that the sources word differently; ``{axis}`` becomes Pan or Tilt, ``{n}`` a number."""

    offset: str = "Current {axis} position is {n}"  # reply to the query of an axis' desired position
    speed: str = "Target {axis} speed is {n} positions/sec"  # reply to the query of its desired speed
    acceleration: str = "{axis} acceleration is {n} positions/sec^2"  # reply to the query of its acceleration
    resolution: str = "{n} seconds arc per position"  # reply to the query of its resolution
    too_fast: str = "{axis} speed cannot exceed {n} positions/sec"  # refusal of a speed above the upper bound
    illegal: str = "Illegal argument"  # refusal of an invalid command
    out_of_range: str = "Illegal argument"  # refusal of any other number
    uncalibrated: str | None = None  # refusal of a move before the reset; None if the limits of 0 refuse it
    # Reply to the query of the control mode, verbose and terse.
    independent: tuple[str, str] = ("independent control mode", "independent control mode")
    # The same in pure velocity mode.
    velocity: tuple[str, str] = ("pure velocity control mode", "pure velocity control mode")
    regular: str = "REGULAR"  # terse word for regular power


@dataclass(frozen=True)
class UnitProfile:
    """A model of pan-tilt unit, with the behaviour of its firmware."""

    version: tuple[int, int, int]  # of the firmware; later commands are unknown to it
    title: str  # reply to the query of the version
    step: float  # resolution of both axes [arc seconds]
    pan: Range  # lowest and highest pan position that the reset finds [steps]
    tilt: Range  # lowest and highest tilt position that the reset finds [steps]
    resolution_digits: int = 4  # decimals of the resolution in replies
    stop_margin: int = 30  # distance from those positions to the mechanical stops [steps]
    slip: int = 8  # steps lost when an axis meets an obstacle
    speed: int = 1000  # desired speed at power-up [steps/s]
    # Moves up to this speed have no ramp; ramps of faster moves begin at 0 here, and at it on a real unit [steps/s].
    base_speed: int = 1000
    lowest_speed: int = 31  # lower bound at power-up [steps/s]
    highest_speed: int = 2902  # upper bound at power-up [steps/s]
    ceiling: int = 6000  # highest upper bound that can be set [steps/s]
    acceleration: int = 2000  # at power-up [steps/s^2]
    reset_speed: int = 1000  # speed of the reset [steps/s]
    tables_s: float = 3.0  # time to compute the tables after a change of acceleration or a bound [s]
    boot_s: float = 1.0  # time from power to readiness, without a reset [s]
    leading_lf: bool = False  # whether the answer to a command that ends with CR begins with a line feed
    reset_at_once: bool = False  # whether RE, RP and RT reset now, rather than set what R and power-up do
    halt_waits: bool = False  # whether H answers once the axes stand, rather than at once; the sources do not say
    greeting: str = ""  # text for a new TCP client; empty for a plain serial line
    wording: Wording = Wording()  # of the replies

    @property
    def resolution(self) -> str:
        """Resolution in replies [arc seconds]."""
        return f"{self.step:.{self.resolution_digits}f}"

    @property
    def banner(self) -> str:
        """Text printed when the unit gets power, before the star of readiness."""
        return f"\r\n{self.title}\r\n"

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
            version=D46_STOCK.version,
            title=D46_STOCK.title,
            step=step * ARCSEC,
            resolution_digits=6,
            pan=counts(pan),
            tilt=counts(tilt),
            stop_margin=0,
            speed=fastest,
            base_speed=0,
            lowest_speed=min(31, fastest),
            highest_speed=fastest,
            ceiling=fastest,
            acceleration=max(round(acceleration / step), 1),
            reset_speed=fastest,
        )


# A PTU-D46-17.5 with factory settings: half steps, limits of the examples in S1 and S2.
D46_STOCK = UnitProfile(
    version=(2, 14, 0),
    title="Pan-Tilt Controller v2.14.0(C14/E), (C)2006 Directed Perception, Inc., All Rights Reserved",
    step=185.1428,
    pan=(-3090, 3090),
    tilt=(-907, 604),
)
# The paper's range, +-180 and -80..+30 degrees, which needs the extended-range option. An older firmware: where S1 and
# S2 differ it has S2's wording, that of units which the drivers CARMEN and ASR met, and MRPT's refusal of a number.
D46_PAPER = UnitProfile(
    version=(2, 12, 1),
    title="Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved",
    step=185.1428,
    pan=(-3500, 3500),
    tilt=(-1555, 583),
    base_speed=57,
    highest_speed=1985,
    wording=Wording(
        offset="Target {axis} position is {n}",
        acceleration="{axis} acceleration is {n} positions/sec/sec",  # ASR's parser accepts no further digit
        resolution="{n} seconds arc per {axis} position",
        too_fast="{axis} speed cannot exceed {n} pos/sec",
        out_of_range="Value out of range",
        independent=("PTU is in independent control mode", "independent"),
        velocity=("PTU is in pure velocity control mode", "pure velocity"),
    ),
)


# Axes

# Stands for "at once" [steps/s^2].
INSTANT = 1e6
# A command that takes time: yields text to print meanwhile, "" for nothing yet, and returns its answer.
Task = Generator[str, None, str]


@dataclass
class UnitAxisSettings:
    """Settings of an axis, which DS saves; in steps and seconds."""

    speed: int
    acceleration: int
    base: int
    upper: int
    lower: int
    user_lowest: int
    user_highest: int
    hold: str = "R"
    move: str = "R"


class UnitAxis:
    """One axis of the unit, "Pan" or "Tilt", as its firmware counts it; a reset finds its ``limits``."""

    def __init__(self, name: str, plant: AxisPlant, unit: UnitProfile, limits: Range) -> None:
        self.name = name
        self.letter = name[0]
        self.plant = plant
        self.settings = UnitAxisSettings(
            unit.speed, unit.acceleration, unit.base_speed, unit.highest_speed, unit.lowest_speed, *limits
        )
        self.calibrated = True
        self.pending: int | None = None  # goal that waits for A or I
        self.velocity = 0  # commanded, in pure velocity mode
        self._unit = unit
        self._limits = limits
        self._goal: int | None = None  # None after a halt
        self._shift = 0  # count less true position, after steps were lost or power failed
        self._into_stop = 0  # direction in which the present move meets a stop

    @property
    def limits(self) -> Range:
        """Lowest and highest position that the reset found; both 0 before a reset."""
        return self._limits if self.calibrated else (0, 0)

    @property
    def position(self) -> int:
        """Position by the unit's own count."""
        return self.plant.position() + self._shift

    @property
    def desired(self) -> int:
        """Commanded position, of now or of the next A or I."""
        if self.pending is not None:
            return self.pending
        return self.position if self._goal is None else self._goal

    def go(self, goal: int, speed: int | None = None) -> None:
        """Move to a position, even during a move; a stop on the way is hit."""
        self._goal, self.pending = goal, None
        self._move(goal, self.settings.speed if speed is None else speed)

    def change_speed(self) -> None:
        """Continue the present move at the speed that is set now."""
        if self._goal is not None and self.plant.moving():
            self._move(self._goal, self.settings.speed)

    def drive(self, velocity: int, limits: Range | None) -> None:
        """Turn at a signed speed, up to the limit or, without one, to the stop; 0 halts."""
        self.velocity = velocity
        side = velocity > 0
        if velocity == 0:
            self.halt()
        elif limits is not None:
            self.go(limits[side], abs(velocity))
        else:  # a step beyond the stop, so that it is hit
            self.go(self._stops()[side] + (1 if side else -1) + self._shift, abs(velocity))

    def halt(self) -> None:
        """Brake, and drop the goal."""
        self._goal = self.pending = None
        self._into_stop = 0
        self.plant.halt(self._acceleration(abs(self.plant.speed())))

    def stopped_at_stop(self) -> bool:
        """Return whether the present move has just hit its stop, and lose steps there."""
        if not self._into_stop or self.plant.moving():
            return False
        self.lose_steps(self._into_stop)
        return True

    def lose_steps(self, direction: int) -> None:
        """Stop at an obstacle: the count goes on in ``direction``, the axis does not."""
        self._stop()
        self._shift += direction * self._unit.slip

    def lose_power(self) -> None:
        """Stop, and count the present position as 0."""
        self._stop()
        self.calibrated = False
        self._shift = -self.plant.position()

    def reset(self) -> Task:
        """Run into both stops, set the limits from them, and go to 0."""
        self.velocity = self._into_stop = 0
        for stop in self._stops():
            self._command(stop, self._unit.reset_speed)
            while self.plant.moving():
                yield ""
            yield f"!{self.letter}"
        self._shift, self._goal, self.pending, self.calibrated = 0, 0, None, True
        self._command(0, self._unit.reset_speed)
        while self.plant.moving():
            yield ""
        return ""

    def _stop(self) -> None:
        self.plant.halt(INSTANT)
        self._goal = self.pending = None
        self._into_stop = self.velocity = 0

    def _stops(self) -> Range:
        """Return the true positions of the mechanical stops."""
        margin = self._unit.stop_margin
        return self._limits[0] - margin, self._limits[1] + margin

    def _move(self, goal: int, speed: int) -> None:
        """Move to a position by the unit's count, or to the stop before it."""
        aim, (lowest, highest) = goal - self._shift, self._stops()
        self._into_stop = (aim > highest) - (aim < lowest)
        self._command(min(max(aim, lowest), highest), speed)

    def _command(self, aim: int, speed: int) -> None:
        """Command the plant to a true position."""
        self.plant.command(aim, speed, self._acceleration(speed))

    def _acceleration(self, speed: float) -> float:
        """Return the acceleration of a change of speed, which needs no ramp up to the base speed."""
        return INSTANT if speed <= self.settings.base else self.settings.acceleration


# The unit

BAUD = 9600  # factory setting of the serial line [S1]


class RefusalError(Exception):
    """The unit refuses a command: it answers an exclamation mark and this message."""


@dataclass
class Settings:
    """Settings that DS saves, and DR and power-up restore."""

    pan: UnitAxisSettings  # of the pan axis
    tilt: UnitAxisSettings  # of the tilt axis
    echo: str = "E"  # "E" if the unit echoes every character, or "D"
    feedback: str = "V"  # "V" if replies to queries are sentences, "T" for terse ones
    limits: str = "E"  # "E" for the factory's, "D" for none, "U" for the user's
    reset: str = "E"  # axes that R and power-up reset: "E" for both, "P", "T", or "D" for none
    immediate: bool = True  # whether positions are executed at once, rather than on A or I
    network_id: int = 0  # number on a shared line; 0 for a unit that is alone on its line


class Unit:
    """State of a unit, with the operations that several commands use."""

    def __init__(self, pan: AxisPlant, tilt: AxisPlant, profile: UnitProfile, now: Callable[[], float]) -> None:
        self.profile, self.wording, self.now = profile, profile.wording, now
        self.pan = UnitAxis("Pan", pan, profile, profile.pan)
        self.tilt = UnitAxis("Tilt", tilt, profile, profile.tilt)
        self.settings = Settings(self.pan.settings, self.tilt.settings)
        self._factory = copy.deepcopy(self.settings)
        self._saved = copy.deepcopy(self.settings)
        self.velocity_mode = False
        self.selected = True  # whether commands on a shared line are for this unit
        self.baud = self.baud_at_power_up = BAUD
        self.byte_delay_s = 0.0

    @property
    def axes(self) -> tuple[UnitAxis, UnitAxis]:
        """Pan and tilt axis."""
        return self.pan, self.tilt

    def say(self, sentence: str, axis: UnitAxis, value: object) -> str:
        """Make the answer to a query, a sentence or the value alone."""
        return sentence.format(axis=axis.name, n=value) if self.settings.feedback == "V" else str(value)

    def limits(self, axis: UnitAxis) -> Range | None:
        """Return the positions allowed now; None if all are."""
        if self.settings.limits == "D":
            return None
        lowest, highest = axis.limits
        if self.settings.limits == "U" and axis.calibrated:
            return max(lowest, axis.settings.user_lowest), min(highest, axis.settings.user_highest)
        return lowest, highest

    def move(self, axis: UnitAxis, goal: int) -> str:
        """Go to a position, now or on A or I.

        Raises:
            RefusalError: the position is beyond a limit, or the unit is in pure velocity mode.
        """
        limits = self.limits(axis)
        if self.velocity_mode:
            raise RefusalError(self.wording.illegal)
        if limits is not None:
            if not axis.calibrated and self.wording.uncalibrated is not None:
                raise RefusalError(self.wording.uncalibrated)
            refuse_beyond(axis, goal, limits)
        if self.settings.immediate:
            axis.go(goal)
        else:
            axis.pending = goal
        return ""

    def set_speed(self, axis: UnitAxis, speed: int) -> str:
        """Set a speed, even during a move; in pure velocity mode it is signed and starts the motion.

        Raises:
            RefusalError: the speed is out of bounds.
        """
        upper, lower = axis.settings.upper, max(axis.settings.lower, 1)
        size = abs(speed) if self.velocity_mode else speed
        if size > upper:
            raise RefusalError(self.wording.too_fast.format(axis=axis.name, n=upper))
        if size < lower and not (self.velocity_mode and speed == 0):
            raise RefusalError(f"Motor speed cannot be less than {lower} pos/sec")
        if self.velocity_mode:
            axis.drive(speed, self.limits(axis))
        else:
            axis.settings.speed = speed
            axis.change_speed()
        return ""

    def set_velocity_mode(self, on: bool) -> None:
        """Change the control mode; a change halts the axes."""
        if on != self.velocity_mode:
            self.velocity_mode = on
            for axis in self.axes:
                axis.drive(0, None)

    def release_pending(self) -> None:
        """Start the moves that wait for A or I."""
        for axis in self.axes:
            if axis.pending is not None:
                axis.go(axis.pending)

    def wait_until_still(self, *axes: UnitAxis) -> Task:
        """Wait until the axes stand."""
        while any(axis.plant.moving() for axis in axes):
            yield ""
        return ""

    def change(self, axis: UnitAxis, name: str, value: int) -> Task:
        """Set an axis's bound or acceleration: wait until the axis stands, then for the tables.

        The desired speed is clipped to the bounds.
        """
        yield from self.wait_until_still(axis)
        ready = self.now() + self.profile.tables_s
        while self.now() < ready:
            yield ""
        settings = axis.settings
        setattr(settings, name, value)
        settings.speed = min(max(settings.speed, settings.lower), settings.upper)
        return ""

    def reset(self, which: str) -> Task:
        """Find the limits of both axes ("E"), of one ("P", "T") or none, tilt first, as real units' replies show."""
        for axis in (self.tilt, self.pan):
            if which in ("E", axis.letter):
                yield from axis.reset()
        return ""

    def save(self) -> None:
        """Save the settings for the next power-up."""
        self._saved = copy.deepcopy(self.settings)

    def restore(self, factory: bool = False) -> None:
        """Restore the saved or the factory's settings; the control mode becomes independent."""
        self.settings = copy.deepcopy(self._factory if factory else self._saved)
        self.pan.settings, self.tilt.settings = self.settings.pan, self.settings.tilt
        self.set_velocity_mode(False)

    def lose_power(self) -> None:
        """Lose all state but the saved settings, including the position."""
        self.velocity_mode = False
        self.restore()
        self.selected = self.settings.network_id == 0
        self.baud, self.byte_delay_s = self.baud_at_power_up, 0.0
        for axis in self.axes:
            axis.lose_power()


def refuse_beyond(axis: UnitAxis, goal: int, limits: Range) -> None:
    """Refuse a position beyond limits.

    Raises:
        RefusalError: the position is beyond one; the message names it.
    """
    lowest, highest = limits
    if goal > highest:
        raise RefusalError(f"Maximum allowable {axis.name} position is {highest}")
    if goal < lowest:
        raise RefusalError(f"Minimum allowable {axis.name} position is {lowest}")
