"""The driver of the PTU-D46 and the tests' own unit on a line in simulated time."""

from cotarget.drivers.polled_head import Halt, Loop, Move
from cotarget.drivers.ptu_d46 import D46Link, D46Settings
from cotarget.drivers.ptu_protocol import Line
from tests.support.d46_peer import SimPort, Unit
from tests.support.simulated_clock import SimClock

# With pan in the unit's own sense, so that what is sent is what the tests say.
CONFIG = D46Settings(port="PORT", pan_deg=(-158.9, 158.9), tilt_deg=(-46.6, 31.1), pan_sign=1, command_delay_s=0.04)


class Bench:
    """A unit on a line in simulated time."""

    def __init__(self, echo=True, verbose=True):
        self.clock = SimClock()
        self.unit = Unit(self.clock, echo, verbose)
        self.port = SimPort(self.unit, self.clock)
        self.numbers = iter(range(1, 1000000))

    def connect(self):
        self.line = Line(self.port, "PORT", 9600, self.clock)
        self.link = D46Link(self.line)
        return self.link.unit

    def start(self):
        self.connect()
        self.loop = Loop(self.link, self.clock, CONFIG.command_delay_s)
        self.until(lambda: not self.loop.snapshot.moving)
        return self.loop

    def until(self, there, most=20.0):
        """Let the loop turn until something is so; how long that took [s]."""
        start = self.clock.now()
        while not there():
            assert self.clock.now() < start + most
            self.loop.turn()
        return self.clock.now() - start

    def run(self, seconds):
        end = self.clock.now() + seconds
        self.until(lambda: self.clock.now() >= end)

    def move(self, pan, tilt, speed=1000, wait=False):
        move = Move(next(self.numbers), (pan, tilt), (speed, speed), wait)
        self.loop.moves.append(move)
        return move

    def orders(self):
        """Commands since the last look, without polls."""
        heard = [order for order in self.unit.heard if order not in ("PP", "TP")]
        self.unit.heard.clear()
        return heard

    def halt(self):
        wish = Halt(next(self.numbers))
        self.loop.halts.append(wish)
        return wish
