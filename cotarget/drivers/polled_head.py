"""A pan-tilt unit that is polled on a thread of its own, behind the Rig's `PanTilt` Protocol.

`PolledHead` is the head that the pipeline sees; a driver gives it a `HeadLink`, which speaks the unit's protocol. The
zoom lens may be a third axis of the unit, `PolledLens`. A thread runs `Loop`, the only user of the link: it polls the
axes all the time and sends the commands of other threads. One turn of the loop is one exchange with the unit, or the
few exchanges of one move. Other threads only append to `Requests` and read the newest `Snapshot`, without locks, so
that a signal handler may halt the head whatever code it interrupted.
"""

import atexit
import contextlib
import itertools
import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Annotated

from cotarget.config import SafetyConfig
from cotarget.drivers.axes import AXES, AxisFacts, AxisTrack
from cotarget.drivers.head_link import DroppedError, Halt, HeadLink, Move, Pair, Requests, drained
from cotarget.drivers.interlock import PositionLostMarker, addresses_of
from cotarget.drivers.lens import LensPositions
from cotarget.drivers.link_errors import CutError, LostError, PositionLostError, RefusedError, SilentError
from cotarget.errors import ConfigError, DeviceError, HaltedError
from cotarget.plugins import place_of
from cotarget.rig import AxisLimits, Clock, HeadSpec, PanTiltLimits, PanTiltState, Speed, ZoomState
from cotarget.schema import Limits, NotNegative, OneOf, Positive, model

log = logging.getLogger(__name__)


@model
class PolledHeadSettings:
    """The settings in rig.toml that every polled head has.

    Attributes:
        step_deg: step size that the unit is expected to report, or those of pan and tilt; 0 for a continuous axis
            [degrees].
        pan_deg: range of pan that the unit is expected to report, with positive pan to the right [degrees].
        tilt_deg: range of tilt that the unit is expected to report, with positive tilt up [degrees].
        pan_sign: 1 where the unit's positive pan turns right, -1 where it turns left.
        tilt_sign: 1 where the unit's positive tilt goes up, -1 where it goes down.
        speed_deg_s: speed of moves, at most the unit's own [degrees/s].
        command_delay_s: time from a command to the start of motion, as measured [s].
    """

    _: KW_ONLY
    step_deg: NotNegative | Annotated[tuple[NotNegative, NotNegative], "[pan, tilt]"]
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
    def signs(self) -> tuple[int, int]:
        """Signs of pan and tilt."""
        return self.pan_sign, self.tilt_sign

    @property
    def spec(self) -> HeadSpec:
        """Describe the head; its acceleration is not known before it is opened."""
        pan, tilt = (
            AxisLimits(
                (math.radians(low), math.radians(high)), math.radians(self.speed_deg_s), step=math.radians(step_deg)
            )
            for (low, high), step_deg in zip((self.pan_deg, self.tilt_deg), self.steps_deg, strict=True)
        )
        return HeadSpec(PanTiltLimits(pan, tilt), self.command_delay_s)


# The thread that owns the link

TRIES = 3  # of a move, and of polls in a row, that end because the unit was silent
PATIENCE_S = 2.0  # for a move, beyond its travel and its acceleration [s]
ANSWERS = 3  # for which a unit that answers late gets more time: one that is steered comes to its goal by some of them
# A unit that reports no position for this time [s] and in so many polls is dead; a program may have been suspended.
UNHEARD_S, UNHEARD_POLLS = 5.0, 10
# A unit may obey late: a head that has stood for so long since the last command [s], and turns by this angle beyond its
# slack, is moved by another program.
OBEYED_S, STRANGE_RAD = 1.0, math.radians(0.5)
LOOP_HALT_S = 0.3  # for the answer to a halt, beyond the time to brake: a unit may answer only when it stands [s]


def braking_s(axes: Sequence[AxisFacts]) -> float:
    """Return the longest time to stop pan or tilt from its highest speed [s]."""
    return max(axis.braking_s(axis.fastest) for axis in axes[:2])


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


@dataclass(frozen=True)
class Snapshot:
    """Positions of axes at one time, interpolated between polls, in the unit's numbers.

    Attributes:
        positions: of pan and tilt, or of the lens.
        moving: whether a command is under way or an axis is not known to stand.
        t: time of the positions [s].
        sigma: standard deviation of either angle [rad].
    """

    positions: tuple[float, ...]
    moving: bool
    t: float
    sigma: float = 0.0


class Loop:
    """Poll the unit and send requests; the only user of the link.

    Args:
        link: to an opened unit.
        clock: the rig's clock.
        delay: time from a command to the start of motion [s].
    """

    def __init__(self, link: HeadLink, clock: Clock, delay: float) -> None:
        self._link, self._clock, self._delay = link, clock, delay
        self._tracks = tuple(AxisTrack(facts) for facts in link.axes)
        self._head, self._lens = self._tracks[:2], self._tracks[2:]
        self._polled = True  # since the last command: commands in quick succession must not displace the polls
        self._has_moved = False  # whether a move was sent since the last zoom
        self._cuts = 0  # in a row, without a poll between them
        self._active: Move | None = None
        self._rest: tuple[float, ...] | None = None  # where the head stands, and has stood for `OBEYED_S`
        self._told_t = -math.inf  # when something was last commanded [s]
        self._speeds: Pair = (0.0, 0.0)  # of the last move
        self.requests = Requests()
        self.halted = 0  # number of the newest halt that was taken out of the queue
        self.rests = False  # whether the unit acknowledged the last halt, after which nothing more is sent
        self.errors: deque[DeviceError] = deque(maxlen=1)  # of a move without a waiting caller; the next call raises it
        self.lens_errors: deque[DeviceError] = deque(maxlen=1)
        self._zooming: tuple[float, float] | None = None  # the lens's goal, and when it should have arrived [s]
        self._zoomed_from = 0.0  # where the lens was at the first of the commands that it has not obeyed
        self._heard_t = [clock.now()] * len(self._tracks)  # when each axis last had a poll of a later time
        self._unheard = [0] * len(self._tracks)  # polls since then
        while not all(track.polls for track in self._tracks):
            self._poll_axes()
        self.snapshot, self.lens_snapshot = self._see(self._head), self._see(self._lens)

    def turn(self) -> None:
        """Do the most urgent exchange: a halt, a move or a zoom, which take turns, or a poll.

        Raises:
            PositionLostError: the head's position may be lost.
            DeviceError: the head cannot be used any more.
        """
        requests = self.requests
        try:
            if requests.halts:
                self._halt()
            elif requests.zooms and self._polled and (self._has_moved or not requests.moves):
                self._has_moved = False
                self._zoom()
            elif requests.moves and self._polled:
                self._has_moved = True
                self._move()
            else:
                self._poll()
        except DroppedError as dropped:
            self._abandon(dropped)
        except CutError as cut:
            self._cuts += 1
            self._expect_motion(self._head)
            if self._active is not None:
                self._requeue(self._active, cut)
            elif self._cuts >= TRIES:
                raise
        self._link.check()
        if self._polled:
            requests.pause(self._link.pause_s)

    def stop_for_good(self, reason: DeviceError) -> None:
        """Halt the head a last time, and end all requests with an error."""
        self.requests.closing = True
        self.rests = try_last_halt(self._link, reason)
        for move in [*([self._active] if self._active else []), *drained(self.requests.moves)]:
            move.finish(reason)
        for halt in drained(self.requests.halts):
            halt.done.set()

    def _halt(self) -> None:
        halts = drained(self.requests.halts)
        # Threads that halt at the same time may queue their requests out of order.
        self.halted = max([self.halted, *(halt.number for halt in halts)])
        try:
            self._abandon(DroppedError("the move was halted"))
            self._stop()
            for halt in halts:
                halt.answered = True
        finally:
            for halt in halts:
                halt.done.set()

    def _stop(self) -> None:
        """Send the halt and wait for its answer."""
        self._link.halt(LOOP_HALT_S + braking_s(self._link.axes))
        self._expect_motion(self._head)

    def _move(self) -> None:
        # The snapshot must say moving before the request leaves the queue: PolledHead.state reads both.
        self.snapshot = replace(self.snapshot, moving=True)
        moves = drained(self.requests.moves)
        fresh = [move for move in moves if move.number > self.halted]
        for move in moves:
            if move not in fresh:
                move.finish(DroppedError("the move was halted"))
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
        self._link.check()
        self.requests.proceed()
        self._link.move(move.goals, move.speeds, self.requests)
        longest = 0.0
        for axis, goal, speed, before in zip(self._head, move.goals, move.speeds, self._speeds, strict=True):
            # A head on its way to an earlier goal must brake first, and perhaps come back.
            fastest = speed if axis.stands() else max(speed, before)
            overshoot = 0.0 if axis.stands() else before * axis.facts.braking_s(before)
            way = abs(goal - axis.newest.position) + overshoot
            longest = max(longest, way / speed + 2 * axis.facts.braking_s(fastest))
        self._speeds = move.speeds
        self._expect_motion(self._head)
        patience = self._delay + PATIENCE_S + ANSWERS * self._link.answer_s
        move.deadline = self._clock.now() + longest + patience

    def _zoom(self) -> None:
        self.lens_snapshot = replace(self.lens_snapshot, moving=True)  # before the request leaves the queue, as a move
        *_, position = drained(self.requests.zooms)
        self._polled, self.requests.is_zooming = False, True
        try:
            self._link.zoom(position, self.requests)
        except DroppedError:
            self.requests.zooms.appendleft(position)  # a newer one replaces it
            raise
        except (RefusedError, CutError) as error:
            self.lens_errors.append(error)
            if isinstance(error, CutError):
                raise
            return
        finally:
            self.requests.is_zooming = False
        self._expect_motion(self._lens)
        (lens,) = self._lens
        longest = abs(position - lens.newest.position) / lens.facts.fastest + 2 * lens.facts.braking_s(
            lens.facts.fastest
        )
        deadline = self._clock.now() + longest + self._delay + PATIENCE_S
        here, before = lens.newest.position, self._zooming
        if before and lens.facts.is_near(here, self._zoomed_from) and not lens.facts.is_near(here, before[0]):
            deadline = min(deadline, before[1])  # it has obeyed none of the commands so far
        else:
            self._zoomed_from = here
        self._zooming = position, deadline

    def _report_strange_motion(self) -> None:
        """Warn, once a motion, of a head that leaves the place where it stood although nothing was commanded."""
        if self._active is not None or any(track.newest.sigma for track in self._head):
            return
        if self._rest is None:
            if self._stand(self._head) and self._clock.now() - self._told_t > OBEYED_S:
                self._rest = tuple(track.newest.position for track in self._head)
            return
        turned = max(
            (abs(track.newest.position - rest) - 2 * track.facts.slack) * track.facts.unit
            for track, rest in zip(self._head, self._rest, strict=True)
        )
        if turned > STRANGE_RAD:
            self._rest = None
            log.warning(
                "%s: the head turns without a command: see that no other program, guard tour or idle preset moves it",
                self._link.name,
            )

    def _expect_motion(self, tracks: Sequence[AxisTrack]) -> None:
        if tracks is self._head:
            self._rest, self._told_t = None, self._clock.now()
        for track in tracks:
            track.expect_motion(self._clock.now() + self._delay)

    def _poll(self) -> None:
        self._poll_axes()
        self._polled = True
        move = self._active
        if move is not None and move.deadline is not None:
            if self._stand(self._head) and not self._off_goal(move):
                if type(self._link).renew is not HeadLink.renew:
                    self._link.halt(LOOP_HALT_S + braking_s(self._link.axes))  # its last velocity would take it on
                self._active = None
                self.snapshot = self._see(self._head)
                move.finish()
            elif min(track.newest.t for track in self._head) > move.deadline:  # a late thread alone does not count
                self._refuse_late(move, min(track.newest.t for track in self._head))
            else:
                self._renew(move)
        self._report_strange_motion()
        self._check_lens()
        self.snapshot, self.lens_snapshot = self._see(self._head), self._see(self._lens)

    def _poll_axes(self) -> None:
        now = self._clock.now()
        for poll in self._link.poll(self.requests):
            track = self._tracks[poll.axis]
            if not track.polls or poll.t > track.newest.t:
                self._heard_t[poll.axis], self._unheard[poll.axis] = now, -1
            track.add(poll)
        self._unheard = [count + 1 for count in self._unheard]
        silent = [
            name
            for name, t, count in zip(AXES, self._heard_t, self._unheard, strict=False)
            if now - t > UNHEARD_S and count > UNHEARD_POLLS
        ]
        if silent:
            what = f"has reported no position of {' and '.join(silent)} with a later time for {UNHEARD_S:g} s"
            raise SilentError(f"the unit at {self._link.name} {what}")
        self._cuts = 0

    def _check_lens(self) -> None:
        """Keep an error for the lens's next caller if it does not arrive in time."""
        if self._zooming is None:
            return
        (lens,), (goal, deadline) = self._lens, self._zooming
        if lens.stands() and lens.facts.is_near(lens.newest.position, goal):
            self._zooming = None
        elif lens.newest.t > deadline:
            self._zooming = None
            at = f"{lens.newest.position:g} where {goal:g} was commanded"
            self.lens_errors.append(DeviceError(f"the lens at {self._link.name} did not arrive in time: it is at {at}"))

    def _renew(self, move: Move) -> None:
        if self.requests.halt_waits() or self.requests.moves:
            return
        try:
            self._link.renew(self.requests)
        except RefusedError as error:
            self._give_up(move, error)

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
        self.requests.moves.appendleft(move)  # a newer move in the queue replaces it, a halt drops it

    def _off_goal(self, move: Move) -> list[AxisTrack]:
        """List the axes whose newest poll is farther off the move's goal than their slack."""
        goals = zip(self._head, move.goals, strict=True)
        return [track for track, goal in goals if not track.facts.is_near(track.newest.position, goal)]

    def _refuse_late(self, move: Move, t: float) -> None:
        """End a move that did not arrive in time; raise where an axis may have lost its position.

        Args:
            move: the move, whose deadline is over.
            t: time of the polls [s]. After a pause of the program the first ones show the head at its goal.
        """
        if not self._off_goal(move) and (move.rests_by is None or t <= move.rests_by):
            move.rests_by = move.rests_by or t + PATIENCE_S
            return
        pan, tilt = (f"{track.newest.position:g}" for track in self._head)
        wanted = ", ".join(f"{goal:g}" for goal in move.goals)
        what = f"did not arrive in time: pan {pan}, tilt {tilt}, where {wanted} were commanded; it was halted"
        if not self._off_goal(move):
            what = f"is where it was sent, pan {pan}, tilt {tilt}, but does not come to rest; it was halted"
        if any(track.facts.loses_steps for track in self._off_goal(move)):
            raise PositionLostError(
                self._link.name,
                f"{what}, and its position may be lost by something in its way or a weak motor supply",
            )
        why = "see that nothing is in its way; if it always ends as far off, give its axes more slack in the driver"
        if not self._off_goal(move):
            why = self.why_restless()
        self._give_up(move, DeviceError(f"the pan-tilt unit at {self._link.name} {what}; {why}"))

    def why_restless(self) -> str:
        """Explain why pan and tilt are not known to stand."""
        if any(track.newest.moving for track in self._head):
            return "it says that it moves; if it stands all the same, let its driver give moving=None"
        return "if it trembles there, give its axes more slack in the driver"

    @staticmethod
    def _stand(tracks: Sequence[AxisTrack]) -> bool:
        return all(track.stands() for track in tracks)

    def _see(self, tracks: Sequence[AxisTrack]) -> Snapshot:
        """Make a snapshot of pan and tilt, or of the lens, at the older one of their newest polls."""
        t = min((track.newest.t for track in tracks), default=-math.inf)
        commanded = self._active is not None if tracks is self._head else self._zooming is not None
        moving = commanded or not self._stand(tracks)
        sigma = max((track.newest.sigma * track.facts.unit for track in tracks), default=0.0)
        return Snapshot(tuple(track.interpolate(t) for track in tracks), moving, t, sigma)


# The head

OF_A_UNIT = ("poll", "move", "halt", "close")  # methods of a `HeadLink` that have no default
STANDS_S = 5.0  # time limit for a head that turned when it was opened to stand after the halt [s]
LENS_STANDS_S = 1.0  # a lens is only known to stand after some polls; one that moves is not waited for [s]
HALT_S = 1.0  # time limit for the answer to a halt, beyond braking; synchronising the line may come first [s]
CLOSE_S = 5.0  # time limit for the thread to end [s]
CHECK_S = 0.2  # a caller that waits for a move checks with this period whether the thread still runs [s]
NOTHING_SAID = SafetyConfig()
# Limits differ by a few steps from unit to unit and from reset to reset; a larger difference is another unit's.
LIMITS_DEG = 3.0
STEP_SHARE = 2e-3  # tolerance relative to the step, which the unit and rig.toml round
ROUNDING = 1e-9  # relative; of a speed after its conversion from degrees


class PolledHead:
    """A pan-tilt unit that is open, checked against the configuration, and standing.

    A thread polls the positions and sends commands. The next call of any method raises an error that occurred there. If
    the position may be lost, the error is permanent: a marker file keeps every program from opening the head until
    `cotarget reset-head`. Nothing here resets the unit.

    Args:
        open_link: opens the unit, halts it, and raises CotargetError where it cannot be used.
        config: address, limits, steps and signs that the unit must report.
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
        address = next(iter(addresses_of(config)), "")
        self._lost = PositionLostMarker(address, safety.stop_file)
        self._lost.refuse()
        self._signs = config.signs
        self._numbers = itertools.count(1)
        self._dead: DeviceError | None = None
        self._closed = False
        try:
            self._link = _checked(open_link())
        except BaseException as error:
            self._remember(error)
            raise
        try:
            self.axes = pan, tilt = self._link.axes[:2]
            compare(config, self.axes, address)
            _refuse_too_slow("hardware.head.speed_deg_s", config.speed_deg_s, self.axes, address)
            _refuse_too_slow("safety.speed_deg_s", safety.speed_deg_s, self.axes, address)
            speed = math.radians(config.speed_deg_s)
            self._limits = PanTiltLimits(pan.limits(config.pan_sign, speed), tilt.limits(config.tilt_sign, speed))
            self._goals = self._link.goals()
            self._loop = Loop(self._link, clock, config.command_delay_s)
            self._wait_until_it_stands(clock)
        except BaseException as error:
            try_last_halt(self._link, error)
            self._remember(error)
            self._link.close()
            raise
        self._thread = threading.Thread(target=self._run, name=f"head at {address}", daemon=True)
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
        waiting = bool(self._loop.requests.moves)
        seen = self._loop.snapshot
        return PanTiltState(*self._angles(seen.positions), seen.moving or waiting, seen.t, seen.sigma)

    def lens(self, positions: LensPositions) -> "PolledLens":
        """Return the lens of a unit that has it as a third axis.

        Args:
            positions: focal lengths of its positions.
        """
        return PolledLens(self._loop, positions, self._raise_pending)

    def move(self, pan: float, tilt: float, speed: Speed | None = None, wait: bool = False) -> tuple[float, float]:
        """Command both axes; the newest command wins.

        Args:
            pan: angle [rad].
            tilt: angle [rad].
            speed: of both axes or of each [rad/s]; by default, and at most, the configured one. The unit may have a
                lowest speed.
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
        axes = tuple(zip(self.axes, self._signs, (pan, tilt), strict=True))
        a, b = self._goals = self._kept([axis.goal(angle, sign) for axis, sign, angle in axes])
        move = Move(number, (a, b), (self.axes[0].speed(fastest[0]), self.axes[1].speed(fastest[1])), wait)
        self._loop.requests.add(self._loop.requests.moves, move)
        if wait:
            self._wait_for(move)
        return self._angles((a, b))

    def _kept(self, goals: Sequence[float]) -> Pair:
        """Keep the last goal of an axis that is sent to where it stands, off that goal by its slack at most.

        A servo rests a little off each goal; sent to where it rests, it would move on by as much.
        """
        seen, kept = self._loop.snapshot, list(goals)
        for i, (goal, axis) in enumerate(zip(goals, self.axes, strict=True)):
            stands_there = not seen.moving and abs(goal - seen.positions[i]) <= axis.same
            if stands_there and self._goals is not None and axis.is_near(self._goals[i], goal):
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
        self._loop.requests.add(self._loop.requests.halts, request)
        # The halt may come after the answer to a command that was given up.
        limit_s = HALT_S + braking_s(self.axes) + 2 * self._link.answer_s
        request.done.wait(limit_s if self._thread.is_alive() else 0.0)
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
        self._closed = True
        self._loop.requests.close()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.warning("%s: the thread of the pan-tilt unit does not end", self._link.name)
        self._link.close()
        atexit.unregister(self.close)

    def _run(self) -> None:
        reason: DeviceError = DroppedError(f"the pan-tilt unit at {self._link.name} is closed")
        try:
            while not self._loop.requests.closing:
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

    def _angles(self, positions: Sequence[float]) -> Pair:
        """Convert positions of pan and tilt to angles [rad]."""
        pan, tilt = (sign * at * axis.unit for sign, at, axis in zip(self._signs, positions, self.axes, strict=True))
        return pan, tilt

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
        begin = clock.now()
        while self._loop.snapshot.moving or (self._loop.lens_snapshot.moving and clock.now() < begin + LENS_STANDS_S):
            if clock.now() > begin + STANDS_S:
                raise DeviceError(
                    f"the pan-tilt unit at {self._link.name} does not come to rest though it was halted; "
                    f"{self._loop.why_restless()}"
                )
            self._loop.turn()


def _checked(link: HeadLink) -> HeadLink:
    """Refuse a link that lacks a part of `HeadLink`, and name the part."""
    needed = ("name", "axes", *(name for name in vars(HeadLink) if not name.startswith("_")))
    own = [name for name in needed if getattr(type(link), name, None) is not getattr(HeadLink, name, ...)]
    lacks = [name for name in needed if not hasattr(link, name) or (name in OF_A_UNIT and name not in own)]
    if lacks:
        if "close" not in lacks:
            link.close()
        raise ConfigError(f"hardware.head.driver: {type(link).__name__} has no {lacks[0]}; HeadLink says what it needs")
    return link


def compare(config: PolledHeadSettings, axes: Sequence[AxisFacts], address: str) -> None:
    """Refuse a unit whose steps or limits differ from rig.toml; the message has both, and what to write."""
    steps = [math.degrees(axis.step * axis.unit) for axis in axes]
    if any(abs(step - said) > STEP_SHARE * said for step, said in zip(steps, config.steps_deg, strict=True)):
        own, said = (tuple(float(f"{step:.6g}") for step in each) for each in (steps, config.steps_deg))
        raise ConfigError(
            f"hardware.head.step_deg: pan and tilt of the unit at {address} have steps of {own[0]:.6g} and "
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
                f"hardware.head.{word}_deg: the unit at {address} goes from {found[0]:.1f} to {found[1]:.1f} "
                f"degrees, not from {expected[0]:g} to {expected[1]:g}; write {word}_deg = "
                f"[{found[0]:.1f}, {found[1]:.1f}]{turned}"
            )


def _agree(found: tuple[float, float], expected: tuple[float, float]) -> bool:
    return max(abs(a - b) for a, b in zip(found, expected, strict=True)) <= LIMITS_DEG


def _refuse_too_slow(key: str, cap_deg_s: float | None, axes: Sequence[AxisFacts], address: str) -> None:
    """Refuse a speed cap below the unit's lowest speed, and name that speed."""
    slowest = max(axis.slowest * math.degrees(axis.unit) for axis in axes)
    if cap_deg_s is not None and cap_deg_s * (1 + ROUNDING) < slowest:
        least = math.ceil(100 * slowest) / 100
        raise ConfigError(
            f"{key}: {cap_deg_s:g} degrees/s is slower than the unit at {address} can turn; it takes {least:g} at least"
        )


class PolledLens:
    """The zoom lens of a unit that moves it as a third axis: the lens's part of the `ZoomCamera` Protocol."""

    def __init__(self, loop: Loop, positions: LensPositions, raise_pending: Callable[[], None]) -> None:
        self._loop, self._positions, self._raise_pending = loop, positions, raise_pending

    @property
    def focal_range(self) -> tuple[float, float]:
        """Shortest and longest nominal focal length [px]."""
        return self._positions.focal_range

    def number(self, focal_px: float) -> float:
        """Return the unit's number of the position nearest to a nominal focal length [px]."""
        return self._positions.position_for(focal_px)

    def zoom(self, focal_px: float) -> float:
        """Start the lens moving and return at once the focal length that it will reach [px].

        Raises:
            DeviceError: the focal length is not above zero, the lens did not arrive, or another error occurred since
                the last call.
        """
        self._raise_errors()
        if not 0 < focal_px < math.inf:
            raise DeviceError(f"the lens cannot go to a focal length of {focal_px} px")
        position = self._positions.position_for(focal_px)
        self._loop.requests.add(self._loop.requests.zooms, position)
        return self._positions.focal_at(position)

    def state(self) -> ZoomState:
        """Return the focal length of the last poll, at once. Raises as `zoom` does."""
        self._raise_errors()
        waiting = bool(self._loop.requests.zooms)  # in this order, as in `PolledHead.state`
        seen = self._loop.lens_snapshot
        return ZoomState(self._positions.focal_at(seen.positions[0]), seen.moving or waiting, seen.t)

    def _raise_errors(self) -> None:
        self._raise_pending()
        with contextlib.suppress(IndexError):
            raise self._loop.lens_errors.popleft()
