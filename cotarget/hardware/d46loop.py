"""What the thread that owns the line to a PTU-D46 does: it polls positions all the time, and sends what is wished.

One turn is one exchange, or the few of one move. Other threads only append wishes to queues and read the newest
snapshot: no locks, so that a signal handler may halt the head whatever it interrupted.
"""

import logging
from collections import deque
from collections.abc import Callable
from typing import TypeVar

from cotarget.errors import DeviceError
from cotarget.hardware import d46
from cotarget.hardware.d46 import RefusedError, ReplyError, command
from cotarget.hardware.d46lost import PositionLostError
from cotarget.hardware.d46track import Snapshot, Track
from cotarget.hardware.d46unit import HALT_NOW, HALT_TRIES, Unit, halt_outright, refuse_events, restarted
from cotarget.hardware.d46wishes import CutError, DroppedError, Halt, Move, drained
from cotarget.hardware.line import QUICK_S, Line
from cotarget.hardware.lineerrors import LostError, RestartedError, SilentError
from cotarget.rig import Clock

log = logging.getLogger(__name__)
Meaning = TypeVar("Meaning")

TRIES = 3  # of one exchange, each but the first after getting back in step
PATIENCE_S = 2.0  # for a move, beyond its way and its run-up [s]
HALT_S = 0.3  # for the answer to a halt, beyond the time to brake: some units may answer when they stand


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

    def __init__(self, line: Line, unit: Unit, clock: Clock, delay: float) -> None:
        self._line, self._clock, self._delay = line, clock, delay
        self._tracks = (Track("P", unit.pan), Track("T", unit.tilt))
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
            self._halt_at_last(HALT_S if isinstance(reason, SilentError) else HALT_S + self.braking_s)
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
        wishes = drained(self.halts)
        # Threads that halt at once may get here in another order than they were numbered in.
        self.halted = max([self.halted, *(wish.number for wish in wishes)])
        try:
            self._abandon(DroppedError("the move was halted"))
            self._stop()
            for wish in wishes:
                wish.answered = True
        finally:
            for wish in wishes:
                wish.done.set()

    def _stop(self) -> None:
        """Order the halt and wait for the answer."""
        for track in self._tracks:
            track.goal = None
        for left in reversed(range(HALT_TRIES)):
            try:
                self._exchange(HALT_NOW, d46.done, patience=HALT_S + self.braking_s)
                break
            except RefusedError:
                if not left:
                    raise
        self._expect_motion()

    def _move(self) -> None:
        # A snapshot that says moving must be there before the wish leaves the queue: see D46Head.state.
        self.snapshot = Snapshot(self.snapshot.pan, self.snapshot.tilt, True, self.snapshot.t)
        wishes = drained(self.moves)
        fresh = [wish for wish in wishes if wish.number > self.halted]
        for wish in wishes:
            if wish not in fresh:
                wish.finish(DroppedError("the move was halted"))
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
        if reason := self._other_wish():
            raise DroppedError(reason)
        self._exchange(command(name, value), d46.done, self._other_wish)

    def _other_wish(self) -> str:
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
                position, t = self._exchange(command(track.name + "P"), d46.bare_integer)
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
        stands = ", ".join(f"{d46.AXIS_WORDS[axis.name]} {axis.position}" for axis in self._tracks)
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
