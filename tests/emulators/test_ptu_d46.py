"""The emulated PTU-D46 against what the manuals and published drivers tell of real units.

Most of it runs in simulated time; expectations are the sentences of the manuals and hand-worked moves.
"""

import math
import random
import socket
import threading
import time
from dataclasses import replace

import pytest
import serial

from cotarget.emulators.faults import Faults
from cotarget.emulators.ptu_d46.firmware import D46, D46_FAULTS
from cotarget.emulators.ptu_d46.unit import D46_PAPER, D46_STOCK, E_SERIES, UnitProfile, plain_acceleration
from cotarget.emulators.serve import SerialLine, TcpLine, Wire
from cotarget.errors import ConfigError, DeviceError
from cotarget.sim.motion import Axis

STEP_S = 1e-3  # of simulated time
LONG_S = 60.0  # of simulated time: more than a reset of the D46 takes
DEADLINE_S = 10.0  # of real time: a loaded machine has reached it only if something hangs


class SteppedPlant:
    """An axis in simulated or real time, with the simulation's trapezoids; `t` gives the time."""

    def __init__(self, t):
        self.t, self.axis, self.rest, self.furthest = t, Axis(1e6, 1.0), -math.inf, 0.0
        self.lock = threading.Lock()

    def command(self, goal, speed, acceleration):
        with self.lock:
            self.axis.acceleration = acceleration
            self.rest = self.axis.command(self.t(), goal, speed)
            self.furthest = max(self.furthest, abs(goal))

    def halt(self, acceleration):
        with self.lock:
            self.axis.acceleration = acceleration
            self.rest = self.axis.halt(self.t())

    def position(self):
        with self.lock:
            return round(self.axis.motor(self.t())[0])

    def speed(self):
        with self.lock:
            return self.axis.motor(self.t())[1]

    def moving(self):
        with self.lock:
            return self.t() < self.rest


class Bench:
    """A unit in simulated time."""

    def __init__(self, unit=D46_STOCK, terse=True):
        self.t = 0.0
        self.pan, self.tilt = SteppedPlant(lambda: self.t), SteppedPlant(lambda: self.t)
        self.faults = Faults(D46_FAULTS)
        self.unit = D46(self.pan, self.tilt, unit, self.faults, lambda: self.t)
        if terse:
            assert self("ED ") == "ED *\r\n"
            assert self("FT ") == "*\r\n"

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

    def wait(self, text, end="\r\n", longest=LONG_S):
        """Send, and give what comes up to an end, and how long that took."""
        said, start = self(text), self.t
        while not said.endswith(end):
            assert self.t < start + longest, said
            said += self.run(STEP_S)
        return said, self.t - start


@pytest.fixture
def bench():
    return Bench()


def test_at_power_up_it_echoes_and_speaks_in_sentences():
    bench = Bench(terse=False)
    assert bench("PP ") == "PP * Current Pan position is 0\r\n"
    assert bench("E ") == "E * Echoing ON\r\n"
    assert bench("F ") == "F * ASCII verbose mode\r\n"
    assert bench("ED ") == "ED *\r\n"  # still echoed
    assert bench("pp ") == "* Current Pan position is 0\r\n"
    assert bench("E ") == "* Echoing OFF\r\n"
    assert bench("FT ") == "*\r\n"
    assert bench("PP ") == "* 0\r\n"
    assert bench("F ") == "* ASCII terse mode\r\n"
    assert bench("EE ") == "*\r\n"
    assert bench("TP\r") == "TP\r* 0\r\n"


@pytest.mark.parametrize("delimiter", [" ", "\r", "\n", "\r\n"])
def test_delimiters(bench, delimiter):
    assert bench(f"pP{delimiter}") == "* 0\r\n"
    assert bench(delimiter) == ""
    assert bench(f"P{delimiter}P{delimiter}").count("! Illegal argument\r\n") == 2


def test_the_delimiter_cr_yields_a_leading_line_feed_on_an_e_series():
    bench = Bench(replace(E_SERIES, halt_waits=False))
    assert bench("H\r") == "\n*\r\n"
    assert bench("PR\r") == "\n* 23.142857\r\n"
    assert bench("ZZ\r") == "\n! Illegal Command Entered\r\n"
    assert bench("H ") == "*\r\n"
    assert bench.wait("RT\r") == ("\n!T!T*\r\n", pytest.approx(6.0, abs=2.0))


# The sentences of S1, S2 and of published drivers; a number for terse mode.
SENTENCES = [
    ("PP", "Current Pan position is 0", "0"),
    ("TP", "Current Tilt position is 0", "0"),
    ("PS", "Target Pan speed is 1000 positions/sec", "1000"),
    ("TD", "Current Tilt speed is 0 positions/sec", "0"),
    ("PA", "Pan acceleration is 2000 positions/sec^2", "2000"),
    ("PB", "Current Pan base speed is 1000 positions/sec", "1000"),
    ("PU", "Maximum Pan speed is 2902 positions/sec", "2902"),
    ("TL", "Minimum Tilt speed is 31 positions/sec", "31"),
    ("PN", "Minimum Pan position is -3090", "-3090"),
    ("PX", "Maximum Pan position is 3090", "3090"),
    ("TN", "Minimum Tilt position is -907", "-907"),
    ("TX", "Maximum Tilt position is 604", "604"),
    ("PNU", "Minimum user defined Pan Position is -3090", "-3090"),
    ("PR", "185.1428 seconds arc per position", "185.1428"),
    ("L", "Limit bounds are ENABLED (soft limits enabled)", "Limit bounds are ENABLED (soft limits enabled)"),
    ("PH", "Pan in REGULAR hold power mode", "REGULAR"),
    ("TM", "Tilt in REGULAR move power mode", "REGULAR"),
    ("O", "Input 30 VDC @ 86 degF", "Input 30 VDC @ 86 degF"),
    ("U", "Unit ID is 0", "0"),
    ("WP", "Pan axis is in HALF step mode", "H"),
]


@pytest.mark.parametrize(("query", "verbose", "terse"), SENTENCES)
def test_queries(bench, query, verbose, terse):
    assert bench(f"{query} ") == f"* {terse}\r\n"
    assert bench("FV ") == "*\r\n"
    assert bench(f"{query} ") == f"* {verbose}\r\n"


def test_wordings_that_the_sources_disagree_on():
    stock, paper, e_series = (Bench(unit) for unit in (D46_STOCK, D46_PAPER, E_SERIES))
    for bench in (stock, paper, e_series):
        bench("FV ")
    assert stock("PO ") == "* Current Pan position is 0\r\n"  # S2
    assert paper("PO ") == "* Target Pan position is 0\r\n"  # drivers
    assert paper("TR ") == "* 185.1428 seconds arc per Tilt position\r\n"  # CARMEN
    assert e_series("PS ") == "* Desired Pan speed is 8000 positions/sec\r\n"
    assert not any(c.isdigit() for c in paper("PA ").split("2000")[1])  # as ASR's parser needs
    # Player and ROS look at the third character in terse mode, ASR for the word in verbose mode.
    for bench in (stock, paper):
        assert "independent" in bench("C ")
        assert bench("FT C ").split("*\r\n")[1][2] == "i"
        assert bench("CV C ").split("*\r\n")[1][2] == "p"
    assert e_series("C ") == "* PTU is in Independent Mode\r\n"
    assert e_series("FT C ") == "*\r\n* Independent speed control mode\r\n"
    assert e_series("CV C ") == "*\r\n* Pure Velocity speed control mode\r\n"
    assert e_series("PH ") == "* REG\r\n"


def test_commands_of_a_later_firmware_are_unknown_to_an_older_one():
    old, new = Bench(D46_PAPER), Bench(D46_STOCK)
    for command in ("WPA", "PNU", "LU", "XS1"):
        assert old(f"{command} ") == "! Illegal argument\r\n"
    assert new("XS1 ") == "*\r\n"
    for command in ("B0,0,100,100", "%%1CPT", "@A", "ZP"):
        assert new(f"{command} ") == "! Illegal argument\r\n"


def test_a_move_takes_the_time_that_its_speeds_say(bench):
    assert bench("PP1000 ") == "*\r\n"  # at once
    assert bench("PO ") == "* 1000\r\n"
    bench.run(0.5)
    assert bench("PP ") == "* 500\r\n"  # 1000 a second, without a ramp up to the base speed
    assert bench("PD ") == "* 1000\r\n"
    assert bench("TP100 ") == "*\r\n"
    said, took = bench.wait("A ")
    assert said == "*\r\n"
    assert took == pytest.approx(0.5, abs=0.01)
    assert bench("PP TP ") == "* 1000\r\n* 100\r\n"
    assert (bench.pan.position(), bench.tilt.position()) == (1000, 100)


def test_moves_change_on_the_fly(bench):
    bench("PP1000 ")
    bench.run(0.3)
    assert bench("PP0 PO ") == "*\r\n* 0\r\n"
    assert bench.wait("A ")[1] == pytest.approx(0.3, abs=0.02)
    bench("PP1000 ")
    bench.run(0.5)
    assert bench("PS100 ") == "*\r\n"
    assert bench.wait("A ")[1] == pytest.approx(5.0, abs=0.1)
    assert bench("PO-250 TO30 ") == "*\r\n*\r\n"
    bench.wait("A ")
    assert bench("PP TP ") == "* 750\r\n* 30\r\n"


def test_speed_offsets_are_from_the_present_speed(bench):
    bench("PS800 PP3000 ")
    bench.run(0.5)
    assert bench("PD-300 PS ") == "*\r\n* 500\r\n"
    bench("H ")
    bench.run(0.5)
    assert bench("PD100 PS ") == "*\r\n* 100\r\n"


def test_ramps_above_the_base_speed_last_as_long_as_on_a_motor_that_starts_at_it():
    # 1000 to 2900 at 2000/s^2: 0.95 s and 1852.5 steps up, the same down; 3000 more steps at 2900: 1.0345 s.
    for distance, seconds in (
        (2 * 1852.5 + 3000, 2 * 0.95 + 3000 / 2900),
        (389, math.sqrt(1000**2 + 2000 * 389) / 1e3),
    ):
        if distance == 389:
            seconds = 2 * (seconds * 1e3 - 1000) / 2000  # up to 1333 a second and down again
            assert seconds == pytest.approx(0.34, abs=0.01)
        a = plain_acceleration(distance, 2900, 1000, 2000)
        plain = distance / 2900 + 2900 / a if distance > 2900**2 / a else 2 * math.sqrt(distance / a)
        assert plain == pytest.approx(seconds)
    assert plain_acceleration(389, 2900, 0, 2000) == 2000


def test_speeds_have_bounds(bench):
    assert bench("PS2903 ") == "! Pan speed cannot exceed 2902 positions/sec\r\n"
    assert bench("TS30 ") == "! Motor speed cannot be less than 31 pos/sec\r\n"
    assert Bench(D46_PAPER)("PS1986 ") == "! Pan speed cannot exceed 1985 pos/sec\r\n"
    said, took = bench.wait("PU500 ")
    assert (said, took) == ("*\r\n", pytest.approx(D46_STOCK.tables_s, abs=0.01))
    assert bench("PU PS ") == "* 500\r\n* 500\r\n"
    assert bench("PS501 ").startswith("!")
    assert bench("PA0 ") == "! Illegal argument\r\n"
    assert Bench(D46_PAPER)("PA0 ").startswith("! Value")


def test_acceleration_is_not_set_on_the_fly(bench):
    bench("PP1000 ")
    assert bench.wait("PA4000 ")[1] == pytest.approx(1.0 + D46_STOCK.tables_s, abs=0.02)
    assert bench("PA ") == "* 4000\r\n"


def test_positions_beyond_the_limits_are_refused(bench):
    assert bench("PP3091 ") == "! Maximum allowable Pan position is 3090\r\n"
    assert bench("TP-908 ") == "! Minimum allowable Tilt position is -907\r\n"
    assert bench("TO605 ") == "! Maximum allowable Tilt position is 604\r\n"
    assert not bench.pan.moving()
    assert bench("TP604 ") == "*\r\n"


def test_user_limits(bench):
    assert bench("PNU-1000 PXU1500 PNU4000 ") == "*\r\n*\r\n! Maximum allowable Pan position is 3090\r\n"
    assert bench("PP2000 PP0 LU ") == "*\r\n*\r\n*\r\n"
    assert bench("L ") == "* Limit user defined bounds are enabled\r\n"
    assert bench("PP2000 ") == "! Maximum allowable Pan position is 1500\r\n"
    assert bench("PP-1001 ") == "! Minimum allowable Pan position is -1000\r\n"
    assert bench("PX PXU ") == "* 3090\r\n* 1500\r\n"


def test_without_limits_it_runs_into_its_stop_and_loses_steps(bench):
    assert bench("LD L ") == "*\r\n* Limit bounds are DISABLED (hard limits only: use care)\r\n"
    assert bench("TP700 ") == "*\r\n"
    assert bench.run(1.0) == "!T"
    assert bench.tilt.furthest == 604 + D46_STOCK.stop_margin
    assert bench.tilt.position() == 634
    assert bench("TP ") == "* 642\r\n"  # eight steps were lost
    said, took = bench.wait("R ", "*\r\n")
    assert said == "!T!T!P!P*\r\n"
    assert took > 2 * (3120 + 3120) / 1000  # to one stop of pan, to the other, and back
    assert bench("PP TP ") == "* 0\r\n* 0\r\n"
    assert (bench.pan.position(), bench.tilt.position()) == (0, 0)
    assert bench.pan.furthest == 3120


def test_hits_are_told_before_the_star_that_waits(bench):
    bench("LD PP1000 TP700 ")
    said, _ = bench.wait("A ")
    assert said == "!T*\r\n"


def test_reset_of_the_axes_that_were_selected(bench):
    assert bench("RP ") == "*\r\n"  # the D46 only selects
    assert bench.wait("R ", "*\r\n")[0] == "!P!P*\r\n"
    assert bench("RT ") == "*\r\n"
    assert bench.wait("R ", "*\r\n")[0] == "!T!T*\r\n"
    assert bench("RD R ") == "*\r\n*\r\n"
    assert bench("RE ") == "*\r\n"
    e_series = Bench(E_SERIES)
    assert e_series.wait("RP ", "*\r\n")[0] == "!P!P*\r\n"  # the E-series resets at once


def test_what_comes_while_busy_waits(bench):
    bench("PP500 ")
    assert bench("A PP H ") == ""
    assert bench.run(0.49) == ""
    assert bench.run(0.02) == "*\r\n* 500\r\n*\r\n"


def test_halt(bench):
    bench("PP3000 TP500 ")
    bench.run(0.2)
    assert bench("HP ") == "*\r\n"
    bench.run(0.1)
    assert bench("PP PD TD ") == "* 200\r\n* 0\r\n* 1000\r\n"
    assert bench("H ") == "*\r\n"
    bench.run(0.1)
    assert bench("TP PO TO ") == "* 300\r\n* 200\r\n* 300\r\n"
    assert bench.wait("A ")[1] == 0


def test_a_unit_whose_halt_answers_when_it_stands():
    bench = Bench(E_SERIES)
    bench("PP20000 ")
    bench.run(2.0)
    said, took = bench.wait("H ")
    # From 8000 to 456 a second at 16000/s^2: 0.4715 s for a motor that then stands, a bit more for a plain ramp.
    assert (said, took) == ("*\r\n", pytest.approx(0.48, abs=0.05))
    assert bench("PD ") == "* 0\r\n"


def test_slaved_positions_wait_for_await_or_immediate(bench):
    # The example in the manual.
    assert bench("S PP1500 TP-900 PP TP ") == "*\r\n*\r\n*\r\n* 0\r\n* 0\r\n"
    assert bench.run(1.0) == ""
    assert bench("PP PO ") == "* 0\r\n* 1500\r\n"
    assert bench.wait("A ") == ("*\r\n", pytest.approx(1.5, abs=0.01))
    assert bench("PP TP ") == "* 1500\r\n* -900\r\n"
    bench("PP0 ")
    assert bench("I ") == "*\r\n"
    assert bench.pan.moving()


def test_pure_velocity_mode_drives_to_the_limits(bench):
    assert bench("CV PS-1000 ") == "*\r\n*\r\n"
    bench.run(1.0)
    assert bench("PP PS PD ") == "* -1000\r\n* -1000\r\n* -1000\r\n"
    assert bench("PS500 ") == "*\r\n"
    bench.run(1.0)
    assert bench("PP ") == "* -500\r\n"
    assert bench("PS0 PS ") == "*\r\n* 0\r\n"
    bench.run(0.1)
    assert bench("PD PS10 PS-3000 PP5 ").splitlines() == [
        "* 0",
        "! Motor speed cannot be less than 31 pos/sec",
        "! Pan speed cannot exceed 2902 positions/sec",
        "! Illegal argument",
    ]
    bench("TS-1000 ")
    bench.run(1.0)
    assert bench("TP TD ") == "* -907\r\n* 0\r\n"  # stands at the limit, without a hit
    bench("LD TS-100 ")
    assert bench.run(1.0) == "!T"
    assert bench("CI PS C ") == "*\r\n* 1000\r\n* independent control mode\r\n"


def test_defaults(bench):
    bench("PS500 CV DS ")
    assert bench("PS0 CI PS700 TS800 DR PS TS C ").splitlines()[-3:] == [
        "* 500",
        "* 1000",
        "* independent control mode",
    ]
    assert bench("DF ") == "DF *\r\n"[3:]
    assert bench("PS E ") == "PS * Target Pan speed is 1000 positions/sec\r\nE * Echoing ON\r\n"


def test_power(bench):
    assert bench("PHL PH PMH PM PHO PH PHR ").splitlines() == ["*", "* LOW", "*", "* HIGH", "*", "* OFF", "*"]
    assert bench("PHH PMO ") == "! Illegal argument\r\n" * 2


def test_presets(bench):
    bench("PP100 TP50 ")
    bench.wait("A ")
    assert bench("XS32 PP0 TP0 XS33 XG1 ").splitlines()[-2:] == ["! Illegal argument"] * 2
    bench.wait("A ")
    assert bench("XG32 ") == "*\r\n"
    bench.wait("A ")
    assert bench("PP TP XC32 XG32 ") == "* 100\r\n* 50\r\n*\r\n! Illegal argument\r\n"


@pytest.mark.parametrize("delimiter", [" ", "\r\n"])
def test_autoscan_goes_to_and_fro_until_any_character(bench, delimiter):
    assert bench(f"M-500,500,-100,100{delimiter}") == "*\r\n"
    seen = []
    for _ in range(60):
        assert bench.run(0.1) == ""
        seen.append(bench.pan.position())
    assert min(seen) < -390
    assert max(seen) > 390
    assert bench("x") == ""
    bench.wait("A ")
    assert bench("PP TP ") == "* 0\r\n* 0\r\n"
    assert bench("MQ ME MQ M0,9000 ").splitlines()[-1] == "! Illegal argument"


def test_step_modes(bench):
    said, _ = bench.wait("WPQ ", "*\r\n")
    assert said == "!P!P*\r\n"  # recalibrates that axis
    assert bench("PR TR PN PX TX WP ").splitlines() == ["* 92.5714", "* 185.1428", "* -6180", "* 6180", "* 604", "* Q"]
    bench("PP2000 ")
    bench.wait("A ")
    assert bench.pan.position() == 1000


def test_power_up():
    bench = Bench(terse=False)
    bench("ED FT PP700 ")
    bench.run(1.0)
    bench.unit.power_on()
    said, _ = bench.wait("", "*\r\n")
    assert said == f"\r\n{D46_STOCK.title}\r\n!T!T!P!P*\r\n"
    assert bench("PP ") == "PP * Current Pan position is 0\r\n"
    assert bench.pan.position() == 0
    assert bench("V ") == f"V * {D46_STOCK.title}\r\n"


def test_the_line_can_be_set(bench):
    assert bench("@(19200,0,F) ") == "*\r\n"
    assert bench.unit.baud == 19200
    for wrong in ("@(9601,0,F)", "@(9600,5,F)", "@(9600,1001,T)", "@(115200,0,F)", "@(9600,0,X)"):
        assert bench(f"{wrong} ") == "! Illegal argument\r\n"
    assert bench("@(600,20,T) ") == "*\r\n"
    assert (bench.unit.baud, bench.unit.byte_delay_s) == (600, 0.02)
    bench.unit.power_on(calibrate=False)
    assert (bench.unit.baud, bench.unit.byte_delay_s) == (600, 0.0)
    assert Bench(E_SERIES)("@(115200,0,F) ") == "*\r\n"


def test_expansion_ports():
    bench = Bench(replace(D46_STOCK, expansion=True))
    assert bench("@ ") == "*\r\n"  # AriaCoda begins with this
    assert bench("@A ") == "*\r\n"
    assert bench("PP anything ") == ""
    assert bench("@ ") == "*\r\n"
    assert bench("PP ") == "* 0\r\n"


def test_a_shared_line(bench):
    assert bench("U5 U ") == "*\r\n* 5\r\n"
    assert bench("_3 ") == ""
    assert bench("PP100 PP ") == ""
    assert bench("@(600,0,F) _5 ") == "*\r\n"
    assert bench("PP @(600,0,F) ") == "* 0\r\n! Illegal argument\r\n"
    assert bench("_0 U0 ") == "*\r\n*\r\n"


def test_continuous_pan_and_the_e_series_command_of_both_axes():
    bench = Bench(replace(D46_STOCK, slip_ring=True))
    assert bench("%%1CPT PN PX ") == "*\r\n* -6999\r\n* 7000\r\n"  # the example in S2
    assert bench("PP6900 ") == "*\r\n"
    assert bench.run(10.0) == ""
    assert bench("PP ") == "* 6900\r\n"
    bench = Bench(E_SERIES)
    assert bench("B800,-80,4000,400 ") == "*\r\n"
    bench.wait("A ")
    assert bench("PP TP PS TS ") == "* 800\r\n* -80\r\n* 4000\r\n* 400\r\n"


def test_a_menu_and_nonsense(bench):
    assert bench("? ").startswith("* PP")
    for text in ("PPx", "PP--1", "PP1.5", "é", "PP9999999999", "\x00\xff", "*", "!", "W", "MX"):
        assert bench(f"{text} ") == "! Illegal argument\r\n"
    assert bench("P" * 500 + " ") == "! Illegal argument\r\n"
    assert bench("PP ") == "* 0\r\n"


@pytest.mark.parametrize("unit", [D46_STOCK, D46_PAPER, E_SERIES])
def test_random_commands_neither_break_it_nor_leave_the_stops(unit):
    rng = random.Random(1)
    others = (
        "PO",
        "TS",
        "LD",
        "LE",
        "LU",
        "CV",
        "CI",
        "A",
        "H",
        "R",
        "M-500,500",
        "WTQ",
        "DR",
        "S",
        "I",
        "EE",
        "RP",
        "_",
    )
    names = [*(query for query, _, _ in SENTENCES), *others]
    bench = Bench(unit)
    for _ in range(2000):
        text = rng.choice(names) + rng.choice(["", "0", "-100", "3000", "-99999999", chr(rng.randrange(256))])
        bench(text + rng.choice(" \r\n"))
        bench.t += rng.random()
        bench.unit.output()
        assert unit.pan[0] - unit.stop_margin <= bench.pan.position() <= unit.pan[1] + unit.stop_margin
        assert unit.tilt[0] - unit.stop_margin <= bench.tilt.position() <= unit.tilt[1] + unit.stop_margin


def test_a_profile_from_degrees():
    unit = UnitProfile.from_degrees((-180, 180), (-80, 30), 0.0514286, 100, 200)
    # 180 / 0.0514286 = 3499.998, 80 / 0.0514286 = 1555.555, 30 / 0.0514286 = 583.33
    assert (unit.pan, unit.tilt) == ((-3500, 3500), (-1555, 583))
    bench = Bench(unit)
    assert bench("PR ") == "* 185.142960\r\n"
    assert bench("PU PA PB ") == "* 1944\r\n* 3889\r\n* 0\r\n"
    bench("PP1000 ")
    # 1944.44 a second, 3888.9 a second squared: half a second and 486 steps up, the same down, 28 steps between.
    assert bench.wait("A ")[1] == pytest.approx(1.0 + 28 / 1944, abs=0.01)
    for step in (0, -0.1, 1e-9, math.nan):
        with pytest.raises(ConfigError, match="step"):
            UnitProfile.from_degrees((-180, 180), (-80, 30), step, 100, 200)


def test_paper_range():
    bench = Bench(D46_PAPER)
    assert bench("PN PX TN TX ") == "* -3500\r\n* 3500\r\n* -1555\r\n* 583\r\n"


class TestFaults:
    def test_silence_hides_replies_but_the_unit_obeys(self, bench):
        bench.faults.set("silence")
        assert bench("PP500 PP ") == ""
        bench.run(0.1)
        bench("H ")
        bench.run(0.1)
        bench.faults.set("silence", False)
        assert bench("PP ") == "* 100\r\n"

    def test_garbage(self, bench):
        bench.faults.set("garbage")
        said = bench("PP ")
        assert len(said) == len("* 0\r\n")
        assert said != "* 0\r\n"

    def test_half_replies(self, bench):
        bench.faults.set("half-replies")
        assert bench("PP ") == "* "

    def test_late_replies_come_in_order(self, bench):
        bench.faults.set("late-replies")
        assert bench("PP ") == ""
        bench.faults.set("late-replies", False)
        assert bench("TP100 ") == ""
        assert bench.run(1.45) == ""
        assert bench.run(0.1) == "* 0\r\n*\r\n"

    def test_unplugged(self, bench):
        bench.faults.set("unplugged")
        assert bench("PP100 ") == ""
        bench.faults.set("unplugged", False)
        assert bench("PO ") == "* 0\r\n"

    def test_a_power_cycle_in_motion(self, bench):
        bench("PP1000 ")
        bench.run(0.3)
        bench.faults.set("power-cycle")
        said = bench.run(D46_STOCK.boot_s + 0.1)
        assert said == f"\r\n{D46_STOCK.title}\r\n*\r\n"
        assert bench.pan.position() == pytest.approx(300, abs=1)
        assert bench("ED FT ") == "ED *\r\n*\r\n"
        assert bench("PP PN PX TN TX ") == "* 0\r\n" * 5
        assert bench("PP1 TP-1 ").splitlines() == [
            "! Maximum allowable Pan position is 0",
            "! Minimum allowable Tilt position is 0",
        ]
        assert bench.wait("R ", "*\r\n")[0] == "!T!T!P!P*\r\n"
        assert bench("PP PX ") == "* 0\r\n* 3090\r\n"
        assert bench.pan.position() == 0

    def test_an_uncalibrated_e_series(self):
        bench = Bench(E_SERIES)
        bench.faults.set("power-cycle")
        bench.run(E_SERIES.boot_s + 0.1)
        assert bench("ED PP5 ") == "ED *\r\n! Axis Error\r\n"

    def test_a_hit_in_motion(self, bench):
        bench.faults.set("limit-hit")
        assert bench.run(0.1) == ""  # not while it stands
        bench("PP-1000 ")
        assert bench.run(0.3) == "!P"
        assert "limit-hit" not in bench.faults
        assert not bench.pan.moving()
        lost = bench.pan.position() - int(bench("PP ")[2:])
        assert lost == D46_STOCK.slip

    def test_error_replies_spare_the_halt(self, bench):
        bench("PP1000 ")
        bench.faults.set("error-replies")
        assert bench("PP0 PP ") == "! Illegal argument\r\n" * 2
        assert bench("H ") == "*\r\n"
        bench.run(0.1)
        assert not bench.pan.moving()


class TestWire:
    """Pacing, in simulated time."""

    def test_a_query_takes_ten_bits_a_byte_each_way(self):
        bench = Bench()
        wire = Wire(bench.unit)
        wire.feed(b"PP ", bench.t)
        heard = []
        while len(heard) < 5:
            bench.t = wire.due()
            heard += [(bench.t, byte) for byte in wire.step(bench.t)]
        assert bytes(byte for _, byte in heard) == b"* 0\r\n"
        assert [t for t, _ in heard] == pytest.approx([n / 960 for n in range(4, 9)])

    def test_a_late_thread_does_not_slow_the_line(self):
        bench = Bench()
        wire = Wire(bench.unit)
        wire.feed(b"PP ", bench.t)
        bench.t = 1.0
        assert wire.step(bench.t) == b"* 0\r\n"

    def test_echo_overlaps_what_is_still_sent(self):
        bench = Bench(terse=False)
        wire = Wire(bench.unit)
        wire.feed(b"PP ", bench.t)
        bench.t = 2.5 / 960
        assert wire.step(bench.t) == b"P"

    def test_a_new_baud_holds_after_the_reply(self):
        bench = Bench()
        wire = Wire(bench.unit)
        wire.feed(b"@(600,10,F) ", bench.t)
        bench.t = 15.5 / 960
        assert wire.step(bench.t, 9600) == b""  # the reply has its byte delay already, as the command asked
        bench.t += 3 * (0.01 + 1 / 960)
        assert wire.step(bench.t, 9600) == b"*\r\n"
        wire.feed(b"PP ", bench.t, 600)
        bench.t += 8 / 60 + 5 * 0.01 + STEP_S
        assert wire.step(bench.t, 600) == b"* 0\r\n"

    def test_another_baud_is_noise_both_ways(self):
        bench = Bench()
        wire = Wire(bench.unit)
        wire.feed(b"PP1000 ", bench.t, 19200)
        bench.t = 1.0
        wire.step(bench.t, 19200)
        assert bench.pan.position() == 0
        assert not bench.pan.moving()
        wire.feed(b"\r", bench.t, 9600)
        wire.feed(b"PP ", bench.t, 9600)
        bench.t += 1.0
        heard = wire.step(bench.t, 19200)
        assert len(heard) >= len("* 0\r\n")
        assert b"* 0" not in heard


def live(unit=D46_STOCK):
    """A unit on the machine's own clock, its plants and its faults."""
    plants = SteppedPlant(time.monotonic), SteppedPlant(time.monotonic)
    faults = Faults(D46_FAULTS)
    return D46(*plants, unit, faults, time.monotonic), plants, faults


def ask(port, text, end=b"\n"):
    port.write(text)
    return port.read_until(end)


def until(condition):
    """Wait for something that another thread does."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, "hangs"
        time.sleep(1e-3)


@pytest.mark.wire
class TestSerialLine:
    def test_moves_and_reads_back(self):
        unit, (pan, _), _ = live()
        with SerialLine(unit, 9600) as line, serial.Serial(line.port, 9600, timeout=DEADLINE_S) as port:
            assert ask(port, b"ED ") == b"ED *\r\n"
            assert ask(port, b"FT ") == b"*\r\n"
            assert ask(port, b"PP50 ") == b"*\r\n"
            assert ask(port, b"A ") == b"*\r\n"
            assert ask(port, b"PP ") == b"* 50\r\n"
            assert pan.position() == 50
            assert ask(port, b"@(19200,0,F) ") == b"*\r\n"
            port.baudrate = 19200
            assert ask(port, b"PP ") == b"* 50\r\n"

    def test_a_unit_that_was_set_to_another_baud(self):
        unit, _, _ = live()
        with SerialLine(unit, 38400) as line, serial.Serial(line.port, 38400, timeout=DEADLINE_S) as port:
            assert ask(port, b"TP ") == b"TP * Current Tilt position is 0\r\n"
        with pytest.raises(ConfigError, match="baud: 9601 is not one of"):
            SerialLine(unit, 9601)

    def test_a_client_may_come_and_go(self):
        unit, _, _ = live()
        with SerialLine(unit, 9600) as line:
            for _ in range(3):
                with serial.Serial(line.port, 9600, timeout=DEADLINE_S) as port:
                    assert ask(port, b"TP ") == b"TP * Current Tilt position is 0\r\n"

    def test_unplugged_and_replugged(self):
        unit, _, faults = live()
        with SerialLine(unit, 9600) as line:
            with serial.Serial(line.port, 9600, timeout=DEADLINE_S) as port:
                assert ask(port, b"PP ")
                faults.set("unplugged")
                until(lambda: line.port == "")
                with pytest.raises((serial.SerialException, OSError)):
                    port.read()
                faults.set("unplugged", False)
                until(lambda: line.port != "")
            with serial.Serial(line.port, 9600, timeout=DEADLINE_S) as port:
                assert ask(port, b"TX ") == b"TX * Maximum Tilt position is 604\r\n"

    def test_the_line_takes_its_time(self):
        """Pairs of queries come no faster than a real line's; how much slower is the machine's affair."""
        unit, _, _ = live()
        with SerialLine(unit, 9600) as line, serial.Serial(line.port, 9600, timeout=DEADLINE_S) as port:
            ask(port, b"ED "), ask(port, b"FT ")
            pairs, start = 10, time.monotonic()
            sent = sum(3 + len(ask(port, query)) for _ in range(pairs) for query in (b"PP ", b"TP "))
            took = time.monotonic() - start
        assert sent == pairs * 16
        assert took >= sent / 960

    def test_no_thread_is_left(self):
        unit, _, _ = live()
        before = threading.active_count()
        line = SerialLine(unit, 9600)
        assert threading.active_count() == before + 1
        line.close()
        assert threading.active_count() == before


@pytest.mark.wire
class TestTcpLine:
    def test_moves_and_reads_back(self):
        unit, (pan, _), _ = live()
        with TcpLine(unit) as line, serial.serial_for_url(line.url, timeout=DEADLINE_S) as port:
            assert ask(port, b"ED ") == b"ED *\r\n"
            assert ask(port, b"PP-50 ") == b"*\r\n"
            assert ask(port, b"A ") == b"*\r\n"
            assert ask(port, b"PP ") == b"* Current Pan position is -50\r\n"
            assert pan.position() == -50

    def test_an_e_series_greets(self):
        unit, _, _ = live(E_SERIES)
        # pyserial would throw away what comes as it connects.
        with TcpLine(unit) as line, socket.create_connection((line.host, line.port), DEADLINE_S) as client:
            said = b""
            while not said.endswith(b"*\r\n"):
                said += client.recv(100)
        assert b"PAN-TILT" in said

    def test_a_second_client_takes_the_first_ones_place(self):
        unit, _, _ = live()
        with TcpLine(unit) as line, serial.serial_for_url(line.url, timeout=DEADLINE_S) as first:
            assert ask(first, b"PP ")
            with serial.serial_for_url(line.url, timeout=DEADLINE_S) as second:
                assert ask(second, b"TP ") == b"TP * Current Tilt position is 0\r\n"
                with pytest.raises(serial.SerialException):
                    first.read()

    def test_unplugged_and_replugged(self):
        unit, _, faults = live()
        with TcpLine(unit) as line:
            with serial.serial_for_url(line.url, timeout=DEADLINE_S) as port:
                assert ask(port, b"PP ")
                faults.set("unplugged")
                with pytest.raises(serial.SerialException):
                    port.read()
            with pytest.raises(serial.SerialException):
                serial.serial_for_url(line.url)
            faults.set("unplugged", False)

            def answers():
                try:
                    with serial.serial_for_url(line.url, timeout=DEADLINE_S) as port:
                        return ask(port, b"TP ") == b"TP * Current Tilt position is 0\r\n"
                except serial.SerialException:
                    return False

            until(answers)

    def test_a_taken_port_is_told_in_one_line(self):
        unit, _, _ = live()
        with TcpLine(unit) as line, pytest.raises(DeviceError, match=f"cannot listen at 127.0.0.1:{line.port}"):
            TcpLine(live()[0], port=line.port)

    def test_two_lines_to_one_unit_serve_one_program(self):
        """A port that is locked is locked on the network too, and the other way round."""

        def locks(port):
            try:
                serial.Serial(port, exclusive=True).close()
            except serial.SerialException:
                return False
            return True

        with SerialLine(live()[0]) as line, TcpLine(live()[0], beside=line) as tcp:
            with serial.serial_for_url(tcp.url, timeout=DEADLINE_S) as first:
                assert ask(first, b"TP ") == b"TP * Current Tilt position is 0\r\n"
                assert not locks(line.port)
            until(lambda: locks(line.port))
            with (
                serial.Serial(line.port, exclusive=True),
                socket.create_connection((tcp.host, tcp.port), DEADLINE_S) as late,
            ):
                assert late.recv(1) == b""
            with serial.serial_for_url(tcp.url, timeout=DEADLINE_S) as again:
                assert ask(again, b"TP ") == b"TP * Current Tilt position is 0\r\n"
