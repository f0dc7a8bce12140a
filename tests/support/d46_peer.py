"""A small PTU-D46 to try the driver on: its answers from the manuals, a line that can be broken anywhere, and both as
a bench in simulated time.

It knows nothing of the driver, and less than the emulator: its axes turn at constant speed, without run-up.
"""

import itertools
import re
from collections import deque

from cotarget.drivers.head_link import Halt, Move
from cotarget.drivers.polled_head import Loop
from cotarget.drivers.ptu_d46 import D46Link, D46Settings
from cotarget.drivers.ptu_protocol import Line
from tests.support.simulated_clock import SimClock

VERSION = "Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved"
BANNER = b"\r\n### PAN-TILT CONTROLLER v2.12.1d1 ###\r\n"
SET = re.compile(r"([PT])([PS])(-?\d+)")
QUERY = re.compile(r"([PT])([PRNXULAS])")
WORDS = {"P": "Current {} position is {}", "S": "Target {} speed is {} positions/sec"}


class Unit:
    """The other end of the line: commands in, replies out."""

    def __init__(self, clock, echo=True, verbose=True):
        self.clock, self.echo, self.verbose = clock, echo, verbose
        self.heard = []  # commands in order
        self.facts = {"PR": "185.1428", "TR": "185.1428", "PN": -3090, "PX": 3090, "TN": -907, "TX": 604}
        self.facts |= {"PU": 2902, "TU": 2902, "PL": 31, "TL": 31, "PA": 2000, "TA": 2000}
        self.speed = {"P": 1000, "T": 1000}
        self.way = {"P": (0.0, 0, 0), "T": (0.0, 0, 0)}  # when it set out, from where, to where
        self.delay = 0.0  # from a command to the start of motion [s]
        self.stuck = False
        self.velocity = False
        self.scripted = {}  # command -> replies to give instead, in order; None is silence
        self.says_first = b""  # before the next reply
        self.noise = b""  # in front of the next byte that it hears
        self._input = b""

    def position(self, axis):
        since, start, goal = self.way[axis]
        if self.stuck:
            return start
        way = max(self.clock.now() - since - self.delay, 0.0) * self.speed[axis]
        return goal if abs(goal - start) <= way else round(start + (way if goal > start else -way))

    def goals(self):
        return self.way["P"][2], self.way["T"][2]

    def turning(self):
        return any(self.position(axis) != self.way[axis][2] for axis in "PT")

    def receive(self, data):
        """Take bytes; return the reply to each command that they complete."""
        self._input += self.noise + data
        self.noise, reply = b"", b""
        while b" " in self._input:
            order, self._input = self._input.split(b" ", 1)
            reply += (order + b" " if self.echo else b"") + (self.answer(order.decode()) if order else b"")
        return reply

    def answer(self, order):
        self.heard.append(order)
        said = self.obey(order)
        if self.scripted.get(order):
            said = self.scripted[order].pop(0)
            if callable(said):
                said = said()
            if said is None:
                return b""
            return said
        first, self.says_first = self.says_first, b""
        return first + (f"* {said}" if said else "*").encode() + b"\r\n"

    def obey(self, order):
        now = self.clock.now()
        if found := SET.fullmatch(order):
            axis, what, value = found[1], found[2], int(found[3])
            here = self.position(axis)
            if what == "S":
                self.speed[axis] = value
            self.way[axis] = (now, here, value if what == "P" else self.way[axis][2])
            return ""
        if found := QUERY.fullmatch(order):
            axis, what = found[1], found[2]
            value = {"P": self.position(axis), "S": self.speed[axis]}.get(what, self.facts.get(order))
            name = "Pan" if axis == "P" else "Tilt"
            return WORDS.get(what, "The {} value is {} or so^2").format(name, value) if self.verbose else str(value)
        match order:
            case "ED" | "EE":
                self.echo = order == "EE"
            case "FT" | "FV":
                self.verbose = order == "FV"
            case "H":
                self.way = {axis: (now, self.position(axis), self.position(axis)) for axis in "PT"}
            case "CI":
                self.velocity = False
        return {
            "E": f"Echoing {'ON' if self.echo else 'OFF'}",
            "F": f"ASCII {'verbose' if self.verbose else 'terse'} mode",
            "V": VERSION,
            "WP": "H",
            "U": "0",
            "C": "Pure Velocity speed control mode" if self.velocity else "PTU is in Independent Mode",
        }.get(order, "")


class SimPort:
    """pyserial's port with a unit behind it, in simulated time: bytes take theirs in both directions."""

    def __init__(self, unit, clock, baud=9600, timeout=0.01):
        self.unit, self._clock, self._byte_s, self._timeout = unit, clock, 10 / baud, timeout
        self._coming = deque()  # (time, byte)
        self.sent = []  # (time, bytes)
        self.latency = 0.0  # of the unit's answers [s]
        self.broken = None  # what every call raises
        self.closed = False

    def inject(self, data, after=0.0):
        """Let bytes come in."""
        t = max(self._clock.now() + after, self._coming[-1][0] if self._coming else 0.0)
        for byte in data:
            t += self._byte_s
            self._coming.append((t, byte))

    @property
    def in_waiting(self):
        if self.broken:
            raise OSError(5, "Input/output error")
        now = self._clock.now()
        return sum(1 for _ in itertools.takewhile(lambda byte: byte[0] <= now, self._coming))

    def read(self, size=1):
        if self.broken:
            raise self.broken
        if not self.in_waiting:
            soon = self._coming[0][0] if self._coming else float("inf")
            self._clock.sleep_until(min(soon, self._clock.now() + self._timeout))
        return bytes(self._coming.popleft()[1] for _ in range(min(size, self.in_waiting)))

    def write(self, data):
        if self.broken:
            raise self.broken
        self.sent.append((self._clock.now(), data))
        # The unit acts when the delimiter is there; the driver sees that time only through the answer's.
        was = self._clock.t
        self._clock.t = was + len(data) * self._byte_s
        reply = self.unit.receive(data)
        self._clock.t = was
        self.inject(reply, len(data) * self._byte_s + self.latency)
        return len(data)

    def close(self):
        self.closed = True


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
        self.loop.requests.moves.append(move)
        return move

    def orders(self):
        """Commands since the last look, without polls."""
        heard = [order for order in self.unit.heard if order not in ("PP", "TP")]
        self.unit.heard.clear()
        return heard

    def halt(self):
        wish = Halt(next(self.numbers))
        self.loop.requests.halts.append(wish)
        return wish
