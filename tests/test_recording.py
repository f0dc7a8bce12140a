"""The table of Steps: one line each, complete or not there at all."""

import csv
import math

import numpy as np
import pytest

from cotarget.detection import Detection
from cotarget.errors import ConfigError
from cotarget.loop import State, Step
from cotarget.recording import COLUMNS, StepTable
from cotarget.rig import Frame, PanTiltState, ZoomState
from cotarget.targeting import Aim
from cotarget.tracking import Track

PICTURE = np.zeros((4, 4, 3), np.uint8)


def step(index=0, found=True):
    detection = Detection(np.array([10.0, 20.0]), np.array([3.0, 4.0]), 1.0)
    track = Track(
        7, 0.5, True, 0, detection.center_px, np.zeros(2), detection.size_px, 4.0, np.eye(4), 1.0, detection, 1.0
    )
    aim = Aim(0.1, 0.2, 5000.0, 4900.0, False, np.array([1.0, 2.0, 10.0]), 10.5)
    return Step(
        index=index,
        t=0.56,
        state=State.FOLLOWING if found else State.LOST,
        reason="" if found else 'out of sight, says "it"\nfor 0.5 s',
        fixed=Frame(PICTURE, 0.5),
        zoom=Frame(PICTURE, 0.48),
        mask=None,
        detections=(detection,) if found else (),
        tracks=(track,) if found else (),
        target=track if found else None,
        aim=aim if found else None,
        commanded=(math.radians(30), math.radians(-20), 4800.0),
        head=PanTiltState(math.radians(29), math.radians(-19), True, 0.56),
        lens=ZoomState(4700.0, True, 0.56),
    )


def test_one_line_a_step(tmp_path):
    path = tmp_path / "steps.csv"
    with StepTable(path) as table:
        table.write(step(0))
        assert not path.exists()  # not before it is complete
        table.write(step(1, found=False))
    with path.open(newline="") as file:
        first, second = csv.DictReader(file)
    assert tuple(first) == COLUMNS
    numbers = {"index": 0, "t_s": 0.56, "t_fixed_s": 0.5, "t_zoom_s": 0.48, "track": 7, "u_px": 10, "v_px": 20,
               "width_px": 3, "height_px": 4, "depth_m": 10, "range_m": 10.5, "pan_commanded_deg": 30,
               "tilt_commanded_deg": -20, "focal_commanded_px": 4800, "pan_deg": 29, "tilt_deg": -19,
               "focal_px": 4700}  # fmt: skip
    assert {name: float(first[name]) for name in numbers} == pytest.approx(numbers)
    assert (first["state"], first["reason"]) == ("following", "")
    assert (second["state"], second["reason"]) == ("lost", 'out of sight, says "it"\nfor 0.5 s')
    assert {second[name] for name in ("track", "u_px", "width_px", "depth_m", "range_m")} == {""}
    assert list(tmp_path.iterdir()) == [path]


def fill_and_fail(path):
    with StepTable(path) as table:
        table.write(step())
        raise KeyboardInterrupt


def test_a_run_that_fails_leaves_the_old_table_and_no_rubbish(tmp_path):
    path = tmp_path / "steps.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        fill_and_fail(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_no_path_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with StepTable(None) as table:
        table.write(step())
    assert not list(tmp_path.iterdir())


def test_a_table_that_cannot_be_written_is_named_at_once(tmp_path):
    with pytest.raises(ConfigError, match=r"steps\.csv: cannot be written: No such file or directory"):
        StepTable(tmp_path / "none" / "steps.csv")
