"""The emulated PTU-D46 against the manuals and published drivers.

Most of it runs in simulated time; expectations are the sentences of the manuals and hand-worked moves.
"""

import math
import socket
import time
from dataclasses import replace

import pytest
import serial

from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.ports import Wire
from cotarget.emulators.ptu_d46.unit import D46_PAPER, D46_STOCK, UnitProfile
from cotarget.emulators.serve import Faults
from cotarget.errors import ConfigError
from tests.support.emulated_camera import DEADLINE_S
from tests.support.plants import AxisModel, LiveUnit, wait_for
from tests.support.units import E_SERIES

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
@pytest.mark.parametrize(("query", "verbose", "terse"), [
    ("PP", "Current Pan position is 0", "0"), ("TP", "Current Tilt position is 0", "0"),
    ("PS", "Target Pan speed is 1000 positions/sec", "1000"), ("TD", "Current Tilt speed is 0 positions/sec", "0"),
    ("PA", "Pan acceleration is 2000 positions/sec^2", "2000"),
    ("PB", "Current Pan base speed is 1000 positions/sec", "1000"),
    ("PU", "Maximum Pan speed is 2902 positions/sec", "2902"), ("TL", "Minimum Tilt speed is 31 positions/sec", "31"),
    ("PN", "Minimum Pan position is -3090", "-3090"), ("PX", "Maximum Pan position is 3090", "3090"),
    ("TN", "Minimum Tilt position is -907", "-907"), ("TX", "Maximum Tilt position is 604", "604"),
    ("PNU", "Minimum user defined Pan Position is -3090", "-3090"),
    ("PR", "185.1428 seconds arc per position", "185.1428"),
    ("L", "Limit bounds are ENABLED (soft limits enabled)", "Limit bounds are ENABLED (soft limits enabled)"),
    ("PH", "Pan in REGULAR hold power mode", "REGULAR"), ("TM", "Tilt in REGULAR move power mode", "REGULAR"),
    ("O", "Input 30 VDC @ 86 degF", "Input 30 VDC @ 86 degF"), ("U", "Unit ID is 0", "0"),
    ("WP", "Pan axis is in HALF step mode", "H"), ("V", D46_STOCK.title, D46_STOCK.title),
])  # fmt: skip
def test_queries(bench, query, verbose, terse):
    bench.talk((f"{query} ", f"* {terse}|"), ("FV ", "*|"), (f"{query} ", f"* {verbose}|"))


# What the sources disagree on: unit, and what it says in verbose and in terse mode.
@pytest.mark.parametrize(
    ("unit", "query", "verbose", "terse"),
    [
        (D46_STOCK, "PO", "Current Pan position is 0", "0"),  # S2
        (D46_PAPER, "PO", "Target Pan position is 0", "0"),  # drivers
        (D46_PAPER, "TR", "185.1428 seconds arc per Tilt position", "185.1428"),  # CARMEN
        (D46_PAPER, "PA", "Pan acceleration is 2000 positions/sec/sec", "2000"),  # no more digits for ASR's parser
        (E_SERIES, "PS", "Desired Pan speed is 8000 positions/sec", "8000"),
        (E_SERIES, "PH", "Pan in REGULAR hold power mode", "REG"),
        (E_SERIES, "C", "PTU is in Independent Mode", "Independent speed control mode"),
        # Player and ROS look at the third character in terse mode, ASR for the word in verbose mode.
        (D46_STOCK, "C", "independent control mode", "independent control mode"),
        (D46_PAPER, "C", "PTU is in independent control mode", "independent"),
        (E_SERIES, "CV C", "|* PTU is in Pure Velocity Mode", "|* Pure Velocity speed control mode"),
        (D46_PAPER, "CV C", "|* PTU is in pure velocity control mode", "|* pure velocity"),
    ],
)
def test_wordings(unit, query, verbose, terse):
    for mode, answer in (("FV ", verbose), ("FT ", terse)):
        Bench(unit).talk((mode, "*|"), (f"{query} ", f"* {answer}|".replace("* |", "*|")))


ILLEGAL = "! Illegal argument|"
DIALOGUES = {
    "delimiters": [("pP ", "* 0|"), ("PP\r", "* 0|"), ("PP\n", "* 0|"), ("PP\r\n", "* 0|"), ("\r\n", ""), (" ", "")],
    "nonsense": [
        *((f"{text} ", ILLEGAL) for text in ("PPx", "PP--1", "PP1.5", "é", "PP9999999999", "\x00\xff", "*", "!", "W")),
        ("P" * 500 + " ", ILLEGAL), ("P P ", ILLEGAL * 2), ("PP ", "* 0|"),
    ],
    "a move takes the time that its speeds say": [  # 1000 a second, without a ramp up to the base speed
        ("PP1000 ", "*|"), ("PO ", "* 1000|"), (0.5, ""), ("PP PD TP100 ", "* 500|* 1000|*|"), ("A ", "*|", 0.5),
        ("PP TP ", "* 1000|* 100|"),
    ],
    # At 2000 a second and 2000/s^2: a second and 1000 steps on either ramp.
    "moves above the base speed have ramps": [("PS2000 PP3000 ", "*|*|"), ("A ", "*|", 2.5)],
    "moves change on the fly": [
        ("PP1000 ", "*|"), (0.3, ""), ("PP0 PO ", "*|* 0|"), ("A ", "*|", 0.3), ("PP1000 ", "*|"), (0.5, ""),
        ("PS100 ", "*|"), ("A ", "*|", 5.0), ("PO-250 TO30 ", "*|*|"), ("A ", "*|", 2.5), ("PP TP ", "* 750|* 30|"),
    ],
    "offsets are from the present position": [("PP1000 ", "*|"), (0.5, ""), ("PO100 PO ", "*|* 600|")],
    "speeds have bounds": [
        ("PS2903 ", "! Pan speed cannot exceed 2902 positions/sec|"),
        ("TS30 ", "! Motor speed cannot be less than 31 pos/sec|"), ("PU500 ", "*|", D46_STOCK.tables_s),
        ("PU PS ", "* 500|* 500|"), ("PS501 ", "! Pan speed cannot exceed 500 positions/sec|"),
        ("PA0 PB501 PB-1 PL501 PU30 PU6001 ", ILLEGAL * 6), ("PL50 ", "*|", D46_STOCK.tables_s),
        ("PB0 ", "*|", D46_STOCK.tables_s), ("PL PB ", "* 50|* 0|"),
    ],
    "acceleration is not set on the fly": [
        ("PP1000 ", "*|"), ("PA4000 ", "*|", 1.0 + D46_STOCK.tables_s), ("PA ", "* 4000|"),
    ],
    "positions beyond the limits are refused": [
        ("PP3091 ", "! Maximum allowable Pan position is 3090|"),
        ("TP-908 ", "! Minimum allowable Tilt position is -907|"),
        ("TO605 ", "! Maximum allowable Tilt position is 604|"), ("PO ", "* 0|"), ("TP604 ", "*|"),
    ],
    "user limits": [
        ("PNU-1000 PXU1500 PNU4000 ", "*|*|! Maximum allowable Pan position is 3090|"), ("PP2000 PP0 LU ", "*|*|*|"),
        ("L ", "* Limit user defined bounds are enabled|"), ("PP2000 ", "! Maximum allowable Pan position is 1500|"),
        ("PP-1001 ", "! Minimum allowable Pan position is -1000|"), ("PX PXU ", "* 3090|* 1500|"),
    ],
    "hits are reported before the star of await": [("LD PP1000 TP700 ", "*|*|*|"), ("A ", "!T*|", 1.0)],
    "characters wait while the unit is busy": [("PP500 ", "*|"), ("A PP H ", ""), (0.49, ""), (0.02, "*|* 500|*|")],
    "halt": [
        ("PP3000 TP500 ", "*|*|"), (0.2, ""), ("HP ", "*|"), (0.1, ""), ("PP PD TD ", "* 200|* 0|* 1000|"),
        ("H ", "*|"), (0.1, ""), ("TP PO TO ", "* 300|* 200|* 300|"), ("A ", "*|", 0.0),
        ("S PP900 H A PO ", "*|*|*|*|* 200|"),  # a position that waits is dropped
    ],
    "slaved positions wait for await or immediate": [  # the example in the manual
        ("S PP1500 TP-900 PP TP ", "*|*|*|* 0|* 0|"), (1.0, ""), ("PP PO ", "* 0|* 1500|"), ("A ", "*|", 1.5),
        ("PP TP ", "* 1500|* -900|"), ("PP0 ", "*|"), (0.1, ""), ("PP I ", "* 1500|*|"), (1.0, ""), ("PP ", "* 500|"),
    ],
    "pure velocity mode drives to the limits": [
        ("CV PS-1000 ", "*|*|"), (1.0, ""), ("PP PS PD ", "* -1000|* -1000|* -1000|"), ("PS500 ", "*|"), (1.0, ""),
        ("PP ", "* -500|"), ("PS0 PS ", "*|* 0|"), (0.1, ""),
        ("PD PS10 ", "* 0|! Motor speed cannot be less than 31 pos/sec|"),
        ("PS-3000 PP5 ", "! Pan speed cannot exceed 2902 positions/sec|" + ILLEGAL), ("TS-1000 ", "*|"), (1.0, ""),
        ("TP TD ", "* -907|* 0|"),  # stands at the limit, without a hit
        ("LD TS-100 ", "*|*|"), (1.0, "!T"), ("CI PS C ", "*|* 1000|* independent control mode|"),
    ],
    "back from an expansion port": [("@ ", "*|"), ("PP ", "* 0|")],  # with which AriaCoda begins
}  # fmt: skip


@pytest.mark.parametrize("dialogue", DIALOGUES.values(), ids=DIALOGUES)
def test_dialogues_of_a_stock_unit(bench, dialogue):
    bench.talk(*dialogue)


@pytest.mark.parametrize(
    ("unit", "dialogue"),
    [
        (  # the delimiter CR yields a leading line feed
            replace(E_SERIES, halt_waits=False),
            [
                ("H\r", "\n*|"),
                ("PR\r", "\n* 23.142857|"),
                ("ZZ\r", "\n! Illegal Command Entered|"),
                ("H ", "*|"),
                ("@(115200,0,F) ", "*|"),
            ],
        ),
        # From 8000 a second at 16000/s^2.
        (E_SERIES, [("PP20000 ", "*|"), (2.0, ""), ("H ", "*|", 0.5), ("PD ", "* 0|")]),
        (D46_PAPER, [(f"{command} ", ILLEGAL) for command in ("PNU", "LU")]),  # later than its firmware
        (D46_PAPER, [("PN PX TN TX ", "* -3500|* 3500|* -1555|* 583|"), ("PA0 ", "! Value out of range|")]),
        (D46_PAPER, [("PS1986 ", "! Pan speed cannot exceed 1985 pos/sec|")]),
    ],
)
def test_dialogues_of_other_units(unit, dialogue):
    Bench(unit).talk(*dialogue)


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
    bench.unit.power_on()
    assert bench.wait("", "*\r\n")[0] == f"\r\n{D46_STOCK.title}\r\n!T!T!P!P*\r\n"
    bench.talk(("PP ", "PP * Current Pan position is 0|"))
    assert bench.pan.position() == 0


def test_without_limits_it_runs_into_its_stop_and_loses_steps(bench):
    bench.talk(
        ("LD L ", "*|* Limit bounds are DISABLED (hard limits only: use care)|"),
        ("TP700 ", "*|"),
        (1.0, "!T"),
        ("TP ", "* 642|"),  # eight steps were lost
    )
    assert bench.tilt.furthest == bench.tilt.position() == 604 + D46_STOCK.stop_margin
    said, took = bench.wait("R ", "*\r\n")
    assert said == "!T!T!P!P*\r\n"
    assert took > 2 * (3120 + 3120) / 1000  # to one stop of pan, to the other, and back
    bench.talk(("PP TP ", "* 0|* 0|"))
    assert (bench.pan.position(), bench.tilt.position(), bench.pan.furthest) == (0, 0, 3120)


@pytest.mark.parametrize(
    ("unit", "commands", "said"),
    [
        (D46_STOCK, "RP R ", "*|!P!P*|"),  # the D46 only selects
        (D46_STOCK, "RT R ", "*|!T!T*|"),
        (D46_STOCK, "RD R ", "*|*|"),
        (D46_STOCK, "RE R ", "*|!T!T!P!P*|"),
        (E_SERIES, "RP ", "!P!P*|"),  # the E-series resets at once
        (E_SERIES, "RD R ", "*|*|"),
    ],
)
def test_reset_of_selected_axes(unit, commands, said):
    bench, wanted = Bench(unit), said.replace("|", "\r\n")
    found = bench(commands)
    while len(found) < len(wanted):
        found += bench.run(0.1)
    assert found == wanted


def test_the_line_can_be_set(bench):
    bench.talk(("@(19200,0,F) ", "*|"))
    assert bench.unit.baud == 19200
    for wrong in ("(9601,0,F)", "(9600,5,F)", "(9600,1001,T)", "(115200,0,F)", "(9600,0,X)"):
        bench.talk((f"@{wrong} ", ILLEGAL))
    bench.talk(("@(600,20,T) ", "*|"))
    assert (bench.unit.baud, bench.unit.byte_delay_s) == (600, 0.02)
    bench.unit.power_on(calibrate=False)
    assert (bench.unit.baud, bench.unit.byte_delay_s) == (600, 0.0)


def test_a_profile_from_degrees():
    unit = UnitProfile.from_degrees((-180, 180), (-80, 30), 0.0514286, 100, 200)
    # 180 / 0.0514286 = 3499.998, 80 / 0.0514286 = 1555.555, 30 / 0.0514286 = 583.33
    assert (unit.pan, unit.tilt) == ((-3500, 3500), (-1555, 583))
    # 1944.44 a second, 3888.9 a second squared: half a second and 486 steps up, the same down, 28 steps between.
    Bench(unit).talk(
        ("PR PU PA PB ", "* 185.142960|* 1944|* 3889|* 0|"), ("PP1000 ", "*|"), ("A ", "*|", 1.0 + 28 / 1944)
    )
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
        [(0.1, ""), ("PD ", "* 0|")],
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
        [("PD PO PP ", "* 0|* -9|* -9|"), ("PP100 ", "*|"), (1.0, "")],
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


def test_an_uncalibrated_e_series():
    bench = Bench(E_SERIES)
    bench.faults.set("power-cycle")
    bench.run(E_SERIES.boot_s + 0.1)
    bench.talk(("ED PP5 ", "ED *|! Axis Error|"))


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

    def test_a_new_baud_holds_after_the_reply(self, bench):
        wire = Wire(bench.unit)
        wire.feed(b"@(600,10,F) ", bench.t)
        bench.t = 15.5 / 960
        assert wire.step(bench.t, 9600) == b""  # the reply has its byte delay already, as the command asked
        bench.t += 3 * (0.01 + 1 / 960)
        assert wire.step(bench.t, 9600) == b"*\r\n"
        wire.feed(b"PP ", bench.t, 600)
        bench.t += 8 / 60 + 5 * 0.01 + STEP_S
        assert wire.step(bench.t, 600) == b"* 0\r\n"

    def test_another_baud_is_noise_both_ways(self, bench):
        wire = Wire(bench.unit)
        wire.feed(b"PP1000 ", bench.t, 19200)
        bench.t = 1.0
        wire.step(bench.t, 19200)
        assert bench.pan.position() == 0
        assert not bench.pan.moving()
        wire.feed(b"\rPP ", bench.t, 9600)
        bench.t += 1.0
        heard = wire.step(bench.t, 19200)
        assert len(heard) >= len("* 0\r\n")
        assert b"* 0" not in heard


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
        with LiveUnit(tcp=0) as live:
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
        with LiveUnit(tcp=0) as live, live.open(tcp) as port:
            ask(port, b"ED "), ask(port, b"FT ")
            pairs, start = 10, time.monotonic()
            sent = sum(3 + len(ask(port, query)) for _ in range(pairs) for query in (b"PP ", b"TP "))
            took = time.monotonic() - start
        assert sent == pairs * 16
        assert took >= sent / 960


@pytest.mark.wire
def test_a_client_follows_the_unit_to_another_baud():
    with LiveUnit() as live, live.open() as port:
        assert ask(port, b"@(19200,0,T) ", b"*\r\n").endswith(b"*\r\n")
        port.baudrate = 19200
        assert ask(port, TILT_QUERY) == TILT_REPLY


@pytest.mark.wire
def test_an_e_series_greets_on_tcp():
    with LiveUnit(E_SERIES, serial=False, tcp=0) as live:
        # pyserial would throw away what comes as it connects.
        host, port = live.ports.url.removeprefix("socket://").split(":")
        with socket.create_connection((host, int(port)), DEADLINE_S) as client:
            said = b""
            while not said.endswith(b"*\r\n"):
                said += client.recv(100)
    assert b"PAN-TILT" in said


@pytest.mark.wire
def test_a_second_client_replaces_the_first():
    with LiveUnit(tcp=0) as live, live.open(tcp=True) as first:
        assert ask(first, b"PP ")
        with live.open(tcp=True) as second:
            assert ask(second, TILT_QUERY) == TILT_REPLY
            with pytest.raises(serial.SerialException):
                first.read()
