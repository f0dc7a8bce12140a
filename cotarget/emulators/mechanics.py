"""The simulated rig's axes and lens in real time, as the emulated devices command them; and the clock they go by."""

import math
import threading
import time

from cotarget.sim.motion import Axis, LensDrive

REMEMBERED = 5.0  # how far back axes and lens are asked for exposures [s]


class WallClock:
    """The machine's monotonic clock from a start."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> float:
        """Seconds since it was made."""
        return time.monotonic() - self._start

    def sleep_until(self, t: float) -> None:
        """Return when the clock shows ``t`` [s]."""
        time.sleep(max(t - self.now(), 0.0))

    def monotonic(self, t: float) -> float:
        """The machine's monotonic time when this clock shows ``t`` [s]."""
        return self._start + t


class EmulatedAxis:
    """One axis of the simulated head in the steps of a pan-tilt unit; an `AxisPlant`.

    Args:
        axis: of the simulation, in radians.
        clock: the world's.
        step: of the unit, negative where it counts the other way [rad].
        delay: from a command to motion [s].
    """

    def __init__(self, axis: Axis, clock: WallClock, step: float, delay: float) -> None:
        self._axis, self._clock, self._step, self._delay = axis, clock, step, delay
        self._rests = 0.0
        self._lock = threading.Lock()

    def command(self, goal: int, speed: float, acceleration: float) -> None:
        """Go there from now on: steps, steps/s, steps/s^2."""
        with self._lock:
            t = self._begin(acceleration)
            self._rests = self._axis.command(t, goal * self._step, speed * abs(self._step))

    def halt(self, acceleration: float) -> None:
        """Brake from now on."""
        with self._lock:
            self._rests = self._axis.halt(self._begin(acceleration))

    def position(self) -> int:
        """Where it is now [steps]."""
        return round(self._axis.motor(self._clock.now())[0] / self._step)

    def speed(self) -> float:
        """How fast it turns now [steps/s]."""
        return self._axis.motor(self._clock.now())[1] / self._step

    def moving(self) -> bool:
        """Whether it turns, or is about to."""
        return self._clock.now() < self._rests

    def _begin(self, acceleration: float) -> float:
        """When a command given now takes effect; what nobody asks for any more is forgotten."""
        now = self._clock.now()
        self._axis.forget(now - REMEMBERED)
        if math.isfinite(self._axis.acceleration):
            self._axis.acceleration = acceleration * abs(self._step)
        return now + self._delay


class EmulatedLens:
    """The simulated zoom lens; a `LensPlant`."""

    def __init__(self, drive: LensDrive, clock: WallClock, delay: float) -> None:
        self._drive, self._clock, self._delay = drive, clock, delay
        self._rests = 0.0
        self._lock = threading.Lock()

    @property
    def last(self) -> int:
        """The number of its last position."""
        return self._drive.last

    def command(self, position: int) -> None:
        """Go there from now on."""
        with self._lock:
            now = self._clock.now()
            self._drive.axis.forget(now - REMEMBERED)
            self._rests = self._drive.axis.command(now + self._delay, float(min(max(position, 0), self.last)))

    def position(self) -> int:
        """Where it is now."""
        return round(self._drive.axis.motor(self._clock.now())[0])

    def moving(self) -> bool:
        """Whether it moves, or is about to."""
        return self._clock.now() < self._rests
