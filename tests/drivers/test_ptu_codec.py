"""The PTU-D46's protocol as bytes: answers as manuals and drivers print them, and garbled ones."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cotarget.drivers import ptu_protocol
from cotarget.drivers.link_errors import ReplyError

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


NO_ANSWERS = [b"$GPGGA,1,2\r\n", b"ED FT\r\n", b"OK\r\n", b"\xfe* 3\r\n"]
READERS = (
    ptu_protocol.integer,
    ptu_protocol.bare_integer,
    ptu_protocol.arcseconds,
    ptu_protocol.echoing,
    ptu_protocol.terse,
    ptu_protocol.independent,
    ptu_protocol.done,
)


def understood(line, read):
    """What is read from a line; None if it is refused."""
    try:
        reply = ptu_protocol.parse(ptu_protocol.split_events(line)[0])
        return None if reply is None else read(reply.text)
    except ReplyError as error:
        said = str(error)
    assert "\n" not in said
    return None


READ = [
    *((ptu_protocol.integer, line, number) for line, number in NUMBERS),
    *((ptu_protocol.arcseconds, line, number) for line, number in RESOLUTIONS),
    *MODES,
    (ptu_protocol.bare_integer, b"* -17\r\n", -17),
    *((ptu_protocol.integer, line, None) for line in GARBLED),
    *((ptu_protocol.bare_integer, line, None) for line in (*GARBLED, *WORDY)),
    *((read, line, None) for line in NO_ANSWERS for read in READERS),
    (ptu_protocol.arcseconds, b"* 0\r\n", None),
    (ptu_protocol.echoing, b"* Echoing ON OFF\r\n", None),
    (ptu_protocol.done, b"* 123\r\n", None),
]


@pytest.mark.parametrize(("read", "line", "meaning"), READ)
def test_answers_as_manuals_and_drivers_print_them(read, line, meaning):
    found = understood(line, read)
    assert (type(found), found) == (type(meaning), meaning)


@pytest.mark.parametrize(("line", "said"), ERRORS)
def test_errors_keep_the_units_words(line, said):
    rest, events = ptu_protocol.split_events(line)
    reply = ptu_protocol.parse(rest)
    assert (reply.refused, reply.text, events) == (True, said, ())


@pytest.mark.parametrize(("received", "rest", "events"), EVENTS)
def test_events_come_anywhere(received, rest, events):
    assert ptu_protocol.split_events(received) == (rest, events)


def test_the_echo_stands_before_the_answer():
    assert ptu_protocol.parse(b"ED *\r\n") == ptu_protocol.Reply("", False, "ED")
    assert ptu_protocol.parse(b"\r\n") is None


def test_the_banner_is_not_the_answer_to_the_version():
    assert ptu_protocol.parse(VERSION).text.startswith("Pan-Tilt Controller v2.12.1d1(C14/E)")
    assert not ptu_protocol.BANNER.search(VERSION)
    assert ptu_protocol.BANNER.search(b"\r\n### PAN-TILT CONTROLLER v2.12 ###\r\n!T!T!P!P*\r\n")


def test_strange_bytes_are_quoted_in_one_short_line():
    assert ptu_protocol.shown(b"\x00\xffa\tb\r\n") == r"'\x00\xffa\tb'"
    assert len(ptu_protocol.shown(bytes(1000))) < 50


# Real lines, and what may come between their bytes.
LINES = [line for line, *_ in (*NUMBERS, *RESOLUTIONS, *ERRORS, *EVENTS)] + [line for _, line, _ in MODES] + [VERSION]
TOKENS = (b"!P", b"!T", b"!", b"*", b" is ", b"-", b"9" * 400, b"\r\n", b"\0")


@st.composite
def mutated(draw):
    """Any bytes, or a real line that lost, gained or mixed up some."""
    line = bytearray(draw(st.sampled_from(LINES) | st.binary(max_size=60)))
    for _ in range(draw(st.integers(0, 4))):
        at, lost = draw(st.integers(0, len(line))), draw(st.integers(0, 3))
        line[at : at + lost] = draw(st.sampled_from((*TOKENS, *LINES)) | st.binary(max_size=3))
    return bytes(line)


@settings(derandomize=True, database=None, deadline=None, max_examples=300)
@given(mutated())
def test_any_line_is_parsed_or_refused_and_a_bare_integer_equals_its_bytes(line):
    assert set(ptu_protocol.split_events(line)[1]) <= {"P", "T", "D"}
    for read in READERS:
        understood(line, read)
    if (number := understood(line, ptu_protocol.bare_integer)) is not None:
        rest = ptu_protocol.split_events(line)[0].strip(b"\r\n\t \0").decode()
        marks = [at for at in (rest.find("*"), rest.find("!")) if at >= 0]
        assert int(rest[min(marks) + 1 :]) == number
