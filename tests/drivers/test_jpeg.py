"""Damaged JPEGs: what libjpeg itself says of them on stderr is the truth that the decoder is held against."""

import os
import select

import cv2
import numpy as np
import pytest

from cotarget.drivers.mjpeg import USUAL, JpegDecoder

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
SEQUENTIAL = [kind for kind in KINDS if not kind[4] and not kind[5]]
SCENES = 8  # of each kind
# Under Huffman tables of a picture's own, a unit of zeros may make no sense; then some bytes too many are not noticed.
MOST_MISSED = 0.15
# Two long sides: more units than a row can have; of the latter no number of even rows has just one unit more.
LARGE = [(3264, 2448), (1280, 960)]


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
        cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
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
    decoder = JpegDecoder()
    for seed in range(SCENES):
        jpeg = picture(kind[0], seed, *kind[1:])
        image = decoder.decode(jpeg)
        np.testing.assert_array_equal(image, cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))
        assert not image.flags.writeable


@pytest.mark.parametrize("kind", SEQUENTIAL, ids=str)
def test_whatever_libjpeg_complains_of_is_refused(kind, capfd):
    optimized = kind[3]
    decoder, rng = JpegDecoder(), np.random.default_rng(1)
    complained = missed = 0
    for seed in range(SCENES):
        whole = picture(kind[0], seed, *kind[1:])
        for what, jpeg in damaged(whole, rng):
            assert decoder.decode(whole) is not None
            if said := complaint(jpeg):
                complained += 1
                missed += decoder.decode(jpeg) is not None
                assert not missed or optimized, (what, said)
            else:
                decoder.decode(jpeg)  # may show the damage or not, but silently
    assert complained >= 2 * SCENES
    assert missed <= MOST_MISSED * complained
    assert optimized or capfd.readouterr().err == ""


@pytest.mark.parametrize("size", LARGE)
def test_large_stills(size):
    decoder, jpeg = JpegDecoder(), picture(size, 0)
    assert decoder.decode(jpeg).shape == (size[1], size[0], 3)
    first, long = scan(jpeg), len(jpeg) // 4
    assert decoder.decode(jpeg[: first + long] + bytes(long) + jpeg[first + 2 * long :]) is None


def test_what_follows_a_picture_and_what_fills_it_up_do_no_harm():
    """Fill bytes before a marker are T.81's, B.1.1.2; zeros after the end are some cameras'."""
    decoder, jpeg = JpegDecoder(), picture((64, 48), 0)
    whole = decoder.decode(jpeg)
    for more in (jpeg + bytes(100), jpeg + jpeg, jpeg[:-2] + b"\xff\xff\xff" + jpeg[-2:]):
        np.testing.assert_array_equal(decoder.decode(more), whole)


def test_a_camera_whose_pictures_all_have_bytes_too_many_is_taken_as_it_is():
    """As in issue 51 of axis_camera; not even one that only begins with it loses many."""
    exact, more = picture((64, 48), 0), picture((64, 48), 1)
    more = more[:-2] + bytes(651) + more[-2:]
    decoder = JpegDecoder()
    for _ in range(3):
        assert decoder.decode(more) is not None
    for _ in range(100):
        assert decoder.decode(exact) is not None
    assert [decoder.decode(more) is not None for _ in range(USUAL + 3)] == [False] * USUAL + [True] * 3


def test_what_is_no_whole_picture_is_refused(capfd):
    decoder, jpeg = JpegDecoder(), picture((64, 48), 0)
    for end in range(len(jpeg)):
        assert decoder.decode(jpeg[:end]) is None
    for wrong in (jpeg[2:], b"\xff\xd8 nothing \xff\xd9", jpeg[:-40] + jpeg[-2:], jpeg[: scan(jpeg)] + jpeg[-2:]):
        assert decoder.decode(wrong) is None
    for at in range(2, scan(jpeg)):  # its header: anything but an exception
        decoder.decode(jpeg[:at] + bytes([jpeg[at] ^ 0x55]) + jpeg[at + 1 :])
    assert decoder.decode(jpeg) is not None
