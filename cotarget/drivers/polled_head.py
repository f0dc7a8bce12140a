"""The pan-tilt unit PTU-D46 behind the Rig's `PanTilt` Protocol.

What the thread that owns the line to a PTU-D46 does: it polls positions all the time, and sends what is wished.

One turn is one exchange, or the few of one move. Other threads only append wishes to queues and read the newest
snapshot: no locks, so that a signal handler may halt the head whatever it interrupted.

Where the axes of a PTU-D46 are, from polls one after the other, and whether they turn.

What other threads wish of the one that owns the line to a PTU-D46, and what became of it.
"""

import atexit
import contextlib
import itertools
import logging
import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from cotarget.config import HardwareHead, SafetyConfig
from cotarget.drivers import ptu_protocol
from cotarget.drivers.interlock import PositionLostError, PositionLostMarker
from cotarget.drivers.ptu_d46 import (
    HALT_NOW,
    HALT_TRIES,
    AxisFacts,
    UnitInfo,
    connect,
    halt_outright,
    refuse_events,
    restarted,
)
from cotarget.drivers.ptu_protocol import (
    QUICK_S,
    AxisName,
    Line,
    LostError,
    RefusedError,
    ReplyError,
    RestartedError,
    SilentError,
    command,
    open_line,
)
from cotarget.errors import ConfigError, DeviceError, HaltedError
from cotarget.rig import Clock, PanTiltLimits, PanTiltState, Speed

# An axis stands when it has stayed at one step for longer than the slowest speed, 31 steps/s, takes for a step [s].
STILL_S = 0.035


@dataclass(frozen=True)
class Snapshot:
    """Where the axes were at one time [steps, s]; between two polls of an axis it is taken to turn evenly."""

    pan: float
    tilt: float
    moving: bool
    t: float


class AxisTrack:
    """What is known of one axis from polls and orders."""

    def __init__(self, name: AxisName, facts: AxisFacts) -> None:
        self.name, self.facts = name, facts
        self.polls: deque[tuple[float, int]] = deque(maxlen=2)
        self.goal: int | None = None  # as last ordered, None after a halt
        self.speed: int | None = None  # the same
        self._valid = -float("inf")
        self._since: float | None = None

    @property
    def position(self) -> int:
        """The newest [steps]."""
        return self.polls[-1][1]

    def add(self, t: float, position: int) -> None:
        """Take a poll into account."""
        if t < self._valid:
            self._since = None
        elif self._since is None or position != self.position:
            self._since = t
        self.polls.append((t, position))

    def expect_motion(self, t: float) -> None:
        """Count it as turning, until polls after ``t`` [s] show that it stands."""
        self._valid, self._since = t, None

    def stands(self) -> bool:
        """Whether it has stayed at one step for long enough."""
        return self._since is not None and self.polls[-1][0] - self._since >= STILL_S

    def at(self, t: float) -> float:
        """Position at a time between the last two polls [steps]."""
        (t0, x0), (t1, x1) = self.polls[0], self.polls[-1]
        share = (t - t0) / (t1 - t0) if t1 > t0 else 1.0
        return x0 + (x1 - x0) * min(max(share, 0.0), 1.0)


# --- d46wishes ---

Request = TypeVar("Request")


class DroppedError(HaltedError):
    """A move did not come to its end because of another wish."""


class CutError(DeviceError):
    """A move did not come to its end because the line was silent, so that the head was halted."""


@dataclass(eq=False)
class Move:
    """A wish to go somewhere.

    Attributes:
        number: counts wishes; a move older than a halt is not sent any more.
        goals: of pan and tilt [steps].
        speeds: of pan and tilt [steps/s].
        wait: whether somebody waits for its end, and is told the error.
        deadline: when it should have arrived [s], once it is sent.
        cuts: how often it was set out on anew after the line was silent.
        error: why it did not arrive.
        done: set when the head has arrived, or never will.
    """

    number: int
    goals: tuple[int, int]
    speeds: tuple[int, int]
    wait: bool = False
    deadline: float | None = None
    cuts: int = 0
    error: DeviceError | None = None
    done: threading.Event = field(default_factory=threading.Event)

    def finish(self, error: DeviceError | None = None) -> None:
        """Tell whoever waits."""
        self.error = error
        self.done.set()


@dataclass(eq=False)
class Halt:
    """A wish to stop.

    Attributes:
        number: counts wishes, as a move's does.
        answered: whether the unit has said that it stops.
        done: set when it has, or will not.
    """

    number: int
    answered: bool = False
    done: threading.Event = field(default_factory=threading.Event)


def drained(queue: deque[Request]) -> list[Request]:
    """Take all wishes out of a queue that others go on filling."""
    return [queue.popleft() for _ in range(len(queue))]


# --- d46loop ---

log = logging.getLogger(__name__)
Meaning = TypeVar("Meaning")
TRIES = 3  # of one exchange, each but the first after getting back in step
PATIENCE_S = 2.0  # for a move, beyond its way and its run-up [s]
LOOP_HALT_S = 0.3  # for the answer to a halt, beyond the time to brake: some units may answer when they stand


class Loop:
    """The owner of the line.

    Args:
        line: to a unit that was made ready.
        unit: what it said about itself.
        clock: the rig's.
        delay: from an order to the start of motion [s].

    Attributes:
        moves: wishes to go somewhere; the newest wins.
        halts: wishes to stop; they come first.
        halted: the number of the newest wish to stop that was taken out of the queue.
        closing: set when no more wishes will come.
        braking_s: the time that a halt can take [s].
        rests: whether the unit has acknowledged the last halt, after which nothing is sent any more.
        errors: what nobody was told yet.
        snapshot: the newest.
    """

    def __init__(self, line: Line, unit: UnitInfo, clock: Clock, delay: float) -> None:
        self._line, self._clock, self._delay = line, clock, delay
        self._tracks = (AxisTrack("P", unit.pan), AxisTrack("T", unit.tilt))
        self._next = 0  # the axis to poll
        self._polled = True  # since the last move, so that moves in quick succession leave the line to polls too
        self._active: Move | None = None
        self.moves: deque[Move] = deque()
        self.halts: deque[Halt] = deque()
        self.halted = 0
        self.closing = False
        self.braking_s = unit.braking_s
        self.rests = False
        self.errors: deque[DeviceError] = deque(maxlen=1)
        for _ in self._tracks:
            self._poll_position()
        self.snapshot = self._look()
        line.hurry = lambda: self.closing or bool(self.halts)

    def turn(self) -> None:
        """Do the next thing.

        Raises:
            PositionLostError: nobody knows where the head is.
            DeviceError: the head cannot be used any more.
        """
        try:
            if self.halts:
                self._halt()
            elif self.moves and self._polled:
                self._move()
            else:
                self._poll()
        except DroppedError as dropped:
            self._abandon(dropped)
        except CutError as cut:
            self._take_up_again(cut)
        except RestartedError as error:
            raise restarted(self._line) from error
        refuse_events(self._line)

    def stop_for_good(self, reason: DeviceError) -> None:
        """Halt a last time, as well as can be, and tell everybody who waits."""
        self.closing = True
        if not isinstance(reason, LostError):
            self._halt_at_last(LOOP_HALT_S if isinstance(reason, SilentError) else LOOP_HALT_S + self.braking_s)
        for move in [*([self._active] if self._active else []), *drained(self.moves)]:
            move.finish(reason)
        for halt in drained(self.halts):
            halt.done.set()

    def _halt_at_last(self, patience: float) -> None:
        # A unit that was switched off and on echoes again, and stale answers may come first.
        try:
            halt_outright(self._line, patience)
            self.rests = True
        except DeviceError as error:
            log.warning("%s: the pan-tilt unit did not acknowledge the last halt: %s", self._line.name, error)

    def _halt(self) -> None:
        requests = drained(self.halts)
        # Threads that halt at once may get here in another order than they were numbered in.
        self.halted = max([self.halted, *(request.number for request in requests)])
        try:
            self._abandon(DroppedError("the move was halted"))
            self._stop()
            for request in requests:
                request.answered = True
        finally:
            for request in requests:
                request.done.set()

    def _stop(self) -> None:
        """Order the halt and wait for the answer."""
        for track in self._tracks:
            track.goal = None
        for left in reversed(range(HALT_TRIES)):
            try:
                self._exchange(HALT_NOW, ptu_protocol.done, patience=LOOP_HALT_S + self.braking_s)
                break
            except RefusedError:
                if not left:
                    raise
        self._expect_motion()

    def _move(self) -> None:
        # A snapshot that says moving must be there before the wish leaves the queue: see D46Head.state.
        self.snapshot = Snapshot(self.snapshot.pan, self.snapshot.tilt, True, self.snapshot.t)
        requests = drained(self.moves)
        fresh = [request for request in requests if request.number > self.halted]
        for request in requests:
            if request not in fresh:
                request.finish(DroppedError("the move was halted"))
        if not fresh:
            return
        *older, move = fresh
        for other in [*older, *([self._active] if self._active else [])]:
            other.finish(DroppedError("another move took this one's place"))
        self._active, self._polled = move, False
        try:
            self._send(move)
        except RefusedError as error:
            self._give_up(move, error)

    def _send(self, move: Move) -> None:
        for track, speed in zip(self._tracks, move.speeds, strict=True):
            if speed != track.speed:
                self._order(track.name + "S", speed)
                track.speed = speed
        for track, goal in zip(self._tracks, move.goals, strict=True):
            if goal != track.goal:
                track.goal = None
                self._order(track.name + "P", goal)
                track.goal = goal
        self._expect_motion()
        ways = zip(self._tracks, move.goals, move.speeds, strict=True)
        longest = max(
            abs(goal - axis.position) / speed + 2 * speed / axis.facts.acceleration for axis, goal, speed in ways
        )
        move.deadline = self._clock.now() + longest + self._delay + PATIENCE_S

    def _order(self, name: str, value: int) -> None:
        if reason := self._other_request():
            raise DroppedError(reason)
        self._exchange(command(name, value), ptu_protocol.done, self._other_request)

    def _other_request(self) -> str:
        """Why the move under way is not to be sent any further; empty if there is no reason."""
        if self.halts or self.closing or self._line.events:
            return "the move was halted"
        return "another move took this one's place" if self.moves else ""

    def _expect_motion(self) -> None:
        for track in self._tracks:
            track.expect_motion(self._clock.now() + self._delay)

    def _poll(self) -> None:
        self._poll_position()
        self._polled = True
        move = self._active
        if move is not None and move.deadline is not None:
            if self._stand() and all(track.position == track.goal for track in self._tracks):
                self._active = None
                self.snapshot = self._look()
                move.finish()
            elif self._late(move, move.deadline):
                raise self._stalled(move)
        self.snapshot = self._look()

    def _poll_position(self) -> None:
        track = self._tracks[self._next]
        for attempt in range(TRIES):
            try:
                position, t = self._exchange(command(track.name + "P"), ptu_protocol.bare_integer)
                break
            except RefusedError:  # the question itself may have been garbled on its way
                if attempt == TRIES - 1:
                    raise
        track.add(t, position)
        self._next = 1 - self._next

    def _exchange(
        self,
        order: bytes,
        understand: Callable[[str], Meaning],
        unless: Callable[[], str] = lambda: "",
        patience: float = QUICK_S,
    ) -> tuple[Meaning, float]:
        """Ask or order, and once more after getting back in step, unless there is a reason not to."""
        for attempt in range(TRIES):
            try:
                answer = self._line.ask(order, patience)
                return understand(answer.text), answer.t
            except (SilentError, ReplyError) as error:
                if self._line.resync(error):
                    for track in self._tracks:
                        track.goal = None
                    self._expect_motion()
                    if self._active is not None:
                        raise CutError(f"{error}, and the head was halted") from error
                if reason := unless():
                    raise DroppedError(reason) from error
                if attempt == TRIES - 1:
                    raise self._line.nonsense(error) from error
        raise AssertionError("unreachable")

    def _give_up(self, move: Move, error: DeviceError) -> None:
        """Halt a move that failed, and tell whoever waits for it or asks next."""
        self._active = None
        self._stop()
        if not move.wait:
            self.errors.append(error)
        move.finish(error)

    def _abandon(self, reason: DroppedError) -> None:
        """Forget the move under way because of another wish; only who waits for it is told."""
        if self._active is not None:
            self._active.finish(reason)
            self._active = None

    def _take_up_again(self, cut: CutError) -> None:
        """Set out anew on a move that somebody waits for; who does not wait sends another, or looks at the state."""
        move, self._active = self._active, None
        assert move is not None
        if not move.wait or move.cuts == TRIES:
            move.finish(cut)
            return
        move.cuts += 1
        move.deadline = None
        self.moves.appendleft(move)  # behind it may be a newer one, which takes its place, or a halt before it

    def _late(self, move: Move, deadline: float) -> bool:
        """Whether an axis was seen elsewhere than at its goal after the deadline; this thread may be late itself."""
        tracks = zip(self._tracks, move.goals, strict=True)
        seen = min(track.polls[-1][0] for track in self._tracks)
        return seen > deadline and any(track.position != goal for track, goal in tracks)

    def _stalled(self, move: Move) -> PositionLostError:
        stands = ", ".join(f"{ptu_protocol.AXIS_WORDS[axis.name]} {axis.position}" for axis in self._tracks)
        wanted = ", ".join(map(str, move.goals))
        return PositionLostError(
            self._line.name,
            f"did not arrive in time: {stands} steps, where {wanted} were commanded; it was halted, and its position "
            "may be lost by something in its way or a weak motor supply",
        )

    def _stand(self) -> bool:
        return all(track.stands() for track in self._tracks)

    def _look(self) -> Snapshot:
        """Both axes at the time of the older one's newest poll."""
        pan, tilt = self._tracks
        t = min(pan.polls[-1][0], tilt.polls[-1][0])
        return Snapshot(pan.at(t), tilt.at(t), self._active is not None or not self._stand(), t)


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
        self._lost = PositionLostMarker(config.port, safety.stop_file)
        self._lost.refuse()
        self._line = open_line(config.port, config.baud, clock)
        self._signs = (config.pan_sign, config.tilt_sign)
        self._numbers = itertools.count(1)
        self._dead: DeviceError | None = None
        self._closed = False
        try:
            self.unit: UnitInfo = connect(self._line, config)
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
        request = Halt(next(self._numbers))
        self._loop.halts.append(request)
        request.done.wait(HALT_S + self._loop.braking_s if self._thread.is_alive() else 0.0)
        if request.answered or self._loop.rests:
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


def _limits(unit: UnitInfo, config: HardwareHead) -> PanTiltLimits:
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


def _refuse_too_slow(key: str, cap_deg_s: float | None, unit: UnitInfo, port: str) -> None:
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
