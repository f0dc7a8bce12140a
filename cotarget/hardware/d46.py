"""The PTU-D46's ASCII protocol: commands as bytes, and what the unit's answers mean. No I/O and no time.

Sources: Directed Perception's PTU-D46 manual 2.14.0 (2006) and Command Reference Manual 3.00D (2008). Answers are read
leniently, because firmware versions differ in wording, but a line that may have been garbled is refused.
"""

import re
from dataclasses import dataclass
from typing import Literal

from cotarget.errors import DeviceError

# After a command. A carriage return would do too, but makes some units put a line feed before the answer.
DELIMITER = b" "
HALT = b"H "
ARCSECONDS = 3600.0  # a degree
# Longer lines than the longest answer by far are another device's [bytes].
LONGEST_LINE = 4096
SHOWN = 40  # so much of a strange line is quoted in an error [characters]

# Told at any time, even inside of another answer: a pan or tilt limit was hit, the cable was pulled.
# Errors too begin with an exclamation mark, but go on with a space or, to be safe, with a small letter.
EVENT = re.compile(rb"!([PTD])(?![a-z])")
EVENT_INSIDE = re.compile(rb"!([PTD])")
PLAIN = re.compile(rb"[\x20-\x7e\t]*")
# Numbers stand by themselves: digits that something is glued to were garbled. Nine digits are enough for any.
INTEGER = re.compile(r"(?<!\S)[-+]?[0-9]{1,9}(?=[.,;]?(?:\s|$))")
DECIMAL = re.compile(r"(?<!\S)[0-9]{1,9}(?:\.[0-9]{1,9})?(?=[.,;]?(?:\s|$))")
# Words that tell modes, whatever stands around them.
ECHO_ON, ECHO_OFF = (re.compile(rf"echo.*\b{word}\b", re.IGNORECASE) for word in ("on", "off"))
TERSE, VERBOSE = re.compile("terse", re.IGNORECASE), re.compile("verbose", re.IGNORECASE)
INDEPENDENT, VELOCITY = re.compile("indep", re.IGNORECASE), re.compile("veloc", re.IGNORECASE)
# What a unit says when it is switched on, before it calibrates itself; its answer to V has a star and a space before.
BANNER = re.compile(rb"^(?!\s*\*\s).*pan[- ]?tilt", re.IGNORECASE | re.MULTILINE)

AxisName = Literal["P", "T"]
AXES: tuple[AxisName, AxisName] = ("P", "T")
AXIS_WORDS = {"P": "pan", "T": "tilt"}
EVENT_WORDS = {"P": "pan hit its limit (!P)", "T": "tilt hit its limit (!T)", "D": "its cable came off (!D)"}


class ReplyError(DeviceError):
    """What came back is no answer of a PTU-D46 to what was asked."""


class RefusedError(DeviceError):
    """The unit understood a command and refused it."""


@dataclass(frozen=True)
class Reply:
    """One line of the unit's.

    Attributes:
        text: what it says after the ``*`` or ``!``.
        refused: whether it is an error.
        echo: what stands before, the command itself where the unit echoes.
    """

    text: str
    refused: bool = False
    echo: str = ""


def command(name: str, value: int | None = None) -> bytes:
    """The bytes of a command, such as ``PP-120``; without a value it is a query or an order."""
    return f"{name}{'' if value is None else value}".encode("ascii") + DELIMITER


def shown(data: bytes) -> str:
    """Bytes as a short quotation for an error message of one line."""
    text = ascii(data.strip())[2:-1]
    return f"'{text}'" if len(text) <= SHOWN else f"'{text[:SHOWN]}...'"


def split_events(data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Take what the unit told in between out of its bytes: the rest, and "P", "T" or "D" of each in order."""
    start = EVENT.sub(b"", data).lstrip()
    # An answer that is no error has no other exclamation marks: there even "!Pos" is an event in front of "os".
    pattern = EVENT if start.startswith(b"!") or b"*" not in start else EVENT_INSIDE
    return pattern.sub(b"", data), tuple(found.decode("ascii") for found in pattern.findall(data))


def parse(line: bytes) -> Reply | None:
    """Read one line whose events are taken out; None if nothing is left of it.

    Raises:
        ReplyError: it is no answer.
    """
    line = line.strip(b"\r\n\t \0")
    if not line:
        return None
    marks = [at for at in (line.find(b"*"), line.find(b"!")) if at >= 0]
    if not marks or not PLAIN.fullmatch(line):
        raise ReplyError(f"{shown(line)} is no answer of a PTU-D46")
    at = min(marks)
    return Reply(
        text=line[at + 1 :].strip().decode("ascii"),
        refused=line[at : at + 1] == b"!",
        echo=line[:at].strip().decode("ascii"),
    )


def integer(text: str) -> int:
    """The number that an answer tells: the first integer after " is ", or the first of a terse answer.

    Never the last one of the line, which may be the 2 of "positions/sec^2".

    Raises:
        ReplyError: there is none.
    """
    return int(_number(INTEGER, text))


def bare_integer(text: str) -> int:
    """The number that a terse answer consists of.

    Raises:
        ReplyError: it consists of something else.
    """
    found = INTEGER.fullmatch(text)
    if found is None:
        raise ReplyError(f"{shown(text.encode())} is not a number alone")
    return int(found[0])


def arcseconds(text: str) -> float:
    """The resolution that an answer to ``PR`` or ``TR`` tells [seconds of arc].

    Raises:
        ReplyError: there is none, or it is zero.
    """
    value = float(_number(DECIMAL, text))
    if value == 0.0:
        raise ReplyError(f"{shown(text.encode())} is no resolution")
    return value


def done(text: str) -> None:
    """The answer to an order: nothing but the star. Anything more answers something else.

    Raises:
        ReplyError: it says more.
    """
    if text:
        raise ReplyError(f"{shown(text.encode())} answers something else")


def echoing(text: str) -> bool:
    """Whether the answer to ``E`` says that the unit echoes.

    Raises:
        ReplyError: it says neither.
    """
    return _either(text, ECHO_ON, ECHO_OFF)


def terse(text: str) -> bool:
    """Whether the answer to ``F`` says that the unit is terse.

    Raises:
        ReplyError: it says neither.
    """
    return _either(text, TERSE, VERBOSE)


def independent(text: str) -> bool:
    """Whether the answer to ``C`` says that positions can be commanded, rather than velocities alone.

    Raises:
        ReplyError: it says neither.
    """
    return _either(text, INDEPENDENT, VELOCITY)


def _number(pattern: re.Pattern[str], text: str) -> str:
    _, said, tail = text.partition(" is ")
    found = pattern.search(tail if said else text)
    if found is None:
        raise ReplyError(f"{shown(text.encode())} tells no number")
    return found[0]


def _either(text: str, one: re.Pattern[str], other: re.Pattern[str]) -> bool:
    """Whether an answer says the one and not the other."""
    yes, no = one.search(text) is not None, other.search(text) is not None
    if yes == no:
        raise ReplyError(f"{shown(text.encode())} does not tell the mode that was asked for")
    return yes
