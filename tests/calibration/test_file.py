"""calibration.json: a round trip without loss, and errors that name the file and the key."""

import dataclasses
import json
import re
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


def test_calibration_file_round_trip_is_exact(tmp_path):
    path, before = tmp_path / "calibration.json", example()
    save_calibration(path, before)
    after = load_calibration(path)
    assert after.zoom_head.lens == before.zoom_head.lens
    for name in ("fixed", "pitch_mm", "residuals", "held_out", "board"):
        assert getattr(after, name) == getattr(before, name)
    assert dict(after.provenance) == dict(before.provenance)
    for name in ("T_zoom0_fixed", "T_head_zoom"):
        one, other = (getattr(calibration.zoom_head, name).as_matrix() for calibration in (after, before))
        assert np.allclose(one, other, rtol=0, atol=ROUNDING)
    assert dataclasses.astuple(after.zoom_head.axes) == pytest.approx(
        dataclasses.astuple(before.zoom_head.axes), abs=ROUNDING
    )
    assert after.jitter == pytest.approx(before.jitter, abs=ROUNDING)
    assert after.covariance.parameters == before.covariance.parameters
    assert (after.covariance.matrix == before.covariance.matrix).all()
    for a, b in zip(after.views, before.views, strict=True):
        assert np.array_equal(a.corners_px, b.corners_px, equal_nan=True)
        for name in ("camera", "board", "pan", "tilt", "focal_px", "t", "source"):
            assert getattr(a, name) == getattr(b, name)
    assert list(tmp_path.iterdir()) == [path]  # no temporary file stays


def test_calibration_file_may_lack_optional_parts(tmp_path):
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


@pytest.mark.parametrize(("edit", "key"), [
    (lambda t: t.pop("schema"), "schema"),
    (lambda t: t.update(schema=99), "schema 99"),
    (lambda t: t.pop("fixed"), "fixed"),
    (lambda t: t["fixed"].pop("fx"), "fixed: missing key 'fx'"),
    (lambda t: t["fixed"].update(fx=-1), "fixed.fx"),
    (lambda t: t["fixed"].update(fx=float("nan")), "NaN"),
    (lambda t: t["fixed"].update(cy=-1e308), "fixed.cy"),
    (lambda t: t["fixed"].update(size=[640]), "fixed.size"),
    (lambda t: t["fixed"].update(k1=0.0), "'fixed.k1'"),
    (lambda t: t["zoom"].update(stops=[]), "zoom.stops"),
    (lambda t: t["zoom"]["stops"].reverse(), "nominal_px"),
    (lambda t: t["zoom"]["stops"][0].update(pupil=0.1), "zoom.stops[0].pupil"),
    (lambda t: t["zoom"]["stops"][0].update(nominal_px=1e-300), "zoom.stops[0].nominal_px"),
    (lambda t: t["zoom"]["stops"][1].update(cx=1e308), "zoom.stops[1].cx"),
    (lambda t: t["zoom"]["stops"][1].update(focal=0.0), "'zoom.stops[1].focal'"),
    (lambda t: t["zoom"]["stops"][0].update(distortion=[1e308, 0, 0, 0, 0]), "zoom.stops[0].distortion"),
    (lambda t: t["zoom"]["stops"][1].update(distortion=[0] * 4), "zoom.stops[1].distortion"),
    (lambda t: t["T_zoom0_fixed"].update(rotvec_deg=[1e308, 1e308, 3]), "T_zoom0_fixed.rotvec_deg"),
    (lambda t: t.update(T_zoom0_fixed=None), "T_zoom0_fixed"),
    (lambda t: t["T_head_zoom"].pop("rotvec_deg"), "T_head_zoom: missing key 'rotvec_deg'"),
    (lambda t: t["head"].update(pan_scale=3), "head.pan_scale"),
    (lambda t: t["head"].update(squareness_deg=True), "head.squareness_deg"),
    (lambda t: t["head"].update(jitter_deg=-0.01), "head.jitter_deg"),
    (lambda t: t["residuals"].update(pairs=1.5), "residuals.pairs"),
    (lambda t: t["residuals"].update(handeye_rms_px=-1), "residuals.handeye_rms_px"),
    (lambda t: t.update(covariance={"parameters": [], "matrix": []}), "covariance.parameters"),
    (lambda t: t["covariance"].update(parameters=["fixed.fx", "zoom[2].pupil"]), "'zoom[2].pupil'"),
    (lambda t: t["covariance"].update(parameters=["fixed.fx"] * 2), "covariance.parameters: 'fixed.fx'"),
    (lambda t: t["covariance"]["matrix"].pop(), "covariance.matrix"),
    (lambda t: t["covariance"]["matrix"][1].append(0.0), "covariance.matrix[1]"),
    (lambda t: t["covariance"].update(matrix=[[1, 0], [0, -2]]), "covariance.matrix[1][1]"),
    (lambda t: t["covariance"].update(matrix=[[0, 1e-9], [1e-9, 1]]), "covariance.matrix[0][0]"),
    (lambda t: t["covariance"].update(matrix=[[1, 0.5], [0.4, 1]]), "covariance.matrix"),
    (lambda t: t["covariance"].update(matrix=[[1, 2], [2, 1]]), "covariance.matrix"),
    (lambda t: t["covariance"].update(matrix=[[1e-300, 1e99], [1e99, 1e-300]]), "covariance.matrix"),
    (lambda t: t["held_out"].update(widened=0.5), "held_out.widened"),
    (lambda t: t["board"].update(square=0), "board.square"),
    (lambda t: t.update(board=None), "board"),
    (lambda t: t["views"][1].update(camera="left"), "views[1].camera"),
    (lambda t: t["views"][0]["corners_px"][3].pop(), "views[0].corners_px[3]"),
    (lambda t: t["views"][0]["corners_px"].pop(), "views[0].corners_px"),
])  # fmt: skip
def test_errors_name_the_file_and_the_key_in_one_line(tmp_path, edit, key):
    path = edited(tmp_path, edit)
    with pytest.raises(CalibrationError, match=re.escape(key)) as caught:
        load_calibration(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("content", "what"), [
    (b"", "empty"), (b"[1]", "no JSON object"), (b"\xff\xfe", "UTF-8"), (b'{"schema": 2, "fi', "not JSON"),
    (b'backend = "sim"\n[sim]\nseed = 1\n', "TOML"),
    (b'{"schema": 1e999}', "no calibration"),
    (b'{"schema": 1e999, "fixed": 1}', "schema inf"),
    (b'{"schema": 1, "board": {}, "pitch_mm": null, "captures": []}', "captures"),
    (b'{"schema": 1, "versions": {}, "config": null}', "session"),
])  # fmt: skip
def test_other_files_are_refused_with_what_they_are(tmp_path, content, what):
    path = tmp_path / "c.json"
    path.write_bytes(content)
    with pytest.raises(CalibrationError, match=what):
        load_calibration(path)


def test_missing_files_and_folders_are_refused(tmp_path):
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
