"""calibration.json: a round trip without loss, and errors that name the file and the key."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest

from cotarget.calibration import (
    Calibration,
    Covariance,
    HeldOut,
    Rejected,
    Residuals,
    View,
    load_calibration,
    save_calibration,
)
from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import DEFAULT_GAMMA, DEFAULT_T, BoardConfig
from cotarget.errors import CalibrationError, ConfigError
from cotarget.pantilt import HeadGeometry
from cotarget.rig_geometry import FixedCamera, ZoomHead
from tests.support.rigs import with_zoom_head

ROUNDING = 1e-15  # between radians and degrees, matrix and rotation vector


def example():
    rng = np.random.default_rng(0)
    lens = Intrinsics((640, 480), (686.1, 684.2), (325.3, 239.4), (-0.2, 0.01, 1e-5, -1e-4, 0.0))
    return Calibration(
        fixed=FixedCamera(lens),
        zoom_head=ZoomHead(
            ZoomLens((667.0, 1300.0), (lens, lens.scaled(2.0)), (0.0, -0.012)),
            DEFAULT_GAMMA,
            DEFAULT_T,
            HeadGeometry(0.005, 0.0017, 1.001, 0.999, 0.01, -0.02),
        ),
        pitch_mm=0.009,
        residuals=Residuals(0.1, 0.2, None, 0.4, 5, 6, 7, 8, (Rejected("a.png", "no board"),)),
        covariance=Covariance(("fixed.fx", "zoom[1].pupil"), np.array([[0.04, 1e-5 / 3], [1e-5 / 3, 1e-8]])),
        jitter=0.0003,
        held_out=HeldOut(9, 0.4, 0.2, 0.1, 2.0, 2.0),
        board=BoardConfig(),
        views=(
            View("fixed", rng.uniform(0, 640, (54, 2)), 0),
            View(
                "zoom",
                np.where(np.arange(54)[:, None] < 20, np.nan, rng.uniform(0, 640, (54, 2))),
                0,
                0.1,
                -0.2,
                667.0,
                1.5,
                "z.png",
            ),
        ),
        provenance={"method": "sequential", "images": 2},
    )


def test_round_trip(tmp_path):
    path, before = tmp_path / "calibration.json", example()
    save_calibration(path, before)
    after = load_calibration(path)
    assert after.zoom_head.lens == before.zoom_head.lens
    for name in ("fixed", "pitch_mm", "residuals", "held_out", "board"):
        assert getattr(after, name) == getattr(before, name)
    assert dict(after.provenance) == dict(before.provenance)
    assert np.allclose(
        after.zoom_head.T_zoom0_fixed.as_matrix(), before.zoom_head.T_zoom0_fixed.as_matrix(), rtol=0, atol=ROUNDING
    )
    assert np.allclose(
        after.zoom_head.T_head_zoom.as_matrix(), before.zoom_head.T_head_zoom.as_matrix(), rtol=0, atol=ROUNDING
    )
    assert dataclasses.astuple(after.zoom_head.axes) == pytest.approx(
        dataclasses.astuple(before.zoom_head.axes), abs=ROUNDING
    )
    assert after.jitter == pytest.approx(before.jitter, abs=ROUNDING)
    assert after.covariance.parameters == before.covariance.parameters
    assert (after.covariance.matrix == before.covariance.matrix).all()
    for a, b in zip(after.views, before.views, strict=True):
        assert np.array_equal(a.corners_px, b.corners_px, equal_nan=True)
        assert replace(a, corners_px=None).name == b.name
        assert (a.camera, a.board, a.pan, a.tilt, a.focal_px, a.t) == (
            b.camera,
            b.board,
            b.pan,
            b.tilt,
            b.focal_px,
            b.t,
        )
    assert list(tmp_path.iterdir()) == [path]  # no temporary file stays


def test_optional_parts_may_be_missing(tmp_path):
    path = tmp_path / "c.json"
    bare = replace(
        with_zoom_head(example(), T_head_zoom=None),
        pitch_mm=None,
        residuals=None,
        covariance=None,
        board=None,
        views=(),
        provenance={},
    )
    save_calibration(path, bare)
    after = load_calibration(path)
    assert (after.zoom_head.T_head_zoom, after.pitch_mm, after.residuals, after.covariance) == (None, None, None, None)


def edited(tmp_path, edit):
    path = tmp_path / "c.json"
    save_calibration(path, example())
    table = json.loads(path.read_text())
    edit(table)
    path.write_text(json.dumps(table))
    return path


@pytest.mark.parametrize(("edit", "message"), [
    (lambda t: t.pop("schema"), "missing key 'schema'"),
    (lambda t: t.update(schema=99), "schema 99 is not 2"),
    (lambda t: t.pop("fixed"), "missing key 'fixed'"),
    (lambda t: t["fixed"].pop("fx"), "fixed: missing key 'fx'; needed here: cx, cy"),
    (lambda t: t["fixed"].update(fx="wide"), "fixed.fx: 'wide' is not a finite number"),
    (lambda t: t["fixed"].update(fx=-1), r"fixed.fx: -1 is not within 1 to 1e\+07"),
    (lambda t: t["fixed"].update(fx=1e8), r"fixed.fx: 1e\+08 is not within 1 to 1e\+07"),
    (lambda t: t["fixed"].update(cy=-1e308), r"fixed.cy: -1e\+308 is not within -6400 to 6400"),
    (lambda t: t["zoom"]["stops"][0].update(nominal_px=1e-300), r"stops\[0\].nominal_px: 1e-300 is not within 1 to"),
    (
        lambda t: t["zoom"]["stops"][0].update(distortion=[1e308, 0, 0, 0, 0]),
        r"zoom.stops\[0\].distortion: 1e\+308 is not within -1e\+06 to 1e\+06",
    ),
    (lambda t: t["head"].update(pan_scale=3), "head.pan_scale: 3 is not within 0.5 to 2"),
    (lambda t: t["head"].update(tilt_scale=1e308), r"head.tilt_scale: 1e\+308 is not within 0.5 to 2"),
    (lambda t: t["fixed"].update(fx=float("nan")), "the number NaN, which is not finite"),
    (lambda t: t["fixed"].update(size=[640]), "fixed.size: has 1 values where 2 are wanted"),
    (lambda t: t["zoom"].update(stops=[]), "zoom.stops: is empty"),
    (lambda t: t["zoom"]["stops"].reverse(), "nominal_px do not increase"),
    (lambda t: t["zoom"]["stops"][1].update(distortion=[0] * 4), r"zoom.stops\[1\].distortion: has 4 values"),
    (
        lambda t: t["T_zoom0_fixed"].update(rotvec_deg=[1e308, 1e308, 3]),
        r"T_zoom0_fixed.rotvec_deg: \[1e\+308, 1e\+308, 3.0\] is more than a whole turn",
    ),
    (lambda t: t.update(T_zoom0_fixed=None), "T_zoom0_fixed: None is not a table"),
    (lambda t: t["T_head_zoom"].pop("rotvec_deg"), "T_head_zoom: missing key 'rotvec_deg'"),
    (lambda t: t["head"].update(squareness_deg=True), "head.squareness_deg: True is not a finite number"),
    (lambda t: t["residuals"].update(pairs=1.5), "residuals.pairs: 1.5 is not a whole number"),
    (lambda t: t["covariance"]["matrix"].pop(), "covariance.matrix: has 1 values where 2 are wanted"),
    (lambda t: t.update(covariance={"parameters": [], "matrix": []}), "covariance.parameters: is empty"),
    (lambda t: t["covariance"].update(parameters=["fixed.fx", "zoom[2].pupil"]),
     r"covariance.parameters: 'zoom\[2\].pupil' is no parameter; they are: fixed.fx, .*, head.tilt_zero"),
    (lambda t: t["covariance"].update(parameters=["fixed.fx"] * 2), "parameters: 'fixed.fx' is there twice"),
    (lambda t: t["covariance"].update(matrix=[[1, 0], [0, -2]]),
     r"covariance.matrix\[1\]\[1\]: -2 is no variance of zoom\[1\].pupil"),
    (lambda t: t["covariance"].update(matrix=[[0, 1e-9], [1e-9, 1]]), r"matrix\[0\]\[0\]: 0 is no variance"),
    (lambda t: t["covariance"].update(matrix=[[1, 0.5], [0.4, 1]]), "covariance.matrix: is no covariance: not symm"),
    (lambda t: t["covariance"].update(matrix=[[1, 1e-9], [2e-9, 1e-17]]), "covariance.matrix: is no covariance"),
    (lambda t: t["covariance"].update(matrix=[[1, 2], [2, 1]]), "covariance.matrix: is no covariance"),
    (lambda t: t["covariance"].update(matrix=[[1e-300, 1e99], [1e99, 1e-300]]), "covariance.matrix: is no covariance"),
    (lambda t: t["head"].update(jitter_deg=-0.01), "head.jitter_deg: -0.01 is negative"),
    (lambda t: t["held_out"].update(widened=0.5), "held_out.widened: 0.5 is less than 1"),
    (lambda t: t["held_out"].update(ratio=-1), "held_out.ratio: -1 is negative"),
    (lambda t: t["held_out"].update(measured_px=-1), "held_out.measured_px: -1 is negative"),
    (lambda t: t["residuals"].update(fixed_rms_px=-1), "residuals.fixed_rms_px: -1 is negative"),
    (lambda t: t["residuals"].update(handeye_rms_px=-1), "residuals.handeye_rms_px: -1 is negative"),
    (lambda t: t["board"].update(square=0), "board.square: 0 is not greater than zero"),
    (lambda t: t.update(board=None), "board: is null, but there are views"),
    (lambda t: t["views"][1].update(camera="left"), r"views\[1\].camera: 'left' is not one of: fixed, zoom"),
    (lambda t: t.update(T_zoom_fixed=1), "unknown key 'T_zoom_fixed'; valid here: T_head_zoom, T_zoom0_fixed, board"),
    (lambda t: t["fixed"].update(k1=0.0), "unknown key 'fixed.k1'; valid here: cx, cy, distortion, fx, fy, size"),
    (lambda t: t["zoom"]["stops"][1].update(focal=0.0), r"unknown key 'zoom.stops\[1\].focal'; valid here: cx"),
    (lambda t: t["T_head_zoom"].update(rotvec=[0] * 3),
     "unknown key 'T_head_zoom.rotvec'; valid here: rotvec_deg, translation"),
    (lambda t: t["views"][0].update(pan_deg=1), r"unknown key 'views\[0\].pan_deg'; valid here: board"),
    (lambda t: t["views"][0]["corners_px"][3].append(1.0), r"views\[0\].corners_px\[3\]: has 3 values where 2 are"),
    (lambda t: t["views"][0]["corners_px"][3].pop(), r"views\[0\].corners_px\[3\]: has 1 values where 2 are wanted"),
    (lambda t: t["covariance"]["matrix"][1].append(0.0), r"covariance.matrix\[1\]: has 3 values where 2 are wanted"),
    (lambda t: t["covariance"]["matrix"][1].insert(0, "a"), r"covariance.matrix\[1\]\[0\]: 'a' is not a finite number"),
    (lambda t: t["views"][0]["corners_px"].pop(), r"views\[0\].corners_px: has 53 values where 54 are wanted"),
])  # fmt: skip
def test_errors_name_the_file_and_the_key_in_one_line(tmp_path, edit, message):
    path = edited(tmp_path, edit)
    with pytest.raises(CalibrationError, match=message) as caught:
        load_calibration(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("content", "message"), [
    (b"", "is empty; give a calibration.json, as cotarget calibrate writes it"),
    (b"[1]", "holds no JSON object; give a"), (b"\xff\xfe", "not UTF-8"),
    (b'{"schema": 2, "fi', "is not JSON: .*; give a"),
    (b'backend = "sim"\n[sim]\nseed = 1\n', "is TOML; give a calibration.json"),
    (b'{"schema": 1e999}', "is no calibration; give a"),
    (b'{"schema": 1e999, "fixed": 1}', "schema inf"),
    (b'{"schema": 1, "board": {}, "pitch_mm": null, "captures": []}',
     "is no calibration, but the index of captures: cotarget calibrate --from its folder makes one of them; give a"),
    (b'{"schema": 1, "versions": {}, "config": null}',
     "is no calibration, but what a capture session or a recording says of itself; give a calibration.json"),
])  # fmt: skip
def test_what_is_no_calibration_at_all(tmp_path, content, message):
    path = tmp_path / "c.json"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=message):
        load_calibration(path)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(CalibrationError, match="no such file"):
        load_calibration(tmp_path / "none.json")
    with pytest.raises(CalibrationError, match="cannot be read"):
        load_calibration(tmp_path)
    with pytest.raises(ConfigError, match="cannot be written"):
        save_calibration(tmp_path / "none" / "c.json", example())


def test_a_calibration_that_is_not_finite_is_not_written(tmp_path):
    path = tmp_path / "c.json"
    with pytest.raises(CalibrationError, match="not finite"):
        save_calibration(path, replace(example(), pitch_mm=float("inf")))
    assert not path.exists()
