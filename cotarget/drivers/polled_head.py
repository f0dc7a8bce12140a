"""A pan-tilt unit that is polled on a thread of its own, behind the Rig's `PanTilt` Protocol.

`PolledHead` is the head that the pipeline sees; a driver gives it a `HeadLink`, which speaks the unit's protocol. A
thread runs `Loop`, the only user of the link: it polls both axes all the time and sends the commands of other threads.
One turn of the loop is one exchange with the unit, or the few exchanges of one move. Other threads only append requests
to queues and read the newest `HeadSnapshot`, without locks, so that a signal handler may halt the head whatever code it
interrupted.
"""

import atexit
import contextlib
import itertools
import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated, NamedTuple, Protocol, TypeVar

from cotarget.config import SafetyConfig
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.drivers.link_errors import CutError, LostError, PositionLostError, RefusedError, SilentError
from cotarget.errors import ConfigError, DeviceError, HaltedError
from cotarget.plugins import place_of
from cotarget.rig import Clock, HeadSpec, PanTiltLimits, PanTiltState, Speed
from cotarget.schema import Limits, Needed, NotNegative, OneOf, Positive, model

log = logging.getLogger(__name__)

# What a driver provides


@dataclass(frozen=True)
class AxisFacts:
    """What a unit reports about one of its axes.

    Attributes:
        step: size of a step [rad].
        lowest: position [steps].
        highest: position [steps].
        slowest: speed [steps/s].
        fastest: speed [steps/s].
        acceleration: [steps/s^2].
        still_s: an axis stands when it has stayed at one step, or within its slack, for this time [s]; longer than the
            slowest speed takes for a step.
        slack: an axis that stands this far from its goal has arrived; 0 for a stepper, the control error of a servo
            [steps].
        loses_steps: whether the unit counts from a wrong position after the axis was blocked, as a stepper without an
            encoder does. An axis that does not is asked where it is, and never has a lost position.
    """

    step: float
    lowest: int
    highest: int
    slowest: int
    fastest: int
    acceleration: int
    still_s: float
    slack: int = 0
    loses_steps: bool = True

    def degrees(self, sign: int) -> tuple[float, float]:
        """Convert the limits to degrees with rig.toml's sign of the axis: lowest, highest."""
        a, b = (sign * end * math.degrees(self.step) for end in (self.lowest, self.highest))
        return min(a, b), max(a, b)


def braking_s(axes: tuple[AxisFacts, AxisFacts]) -> float:
    """Return the longest time to stop an axis from its highest speed [s]."""
    return max(axis.fastest / axis.acceleration for axis in axes)


class Poll(NamedTuple):
    """Position [steps] of an axis, 0 for pan and 1 for tilt, and the time at which the unit read it [s]."""

    axis: int
    position: int
    t: float


class HeadLink(Protocol):
    """The protocol of an opened pan-tilt unit; `PolledHead` makes one call at a time.

    A link is a subclass, and so has the methods with a default. It repeats what may be repeated, and ends each call in
    a bounded time. Besides the errors named below every method but `close` may raise LostError where the port failed,
    SilentError where the unit does not answer any more, PositionLostError where its position may be lost, or another
    DeviceError where it cannot be used; the head is then halted and closed for good.

    Attributes:
        name: of the port, for messages.
        axes: facts of pan and tilt, as the unit reported them when it was opened.
        hurry: set by `PolledHead`; returns whether a halt waits, so that a link that waits for an answer may give up.
    """

    name: str
    axes: tuple[AxisFacts, AxisFacts]
    hurry: Callable[[], bool] = staticmethod(lambda: False)

    def poll(self) -> Sequence[Poll]:
        """Ask for the position of one axis, in turn, or of both.

        Raises:
            CutError: the unit was halted because it was silent.
        """

    def move(self, goals: tuple[int, int], speeds: tuple[int, int], proceed: Callable[[], None]) -> None:
        """Send pan and tilt to positions [steps] at speeds [steps/s]; return when the unit has taken the command.

        Args:
            goals: within the limits of `axes`.
            speeds: within the limits of `axes`.
            proceed: to be called before each message, also a repeated one; raises where a more urgent request waits,
                and the rest must not be sent.

        Raises:
            RefusedError: the unit refused the command.
            CutError: the unit was halted because it was silent.
        """

    def halt(self, patience: float) -> None:
        """Stop both axes; return when the unit has acknowledged it, which takes ``patience`` [s] at most.

        An axis that stands keeps its goal: a servo whose goal becomes its present position would move a little at each
        halt.
        """

    def halt_last(self, patience: float) -> None:
        """Stop both axes in whatever state unit and line are; no other command follows. By default as `halt` does."""
        self.halt(patience)

    def send_halt(self) -> None:
        """Send the halt and wait for no answer; by default as `halt` does."""
        self.halt(0.0)

    def goals(self) -> tuple[int, int] | None:
        """Positions [steps] that the unit was last sent to, also by another program; None if it cannot tell."""
        return None

    def check(self) -> None:
        """Raise PositionLostError if the unit has reported by itself that its position may be lost; by default not."""

    def close(self) -> None:
        """Release the port; never raises."""


StepSize = Positive | Annotated[tuple[Positive, Positive], "[pan, tilt]"]


@model
class PolledHeadSettings:
    """The settings in [hardware.head] that every polled head has.

    Attributes:
        port: serial port such as "/dev/ttyUSB0", or "socket://host:port".
        step_deg: step size that the unit is expected to report, or those of pan and tilt [degrees].
        pan_deg: range of pan that the unit is expected to report, with positive pan to the right [degrees].
        tilt_deg: range of tilt that the unit is expected to report, with positive tilt up [degrees].
        pan_sign: 1 where the unit's positive pan turns right, -1 where it turns left.
        tilt_sign: 1 where the unit's positive tilt goes up, -1 where it goes down.
        speed_deg_s: speed of moves, at most the unit's own [degrees/s].
        command_delay_s: time from a command to the start of motion, as measured [s].
    """

    _: KW_ONLY
    port: Annotated[str, Needed("/dev/ttyUSB0")] = ""
    step_deg: StepSize
    pan_deg: Limits
    tilt_deg: Limits
    pan_sign: Annotated[int, OneOf(-1, 1)] = 1
    tilt_sign: Annotated[int, OneOf(-1, 1)] = 1
    speed_deg_s: Positive
    command_delay_s: NotNegative = 0.04

    @property
    def steps_deg(self) -> tuple[float, float]:
        """Step sizes of pan and tilt [degrees]."""
        return self.step_deg if isinstance(self.step_deg, tuple) else (self.step_deg, self.step_deg)

    @property
    def spec(self) -> HeadSpec:
        """Describe the head by its coarser step; its acceleration is not known before it is opened."""
        speed, step = math.radians(self.speed_deg_s), math.radians(max(self.steps_deg))
        limits = PanTiltLimits(_radians(self.pan_deg), _radians(self.tilt_deg), speed, math.inf, step)
        return HeadSpec(limits, self.command_delay_s)


# Axis positions from polls


@dataclass(frozen=True)
class HeadSnapshot:
    """Positions of both axes at one time, interpolated between polls."""

    pan: float  # [steps]
    tilt: float  # [steps]
    moving: bool  # whether a move is under way or an axis has not stood for long enough
    t: float  # time of the positions [s]


class AxisTrack:
    """Position and rest of one axis, from its polls."""

    def __init__(self, facts: AxisFacts) -> None:
        self.facts = facts
        self.polls: deque[tuple[float, int]] = deque(maxlen=2)
        self._valid = -float("inf")
        self._since: float | None = None
        self._rest = 0  # position at that time [steps]

    @property
    def position(self) -> int:
        """Position of the newest poll [steps]."""
        return self.polls[-1][1]

    def add(self, t: float, position: int) -> None:
        """Add a poll: the position [steps] at ``t`` [s]."""
        if t < self._valid:
            self._since = None
        elif self._since is None or abs(position - self._rest) > self.facts.slack:
            self._since, self._rest = t, position
        self.polls.append((t, position))

    def expect_motion(self, t: float) -> None:
        """Count the axis as moving, until polls after ``t`` [s] show that it stands."""
        self._valid, self._since = t, None

    def stands(self) -> bool:
        """Return whether the axis has stayed in place for as long as its facts ask for."""
        return self._since is not None and self.polls[-1][0] - self._since >= self.facts.still_s

    def at(self, t: float) -> float:
        """Interpolate the position [steps] at a time [s] between the last two polls."""
        (t0, x0), (t1, x1) = self.polls[0], self.polls[-1]
        share = (t - t0) / (t1 - t0) if t1 > t0 else 1.0
        return x0 + (x1 - x0) * min(max(share, 0.0), 1.0)


# Requests of other threads

Request = TypeVar("Request")


class DroppedError(HaltedError):
    """A move ended early because of a halt, a newer move, or the end of the driver."""


@dataclass(eq=False)
class Move:
    """A request to move both axes."""

    number: int  # sequence number of the request; a move numbered before a halt is not sent any more
    goals: tuple[int, int]  # of pan and tilt [steps]
    speeds: tuple[int, int]  # of pan and tilt [steps/s]
    wait: bool = False  # whether the caller waits for the end, and so receives the error
    deadline: float | None = None  # time by which the head should have arrived [s]; None until the move is sent
    cuts: int = 0  # how often the move was sent again after the line was silent
    error: DeviceError | None = None  # why the head did not arrive
    done: threading.Event = field(default_factory=threading.Event)  # set when the head has arrived, or will not

    def finish(self, error: DeviceError | None = None) -> None:
        """End the move and wake the caller that waits."""
        self.error = error
        self.done.set()


@dataclass(eq=False)
class Halt:
    """A request to stop both axes."""

    number: int  # sequence number of the request, shared with moves
    answered: bool = False  # whether the unit acknowledged the halt
    done: threading.Event = field(default_factory=threading.Event)  # set when it has, or will not


def drained(queue: deque[Request]) -> list[Request]:
    """Take all requests out of a queue that other threads go on filling."""
    return [queue.popleft() for _ in range(len(queue))]


# The thread that owns the link

TRIES = 3  # of a move, and of polls in a row, that end because the unit was silent
PATIENCE_S = 2.0  # for a move, beyond its travel and its acceleration [s]
LOOP_HALT_S = 0.3  # for the answer to a halt, beyond the time to brake: a unit may answer only when it stands [s]


def try_last_halt(link: HeadLink, reason: BaseException) -> bool:
    """Halt the unit a last time, unless its port has failed; return whether it acknowledged that."""
    if isinstance(reason, LostError):
        return False
    try:
        link.halt_last(LOOP_HALT_S if isinstance(reason, SilentError) else LOOP_HALT_S + braking_s(link.axes))
    except Exception as error:  # a mistake in a link must not keep a lost position from being remembered
        log.log(
            logging.DEBUG if isinstance(reason, SilentError) else logging.WARNING,
            "%s: the pan-tilt unit did not acknowledge the last halt: %s",
            link.name,
            error,
        )
        return False
    return True


class Loop:
    """Poll the unit and send requests; the only user of the link.

    Args:
        link: to an opened unit.
        clock: the rig's clock.
        delay: time from a command to the start of motion [s].
    """

    def __init__(self, link: HeadLink, clock: Clock, delay: float) -> None:
        self._link, self._clock, self._delay = link, clock, delay
        pan, tilt = (AxisTrack(facts) for facts in link.axes)
        self._tracks = (pan, tilt)
        self._polled = True  # since the last move: moves in quick succession must not displace the polls
        self._cuts = 0  # in a row, without a poll between them
        self._active: Move | None = None
        self.moves: deque[Move] = deque()  # the newest wins
        self.halts: deque[Halt] = deque()  # they come before moves
        self.halted = 0  # number of the newest halt that was taken out of the queue
        self.closing = False  # set when no more requests will come
        self.rests = False  # whether the unit acknowledged the last halt, after which nothing more is sent
        self.errors: deque[DeviceError] = deque(maxlen=1)  # of a move without a waiting caller; the next call raises it
        while not all(track.polls for track in self._tracks):
            self._poll_position()
        self.snapshot = self._make_snapshot()
        link.hurry = lambda: self.closing or bool(self.halts)

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
            self._cuts += 1
            self._expect_motion()
            if self._active is not None:
                self._requeue(self._active, cut)
            elif self._cuts >= TRIES:
                raise
        self._link.check()

    def stop_for_good(self, reason: DeviceError) -> None:
        """Halt the head a last time, and end all requests with an error."""
        self.closing = True
        self.rests = try_last_halt(self._link, reason)
        for move in [*([self._active] if self._active else []), *drained(self.moves)]:
            move.finish(reason)
        for halt in drained(self.halts):
            halt.done.set()

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
        self._link.halt(LOOP_HALT_S + braking_s(self._link.axes))
        self._expect_motion()

    def _move(self) -> None:
        # The snapshot must say moving before the request leaves the queue: PolledHead.state reads both.
        self.snapshot = HeadSnapshot(self.snapshot.pan, self.snapshot.tilt, True, self.snapshot.t)
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
        self._link.move(move.goals, move.speeds, self._proceed)
        self._expect_motion()
        ways = zip(self._tracks, move.goals, move.speeds, strict=True)
        longest = max(
            abs(goal - axis.position) / speed + 2 * speed / axis.facts.acceleration for axis, goal, speed in ways
        )
        move.deadline = self._clock.now() + longest + self._delay + PATIENCE_S

    def _proceed(self) -> None:
        """Raise if the move under way must not be sent any further."""
        self._link.check()
        if self.halts or self.closing:
            raise DroppedError("the move was halted")
        if self.moves:
            raise DroppedError("another move took this one's place")

    def _expect_motion(self) -> None:
        for track in self._tracks:
            track.expect_motion(self._clock.now() + self._delay)

    def _poll(self) -> None:
        self._poll_position()
        self._polled = True
        move = self._active
        if move is not None and move.deadline is not None:
            if self._stand() and not self._off_goal(move):
                self._active = None
                self.snapshot = self._make_snapshot()
                move.finish()
            elif self._late(move, move.deadline):
                self._refuse_stalled(move)
        self.snapshot = self._make_snapshot()

    def _poll_position(self) -> None:
        for axis, position, t in self._link.poll():
            self._tracks[axis].add(t, position)
        self._cuts = 0

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

    def _requeue(self, move: Move, cut: CutError) -> None:
        """Queue a cut move again if its caller waits for it; other callers send a new move or read the state."""
        self._active = None
        if not move.wait or move.cuts == TRIES:
            move.finish(cut)
            return
        move.cuts += 1
        move.deadline = None
        self.moves.appendleft(move)  # a newer move in the queue replaces it, a halt drops it

    def _off_goal(self, move: Move) -> list[AxisTrack]:
        """List the axes whose newest poll is farther off the move's goal than their slack."""
        goals = zip(self._tracks, move.goals, strict=True)
        return [track for track, goal in goals if abs(track.position - goal) > track.facts.slack]

    def _late(self, move: Move, deadline: float) -> bool:
        """Return whether a poll after the deadline shows an axis off its goal; a late thread alone does not count."""
        return min(track.polls[-1][0] for track in self._tracks) > deadline and bool(self._off_goal(move))

    def _refuse_stalled(self, move: Move) -> None:
        """End a move that did not arrive in time; raise where an axis may have lost its position."""
        pan, tilt = (track.position for track in self._tracks)
        wanted = ", ".join(map(str, move.goals))
        what = f"did not arrive in time: pan {pan}, tilt {tilt} steps, where {wanted} were commanded; it was halted"
        if any(track.facts.loses_steps for track in self._off_goal(move)):
            raise PositionLostError(
                self._link.name,
                f"{what}, and its position may be lost by something in its way or a weak motor supply",
            )
        why = "see that nothing is in its way; if it always ends as far off, give its axes more slack in the driver"
        self._give_up(move, DeviceError(f"the pan-tilt unit at {self._link.name} {what}; {why}"))

    def _stand(self) -> bool:
        return all(track.stands() for track in self._tracks)

    def _make_snapshot(self) -> HeadSnapshot:
        """Make a snapshot of both axes at the older one of their newest polls."""
        pan, tilt = self._tracks
        t = min(pan.polls[-1][0], tilt.polls[-1][0])
        return HeadSnapshot(pan.at(t), tilt.at(t), self._active is not None or not self._stand(), t)


# The head

STANDS_S = 5.0  # time limit for a head that turned when it was opened to stand after the halt [s]
HALT_S = 1.0  # time limit for the answer to a halt, beyond braking; synchronising the line may come first [s]
CLOSE_S = 5.0  # time limit for the thread to end [s]
CHECK_S = 0.2  # a caller that waits for a move checks with this period whether the thread still runs [s]
NOTHING_SAID = SafetyConfig()
# Limits differ by a few steps from unit to unit and from reset to reset; a larger difference is another unit's.
LIMITS_DEG = 3.0
STEP_SHARE = 2e-3  # tolerance relative to the step, which the unit and rig.toml round
ROUNDING = 1e-9  # relative; keeps a speed of whole steps/s from being rounded down after its conversion from degrees


class PolledHead:
    """A pan-tilt unit that is open, checked against the configuration, and standing.

    A thread polls the positions and sends commands. The next call of any method raises an error that occurred there. If
    the position may be lost, the error is permanent: a marker file keeps every program from opening the head until
    `cotarget reset-head`. Nothing here resets the unit.

    Args:
        open_link: opens the unit, halts it, and raises CotargetError where it cannot be used.
        config: port, limits, step and signs that the unit must report.
        clock: the rig's clock.
        safety: speed cap, which the unit must be able to keep, and stop file, beside which the marker file lies.

    Raises:
        ConfigError: the unit differs from the configuration.
        DeviceError: there is no unit, or it cannot be used in its state.
    """

    def __init__(
        self,
        open_link: Callable[[], HeadLink],
        config: PolledHeadSettings,
        clock: Clock,
        safety: SafetyConfig = NOTHING_SAID,
    ) -> None:
        self._lost = PositionLostMarker(config.port, safety.stop_file)
        self._lost.refuse()
        self._signs = (config.pan_sign, config.tilt_sign)
        self._numbers = itertools.count(1)
        self._dead: DeviceError | None = None
        self._closed = False
        try:
            self._link = _checked(open_link())
        except BaseException as error:
            self._remember(error)
            raise
        try:
            self.axes = self._link.axes
            compare(config, self.axes)
            _refuse_too_slow("hardware.head.speed_deg_s", config.speed_deg_s, self.axes, config.port)
            _refuse_too_slow("safety.speed_deg_s", safety.speed_deg_s, self.axes, config.port)
            self._limits = _limits(self.axes, config)
            self._goals = self._link.goals()
            self._loop = Loop(self._link, clock, config.command_delay_s)
            self._wait_until_it_stands(clock)
        except BaseException as error:
            try_last_halt(self._link, error)
            self._remember(error)
            self._link.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"head at {config.port}", daemon=True)
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
        self._raise_pending()
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
        self._raise_pending()
        if not (math.isfinite(pan) and math.isfinite(tilt)):
            raise DeviceError(f"the head cannot go to pan {pan}, tilt {tilt}")
        fastest = self._limits.capped(speed)
        axes = self.axes
        a, b = self._goals = self._kept(
            [
                min(max(round(sign * angle / axis.step), axis.lowest), axis.highest)
                for sign, angle, axis in zip(self._signs, (pan, tilt), axes, strict=True)
            ]
        )
        move = Move(number, (a, b), (_steps(fastest[0], axes[0]), _steps(fastest[1], axes[1])), wait)
        self._loop.moves.append(move)
        if wait:
            self._wait_for(move)
        return self._angles(a, b)

    def _kept(self, goals: Sequence[int]) -> tuple[int, int]:
        """Keep the last goal of an axis that is sent to where it stands, off that goal by its slack at most.

        A servo rests a little off each goal; sent to where it rests, it would move on by as much.
        """
        seen, kept = self._loop.snapshot, list(goals)
        for i, (goal, axis) in enumerate(zip(goals, self.axes, strict=True)):
            stands_there = not seen.moving and goal == round((seen.pan, seen.tilt)[i])
            if stands_there and self._goals is not None and abs(self._goals[i] - goal) <= axis.slack:
                kept[i] = self._goals[i]
        return kept[0], kept[1]

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
        request.done.wait(HALT_S + braking_s(self.axes) if self._thread.is_alive() else 0.0)
        if request.answered or self._loop.rests:
            return
        if not self._thread.is_alive() and not isinstance(self._dead, LostError):
            with contextlib.suppress(DeviceError):
                self._link.send_halt()
        if self._dead is not None:
            raise DeviceError(str(self._dead)) from self._dead
        raise DeviceError(f"the pan-tilt unit at {self._link.name} did not acknowledge a halt: it does not answer")

    def close(self) -> None:
        """Halt, end the thread and release the port; never raises, and may be called again."""
        if self._closed:
            return
        self._closed = self._loop.closing = True
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.warning("%s: the thread of the pan-tilt unit does not end", self._link.name)
        self._link.close()
        atexit.unregister(self.close)

    def _run(self) -> None:
        reason: DeviceError = DroppedError(f"the pan-tilt unit at {self._link.name} is closed")
        try:
            while not self._loop.closing:
                self._loop.turn()
        except DeviceError as error:
            reason = error
        except Exception as error:  # a bug in the driver must not leave the head turning
            log.debug("the driver of the pan-tilt unit failed", exc_info=True)
            reason = DeviceError(f"the driver of the pan-tilt unit failed: {error!r} ({place_of(error)})")
        self._dead = reason
        self._loop.stop_for_good(reason)
        self._remember(reason)  # after the halt: a hanging disk must not delay it

    def _remember(self, error: BaseException) -> None:
        """Write the marker file if the position may be lost; then no program opens the head before its reset."""
        if isinstance(error, PositionLostError):
            self._lost.note(str(error))

    def _angles(self, pan: float, tilt: float) -> tuple[float, float]:
        """Convert steps of the unit to angles [rad]."""
        return self._signs[0] * pan * self.axes[0].step, self._signs[1] * tilt * self.axes[1].step

    def _raise_pending(self) -> None:
        if self._closed:
            raise DeviceError(f"the pan-tilt unit at {self._link.name} is closed")
        if self._dead is not None:
            raise DeviceError(str(self._dead)) from self._dead
        with contextlib.suppress(IndexError):
            raise self._loop.errors.popleft()

    def _wait_for(self, move: Move) -> None:
        while not move.done.wait(CHECK_S):
            if not self._thread.is_alive():
                self._raise_pending()
        if move.error is not None:
            kind = HaltedError if isinstance(move.error, HaltedError) else DeviceError
            raise kind(str(move.error)) from move.error

    def _wait_until_it_stands(self, clock: Clock) -> None:
        deadline = clock.now() + STANDS_S
        while self._loop.snapshot.moving:
            if clock.now() > deadline:
                raise DeviceError(
                    f"the pan-tilt unit at {self._link.name} goes on turning though it was halted; one that trembles "
                    "there needs slack in its driver's AxisFacts"
                )
            self._loop.turn()


def _checked(link: HeadLink) -> HeadLink:
    """Refuse a link that lacks a part of `HeadLink`, and name the part."""
    needed = ("name", "axes", *(name for name in vars(HeadLink) if not name.startswith("_")))
    if lacks := [name for name in needed if not hasattr(link, name)]:
        if "close" not in lacks:
            link.close()
        raise ConfigError(f"hardware.head.driver: {type(link).__name__} has no {lacks[0]}; HeadLink says what it needs")
    return link


def compare(config: PolledHeadSettings, axes: tuple[AxisFacts, AxisFacts]) -> None:
    """Refuse a unit whose steps or limits differ from rig.toml; the message has both, and what to write."""
    steps = [math.degrees(axis.step) for axis in axes]
    if any(abs(step - said) > STEP_SHARE * said for step, said in zip(steps, config.steps_deg, strict=True)):
        own, said = (tuple(float(f"{step:.6g}") for step in each) for each in (steps, config.steps_deg))
        raise ConfigError(
            f"hardware.head.step_deg: pan and tilt of the unit at {config.port} have steps of {own[0]:.6g} and "
            f"{own[1]:.6g} degrees, not {said[0]:.6g} and {said[1]:.6g}; write step_deg = "
            f"{own[0] if own[0] == own[1] else list(own)}, or change the unit's step mode"
        )
    for word, axis, expected, sign in (
        ("pan", axes[0], config.pan_deg, config.pan_sign),
        ("tilt", axes[1], config.tilt_deg, config.tilt_sign),
    ):
        found = axis.degrees(sign)
        if not _agree(found, expected):
            turned = f", or {word}_sign = {-sign}" if _agree(axis.degrees(-sign), expected) else ""
            raise ConfigError(
                f"hardware.head.{word}_deg: the unit at {config.port} goes from {found[0]:.1f} to {found[1]:.1f} "
                f"degrees, not from {expected[0]:g} to {expected[1]:g}; write {word}_deg = "
                f"[{found[0]:.1f}, {found[1]:.1f}]{turned}"
            )


def _agree(found: tuple[float, float], expected: tuple[float, float]) -> bool:
    return max(abs(a - b) for a, b in zip(found, expected, strict=True)) <= LIMITS_DEG


def _limits(axes: tuple[AxisFacts, AxisFacts], config: PolledHeadSettings) -> PanTiltLimits:
    """Convert the unit's limits to radians with the signs of rig.toml; the step is the coarser one."""
    pan, tilt = axes
    return PanTiltLimits(
        pan=_radians(pan.degrees(config.pan_sign)),
        tilt=_radians(tilt.degrees(config.tilt_sign)),
        speed=min(math.radians(config.speed_deg_s), *(axis.fastest * axis.step for axis in axes)),
        acceleration=min(axis.acceleration * axis.step for axis in axes),
        step=max(axis.step for axis in axes),
        slack=max(axis.slack * axis.step for axis in axes),
    )


def _radians(degrees: tuple[float, float]) -> tuple[float, float]:
    return math.radians(degrees[0]), math.radians(degrees[1])


def _steps(speed: float, axis: AxisFacts) -> int:
    """Convert a speed [rad/s] to steps/s, rounded down, within the axis' bounds."""
    return min(max(math.floor(speed / axis.step * (1 + ROUNDING)), axis.slowest, 1), axis.fastest)


def _refuse_too_slow(key: str, cap_deg_s: float | None, axes: tuple[AxisFacts, AxisFacts], port: str) -> None:
    """Refuse a speed cap below the unit's lowest speed, and name that speed."""
    slowest = max(max(axis.slowest, 1) * math.degrees(axis.step) for axis in axes)
    if cap_deg_s is not None and cap_deg_s * (1 + ROUNDING) < slowest:
        least = math.ceil(100 * slowest) / 100
        raise ConfigError(
            f"{key}: {cap_deg_s:g} degrees/s is slower than the unit at {port} can turn; it takes {least:g} at least"
        )
