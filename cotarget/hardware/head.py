"""The pan-tilt unit PTU-D46 behind the Rig's `PanTilt` Protocol."""

import atexit
import contextlib
import itertools
import logging
import math
import threading

from cotarget.config import SafetyConfig
from cotarget.errors import ConfigError, DeviceError, HaltedError
from cotarget.hardware.d46loop import Loop
from cotarget.hardware.d46lost import LostPosition, PositionLostError
from cotarget.hardware.d46unit import HALT_NOW, AxisFacts, Unit, connect
from cotarget.hardware.d46wishes import DroppedError, Halt, Move
from cotarget.hardware.line import open_line
from cotarget.hardware.lineerrors import LostError
from cotarget.hwconfig import HardwareHead
from cotarget.rig import Clock, PanTiltLimits, PanTiltState, Speed

log = logging.getLogger(__name__)

STANDS_S = 5.0  # for a head that turned when it was opened to stand after the halt
HALT_S = 1.0  # for a halt to be acknowledged, beyond braking, with a line that has to be got back in step first
CLOSE_S = 5.0  # for the thread to end
LOOK_S = 0.2  # how often somebody who waits for a move looks whether the thread still lives
NOTHING_SAID = SafetyConfig()
ROUNDING = 1e-9  # of a speed that is a whole number of steps but for the conversion from degrees


class D46Head:
    """A PTU-D46, opened, compared with the configuration, and standing.

    A thread of its own owns the line: it polls the positions all the time and sends commands as they come. What goes
    wrong there is raised by the next call of any method, and for good if the position may be lost: then no program
    opens the head any more until it was reset. Nothing here resets the unit.

    Args:
        config: where the unit is, and what it is expected to say.
        clock: the rig's.
        safety: a speed cap that the unit must be able to keep, and a stop file, beside which is remembered that the
            position is lost.

    Raises:
        ConfigError: the unit is another than the configuration says.
        DeviceError: there is no unit, or none that can be used as it is.
    """

    def __init__(self, config: HardwareHead, clock: Clock, safety: SafetyConfig = NOTHING_SAID) -> None:
        self._lost = LostPosition(config.port, safety.stop_file)
        self._lost.refuse()
        self._line = open_line(config.port, config.baud, clock)
        self._signs = (config.pan_sign, config.tilt_sign)
        self._numbers = itertools.count(1)
        self._dead: DeviceError | None = None
        self._closed = False
        try:
            self.unit: Unit = connect(self._line, config)
            for key, cap in (
                ("hardware.head.speed_deg_s", config.speed_deg_s),
                ("safety.speed_deg_s", safety.speed_deg_s),
            ):
                _refuse_too_slow(key, cap, self.unit, config.port)
            self._limits = _limits(self.unit, config)
            self._loop = Loop(self._line, self.unit, clock, config.command_delay_s)
            self._wait_until_it_stands(clock)
        except BaseException as error:
            self._remember(error)
            self._line.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"PTU-D46 at {config.port}", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # a program that ends without closing it must not leave it turning

    @property
    def limits(self) -> PanTiltLimits:
        """What the unit can do, by its own account; its speed is at most the configured one."""
        return self._limits

    def state(self) -> PanTiltState:
        """Where the head was when it was last polled; at once.

        Raises:
            DeviceError: something went wrong since the last call, or the line is dead.
        """
        self._raise_what_happened()
        # In this order: the loop says that it moves before it takes a wish out of the queue.
        waiting = bool(self._loop.moves)
        seen = self._loop.snapshot
        pan, tilt = self._angles(seen.pan, seen.tilt)
        return PanTiltState(pan, tilt, seen.moving or waiting, seen.t)

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes; the newest command wins.

        Args:
            pan: angle [rad].
            tilt: angle [rad].
            speed: of both axes or of each [rad/s]; the configured one unless given, and never above that. The unit
                takes it in whole steps a second, rounded down, and turns no slower than it can.
            wait: return only when the head stands there.

        Returns:
            What was commanded after clipping to the limits and rounding to steps [rad].

        Raises:
            DeviceError: a value is no number, the head did not arrive, or something went wrong since the last call.
        """
        number = next(self._numbers)
        self._raise_what_happened()
        if not (math.isfinite(pan) and math.isfinite(tilt)):
            raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
        fastest = self._limits.capped(speed)
        axes = (self.unit.pan, self.unit.tilt)
        a, b = (
            min(max(round(sign * angle / axis.step), axis.lowest), axis.highest)
            for sign, angle, axis in zip(self._signs, (pan, tilt), axes, strict=True)
        )
        move = Move(number, (a, b), (_steps(fastest[0], axes[0]), _steps(fastest[1], axes[1])), wait)
        self._loop.moves.append(move)
        if wait:
            self._wait_for(move)
        return self._angles(a, b)

    def halt(self) -> None:
        """Stop at once, before anything else; return when the unit has acknowledged it.

        May be called from any thread and from a signal handler, as often as one likes. A move that somebody is about
        to command at that moment is not sent any more.

        Raises:
            DeviceError: the unit did not acknowledge it.
        """
        if self._closed:
            return
        wish = Halt(next(self._numbers))
        self._loop.halts.append(wish)
        wish.done.wait(HALT_S + self._loop.braking_s if self._thread.is_alive() else 0.0)
        if wish.answered or self._loop.rests:
            return
        if not self._thread.is_alive() and not isinstance(self._dead, LostError):
            with contextlib.suppress(DeviceError):
                self._line.write(HALT_NOW)
        if self._dead is not None:
            raise DeviceError(str(self._dead)) from self._dead
        raise DeviceError(f"the pan-tilt unit at {self._line.name} did not acknowledge a halt: it does not answer")

    def close(self) -> None:
        """Halt, end the thread and release the port; nothing is raised, and a second time does nothing."""
        if self._closed:
            return
        self._closed = self._loop.closing = True
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.warning("%s: the thread of the pan-tilt unit does not end", self._line.name)
        self._line.close()
        atexit.unregister(self.close)

    def _run(self) -> None:
        reason: DeviceError = DroppedError(f"the pan-tilt unit at {self._line.name} is closed")
        try:
            while not self._loop.closing:
                self._loop.turn()
        except DeviceError as error:
            reason = error
        except Exception as error:  # a mistake in the driver must not leave the head turning
            log.debug("the driver of the pan-tilt unit failed", exc_info=True)
            reason = DeviceError(f"the driver of the pan-tilt unit failed: {error!r}")
        self._dead = reason
        self._loop.stop_for_good(reason)
        self._remember(reason)  # after the halt: a disk that hangs must not keep the head from that

    def _remember(self, error: BaseException) -> None:
        """Let no program move the head before it was reset, if its position may be lost."""
        if isinstance(error, PositionLostError):
            self._lost.note(str(error))

    def _angles(self, pan: float, tilt: float) -> tuple[float, float]:
        """The unit's steps as angles [rad]."""
        return self._signs[0] * pan * self.unit.pan.step, self._signs[1] * tilt * self.unit.tilt.step

    def _raise_what_happened(self) -> None:
        if self._closed:
            raise DeviceError(f"the pan-tilt unit at {self._line.name} is closed")
        if self._dead is not None:
            raise DeviceError(str(self._dead)) from self._dead
        with contextlib.suppress(IndexError):
            raise self._loop.errors.popleft()

    def _wait_for(self, move: Move) -> None:
        while not move.done.wait(LOOK_S):
            if not self._thread.is_alive():
                self._raise_what_happened()
        if move.error is not None:
            kind = HaltedError if isinstance(move.error, HaltedError) else DeviceError
            raise kind(str(move.error)) from move.error

    def _wait_until_it_stands(self, clock: Clock) -> None:
        deadline = clock.now() + STANDS_S
        while self._loop.snapshot.moving:
            if clock.now() > deadline:
                raise DeviceError(f"the pan-tilt unit at {self._line.name} goes on turning though it was halted")
            self._loop.turn()


def _limits(unit: Unit, config: HardwareHead) -> PanTiltLimits:
    """What the unit can do, in the sense of rig.toml."""
    (pan, tilt), step = (unit.pan, unit.tilt), unit.pan.step
    return PanTiltLimits(
        pan=_radians(pan.degrees(config.pan_sign)),
        tilt=_radians(tilt.degrees(config.tilt_sign)),
        speed=min(math.radians(config.speed_deg_s), pan.fastest * step, tilt.fastest * step),
        acceleration=min(pan.acceleration, tilt.acceleration) * step,
        step=step,
    )


def _radians(degrees: tuple[float, float]) -> tuple[float, float]:
    return math.radians(degrees[0]), math.radians(degrees[1])


def _steps(speed: float, axis: AxisFacts) -> int:
    """A speed [rad/s] as the unit's own number [steps/s], rounded down, within its bounds."""
    return min(max(math.floor(speed / axis.step * (1 + ROUNDING)), axis.slowest, 1), axis.fastest)


def _refuse_too_slow(key: str, cap_deg_s: float | None, unit: Unit, port: str) -> None:
    """Refuse a cap that the unit cannot keep.

    Raises:
        ConfigError: with what it can.
    """
    slowest = max(max(axis.slowest, 1) * math.degrees(axis.step) for axis in (unit.pan, unit.tilt))
    if cap_deg_s is not None and cap_deg_s * (1 + ROUNDING) < slowest:
        least = math.ceil(100 * slowest) / 100
        raise ConfigError(
            f"{key}: {cap_deg_s:g} degrees/s is slower than the unit at {port} can turn; it takes {least:g} at least"
        )
