"""Axes that do not say where they are, or do not go where they are sent: dead reckoning, and steering by velocity.

Positions and speeds are in the numbers of the axis's facts. Times are on the rig's clock [s].
"""

from collections import deque

from cotarget.drivers.axes import AxisFacts
from cotarget.drivers.lens import LensMotion

SPEED_SHARE = 0.1  # relative standard deviation of a speed that nobody has measured
GAIN_HZ = 4.0  # of steering; above a third of the inverse of the unpredicted dead time it would overshoot
FLOW_S = 0.5  # goals that follow each other as soon move along
FLOW_GAIN = 0.4  # by which the newest pair of goals changes their estimated speed


class ReckonedAxis:
    """Where an axis should be by its commands.

    Args:
        facts: range and highest speed of the axis.
        delay: time from a command to the start of motion [s].
    """

    def __init__(self, facts: AxisFacts, delay: float) -> None:
        self._facts, self._delay = facts, delay
        middle = (facts.lowest + facts.highest) / 2
        self._motion = LensMotion(middle, middle, 0.0, facts.fastest)
        self._sigma, self._sigma_t = (facts.highest - facts.lowest) / 2, 0.0  # of the position at a time

    def correct(self, position: float, t: float) -> None:
        """Take a position that the device has said; a motion under way goes on from there."""
        motion = self._motion
        goal = position if t >= motion.arrives else motion.goal
        self._motion = LensMotion(position, goal, max(t, motion.t), motion.speed)
        self._sigma = 0.0

    def command(self, goal: float, speed: float, now: float) -> None:
        """Start a motion to a goal; from the far end of the range, if nothing is known of the position."""
        t, (here, sigma) = now + self._delay, self.at(now)
        far = max((self._facts.lowest, self._facts.highest), key=lambda end: abs(end - goal))
        start = far if sigma >= abs(self._facts.highest - self._facts.lowest) / 2 else here
        self._motion = LensMotion(start, goal, t, max(speed, 1e-6))
        self._sigma, self._sigma_t = sigma, now

    def halt(self, now: float) -> None:
        """End the motion where the axis should be."""
        here, self._sigma = self.at(now)
        self._motion = LensMotion(here, here, now, self._facts.fastest)

    def at(self, t: float) -> tuple[float, float]:
        """Return the position at a time, and its standard deviation; a motion ends at its goal exactly."""
        motion = self._motion
        here = motion.position(t)
        if (
            t >= motion.arrives + SPEED_SHARE * (motion.arrives - motion.t) + self._delay
            and motion.start != motion.goal
        ):
            return motion.goal, 0.0
        return here, self._sigma + SPEED_SHARE * abs(here - motion.start)


class SteeredAxis:
    """Velocities that lead an axis to its goal, and along with goals that move.

    The position is predicted from the newest one that the device has said and the velocities sent since.

    Args:
        facts: of the axis.
        delay: time from a command to the start of motion [s].
    """

    def __init__(self, facts: AxisFacts, delay: float) -> None:
        self._facts, self._delay = facts, delay
        self._sent = deque([(0.0, 0.0)], maxlen=100)  # (time, velocity)
        self._goal: float | None = None
        self._limit, self._flow, self._aimed = facts.fastest, 0.0, -FLOW_S

    @property
    def velocity(self) -> float:
        """The velocity sent last [1/s]."""
        return self._sent[-1][1]

    def aim(self, goal: float, speed: float, now: float) -> None:
        """Set a goal and the highest speed."""
        passed = now - self._aimed
        if self._goal is None or passed >= FLOW_S:
            self._flow = 0.0
        elif passed > 0:
            self._flow += FLOW_GAIN * ((goal - self._goal) / passed - self._flow)
        self._goal, self._limit, self._aimed = goal, speed, now

    def stop(self, now: float) -> None:
        """Forget the goal; the axis was stopped."""
        self._goal = None
        self._sent.append((now, 0.0))

    def wanted(self, position: float, t: float, now: float) -> float:
        """Return the velocity to send now [1/s].

        Args:
            position: that the device has said.
            t: time of it.
            now: the time.
        """
        if self._goal is None:
            return 0.0
        flow = self._flow if now - self._aimed < FLOW_S else 0.0
        error = self._goal + flow * (now - self._aimed) - self._predicted(position, t, now)
        if abs(error) <= max(self._facts.slack / 2, self._facts.same) and abs(flow) < GAIN_HZ * self._facts.slack:
            return 0.0
        return min(max(flow + GAIN_HZ * error, -self._limit), self._limit)

    def send(self, velocity: float, now: float) -> None:
        """Note a velocity that was sent."""
        self._sent.append((now, velocity))

    def _predicted(self, position: float, t: float, now: float) -> float:
        """Predict the position at which a command of now takes effect."""
        ends = [*(begin for begin, _ in list(self._sent)[1:]), now]
        for (begin, velocity), end in zip(self._sent, ends, strict=True):
            position += velocity * max(end - max(begin, t - self._delay), 0.0)
        return position
