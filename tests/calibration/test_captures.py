"""An index of captures that somebody edited, or that lost its images: refused in one line that names the place."""

import json

import cv2
import numpy as np
import pytest

from cotarget.calibration.captures import INDEX, pair_photos, read_images, read_index
from cotarget.errors import CalibrationError

FIXED = {"file": "a.png", "camera": "fixed", "board": 0, "pan": 0.0, "tilt": 0.0, "focal_px": None, "t": 2.0}
ZOOM = {"file": "b.png", "camera": "zoom", "board": 0, "pan": 0.1, "tilt": -0.2, "focal_px": 667.0, "t": 1.0}


@pytest.fixture
def folder(tmp_path):
    for name, size in (("a.png", (48, 64)), ("b.png", (48, 64)), ("small.png", (24, 32)), ("unlisted.png", (8, 8))):
        cv2.imwrite(str(tmp_path / name), np.zeros((*size, 3), np.uint8))
    return tmp_path


def write(folder, rows, kind="chessboard"):
    table = {"schema": 1, "board": {"kind": kind, "corners": [9, 6], "square": 0.1}, "pitch_mm": None}
    (folder / INDEX).write_text(json.dumps(table | {"captures": rows}))


def test_order_and_unlisted_images_do_no_harm(folder):
    write(folder, [FIXED, ZOOM], kind="charuco")
    index = read_index(folder)
    assert index.board.kind == "charuco"
    assert [capture.t for capture in read_images(folder, index.captures)] == [2.0, 1.0]


def test_the_fixed_camera_needs_no_angles(folder):
    write(folder, [FIXED | {"pan": None, "tilt": None}])
    assert read_index(folder).captures[0].pan == 0.0


@pytest.mark.parametrize(("rows", "said"), [
    ([FIXED, ZOOM | {"file": "c.png"}], r"captures\[1\].file: c.png: no such file"),
    ([FIXED, ZOOM, FIXED], r"captures\[2\].file: a.png is captures\[0\] already"),
    ([FIXED, FIXED | {"file": "./a.png"}], r"captures\[1\].file: a.png is captures\[0\] already"),
    ([FIXED | {"camera": "wide"}], r"captures\[0\].camera: 'wide' is not one of: fixed, zoom"),
    ([FIXED | {"board": -1}], r"captures\[0\].board: -1"),
    ([FIXED | {"board": 1.5}], r"captures\[0\].board"),
    ([FIXED, ZOOM | {"pan": None}], r"captures\[1\].pan: is missing; .* needs the head's pan and tilt"),
    ([{k: v for k, v in ZOOM.items() if k != "tilt"}], r"captures\[0\].tilt: is missing"),
    ([ZOOM | {"pan": 90.0}], r"captures\[0\].pan: 90 .* looks like degrees"),
    ([ZOOM | {"tilt": -31}], r"captures\[0\].tilt: -31 .* looks like degrees"),
    ([FIXED, FIXED | {"file": "small.png"}], "small.png: is 32x24 px where a.png of the same camera is 64x48"),
])  # fmt: skip
def test_what_makes_no_sense_is_refused_by_name(folder, rows, said):
    write(folder, rows)
    with pytest.raises(CalibrationError, match=said) as caught:
        list(read_images(folder, read_index(folder).captures))
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_kind_of_board_is_named(folder):
    write(folder, [FIXED], kind="circles")
    with pytest.raises(CalibrationError, match=r"board.kind: 'circles' is not one of: charuco, chessboard"):
        read_index(folder)


def test_what_a_killed_run_left_is_no_photo(folder):
    for name in ("left1.png", "right1.png", ".left7.part.png", ".right1.part.png"):
        cv2.imwrite(str(folder / name), np.zeros((9, 9, 3), np.uint8))
    captures, unpaired = pair_photos(folder, "*left*.png", "*right*.png")
    assert [capture.source for capture in captures] == ["left1.png", "right1.png"]
    assert not unpaired


def test_photos_of_two_sizes_are_refused(folder):
    for name, size in (
        ("left1.png", (48, 64)),
        ("left2.png", (24, 32)),
        ("right1.png", (9, 9)),
        ("right2.png", (9, 9)),
    ):
        cv2.imwrite(str(folder / name), np.zeros((*size, 3), np.uint8))
    captures, unpaired = pair_photos(folder, "left*.png", "right*.png")
    assert not unpaired
    with pytest.raises(CalibrationError, match=r"left2.png: is 32x24 px where left1.png .* is 64x48"):
        list(read_images(folder, captures))
