"""The reader of MJPEG streams on hand-made bytes, as manuals and bug reports show them, and on made-up ones."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cotarget.drivers.mjpeg import LONGEST_PICTURE, LONGEST_SKIP, MultipartReader, boundary_of


def segment(marker, payload):
    """A marker with its payload and the length that counts its own two bytes (T.81, B.1.1.4)."""
    return bytes([0xFF, marker]) + (len(payload) + 2).to_bytes(2, "big") + payload


def jpeg(width=16, height=8, data=b"\x12\xff\x00\x34\xff\xd0\x56", app=b"JFIF\0"):
    """The bones of a JPEG: what the reader looks at and no picture; the data holds a stuffed 0xff and a restart."""
    frame = b"\x08" + height.to_bytes(2, "big") + width.to_bytes(2, "big") + b"\x01\x01\x11\x00"
    scan = b"\x01\x01\x00\x00\x3f\x00"
    return b"\xff\xd8" + segment(0xE0, app) + segment(0xC0, frame) + segment(0xDA, scan) + data + b"\xff\xd9"


def part(body, length=None, boundary=b"--myboundary", end=b"\r\n"):
    """One part as the Axis 241Q writes it; ``length`` -1 for no Content-Length."""
    length = len(body) if length is None else length
    stated = b"" if length < 0 else b"Content-Length: %d\r\n" % length
    return boundary + b"\r\nContent-Type: image/jpeg\r\n" + stated + b"\r\n" + body + end


A, B, C = jpeg(data=b"\xaa" * 40), jpeg(32, 24, b"\xbb" * 50), jpeg(640, 480, b"\xcc" * 60)


def read(stream, step=None, boundary="myboundary"):
    reader = MultipartReader(boundary)
    step = step or max(len(stream), 1)
    pictures = [p for i in range(0, len(stream), step) for p in reader.feed(stream[i : i + step], float(i))]
    return [p.jpeg for p in pictures], reader


@pytest.mark.parametrize(
    ("content_type", "boundary"),
    [
        ("multipart/x-mixed-replace;boundary=myboundary", "myboundary"),
        ("multipart/x-mixed-replace; boundary=--myboundary", "myboundary"),
        ('multipart/x-mixed-replace; boundary="my boundary"', "my boundary"),
        ('multipart/x-mixed-replace;BOUNDARY = "--myboundary" ; charset=utf-8', "myboundary"),
        ("multipart/x-mixed-replace;boundary=myboundary;charset=utf-8", "myboundary"),
        ("multipart/x-mixed-replace", None),
        ("multipart/x-mixed-replace;boundary=", None),
        ("multipart/x-mixed-replace;boundary=--", None),
        ("image/jpeg", None),
    ],
)
def test_boundaries_as_servers_announce_them(content_type, boundary):
    assert boundary_of(content_type) == boundary


STREAMS = {
    "as Axis writes it": part(A) + part(B) + part(C),
    "without Content-Length": part(A, -1) + part(B, -1) + part(C, -1),
    "Content-Length too small": part(A, 10) + part(B, 0) + part(C, 3),
    "Content-Length too large": part(A, 5000) + part(B, 10**9) + part(C, 10**30),
    "bytes after each picture": part(A + bytes(9)) + part(B + b"\r\n\r\n") + part(C + b"--\xff\xd9"),
    "no first boundary": part(A).removeprefix(b"--myboundary\r\n") + part(B) + part(C),
    "begins in a picture": A[-20:] + b"\r\n" + part(A) + part(B) + part(C),
    "four dashes": b"".join(part(x, boundary=b"----myboundary") for x in (A, B, C)),
    "bare line feeds": b"".join(part(x).replace(b"\r\n", b"\n") for x in (A, B, C)),
    "no line end after the picture": b"".join(part(x, end=b"") for x in (A, B, C)),
    "another boundary than announced": b"".join(part(x, boundary=b"--other") for x in (A, B, C)),
    "nothing between pictures": A + B + C,
    "the boundary sent early": part(A) + b"--myboundary\r\n" + b"\r\n" + part(B) + part(C),
    "other parts between": part(A) + b"--myboundary\r\nContent-Type: text/plain\r\n\r\nhello\r\n" + part(B) + part(C),
    "closed by the last boundary": part(A) + part(B) + part(C) + b"--myboundary--\r\n",
}


@pytest.mark.parametrize("step", [1, 7, None])
@pytest.mark.parametrize("name", STREAMS)
def test_whole_pictures_come_out_of_every_kind_of_stream(name, step):
    pictures, reader = read(STREAMS[name], step)
    assert pictures == [A, B, C]
    assert reader.broken == 0
    assert not reader.unfinished


CUT = {
    "in its data": B[:-20],
    "without its end": B[:-2],
    "in a table's length": B[:7],
    "in its first segment": B[:10],
    "after its first marker": B[:3],
    "with another picture's start in its data": B[:-20] + C[:-30],
    "with a marker that none has": B[:-20] + b"\xff\x05\xff\xd9",
    "without a scan": b"\xff\xd8" + segment(0xE0, b"JFIF\0") + b"\xff\xd9",
    "with a segment shorter than its length": b"\xff\xd8\xff\xe0\x00\x01" + B[2:],
}


@pytest.mark.parametrize("step", [1, 7, None])
@pytest.mark.parametrize("name", CUT)
def test_a_broken_picture_is_dropped_and_counted_and_the_next_is_whole(name, step):
    for boundary in ("myboundary", None):  # headers alone part them, too
        pictures, reader = read(part(A) + part(CUT[name]) + part(C), step, boundary)
        assert pictures == [A, C]
        assert reader.broken == 1


def test_fill_bytes_may_precede_markers():
    """T.81, B.1.1.2."""
    filled = A[:2] + b"\xff\xff" + A[2:-2] + b"\xff" + A[-2:]
    assert read(part(filled) + part(C))[0] == [filled, C]


def test_a_picture_in_a_picture_is_not_taken_for_it():
    """Cameras put a thumbnail, a whole JPEG, into the application data; not even a broken picture gives it up."""
    thumbnail = jpeg(160, 120)
    whole = jpeg(640, 480, app=b"Exif\0\0" + thumbnail)
    broken = whole[: whole.index(thumbnail) + len(thumbnail)] + b"\0" * 50
    pictures, reader = read(part(whole) + part(broken) + part(A))
    assert pictures == [whole, A]
    assert reader.broken == 1


def test_a_picture_is_out_with_its_last_byte_and_dated_by_its_first():
    stream = part(C)
    first, last = stream.index(C), stream.index(C) + len(C) - 1
    reader = MultipartReader("myboundary")
    for i in range(last):
        assert reader.feed(stream[i : i + 1], float(i)) == []
        assert reader.unfinished == (i >= first + 2)
    (picture,) = reader.feed(stream[last : last + 1], float(last))
    assert (picture.jpeg, picture.t) == (C, float(first))
    assert not reader.unfinished


def test_a_picture_without_end_is_given_up():
    reader = MultipartReader("myboundary")
    reader.feed(C[:-20], 0.0)
    piece = b"\xaa" * 1_000_000
    for i in range(LONGEST_PICTURE // len(piece) + 1):
        assert reader.feed(piece, float(i)) == []
    assert (reader.broken, reader.unfinished) == (1, False)
    assert [p.jpeg for p in reader.feed(b"\r\n" + part(A), 50.0)] == [A]


def test_without_any_boundary_pictures_are_found_again_after_a_broken_one():
    pictures, reader = read(B[:-20] + (A + C) * (LONGEST_SKIP // len(A)), 50_000)
    assert reader.broken == 1
    assert pictures[-1] == C


CUTS = st.sets(st.integers(1, 2000), max_size=12)


def fed(stream, cuts, boundary="myboundary"):
    """Feed a stream in pieces, each at the time that is its first byte's index."""
    reader, pictures, start = MultipartReader(boundary), [], 0
    for end in [*sorted(cut for cut in cuts if cut < len(stream)), len(stream)]:
        pictures += reader.feed(stream[start:end], float(start))
        start = end
    return reader, pictures


CRUMBS = [A, B, C, jpeg(8, 8, b""), part(A), part(B, 3), part(C, -1), b"\xff\xd8\xff", b"\xff\xd9", b"\xff", b"\r\n"]
CRUMBS += [b"--myboundary", b"\r\nContent-Type: image/jpeg\r\n\r\n", b"\xff\xda\x00\x02", bytes(5)]
BOUNDARIES = st.sampled_from(["myboundary", "other", None])


# The same examples in every run, whatever the machine's speed, and no files beside the tests.
@settings(derandomize=True, database=None, deadline=None, max_examples=300)
@given(st.lists(st.sampled_from(CRUMBS) | st.binary(max_size=9), max_size=8), CUTS, BOUNDARIES)
def test_how_a_stream_is_cut_into_pieces_does_not_matter(crumbs, cuts, boundary):
    stream = b"".join(crumbs)
    (pieces, found), (whole, at_once) = fed(stream, cuts, boundary), fed(stream, (), boundary)
    assert [picture.jpeg for picture in found] == [picture.jpeg for picture in at_once]
    assert (pieces.broken, pieces.unfinished) == (whole.broken, whole.unfinished)
    for picture in found:
        assert picture.jpeg.startswith(b"\xff\xd8\xff")
        assert picture.jpeg.endswith(b"\xff\xd9")
