"""The unit behind the D46's commands: both axes, what is set and what is saved, limits, modes, the reset."""

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from cotarget.emulators.d46_axis import AxisSettings, Task, UnitAxis
from cotarget.emulators.d46_profiles import Range, UnitProfile
from cotarget.emulators.plant import AxisPlant

BAUD = 9600  # of the serial line, as it leaves the factory [S1]


class RefusalError(Exception):
    """A command that the unit answers with an exclamation mark and this message."""


@dataclass
class Settings:
    """What DS saves, and DR and power-up restore.

    Attributes:
        pan: of the pan axis.
        tilt: of the tilt axis.
        echo: whether it returns every character.
        verbose: whether replies to queries are sentences.
        limits: E factory's, D none, U the user's.
        reset: axes that R and power-up reset, of "PT".
        immediate: whether positions are gone to at once, rather than on A or I.
        scan_at_power_up: whether it scans by itself when it gets power.
        network_id: 0 for a unit that has the line for itself.
    """

    pan: AxisSettings
    tilt: AxisSettings
    echo: bool = True
    verbose: bool = True
    limits: str = "E"
    reset: str = "PT"
    immediate: bool = True
    scan_at_power_up: bool = False
    network_id: int = 0


class Unit:
    """The state of a unit, and what more than one command does with it.

    Args:
        pan: mechanics of pan, in half steps.
        tilt: mechanics of tilt.
        profile: the model.
        now: clock of the unit [s].
    """

    def __init__(self, pan: AxisPlant, tilt: AxisPlant, profile: UnitProfile, now: Callable[[], float]) -> None:
        self.profile = profile
        self.now = now
        self.pan = UnitAxis("Pan", pan, profile, profile.pan)
        self.tilt = UnitAxis("Tilt", tilt, profile, profile.tilt)
        self.settings = Settings(self.pan.settings, self.tilt.settings)
        self._factory = copy.deepcopy(self.settings)
        self._saved = copy.deepcopy(self.settings)
        self.velocity_mode = False
        self.selected = True  # whether commands on the network are for this unit
        self.routed = False  # whether the line goes on to an expansion port
        self.presets: dict[int, tuple[int, int]] = {}
        self.scan: list[Task] = []  # what the autoscan does, an axis each
        self.baud = self.baud_at_power_up = BAUD
        self.byte_delay_s = 0.0

    @property
    def axes(self) -> tuple[UnitAxis, UnitAxis]:
        """Pan and tilt."""
        return self.pan, self.tilt

    def axis(self, letter: str) -> UnitAxis:
        """The axis that P or T stands for."""
        return self.pan if letter == "P" else self.tilt

    def say(self, sentence: str, axis: UnitAxis, n: int) -> str:
        """The answer to a query of a number."""
        return sentence.format(axis=axis.name, n=n) if self.settings.verbose else str(n)

    def limits(self, axis: UnitAxis) -> Range | None:
        """The positions allowed now; None if all are."""
        match self.settings.limits, axis.calibrated:
            case "D", _:
                return None
            case "U", True:
                lowest, highest = axis.factory_limits
                return max(lowest, axis.settings.user_lowest), min(highest, axis.settings.user_highest)
            case _:
                return axis.factory_limits

    def move(self, axis: UnitAxis, goal: int) -> str:
        """Go to a position, now or on A or I.

        Raises:
            RefusalError: it is beyond a limit, or the unit is in pure velocity mode.
        """
        wording, limits = self.profile.wording, self.limits(axis)
        if self.velocity_mode:
            raise RefusalError(wording.illegal)
        if limits is not None:
            if not axis.calibrated and wording.uncalibrated is not None:
                raise RefusalError(wording.uncalibrated)
            if goal > limits[1]:
                raise RefusalError(f"Maximum allowable {axis.name} position is {limits[1]}")
            if goal < limits[0]:
                raise RefusalError(f"Minimum allowable {axis.name} position is {limits[0]}")
        if self.settings.immediate:
            axis.go(goal)
        else:
            axis.pending = goal
        return ""

    def set_speed(self, axis: UnitAxis, speed: int) -> str:
        """Take a speed, on the fly; in pure velocity mode it has a sign, and drives.

        Raises:
            RefusalError: it is out of bounds.
        """
        upper, lower = axis.settings.upper, max(axis.settings.lower, 1)
        size = abs(speed) if self.velocity_mode else speed
        if size > upper:
            raise RefusalError(self.profile.wording.too_fast.format(axis=axis.name, n=upper))
        if size < lower and not (self.velocity_mode and speed == 0):
            raise RefusalError(f"Motor speed cannot be less than {lower} pos/sec")
        if self.velocity_mode:
            axis.drive(speed, self.limits(axis))
        else:
            axis.settings.speed = speed
            axis.change_speed()
        return ""

    def set_velocity_mode(self, on: bool) -> None:
        """Change the control mode; the axes halt."""
        if on != self.velocity_mode:
            self.velocity_mode = on
            for axis in self.axes:
                axis.drive(0, None)

    def release_pending(self) -> None:
        """Set out to the positions that waited."""
        for axis in self.axes:
            if axis.pending is not None:
                axis.go(axis.pending)

    def standing(self, axes: Iterable[UnitAxis]) -> Task:
        """Wait until axes stand."""
        waited = tuple(axes)
        while any(axis.moving() for axis in waited):
            yield ""
        return ""

    def compute_tables(self, axis: UnitAxis, change: Callable[[], None]) -> Task:
        """Change what is not changed on the fly: once the axis stands, and it takes its time."""
        yield from self.standing([axis])
        ready = self.now() + self.profile.tables_s
        while self.now() < ready:
            yield ""
        change()
        return ""

    def reset(self, letters: str) -> Task:
        """Find the limits of the axes named, tilt first, as the replies of real units show."""
        for axis in (self.tilt, self.pan):
            if axis.letter in letters:
                yield from axis.reset()
        return ""

    def start_scan(self, ranges: dict[str, Range]) -> None:
        """Go to and fro between two positions of each axis named, until `end_scan`."""

        def sweep(axis: UnitAxis, ends: Range) -> Task:
            while True:
                for end in ends:
                    axis.go(end)
                    yield from self.standing([axis])
                    yield ""

        self.scan = [sweep(self.axis(letter), ends) for letter, ends in ranges.items()]

    def end_scan(self) -> None:
        """Stop the scan and go home."""
        self.scan = []
        for axis in self.axes:
            axis.go(0)

    def save(self) -> None:
        """Keep the settings for the next power-up."""
        self._saved = copy.deepcopy(self.settings)

    def restore(self, factory: bool = False) -> None:
        """Take the saved settings again, or the factory's; the control mode is independent then."""
        self.settings = copy.deepcopy(self._factory if factory else self._saved)
        self.pan.settings, self.tilt.settings = self.settings.pan, self.settings.tilt
        self.set_velocity_mode(False)

    def lose_power(self) -> None:
        """What a gap in the power does: all but the saved settings is forgotten, above all where the axes are."""
        self.velocity_mode = False
        self.restore()
        self.selected, self.routed = self.settings.network_id == 0, False
        self.scan = []
        self.baud, self.byte_delay_s = self.baud_at_power_up, 0.0
        for axis in self.axes:
            axis.lose_power()
