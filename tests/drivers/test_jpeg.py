"""Damaged JPEGs: what libjpeg says of them to OpenCV, on stderr, is what the decoder must refuse."""

import os
import select
import sys

import cv2
import numpy as np
import pytest

from cotarget.drivers.mjpeg import (
    USUAL,
    USUAL_AFTER_EXACT,
    DamagedError,
    ExcessError,
    StreamDecoder,
    decode_jpeg,
    import_simplejpeg,
)
from cotarget.errors import MissingPackageError

GRAY, FULL, HALF, QUARTER = 0, 0x111111, 0x211111, 0x221111  # how finely a picture's colour is sampled
KINDS = [
    # size, quality, sampling, Huffman tables of its own, progressive, restart interval
    ((320, 240), 90, QUARTER, 0, 0, 0),
    ((320, 240), 30, QUARTER, 1, 0, 0),
    ((640, 480), 90, HALF, 0, 0, 0),
    ((64, 48), 95, FULL, 0, 0, 0),
    ((61, 43), 60, QUARTER, 0, 0, 0),
    ((64, 48), 90, GRAY, 0, 0, 0),
    ((320, 240), 90, QUARTER, 0, 0, 4),
    ((320, 240), 90, QUARTER, 0, 1, 0),
    ((16, 16), 50, QUARTER, 0, 0, 0),
]
SCENES = 8  # of each kind


def picture(size, seed, quality=90, sampling=QUARTER, optimized=0, progressive=0, restarts=0):
    """Soft shapes and some noise, as a camera has them."""
    rng = np.random.default_rng(seed)
    width, height = size
    shapes = cv2.resize(rng.integers(0, 255, (max(height // 16, 2), max(width // 16, 2), 3), dtype=np.uint8), size)
    image = np.clip(shapes + rng.normal(0, 3, shapes.shape), 0, 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, optimized]
    options += [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive, cv2.IMWRITE_JPEG_RST_INTERVAL, restarts]
    if sampling == GRAY:
        image = image[:, :, 0]
    else:
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    return cv2.imencode(".jpg", image, options)[1].tobytes()


def opencv(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def accepted(jpeg, decode=decode_jpeg):
    try:
        decode(jpeg)
    except DamagedError:
        return False
    return True


def scan(jpeg):
    """Where the data of its last scan begin; they end two bytes before the end."""
    start = jpeg.rindex(b"\xff\xda")
    return start + 2 + int.from_bytes(jpeg[start + 2 : start + 4])


def damaged(jpeg, rng):
    """The same with its data damaged in many ways, none of which takes its last byte or its end."""
    first, last = scan(jpeg), len(jpeg) - 4
    long = (last - first) // 4
    at = first + int(rng.integers(last - first - long))
    flipped = bytes([jpeg[at] ^ 1 << int(rng.integers(8))])
    yield "a bit", jpeg[:at] + flipped + jpeg[at + 1 :]
    yield "a byte", jpeg[:at] + bytes([int(rng.integers(255))]) + jpeg[at + 1 :]
    yield "a quarter is zero", jpeg[:at] + bytes(long) + jpeg[at + long :]
    yield "some are zero", jpeg[:at] + bytes(min(16, long)) + jpeg[at + min(16, long) :]
    yield "some are missing", jpeg[:at] + jpeg[at + min(20, long) :]
    yield "some come twice", jpeg[: at + min(30, long)] + jpeg[at:]
    yield "too many at the end", jpeg[:-2] + b"\x00\x80" + jpeg[-2:]


def complaint(jpeg):
    """What libjpeg, by OpenCV, says on stderr of a picture."""
    kept, (ours, theirs) = os.dup(2), os.pipe()
    os.dup2(theirs, 2)
    try:
        opencv(jpeg)
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(theirs)
    try:
        return os.read(ours, 65536).decode() if select.select([ours], [], [], 0)[0] else ""
    finally:
        os.close(ours)


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_whole_pictures_are_decoded_as_opencv_does(kind):
    for seed in range(SCENES):
        jpeg = picture(kind[0], seed, *kind[1:])
        image = decode_jpeg(jpeg)
        np.testing.assert_array_equal(image, opencv(jpeg))
        assert not image.flags.writeable


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_whatever_libjpeg_complains_of_is_refused_silently(kind, capfd):
    rng, complained = np.random.default_rng(1), 0
    for seed in range(SCENES):
        for what, jpeg in damaged(picture(kind[0], seed, *kind[1:]), rng):
            said = complaint(jpeg)
            complained += bool(said)
            assert not (said and accepted(jpeg)), (what, said)
    assert complained >= 2 * SCENES
    assert capfd.readouterr().err == ""


def test_a_picture_without_one_of_its_restart_markers_or_its_last_scans_is_refused():
    jpeg = picture((320, 240), 0, restarts=4)
    at = jpeg.index(b"\xff\xd3", scan(jpeg))
    assert not accepted(jpeg[:at] + jpeg[at + 2 :])
    jpeg = picture((320, 240), 0, progressive=1)
    assert not accepted(jpeg[: (scan(jpeg) + len(jpeg)) // 2] + jpeg[-2:])


def test_a_header_that_asks_for_gigabytes_is_refused():
    jpeg = picture((64, 48), 0)
    at = jpeg.index(b"\xff\xc0") + 5
    with pytest.raises(DamagedError, match="65000 x 65000"):
        decode_jpeg(jpeg[:at] + (65000).to_bytes(2) * 2 + jpeg[at + 4 :])


# Exif with one entry: orientation 6, to be shown turned by a quarter.
TIFF = bytes.fromhex("4d4d002a 00000008 0001 0112 0003 00000001 0006 0000 00000000")
EXIF = b"\xff\xe1" + (2 + 6 + len(TIFF)).to_bytes(2, "big") + b"Exif\0\0" + TIFF


def test_what_follows_a_picture_what_fills_it_up_and_its_orientation_change_nothing():
    """Fill bytes before a marker are T.81's, B.1.1.2; zeros after the end are some cameras'."""
    jpeg = picture((64, 48), 0)
    turned = jpeg[:2] + EXIF + jpeg[2:]
    assert opencv(turned).shape == (64, 48, 3)  # OpenCV believes it
    for more in (jpeg + bytes(100), jpeg + jpeg, jpeg[:-2] + b"\xff\xff\xff" + jpeg[-2:], turned):
        np.testing.assert_array_equal(decode_jpeg(more), opencv(jpeg))


def test_a_camera_whose_pictures_all_have_bytes_too_many_is_taken_as_it_is():
    """As in issue 51 of axis_camera; one that does not begin with it must do it for longer."""
    exact, whole = picture((64, 48), 0), picture((64, 48), 1)
    more = whole[:-2] + bytes(651) + whole[-2:]
    with pytest.raises(ExcessError):
        decode_jpeg(more)
    decoder = StreamDecoder()
    assert [accepted(more, decoder.decode) for _ in range(USUAL + 3)] == [False] * USUAL + [True] * 3
    np.testing.assert_array_equal(decoder.decode(more), opencv(whole))
    assert accepted(exact, decoder.decode)
    needed = USUAL_AFTER_EXACT
    assert [accepted(more, decoder.decode) for _ in range(needed + 3)] == [False] * needed + [True] * 3


def test_what_is_no_whole_picture_is_refused(capfd):
    jpeg = picture((64, 48), 0)
    for end in range(len(jpeg)):
        assert not accepted(jpeg[:end])
    for wrong in (jpeg[2:], b"\xff\xd8 nothing \xff\xd9", jpeg[:-40] + jpeg[-2:], jpeg[: scan(jpeg)] + jpeg[-2:]):
        assert not accepted(wrong)
    for at in range(2, scan(jpeg)):  # its header: anything but another exception
        accepted(jpeg[:at] + bytes([jpeg[at] ^ 0x55]) + jpeg[at + 1 :])
    assert accepted(jpeg)
    assert capfd.readouterr() == ("", "")


def test_simplejpeg_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "simplejpeg", None)
    for call in (import_simplejpeg, lambda: StreamDecoder().decode(picture((64, 48), 0))):
        with pytest.raises(MissingPackageError, match=r"need simplejpeg, .+ -m pip install .*'simplejpeg>="):
            call()
