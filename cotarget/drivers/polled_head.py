"""The pan-tilt unit PTU-D46 behind the Rig's `PanTilt` Protocol.

`D46Head` is the head that the pipeline sees. A thread of its own runs `Loop`, the only user of the serial line: it
polls both axes all the time and sends the commands of other threads. One turn of the loop is one exchange with the
unit, or the few exchanges of one move. Other threads only append requests to queues and read the newest `Snapshot`,
without locks, so that a signal handler may halt the head whatever code it interrupted.
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

log = logging.getLogger(__name__)

# Axis positions from polls

# An axis stands when it has stayed at one step for longer than the slowest speed, 31 steps/s, takes for a step [s].
STILL_S = 0.035


@dataclass(frozen=True)
class Snapshot:
    """Positions of both axes at one time, interpolated between polls.

    Attributes:
        pan: position [steps].
        tilt: position [steps].
        moving: whether a move is under way or an axis has not stood for long enough.
        t: time of the positions [s].
    """

    pan: float
    tilt: float
    moving: bool
    t: float


class AxisTrack:
    """Position, goal and rest of one axis, from its polls and commands."""

    def __init__(self, name: AxisName, facts: AxisFacts) -> None:
        self.name, self.facts = name, facts
        self.polls: deque[tuple[float, int]] = deque(maxlen=2)
        self.goal: int | None = None  # of the last command [steps]; None after a halt
        self.speed: int | None = None  # of the last command [steps/s]
        self._valid = -float("inf")
        self._since: float | None = None

    @property
    def position(self) -> int:
        """Position of the newest poll [steps]."""
        return self.polls[-1][1]

    def add(self, t: float, position: int) -> None:
        """Add a poll: the position [steps] at ``t`` [s]."""
        if t < self._valid:
            self._since = None
        elif self._since is None or position != self.position:
            self._since = t
        self.polls.append((t, position))

    def expect_motion(self, t: float) -> None:
        """Count the axis as moving, until polls after ``t`` [s] show that it stands."""
        self._valid, self._since = t, None

    def stands(self) -> bool:
        """Return whether the axis has stayed at one step for `STILL_S`."""
        return self._since is not None and self.polls[-1][0] - self._since >= STILL_S

    def at(self, t: float) -> float:
        """Interpolate the position [steps] at a time [s] between the last two polls."""
        (t0, x0), (t1, x1) = self.polls[0], self.polls[-1]
        share = (t - t0) / (t1 - t0) if t1 > t0 else 1.0
        return x0 + (x1 - x0) * min(max(share, 0.0), 1.0)


# Requests of other threads

Request = TypeVar("Request")


class DroppedError(HaltedError):
    """A move ended early because of a halt, a newer move, or the end of the driver."""


class CutError(DeviceError):
    """A move ended early because the line was silent and the head was halted."""


@dataclass(eq=False)
class Move:
    """A request to move both axes.

    Attributes:
        number: sequence number of the request; a move numbered before a halt is not sent any more.
        goals: of pan and tilt [steps].
        speeds: of pan and tilt [steps/s].
        wait: whether the caller waits for the end, and so receives the error.
        deadline: time by which the head should have arrived [s]; None until the move is sent.
        cuts: how often the move was sent again after the line was silent.
        error: why the head did not arrive.
        done: set when the head has arrived, or will not.
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
        """End the move and wake the caller that waits."""
        self.error = error
        self.done.set()


@dataclass(eq=False)
class Halt:
    """A request to stop both axes.

    Attributes:
        number: sequence number of the request, shared with moves.
        answered: whether the unit acknowledged the halt.
        done: set when it has, or will not.
    """

    number: int
    answered: bool = False
    done: threading.Event = field(default_factory=threading.Event)


def drained(queue: deque[Request]) -> list[Request]:
    """Take all requests out of a queue that other threads go on filling."""
    return [queue.popleft() for _ in range(len(queue))]


# The thread that owns the line

Meaning = TypeVar("Meaning")
TRIES = 3  # of one exchange; the line is synchronised again before each but the first
PATIENCE_S = 2.0  # for a move, beyond its travel and its acceleration [s]
LOOP_HALT_S = 0.3  # for the answer to a halt, beyond the time to brake: a unit may answer only when it stands [s]


class Loop:
    """Poll the unit and send requests; the only user of the serial line.

    Args:
        line: to a unit that `connect` has made ready.
        unit: what the unit reported about itself.
        clock: the rig's clock.
        delay: time from a command to the start of motion [s].

    Attributes:
        moves: requests to move; the newest wins.
        halts: requests to stop; they come before moves.
        halted: number of the newest halt that was taken out of the queue.
        closing: set when no more requests will come.
        braking_s: longest time to stop the axes [s].
        rests: whether the unit acknowledged the last halt, after which nothing more is sent.
        errors: failure of a move without a waiting caller; the next call raises it.
        snapshot: the newest positions.
    """

    def __init__(self, line: Line, unit: UnitInfo, clock: Clock, delay: float) -> None:
        self._line, self._clock, self._delay = line, clock, delay
        self._tracks = (AxisTrack("P", unit.pan), AxisTrack("T", unit.tilt))
        self._next = 0  # the axis to poll
        self._polled = True  # since the last move: moves in quick succession must not displace the polls
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
        """Do the most urgent exchange: a halt, then a move, then a poll.

        Raises:
            PositionLostError: the head's position may be lost.
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
        """Halt the head a last time, and end all requests with an error."""
        self.closing = True
        if not isinstance(reason, LostError):
            self._halt_at_last(LOOP_HALT_S if isinstance(reason, SilentError) else LOOP_HALT_S + self.braking_s)
        for move in [*([self._active] if self._active else []), *drained(self.moves)]:
            move.finish(reason)
        for halt in drained(self.halts):
            halt.done.set()

    def _halt_at_last(self, patience: float) -> None:
        # A unit that was switched off and on echoes commands again, and late answers may come first.
        try:
            halt_outright(self._line, patience)
            self.rests = True
        except DeviceError as error:
            log.warning("%s: the pan-tilt unit did not acknowledge the last halt: %s", self._line.name, error)

    def _halt(self) -> None:
        requests = drained(self.halts)
        # Threads that halt at the same time may queue their requests out of order.
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
        """Send the halt and wait for its answer."""
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
        # The snapshot must say moving before the request leaves the queue: D46Head.state reads both.
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
        """Return why the move under way must not be sent any further; empty if it may."""
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
            except RefusedError:  # the query itself may have been garbled on its way
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
        """Send one command and read its answer; repeat after an error.

        Each repetition comes after the line is synchronised, unless ``unless`` returns a reason to stop.

        Returns:
            The answer's meaning, and its time [s].
        """
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
        """Halt a move that failed; its waiting caller, or the next call of the head, gets the error."""
        self._active = None
        self._stop()
        if not move.wait:
            self.errors.append(error)
        move.finish(error)

    def _abandon(self, reason: DroppedError) -> None:
        """End the move under way because of another request; only a waiting caller gets the error."""
        if self._active is not None:
            self._active.finish(reason)
            self._active = None

    def _take_up_again(self, cut: CutError) -> None:
        """Queue a cut move again if its caller waits for it; other callers send a new move or read the state."""
        move, self._active = self._active, None
        assert move is not None
        if not move.wait or move.cuts == TRIES:
            move.finish(cut)
            return
        move.cuts += 1
        move.deadline = None
        self.moves.appendleft(move)  # a newer move in the queue replaces it, a halt drops it

    def _late(self, move: Move, deadline: float) -> bool:
        """Return whether a poll after the deadline shows an axis off its goal; a late thread alone does not count."""
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
        """Make a snapshot of both axes at the older one of their newest polls."""
        pan, tilt = self._tracks
        t = min(pan.polls[-1][0], tilt.polls[-1][0])
        return Snapshot(pan.at(t), tilt.at(t), self._active is not None or not self._stand(), t)


# The head

STANDS_S = 5.0  # time limit for a head that turned when it was opened to stand after the halt [s]
HALT_S = 1.0  # time limit for the answer to a halt, beyond braking; synchronising the line may come first [s]
CLOSE_S = 5.0  # time limit for the thread to end [s]
LOOK_S = 0.2  # a caller that waits for a move checks with this period whether the thread still runs [s]
NOTHING_SAID = SafetyConfig()
ROUNDING = 1e-9  # relative; keeps a speed of whole steps/s from being rounded down after its conversion from degrees


class D46Head:
    """A PTU-D46 that is open, checked against the configuration, and standing.

    A thread polls the positions and sends commands. The next call of any method raises an error that occurred there. If
    the position may be lost, the error is permanent: a marker file keeps every program from opening the head until
    `cotarget reset-head`. Nothing here resets the unit.

    Args:
        config: port, baud rate, limits, step and signs that the unit must report.
        clock: the rig's clock.
        safety: speed cap, which the unit must be able to keep, and stop file, beside which the marker file lies.

    Raises:
        ConfigError: the unit differs from the configuration.
        DeviceError: there is no unit, or it cannot be used in its state.
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
        atexit.register(self.close)  # a program that ends without closing the head must not leave it turning

    @property
    def limits(self) -> PanTiltLimits:
        """Limits that the unit reports; the speed is at most the configured one."""
        return self._limits

    def state(self) -> PanTiltState:
        """Return the positions of the last poll, at once.

        Raises:
            DeviceError: an error occurred since the last call, or the line is dead.
        """
        self._raise_what_happened()
        # In this order: the loop sets the snapshot to moving before it takes a request out of the queue.
        waiting = bool(self._loop.moves)
        seen = self._loop.snapshot
        pan, tilt = self._angles(seen.pan, seen.tilt)
        return PanTiltState(pan, tilt, seen.moving or waiting, seen.t)

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes; the newest command wins.

        Args:
            pan: angle [rad].
            tilt: angle [rad].
            speed: of both axes or of each [rad/s]; by default, and at most, the configured one. The unit takes whole
                steps/s, rounded down, and has a lowest speed.
            wait: return only when the head stands at the goal.

        Returns:
            The commanded angles after clipping to the limits and rounding to steps [rad].

        Raises:
            DeviceError: an angle is not finite, the head did not arrive, or an error occurred since the last call.
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
        """Stop both axes before anything else is sent; return when the unit has acknowledged it.

        May be called from any thread and from a signal handler, any number of times. A move that another thread
        commands at the same moment is not sent any more.

        Raises:
            DeviceError: the unit did not acknowledge the halt.
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
        """Halt, end the thread and release the port; never raises, and may be called again."""
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
        except Exception as error:  # a bug in the driver must not leave the head turning
            log.debug("the driver of the pan-tilt unit failed", exc_info=True)
            reason = DeviceError(f"the driver of the pan-tilt unit failed: {error!r}")
        self._dead = reason
        self._loop.stop_for_good(reason)
        self._remember(reason)  # after the halt: a hanging disk must not delay it

    def _remember(self, error: BaseException) -> None:
        """Write the marker file if the position may be lost; then no program opens the head before its reset."""
        if isinstance(error, PositionLostError):
            self._lost.note(str(error))

    def _angles(self, pan: float, tilt: float) -> tuple[float, float]:
        """Convert steps of the unit to angles [rad]."""
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
    """Convert the unit's limits to radians with the signs of rig.toml."""
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
    """Convert a speed [rad/s] to steps/s, rounded down, within the axis' bounds."""
    return min(max(math.floor(speed / axis.step * (1 + ROUNDING)), axis.slowest, 1), axis.fastest)


def _refuse_too_slow(key: str, cap_deg_s: float | None, unit: UnitInfo, port: str) -> None:
    """Refuse a speed cap below the unit's lowest speed.

    Raises:
        ConfigError: the cap is too low; the message names the lowest speed.
    """
    slowest = max(max(axis.slowest, 1) * math.degrees(axis.step) for axis in (unit.pan, unit.tilt))
    if cap_deg_s is not None and cap_deg_s * (1 + ROUNDING) < slowest:
        least = math.ceil(100 * slowest) / 100
        raise ConfigError(
            f"{key}: {cap_deg_s:g} degrees/s is slower than the unit at {port} can turn; it takes {least:g} at least"
        )
