"""Properties of the PTU-D46's codec and of the multipart reader, on examples that hypothesis makes."""

from hypothesis import given, settings
from hypothesis import strategies as st

from cotarget.drivers import ptu_protocol
from cotarget.drivers.mjpeg import MultipartReader
from cotarget.drivers.serial_line import ReplyError

# The same examples in every run, whatever the machine's speed, and no files beside the tests.
PROPERTY = settings(derandomize=True, database=None, deadline=None, max_examples=300)

# The PTU-D46

NUMBERS = st.integers(-999_999_999, 999_999_999)
WORDS = st.sampled_from(["", "Current Pan position is ", "Target Tilt speed is ", "Unit ID is "])
UNITS = st.sampled_from(["", ".", " positions/sec", " positions/sec^2"])
LINE_ENDS = st.sampled_from(["\r\n", "\n\r\n", "\r\n\0"])
EVENTS = st.sampled_from([b"!P", b"!T", b"!D"])


def understood(line, read):
    """What is read from a line; None if it is refused."""
    try:
        rest, _ = ptu_protocol.split_events(line)
        reply = ptu_protocol.parse(rest)
        return None if reply is None else read(reply.text)
    except ReplyError:
        return None


@PROPERTY
@given(st.sampled_from(["PP", "TP", "PS", "TS"]), NUMBERS)
def test_a_command_says_its_value_and_ends_with_the_delimiter(name, value):
    order = ptu_protocol.command(name, value).decode()
    assert order.endswith(" ")
    assert (order[:2], int(order[2:])) == (name, value)


@PROPERTY
@given(NUMBERS, WORDS, UNITS, LINE_ENDS)
def test_a_number_is_read_from_any_wording(number, words, unit, end):
    assert understood(f"* {words}{number}{unit}{end}".encode(), ptu_protocol.integer) == number


@PROPERTY
@given(NUMBERS, EVENTS, st.data())
def test_an_event_may_come_at_any_place_of_an_answer(number, event, data):
    line = f"* {number}\r\n".encode()
    at = data.draw(st.integers(0, len(line)))
    rest, events = ptu_protocol.split_events(line[:at] + event + line[at:])
    assert (rest, events) == (line, (event[1:].decode(),))


@PROPERTY
@given(NUMBERS, st.integers(0x80, 0xFF), st.data())
def test_a_byte_that_no_unit_sends_makes_a_line_no_answer(number, byte, data):
    line = bytearray(f"* {number}\r\n".encode())
    line[data.draw(st.integers(0, len(line) - 3))] = byte  # before its end
    assert understood(bytes(line), ptu_protocol.bare_integer) is None


@PROPERTY
@given(NUMBERS, st.data())
def test_an_answer_that_lost_its_begin_is_no_number(number, data):
    line = f"* {number}\r\n".encode()
    assert understood(line[data.draw(st.integers(1, len(line))) :], ptu_protocol.bare_integer) is None


@PROPERTY
@given(st.binary(max_size=60))
def test_of_any_bytes_an_integer_alone_is_what_they_spell(line):
    number = understood(line, ptu_protocol.bare_integer)
    if number is not None:
        rest = ptu_protocol.split_events(line)[0].decode()
        assert int(rest[rest.index("*" if "*" in rest else "!") + 1 :].strip("\r\n\t \0")) == number


# The multipart reader


def some_bytes(most):
    """Bytes without a line end: a part's header among them would show that the picture was cut."""
    return st.binary(max_size=most).map(lambda data: data.replace(b"\r\n", b"\n\n"))


# Compressed data: 0xff comes with a zero or as a restart marker.
STUFFED = st.sampled_from([b"\xff\x00", b"\xff\xd0", b"\xff\xd7"])
DATA = st.lists(some_bytes(30).map(lambda data: data.replace(b"\xff", b"\xfe")) | STUFFED, max_size=6).map(b"".join)
SIDES = st.integers(1, 5000)


def segment(marker, payload):
    return bytes([0xFF, marker]) + (len(payload) + 2).to_bytes(2) + payload


@st.composite
def jpegs(draw):
    """Markers and lengths of a JPEG, and its (width, height)."""
    width, height = draw(SIDES), draw(SIDES)
    frame = b"\x08" + height.to_bytes(2) + width.to_bytes(2) + b"\x01\x01\x11\x00"
    thumbnail = draw(st.sampled_from([b"", b"\xff\xd8\xff\xd9"]))
    app = segment(0xE1, draw(some_bytes(20)) + thumbnail)
    scan = segment(0xDA, b"\x01\x01\x00\x00\x3f\x00") + draw(DATA)
    return b"\xff\xd8" + app + segment(0xC0, frame) + scan + b"\xff\xd9", (width, height)


def part(body, length=None):
    stated = b"" if length is None else b"Content-Length: %d\r\n" % length
    return b"--b0undary\r\nContent-Type: image/jpeg\r\n" + stated + b"\r\n" + body + b"\r\n"


LENGTHS = st.none() | st.integers(0, 10**6)


def fed(stream, cuts):
    """Feed a stream in pieces, each at the time that is its first byte's index."""
    reader, pictures = MultipartReader("b0undary"), []
    ends = [*sorted(cut for cut in cuts if cut < len(stream)), len(stream)]
    start = 0
    for end in ends:
        pictures += reader.feed(stream[start:end], float(start))
        start = end
    return reader, pictures


CUTS = st.sets(st.integers(1, 2000), max_size=12)


@PROPERTY
@given(st.lists(st.tuples(jpegs(), LENGTHS), min_size=1, max_size=5), CUTS)
def test_whole_pictures_come_out_with_size_and_time_however_they_arrive(sent, cuts):
    stream, begins = b"", []
    for (jpeg, _), length in sent:
        stream += part(jpeg, length)
        begins.append(len(stream) - len(jpeg) - 2)
    reader, pictures = fed(stream, cuts)
    assert [picture.jpeg for picture in pictures] == [jpeg for (jpeg, _), _ in sent]
    assert [picture.size for picture in pictures] == [size for (_, size), _ in sent]
    arrivals = [max((cut for cut in {0, *cuts} if cut <= begin), default=0) for begin in begins]
    assert [picture.t for picture in pictures] == arrivals
    assert (reader.broken, reader.unfinished) == (0, False)


@PROPERTY
@given(jpegs(), jpegs(), jpegs(), LENGTHS, CUTS, st.data())
def test_a_picture_that_is_cut_short_costs_no_other(first, cut, last, length, cuts, data):
    end = data.draw(st.integers(3, len(cut[0]) - 2))
    reader, pictures = fed(part(first[0], length) + part(cut[0][:end], length) + part(last[0], length), cuts)
    assert [picture.jpeg for picture in pictures] == [first[0], last[0]]
    assert reader.broken == 1


@PROPERTY
@given(st.lists(st.one_of(jpegs().map(lambda made: part(made[0])), st.binary(max_size=40))), CUTS)
def test_how_a_stream_is_cut_into_pieces_does_not_matter(chunks, cuts):
    stream = b"".join(chunks)
    (pieces, found), (whole, at_once) = fed(stream, cuts), fed(stream, ())
    assert [picture.jpeg for picture in found] == [picture.jpeg for picture in at_once]
    assert (pieces.broken, pieces.unfinished) == (whole.broken, whole.unfinished)
