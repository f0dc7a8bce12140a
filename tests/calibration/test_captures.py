"""Captures, photos and calibration.json on disk: what is malformed or missing is refused in one line with its key."""

import json
import re
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cotarget.board import draw_board
from cotarget.calibration import Calibration, Options, calibrate_captures, calibrate_photos
from cotarget.calibration.calibrate import find_views
from cotarget.calibration.captures import INDEX, pair_photos, read_image, read_images, read_index
from cotarget.config import BoardConfig, TargetProfile
from cotarget.detection import make_detector
from cotarget.drivers.mjpeg import decode_jpeg
from cotarget.errors import CalibrationError, ConfigError
from tests.formats.lists import OLD, read

FIXED = {"file": "a.png", "camera": "fixed", "board": 0, "pan": 0.0, "tilt": 0.0, "focal_px": None, "t": 2.0}
ZOOM = {"file": "b.png", "camera": "zoom", "board": 0, "pan": 0.1, "tilt": -0.2, "focal_px": 667.0, "t": 1.0}
BOARD = {"kind": "chessboard", "corners": [9, 6], "square": 0.1}
DECODERS_DIFFER = 5  # by two libraries, in the colour at an edge [grey levels]
LARGE, SMALL = (48, 64), (24, 32)  # height and width [px]
COLOURED = np.zeros((16, 32, 3), np.uint8)
COLOURED[..., 1], COLOURED[:8, :8, 2] = 200, 255  # one corner differs, so that a turn shows


def tagged(orientation):
    """A JPEG with an EXIF tag from 1 to 8, as of a camera that was turned: 3 is upside down, 6 on its side."""
    jpeg = cv2.imencode(".jpg", COLOURED)[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">HHHIHHI", 1, 0x112, 3, 1, orientation, 0, 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def images(folder, sizes):
    for name, size in sizes.items():
        cv2.imwrite(str(folder / name), np.zeros((*size, 3), np.uint8))
    return folder


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    return images(tmp_path, {"a.png": LARGE, "b.png": LARGE, "small.png": SMALL, "unlisted.png": SMALL})


def write(folder, rows, **changes):
    table = {"schema": 1, "board": BOARD, "pitch_mm": None, "captures": rows} | changes
    (folder / INDEX).write_text(json.dumps(table))


def test_captures_may_be_in_any_order_beside_unlisted_images(folder):
    write(folder, [FIXED | {"pan": None, "tilt": None}, ZOOM], board=BOARD | {"kind": "charuco"})
    index = read_index(folder)
    assert index.board.kind == "charuco"
    assert [capture.t for capture in read_images(folder, index.captures)] == [2.0, 1.0]
    assert [(capture.pan, capture.tilt) for capture in index.captures] == [(0.0, 0.0), (0.1, -0.2)]


@pytest.mark.parametrize(("rows", "changes", "said"), [
    ([], {}, "captures: "), ([FIXED], {"schema": 2}, "schema 2"),
    ([FIXED], {"board": BOARD | {"kind": "circles"}}, "board.kind"),
    ([FIXED], {"board": {"kind": "chessboard", "corners": [9, 6]}}, "board.square: Field required"),
    ([FIXED, ZOOM | {"file": "c.png"}], {}, "captures[1].file: c.png"),
    ([FIXED, ZOOM, FIXED], {}, "captures[2].file: a.png"),
    ([FIXED, FIXED | {"file": "./a.png"}], {}, "captures[1].file: a.png"),
    ([FIXED | {"file": "../a.png"}], {}, "captures[0].file"),
    ([FIXED | {"camera": "wide"}], {}, "captures[0].camera"), ([FIXED | {"board": -1}], {}, "captures[0].board"),
    ([FIXED, ZOOM | {"pan": None}], {}, "captures[1].pan"),
    ([{k: v for k, v in ZOOM.items() if k != "tilt"}], {}, "captures[0].tilt"),
    ([ZOOM | {"tilt": "up"}], {}, "captures[0].tilt"), ([ZOOM | {"pan": 90.0}], {}, "captures[0].pan: 90"),
    ([FIXED], {}, "zoom camera"), ([FIXED | {"file": "text.png"}, ZOOM], {}, "text.png"),
    ([FIXED, FIXED | {"file": "small.png"}, ZOOM], {}, "small.png: is 32x24 px"),
])  # fmt: skip
def test_malformed_index_is_refused_with_its_key(folder, rows, changes, said):
    write(folder, rows, **changes)
    with pytest.raises(CalibrationError) as caught:
        calibrate_captures(folder)
    assert str(folder) in str(caught.value)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("orientation", [3, 6])
def test_exif_orientation_turns_no_picture(tmp_path, orientation, monkeypatch):
    """A camera's photos, its stills over the wire and the template are all as its live frames are."""
    path = tmp_path / "a.jpg"
    path.write_bytes(tagged(orientation))
    templates = []
    monkeypatch.setattr("cotarget.detection.ColorTemplateDetector", templates.append)
    make_detector(TargetProfile(0.2, "width", 160.0, "colour", template=path), 25.0)
    for image in (read_image(path), decode_jpeg(path.read_bytes()), *templates):
        assert image.shape == COLOURED.shape
        assert np.abs(image.astype(int) - decode_jpeg(tagged(1))).max() < DECODERS_DIFFER


def test_photos_leave_out_hidden_files(tmp_path):
    images(tmp_path, dict.fromkeys(("left1.png", "right1.png", ".left7.part.png", ".right1.part.png"), SMALL))
    captures, unpaired = pair_photos(tmp_path, "*left*.png", "*right*.png")
    assert [capture.source for capture in captures] == ["left1.png", "right1.png"]
    assert not unpaired


@pytest.mark.parametrize(("names", "left", "said"), [
    ({}, "left*.png", "left*.png"),
    ({"left1.png": SMALL, "left01.png": SMALL, "right1.png": SMALL}, "left*.png", "the same number"),
    ({"left3.png": SMALL, "right2.png": SMALL}, "left*.png", "no two photos"),
    ({"left.png": SMALL, "right2.png": SMALL}, "left*.png", "left.png"),
    ({"right2.png": SMALL}, "right*.png", "right2.png matches both"),
    ({"left1.png": LARGE, "left2.png": SMALL, "right1.png": SMALL, "right2.png": SMALL}, "left*.png",
     "left2.png: is 32x24 px"),
])  # fmt: skip
def test_photos_without_pairs_are_refused(tmp_path, names, left, said):
    images(tmp_path, names)
    with pytest.raises(CalibrationError) as caught:
        calibrate_photos(tmp_path, left, "right*.png", BoardConfig())
    assert said in str(caught.value)
    with pytest.raises(CalibrationError, match="no such folder"):
        calibrate_photos(tmp_path / "none", left, "right*.png", BoardConfig())


def test_sequential_method_rejects_images_beyond_the_shortest_focal_length(tmp_path):
    for name in ("a.png", "b.png", "c.png"):
        cv2.imwrite(str(tmp_path / name), draw_board(BoardConfig(), 30))
    write(tmp_path, [FIXED, ZOOM, ZOOM | {"file": "c.png", "focal_px": 1334.0}])
    views, rejected, _ = find_views(tmp_path, read_index(tmp_path), lambda *_: None, Options("sequential"))
    assert [view.source for view in views] == ["a.png", "b.png"]
    assert [one.name for one in rejected] == ["c.png"]


def test_images_of_two_boards_are_not_used(tmp_path):
    board = BoardConfig()
    large, small = draw_board(board, 40), draw_board(board, 25)
    both = np.pad(large, ((0, 0), (0, small.shape[1]), (0, 0)), constant_values=255)
    both[: small.shape[0], large.shape[1] :] = small
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), both)
    write(tmp_path, [FIXED, ZOOM])
    with pytest.raises(CalibrationError, match=r"two boards are in this image.* like a\.png"):
        calibrate_captures(tmp_path)


COVARIANCE = '{"parameters": ["fixed.fx", "zoom[1].pupil"], "matrix": [[0.04, 1e-6], [1e-6, 1e-8]]}'


def edited(tmp_path, edit):
    path, table = tmp_path / "c.json", read(OLD / "calibration.json")
    table["covariance"] = json.loads(COVARIANCE)
    edit(table)
    path.write_text(json.dumps(table))
    return path


@pytest.mark.parametrize(("edit", "key"), [
    (lambda t: t.pop("schema"), "schema"), (lambda t: t.update(schema=99), "schema 99"),
    (lambda t: t["fixed"].pop("fx"), "fixed.fx: Field required"), (lambda t: t["fixed"].update(fx=-1), "fixed.fx"),
    (lambda t: t["fixed"].update(fx=float("nan")), "NaN"), (lambda t: t["fixed"].update(cy=-1e308), "fixed.cy"),
    (lambda t: t.update(covariance={"parameters": [], "matrix": []}), "covariance.parameters"),
    (lambda t: t["covariance"]["matrix"][1].append(0.0), "covariance.matrix[1]"),
    (lambda t: t["fixed"].update(k1=0.0), "'fixed.k1'"),
    (lambda t: t["zoom"].update(stops=[]), "zoom.stops"), (lambda t: t["zoom"]["stops"].reverse(), "nominal_px"),
    (lambda t: t["zoom"]["stops"][0].update(pupil=0.1), "zoom.stops[0].pupil"),
    (lambda t: t.update(T_zoom0_fixed=None), "T_zoom0_fixed"),
    (lambda t: t["head"].update(pan_scale=3), "head.pan_scale"),
    (lambda t: t["head"].update(jitter_deg=-0.01), "head.jitter_deg"),
    (lambda t: t["residuals"].update(handeye_rms_px=-1), "residuals.handeye_rms_px"),
    (lambda t: t["covariance"].update(parameters=["fixed.fx", "zoom[2].pupil"]), "'zoom[2].pupil'"),
    (lambda t: t["covariance"].update(parameters=["fixed.fx"] * 2), "covariance.parameters: 'fixed.fx'"),
    (lambda t: t["covariance"]["matrix"].pop(), "covariance.matrix"),
    (lambda t: t["covariance"].update(matrix=[[1, 0], [0, -2]]), "covariance.matrix[1][1]"),
    (lambda t: t["covariance"].update(matrix=[[1, 0.5], [0.4, 1]]), "covariance.matrix"),
    (lambda t: t["covariance"].update(matrix=[[1, 2], [2, 1]]), "covariance.matrix"),
    (lambda t: t["held_out"].update(widened=0.5), "held_out.widened"),
    (lambda t: t["board"].update(square=0), "board.square"), (lambda t: t.update(board=None), "board"),
    (lambda t: t["views"][1].update(camera="left"), "views[1].camera"),
    (lambda t: t["views"][0]["corners_px"].pop(), "views[0].corners_px"),
])  # fmt: skip
def test_errors_name_the_file_and_the_key_in_one_line(tmp_path, edit, key):
    path = edited(tmp_path, edit)
    with pytest.raises(CalibrationError, match=re.escape(key)) as caught:
        Calibration.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("content", "what"), [
    (b"", "not JSON"), (b"[1]", "no JSON object"), (b"\xff\xfe", "UTF-8"), (b'{"schema": 2, "fi', "not JSON"),
    (b'{"schema": 1e999}', "no calibration"), (b'{"schema": 1e999, "fixed": 1}', "schema inf"),
    (b'{"schema": 1, "board": {}, "pitch_mm": null, "captures": []}', "no calibration"),
])  # fmt: skip
def test_other_files_are_refused_with_what_they_are(tmp_path, content, what):
    path = tmp_path / "c.json"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=what):
        Calibration.load(path)


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(CalibrationError, match="no such file"):
        Calibration.load(tmp_path / "none.json")
    with pytest.raises(CalibrationError, match="cannot be read"):
        Calibration.load(tmp_path)
    with pytest.raises(ConfigError, match="cannot be written"):
        Calibration.load(OLD / "calibration.json").save(tmp_path / "none" / "c.json")


def test_a_calibration_that_is_not_finite_is_not_written(tmp_path):
    path = tmp_path / "c.json"
    with pytest.raises(CalibrationError, match="not written"):
        replace(Calibration.load(OLD / "calibration.json"), pitch_mm=float("inf")).save(path)
    assert not path.exists()
