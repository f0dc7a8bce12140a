"""calibration.json: errors name the file and the key. tests/formats has what is read and written."""

import json
import re
from dataclasses import replace

import pytest

from cotarget.calibration import Calibration
from cotarget.errors import CalibrationError, ConfigError
from tests.formats.lists import OLD, read

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
    (lambda t: t["fixed"].update(fx=float("nan")), "NaN"), (lambda t: t["fixed"].update(k1=0.0), "'fixed.k1'"),
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
    (b"", "empty"), (b"[1]", "no JSON object"), (b"\xff\xfe", "UTF-8"), (b'{"schema": 2, "fi', "not JSON"),
    (b'backend = "sim"\n[sim]\nseed = 1\n', "TOML"), (b'{"schema": 1e999}', "no calibration"),
    (b'{"schema": 1e999, "fixed": 1}', "schema inf"),
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
