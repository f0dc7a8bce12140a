"""The PTU-D46's protocol as bytes: what the manuals and other people's units say, and what nobody ever said."""

import os
import random

import pytest

from cotarget.drivers import ptu_protocol
from cotarget.errors import DeviceError

# A default run; the figure that is promised is a million.
FUZZED = int(os.environ.get("COTARGET_FUZZ", "50000"))
FUZZED_SLOW = max(FUZZED, 1_000_000)
VERSION = b"* Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved\r\n"
# Lines as manuals and drivers print them, and the number that they tell.
NUMBERS = [
    (b"* Current Pan position is 0\r\n", 0),
    (b"* 0\r\n", 0),
    (b"* -3090\r\n", -3090),
    (b"PP * Current Pan position is -12\r\n", -12),
    (b"* Target Pan position is 1500\r\n", 1500),
    (b"* Target Pan speed is 1000 positions/sec\r\n", 1000),
    (b"* Desired Pan speed is 1000 positions/sec\r\n", 1000),
    (b"* Current Pan speed is 450 positions/sec\r\n", 450),
    (b"* Pan acceleration is 2000 positions/sec^2\r\n", 2000),
    (b"* Current Pan base speed is 1000 positions/sec\r\n", 1000),
    (b"* Maximum Pan speed is 2902 positions/sec\r\n", 2902),
    (b"* Minimum Pan speed is 31 positions/sec\r\n", 31),
    (b"* Minimum Pan position is -3090\r\n", -3090),
    (b"* Minimum user defined Pan Position is -1000\r\n", -1000),
    (b"* 2000 positions/sec^2\r\n", 2000),
    (b"* Unit ID is 0\r\n", 0),
    (b"\n* 17\r\n", 17),
]
RESOLUTIONS = [
    (b"* 92.5714 seconds arc per position\r\n", 92.5714),
    (b"* 185.1428 seconds arc per Pan position\r\n", 185.1428),
    (b"PR * 46.2857 seconds arc per Pan position\r\n", 46.2857),
    (b"\n* 23.142857\r\n", 23.142857),
]
ERRORS = [
    (b"! Maximum allowable Pan position is 3090\r\n", "Maximum allowable Pan position is 3090"),
    (b"! Minimum allowable Tilt position is -903\r\n", "Minimum allowable Tilt position is -903"),
    (b"! Pan speed cannot exceed 1985 positions/sec\r\n", "Pan speed cannot exceed 1985 positions/sec"),
    (b"! Motor speed cannot be less than 31 pos/sec\r\n", "Motor speed cannot be less than 31 pos/sec"),
    (b"! Illegal argument\r\n", "Illegal argument"),
    (b"\n! Illegal Command Entered\r\n", "Illegal Command Entered"),
    (b"PP99999 ! Maximum allowable Pan position is 3090\r\n", "Maximum allowable Pan position is 3090"),
    (b"! Axis Error\r\n", "Axis Error"),
]
# What was received, what is left without the events, and the events.
EVENTS = [
    (b"!P* 12\r\n", b"* 12\r\n", ("P",)),
    (b"\n!T!T*\r\n", b"\n*\r\n", ("T", "T")),
    (b"!T!T!P!P*\r\n", b"*\r\n", ("T", "T", "P", "P")),
    (b"* 1!P2\r\n", b"* 12\r\n", ("P",)),
    (b"* 12!D\r\n", b"* 12\r\n", ("D",)),
    (b"* Current Pan pos!Pition is 5\r\n", b"* Current Pan position is 5\r\n", ("P",)),
    (b"PP !T* Current Pan position is 5\r\n", b"PP * Current Pan position is 5\r\n", ("T",)),
    (b"!P! Illegal argument\r\n", b"! Illegal argument\r\n", ("P",)),
    (b"! Pan speed cannot exceed 1985 positions/sec\r\n", b"! Pan speed cannot exceed 1985 positions/sec\r\n", ()),
    (b"!Tilt is not there\r\n", b"!Tilt is not there\r\n", ()),
    (b"!P\r\n", b"\r\n", ("P",)),
]
MODES = [
    (ptu_protocol.echoing, b"E * Echoing ON\r\n", True),
    (ptu_protocol.echoing, b"* Echoing OFF\r\n", False),
    (ptu_protocol.terse, b"* ASCII verbose mode\r\n", False),
    (ptu_protocol.terse, b"* ASCII terse mode\r\n", True),
    (ptu_protocol.independent, b"* PTU is in Independent Mode\r\n", True),
    (ptu_protocol.independent, b"* Independent speed control mode\r\n", True),
    (ptu_protocol.independent, b"* Pure Velocity speed control mode\r\n", False),
]
# Answers that lost or gained a byte must not become another number.
GARBLED = [b"* 12\xff4", b"* 12.5", b"* x3", b"* --3", b"* 3-4", b"*", b"* is -", b"* 12345678901234567890"]
# Nor may an answer in the middle of work, where the unit is terse, have anything else in it.
WORDY = [b"* 1 2x", b"* 1 2", b"* Current Pan position is 0", b"*"]


def text_of(line):
    return ptu_protocol.parse(ptu_protocol.split_events(line)[0]).text


@pytest.mark.parametrize(("line", "number"), NUMBERS)
def test_the_first_integer_after_is(line, number):
    assert ptu_protocol.integer(text_of(line)) == number


@pytest.mark.parametrize(("line", "arcseconds"), RESOLUTIONS)
def test_resolution_in_seconds_of_arc(line, arcseconds):
    assert ptu_protocol.arcseconds(text_of(line)) == arcseconds


@pytest.mark.parametrize(("line", "said"), ERRORS)
def test_errors_are_told_in_the_units_words(line, said):
    rest, events = ptu_protocol.split_events(line)
    reply = ptu_protocol.parse(rest)
    assert reply.refused
    assert reply.text == said
    assert events == ()


@pytest.mark.parametrize(("received", "rest", "events"), EVENTS)
def test_events_come_anywhere(received, rest, events):
    assert ptu_protocol.split_events(received) == (rest, events)


@pytest.mark.parametrize(("meaning", "line", "value"), MODES)
def test_words_tell_modes(meaning, line, value):
    assert meaning(text_of(line)) is value


@pytest.mark.parametrize("line", GARBLED)
def test_a_garbled_number_is_refused(line):
    with pytest.raises(ptu_protocol.ReplyError):
        ptu_protocol.integer(text_of(line))


@pytest.mark.parametrize("line", WORDY)
def test_a_terse_number_stands_alone(line):
    assert ptu_protocol.bare_integer(text_of(b"* -17\r\n")) == -17
    with pytest.raises(ptu_protocol.ReplyError):
        ptu_protocol.bare_integer(text_of(line))


@pytest.mark.parametrize("line", [b"$GPGGA,1,2\r\n", b"ED FT\r\n", b"OK\r\n", b"\xfe* 3\r\n"])
def test_lines_of_other_devices_are_refused(line):
    with pytest.raises(ptu_protocol.ReplyError, match="is no answer of a PTU-D46"):
        ptu_protocol.parse(line)


def test_the_echo_stands_before_the_answer():
    assert ptu_protocol.parse(b"ED *\r\n") == ptu_protocol.Reply("", False, "ED")
    assert ptu_protocol.parse(b"\r\n") is None


def test_an_order_is_answered_by_a_star_alone():
    ptu_protocol.done(text_of(b"*\r\n"))
    with pytest.raises(ptu_protocol.ReplyError, match="'123' answers something else"):
        ptu_protocol.done(text_of(b"* 123\r\n"))


def test_commands_end_in_a_space():
    assert ptu_protocol.command("PP", -120) == b"PP-120 "
    assert ptu_protocol.command("TS", 1000) == b"TS1000 "
    assert ptu_protocol.command("ED") == b"ED "


def test_the_banner_is_not_the_answer_to_the_version():
    assert text_of(VERSION).startswith("Pan-Tilt Controller v2.12.1d1(C14/E)")
    assert not ptu_protocol.BANNER.search(VERSION)
    assert ptu_protocol.BANNER.search(b"\r\n### PAN-TILT CONTROLLER v2.12 ###\r\n!T!T!P!P*\r\n")


def test_strange_bytes_are_quoted_in_one_short_line():
    assert ptu_protocol.shown(b"\x00\xffa\tb\r\n") == r"'\x00\xffa\tb'"
    assert len(ptu_protocol.shown(bytes(1000))) < 50


SEEDS = [line for line, *_ in [*NUMBERS, *RESOLUTIONS, *ERRORS, *EVENTS]] + [line for _, line, _ in MODES] + [VERSION]
TOKENS = (b"!P", b"!T", b"!", b"*", b" is ", b"-", b"9" * 400, b"\r\n", b"\0")
READERS = (
    ptu_protocol.integer,
    ptu_protocol.bare_integer,
    ptu_protocol.arcseconds,
    ptu_protocol.echoing,
    ptu_protocol.terse,
    ptu_protocol.independent,
    ptu_protocol.done,
)


def mutated(rng):
    """A random line, or a real one that lost, gained or mixed up some bytes."""
    if rng.random() < 0.3:
        return rng.randbytes(rng.randrange(40))
    line = bytearray(rng.choice(SEEDS))
    for _ in range(rng.randrange(1, 5)):
        at = rng.randrange(len(line) + 1)
        match rng.randrange(4):
            case 0:
                line[at : at + rng.randrange(4)] = b""
            case 1:
                line[at:at] = rng.randbytes(rng.randrange(3))
            case 2:
                line[at:at] = rng.choice(TOKENS)
            case 3:
                line[at:at] = rng.choice(SEEDS)
    return bytes(line)


def fuzz(count, seed):
    """Put strange lines through everything that reads lines; how often something was understood."""
    rng = random.Random(seed)
    understood, complaints = 0, set()
    for _ in range(count):
        try:
            rest, events = ptu_protocol.split_events(mutated(rng))
            reply = ptu_protocol.parse(rest)
        except DeviceError as error:
            complaints.add(str(error))
            continue
        assert set(events) <= {"P", "T", "D"}
        for read in READERS if reply is not None else ():
            try:
                read(reply.text)
                understood += 1
            except DeviceError as error:
                complaints.add(str(error))
    assert not any("\n" in complaint for complaint in complaints)
    return understood


def test_nothing_but_the_drivers_own_errors():
    assert fuzz(FUZZED, seed=1) > FUZZED // 100


@pytest.mark.slow
def test_nothing_but_the_drivers_own_errors_in_a_million():
    assert fuzz(FUZZED_SLOW, seed=2) > FUZZED_SLOW // 100
