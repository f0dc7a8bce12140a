"""The emulated PTU-D46 against the manuals and published drivers.

Most of it runs in simulated time; expectations are the sentences of the manuals and hand-worked moves.
"""

import math
import time

import pytest
import serial

from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import Wire
from cotarget.emulators.ptu_d46.unit import D46_STOCK, UnitProfile
from cotarget.emulators.serve import Faults
from cotarget.errors import ConfigError
from tests.support.plants import AxisModel, LiveUnit, wait_for

STEP_S = 1e-3  # of simulated time
LONG_S = 60.0  # of simulated time: more than a reset of the D46 takes
SOON_S = 0.02  # of simulated time: by how much moves may be off what was worked by hand


class Bench:
    """A unit in simulated time."""

    def __init__(self, unit=D46_STOCK, terse=True):
        self.t = 0.0
        self.pan, self.tilt = AxisModel(lambda: self.t), AxisModel(lambda: self.t)
        self.faults = Faults(D46_FAULTS)
        self.unit = D46(self.pan, self.tilt, unit, self.faults, lambda: self.t)
        if terse:
            self.talk(("ED ", "ED *|"), ("FT ", "*|"))

    def __call__(self, text):
        """Send, and give what comes back at once."""
        self.unit.receive(text.encode("latin-1"))
        return self.unit.output().decode("latin-1")

    def run(self, seconds):
        """Give what comes within a time."""
        said, until = "", self.t + seconds
        while self.t < until:
            self.t += STEP_S
            said += self.unit.output().decode("latin-1")
        return said

    def wait(self, text, end="\r\n"):
        """Send, and give what comes up to an end, and how long that took."""
        said, start = self(text), self.t
        while not said.endswith(end):
            assert self.t < start + LONG_S, said
            said += self.run(STEP_S)
        return said, self.t - start

    def talk(self, *exchanges):
        """Check exchanges, in which | stands for the end of a line.

        Each is (text, reply at once), (seconds, what comes within that time), or (text, reply, seconds until then).
        """
        for sent, reply, *took in exchanges:
            reply = reply.replace("|", "\r\n")
            if took:
                assert self.wait(sent, reply[-3:]) == (reply, pytest.approx(took[0], abs=SOON_S)), sent
            else:
                assert (self.run(sent) if isinstance(sent, float) else self(sent)) == reply, sent


@pytest.fixture
def bench():
    return Bench()


# Queries with their sentences of S1, S2 and published drivers, and their terse answers.
@pytest.mark.parametrize(
    ("query", "verbose", "terse"),
    [
        ("PP", "Current Pan position is 0", "0"),
        ("TP", "Current Tilt position is 0", "0"),
        ("PO", "Target Pan position is 0", "0"),
        ("PS", "Target Pan speed is 1000 positions/sec", "1000"),
        ("PA", "Pan acceleration is 2000 positions/sec^2", "2000"),
        ("PU", "Maximum Pan speed is 2902 positions/sec", "2902"),
        ("TL", "Minimum Tilt speed is 31 positions/sec", "31"),
        ("PN", "Minimum Pan position is -3090", "-3090"),
        ("PX", "Maximum Pan position is 3090", "3090"),
        ("TN", "Minimum Tilt position is -907", "-907"),
        ("TX", "Maximum Tilt position is 604", "604"),
        ("PR", "185.1428 seconds arc per position", "185.1428"),
        ("U", "Unit ID is 0", "0"),
        ("WP", "Pan axis is in HALF step mode", "H"),
        ("C", "independent control mode", "independent control mode"),
        ("V", D46_STOCK.title, D46_STOCK.title),
    ],
)
def test_queries(bench, query, verbose, terse):
    bench.talk((f"{query} ", f"* {terse}|"), ("FV ", "*|"), (f"{query} ", f"* {verbose}|"))


ILLEGAL = "! Illegal argument|"
DIALOGUES = {
    "delimiters": [("pP ", "* 0|"), ("PP\r", "* 0|"), ("PP\n", "* 0|"), ("PP\r\n", "* 0|"), ("\r\n", ""), (" ", "")],
    "nonsense": [
        *((f"{text} ", ILLEGAL) for text in ("PPx", "PP--1", "PP1.5", "é", "PP9999999999", "\x00\xff", "*", "!", "W")),
        ("P" * 500 + " ", ILLEGAL),
        ("P P ", ILLEGAL * 2),
        ("PP ", "* 0|"),
    ],
    "a move takes the time that its speeds say": [  # 1000 a second, without a ramp up to the base speed
        ("PP1000 ", "*|"),
        ("PO ", "* 1000|"),
        (0.5, ""),
        ("PP TP100 ", "* 500|*|"),
        ("A ", "*|", 0.5),
        ("PP TP ", "* 1000|* 100|"),
    ],
    # At 2000 a second and 2000/s^2: a second and 1000 steps on either ramp.
    "moves above the base speed have ramps": [("PS2000 PP3000 ", "*|*|"), ("A ", "*|", 2.5)],
    "moves change on the fly": [
        ("PP1000 ", "*|"),
        (0.3, ""),
        ("PP0 PO ", "*|* 0|"),
        ("A ", "*|", 0.3),
        ("PP1000 ", "*|"),
        (0.5, ""),
        ("PS100 ", "*|"),
        ("A ", "*|", 5.0),
        ("PO-250 TO30 ", "*|*|"),
        ("A ", "*|", 2.5),
        ("PP TP ", "* 750|* 30|"),
    ],
    "offsets are from the present position": [("PP1000 ", "*|"), (0.5, ""), ("PO100 PO ", "*|* 600|")],
    "speeds have bounds": [
        ("PS2903 ", "! Pan speed cannot exceed 2902 positions/sec|"),
        ("TS30 ", "! Motor speed cannot be less than 31 pos/sec|"),
        ("PS2902 TS31 PS TS ", "*|*|* 2902|* 31|"),
    ],
    "positions beyond the limits are refused": [
        ("PP3091 ", "! Maximum allowable Pan position is 3090|"),
        ("TP-908 ", "! Minimum allowable Tilt position is -907|"),
        ("TO605 ", "! Maximum allowable Tilt position is 604|"),
        ("PO ", "* 0|"),
        ("TP604 ", "*|"),
    ],
    "characters wait while the unit is busy": [
        ("PP500 ", "*|"),
        ("A PP H ", ""),
        (0.49, ""),
        (0.02, "*|* 500|*|"),
    ],
    "halt": [
        ("PP3000 TP500 ", "*|*|"),
        (0.2, ""),
        ("H ", "*|"),
        (0.1, ""),
        ("PP TP PO TO ", "* 200|* 200|* 200|* 200|"),
        ("A ", "*|", 0.0),
    ],
    "what neither driver nor known program sends": [
        (f"{text} ", ILLEGAL) for text in ("PA500", "PD100", "PNU", "PHL", "HP", "LD", "S", "CV", "DF", "RE", "U5", "@")
    ],
    "modes that it is in already": [("I CI ", "*|*|")],
}


@pytest.mark.parametrize("dialogue", DIALOGUES.values(), ids=DIALOGUES)
def test_dialogues_of_a_stock_unit(bench, dialogue):
    bench.talk(*dialogue)


def test_at_power_up_it_echoes_and_is_verbose():
    bench = Bench(terse=False)
    bench.talk(
        ("PP ", "PP * Current Pan position is 0|"),
        ("E ", "E * Echoing ON|"),
        ("F ", "F * ASCII verbose mode|"),
        ("ED ", "ED *|"),  # still echoed
        ("pp E FT PP F EE ", "* Current Pan position is 0|* Echoing OFF|*|* 0|* ASCII terse mode|*|"),
        ("TP\r", "TP\r* 0|"),
        ("PP700 ED ", "PP700 *|ED *|"),
        (1.0, ""),
    )


def test_a_reset_runs_into_the_stops_and_finds_the_limits(bench):
    bench.faults.set("limit-hit")
    bench.talk(("PP-1000 ", "*|"), (0.1, "!P"))
    said, took = bench.wait("R ", "*\r\n")
    assert said == "!T!T!P!P*\r\n"
    assert took > 2 * (3120 + 3120) / 1000  # to one stop of pan, to the other, and back
    bench.talk(("PP TP PN PX ", "* 0|* 0|* -3090|* 3090|"))
    assert (bench.pan.position(), bench.tilt.position()) == (0, 0)
    assert (bench.pan.furthest, bench.tilt.furthest) == (3090 + D46_STOCK.stop_margin, 907 + D46_STOCK.stop_margin)


def test_a_profile_from_degrees():
    unit = UnitProfile.from_degrees((-180, 180), (-80, 30), 0.0514286, 100, 200)
    # 180 / 0.0514286 = 3499.998, 80 / 0.0514286 = 1555.555, 30 / 0.0514286 = 583.33
    assert (unit.pan, unit.tilt) == ((-3500, 3500), (-1555, 583))
    # 1944.44 a second, 3888.9 a second squared: half a second and 486 steps up, the same down, 28 steps between.
    Bench(unit).talk(("PR PU PA ", "* 185.142960|* 1944|* 3889|"), ("PP1000 ", "*|"), ("A ", "*|", 1.0 + 28 / 1944))
    for step in (0, -0.1, 1e-9, math.nan):
        with pytest.raises(ConfigError, match="step"):
            UnitProfile.from_degrees((-180, 180), (-80, 30), step, 100, 200)


# Each fault: exchanges before it is on, while it is, and after.
FAULTS = {
    "silence": ([], [("PP500 PP ", ""), (0.1, ""), ("H ", ""), (0.1, "")], [("PP ", "* 100|")]),
    "half-replies": ([], [("PP ", "* ")], [("PP ", "* 0|")]),
    "late-replies": ([], [("PP ", "")], [("TP100 ", ""), (1.45, ""), (0.1, "* 0|*|")]),  # in order
    "unplugged": ([], [("PP100 ", "")], [("PO ", "* 0|")]),
    "error-replies": (  # which spare the halt
        [("PP1000 ", "*|")],
        [("PP0 PP ", ILLEGAL * 2), ("H ", "*|")],
        [("A ", "*|", 0.0)],
    ),
    "power-cycle": (
        [("PP1000 ", "*|"), (0.3, "")],
        [(D46_STOCK.boot_s + 0.1, f"|{D46_STOCK.title}|*|")],
        [
            ("ED FT ", "ED *|*|"),
            ("PP PN PX TN TX ", "* 0|" * 5),
            ("PP1 ", "! Maximum allowable Pan position is 0|"),
            ("TP-1 ", "! Minimum allowable Tilt position is 0|"),
        ],
    ),
    "limit-hit": (  # not while it stands; eight steps are lost
        [],
        [(0.1, ""), ("PP-1000 ", "*|"), (0.1, "!P")],
        [("PO PP ", "* -9|* -9|"), ("PP100 ", "*|"), (1.0, "")],
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults(bench, fault):
    before, during, after = FAULTS[fault]
    bench.talk(*before)
    bench.faults.set(fault)
    bench.talk(*during)
    bench.faults.set(fault, False)
    bench.talk(*after)


class TestWire:
    """Pacing, in simulated time."""

    def test_a_query_takes_ten_bits_a_byte_each_way(self, bench):
        wire = Wire(bench.unit)
        wire.feed(b"PP ", bench.t)
        heard = []
        while len(heard) < 5:
            bench.t = wire.due()
            heard += [(bench.t, byte) for byte in wire.step(bench.t)]
        assert bytes(byte for _, byte in heard) == b"* 0\r\n"
        assert [t for t, _ in heard] == pytest.approx([n / 960 for n in range(4, 9)])


# In real time

TILT_QUERY, TILT_REPLY = b"TP ", b"TP * Current Tilt position is 0\r\n"


def ask(port, text, end=b"\n"):
    port.write(text)
    return port.read_until(end)


def answers(live, tcp):
    """Whether a new client gets an answer."""
    try:
        with live.open(tcp) as port:
            return ask(port, TILT_QUERY) == TILT_REPLY
    except (serial.SerialException, OSError):
        return False


@pytest.mark.wire
@pytest.mark.parametrize("tcp", [False, True])
class TestPorts:
    def test_unplugged_and_replugged(self, tcp):
        with LiveUnit() as live:
            with live.open(tcp) as port:
                assert ask(port, b"PP ")
                live.faults.set("unplugged")
                wait_for(lambda: live.ports.port == "")
                with pytest.raises((serial.SerialException, OSError)):
                    port.read()
            assert not answers(live, tcp)
            live.faults.set("unplugged", False)
            wait_for(lambda: answers(live, tcp))

    def test_the_line_takes_its_time(self, tcp):
        """Pairs of queries are no faster than on a real line; how much slower depends on the machine."""
        with LiveUnit() as live, live.open(tcp) as port:
            ask(port, b"ED "), ask(port, b"FT ")
            pairs, start = 10, time.monotonic()
            sent = sum(3 + len(ask(port, query)) for _ in range(pairs) for query in (b"PP ", b"TP "))
            took = time.monotonic() - start
        assert sent == pairs * 16
        assert took >= sent / 960


@pytest.mark.wire
def test_a_second_client_replaces_the_first():
    with LiveUnit() as live, live.open(tcp=True) as first:
        assert ask(first, b"PP ")
        with live.open(tcp=True) as second:
            assert ask(second, TILT_QUERY) == TILT_REPLY
            with pytest.raises(serial.SerialException):
                first.read()
