"""Axes that do not say where they are, or do not go where they are sent: dead reckoning, steering by velocity, steps.

Positions and speeds are in the numbers of the axis's facts. Times are on the rig's clock [s].
"""

from collections import deque
from dataclasses import replace
from itertools import pairwise

from cotarget.drivers.axes import AxisFacts
from cotarget.drivers.lens import LensMotion

SPEED_SHARE = 0.1  # relative standard deviation of a speed that was not measured
SLOWEST = 1e-6  # a speed of zero would never arrive
GAIN_HZ = 4.0  # of steering; above a third of the inverse of the unpredicted dead time it would overshoot
FLOW_S = 0.5  # goals that follow each other as soon move along
# Factors of gain and tolerance of an axis that goes beyond its goal again and again; its widest tolerance, in slacks.
CALMER, WIDER, WIDEST = 0.5, 1.5, 10.0
SWINGS = 2  # beyond a goal that count as chance, such as by a late status
SLOW = 0.01  # of the highest speed: a goal that moves by less may rest, whatever the slack
FLOW_GAIN = 0.4  # by which the newest pair of goals changes their estimated speed
MEASURED_DEG = 1.0  # shortest step from which it is measured how far the device goes
GAINS = (0.1, 10.0)  # of a device's steps that are believed


class ReckonedAxis:
    """Where an axis should be by its commands.

    Two motions with the same commands begin at the ends of the range; the position is known where they have met.

    Args:
        facts: range and highest speed of the axis.
        delay: time from a command to the start of motion [s].
    """

    def __init__(self, facts: AxisFacts, delay: float) -> None:
        self._delay = delay
        ends = (facts.lowest, facts.highest)
        self._motions = [LensMotion(end, end, 0.0, facts.fastest) for end in ends]

    @property
    def arrives(self) -> float:
        """Time at which the axis should be at its goal [s]."""
        return max(motion.arrives for motion in self._motions)

    def correct(self, position: float, t: float) -> None:
        """Take a position that the device has said; a motion under way goes on from there."""
        newest = self._motions[0]
        stands = t >= self.arrives or newest.start == newest.goal
        goal = position if stands else newest.goal
        self._motions = [LensMotion(position, goal, max(t, newest.t), newest.speed)] * 2

    def command(self, goal: float, speed: float, now: float) -> None:
        """Start a motion to a goal."""
        moved = [motion.toward(goal, now + self._delay) for motion in self._motions]
        self._motions = [replace(motion, speed=max(speed, SLOWEST)) for motion in moved]

    def halt(self, now: float) -> None:
        """End the motion where the axis should be."""
        places = [motion.position(now) for motion in self._motions]
        self._motions = [LensMotion(place, place, now, 1.0) for place in places]

    def at(self, t: float) -> tuple[float, float]:
        """Return the position at a time, and its standard deviation."""
        a, b = (float(motion.position(t)) for motion in self._motions)
        here = (a + b) / 2
        return here, abs(b - a) / 2 + SPEED_SHARE * abs(self._motions[0].goal - here)


class SteeredAxis:
    """Velocities that lead an axis to its goal, and along with goals that move.

    The position is predicted from the newest one that the device has said and the velocities sent since. An axis that
    turns on after a stop is stopped as much earlier where its goal rests; on the way with a goal that moves, another
    velocity takes the place of a stop. So does a velocity of 0 while the other axis turns: the device stops where both
    are 0. One that goes beyond a goal at rest all the same, again and again,
    such as by positions that are late or by its lowest speed, gets a lower gain and a wider tolerance for a while.

    Args:
        facts: of the axis.
        delay: time from a command to the start of motion [s].
        stop_delay: time by which a stop takes longer [s].
        answer: time that the device takes for an answer [s]. A command is obeyed within it, and a position is as old at
            most.
    """

    def __init__(self, facts: AxisFacts, delay: float, stop_delay: float = 0.0, answer: float = 0.0) -> None:
        self._facts, self._delay, self._stop_delay = facts, max(delay, answer), stop_delay
        self._gain = self._most_gain = 1 / (1 / GAIN_HZ + 2 * answer)
        self._sent = deque([(0.0, 0.0)], maxlen=100)  # (time at which it begins, velocity)
        self._goal: float | None = None
        self._limit, self._flow, self._aimed = facts.fastest, 0.0, -FLOW_S
        self._slow = min(self._gain * facts.slack, SLOW * facts.fastest)
        self._tolerance = self._least = max(facts.slack / 2, facts.same)
        self._swings = 0  # times that it has gone beyond the goal of now
        self._turned = 0.0  # the velocity with which it last began to go to the goal of now

    @property
    def velocity(self) -> float:
        """The velocity sent last [1/s]."""
        return self._sent[-1][1]

    def aim(self, goal: float, speed: float, now: float) -> None:
        """Set a goal and the highest speed."""
        passed = now - self._aimed
        if self._goal is None or passed >= FLOW_S or goal == self._goal:  # a goal at rest, as at the end of the range
            self._flow = 0.0
        elif passed > 0:
            self._flow += FLOW_GAIN * ((goal - self._goal) / passed - self._flow)
        if goal != self._goal:
            self._turned, self._swings = 0.0, 0
            self._tolerance = max(self._tolerance / WIDER, self._least)
            self._gain = min(self._gain * WIDER, self._most_gain)
        self._goal, self._limit, self._aimed = goal, speed, now

    def stop(self, now: float) -> None:
        """Forget the goal; the axis was stopped."""
        self._goal, self._turned = None, 0.0
        self.send(0.0, now)

    def wanted(self, position: float, t: float, now: float, alone: bool = True) -> float:
        """Return the velocity to send now [1/s].

        Args:
            position: that the device has said.
            t: time of it.
            now: the time.
            alone: whether the other axis stands.
        """
        if self._goal is None:
            return 0.0
        flow = self._flow if now - self._aimed < FLOW_S else 0.0
        goal = self._goal + flow * (now - self._aimed)
        if not self._facts.lowest < goal < self._facts.highest:
            goal, flow = min(max(goal, self._facts.lowest), self._facts.highest), 0.0
        here, coast = self._predicted(position, t, now, alone)
        gain = self._gain
        if not flow:
            left = goal - here - coast
            passes = left * coast < 0 < (goal - here) * coast
            if abs(left) <= self._tolerance or (coast and (self.velocity == 0 or passes)):
                return 0.0
            gain = 1 / (1 / self._gain + self._stop_delay)
        elif abs(goal - here) <= self._tolerance and abs(flow) < self._slow:
            return 0.0
        wanted = min(max(flow + gain * (goal - here), -self._limit), self._limit)
        beyond = abs(goal - position)
        if not flow and wanted * self._turned < 0 and beyond > self._tolerance:
            self._swings += 1
            if self._swings > SWINGS:
                self._gain *= CALMER
                self._tolerance = min(max(WIDER * self._tolerance, beyond / 2), WIDEST * self._facts.slack)
        self._turned = wanted
        return wanted

    def send(self, velocity: float, now: float, alone: bool = True) -> None:
        """Note a velocity that was sent; ``alone`` if that of the other axis is 0."""
        self._sent.append((self._begin(velocity, now, alone), velocity))

    def _begin(self, velocity: float, now: float, alone: bool) -> float:
        return now + self._delay + (self._stop_delay if alone and not velocity else 0.0)

    def _predicted(self, position: float, t: float, now: float, alone: bool) -> tuple[float, float]:
        """Predict the position at which a command of now takes effect, and the way from there on if that is a stop."""
        motions: list[tuple[float, float]] = []  # (begin, velocity)
        for begin, velocity in self._sent:
            while motions and motions[-1][0] >= begin:  # a stop that has not begun
                motions.pop()
            motions.append((begin, velocity))
        takes_effect = now + self._delay
        stops = motions[-1][0] if self.velocity == 0 else self._begin(0.0, now, alone)
        coast = 0.0
        for (begin, velocity), (end, _) in pairwise([*motions, (max(stops, takes_effect), 0.0)]):
            position += velocity * max(min(end, takes_effect) - max(begin, t), 0.0)
            coast += velocity * max(end - max(begin, takes_effect), 0.0)
        return position, coast


class SteppedAxis:
    """Steps that lead an axis to its goal.

    What a step of 1 in the generic space is differs from device to device. How far the axis went for a step from rest
    is measured when it rests again.
    """

    def __init__(self) -> None:
        self._gain = 1.0  # of the device: way over step
        self._from: float | None = None  # where the newest step began, if it began at rest
        self._step = 0.0

    def toward(self, goal: float, position: float, *, rests: bool) -> float:
        """Return the step from a position to a goal.

        Args:
            goal: position to go to.
            position: where the axis is when the step begins.
            rests: whether it rests there.
        """
        self._step = (goal - position) / self._gain
        self._from = position if rests else None
        return self._step

    def rest(self, position: float) -> None:
        """Take the position where the axis rests after a step."""
        if self._from is not None and abs(self._step) > MEASURED_DEG:
            self._gain = min(max((position - self._from) / self._step, GAINS[0]), GAINS[1])
        self._from = None
