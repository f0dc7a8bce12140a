"""`follow` says that the close-up did not show what the fixed camera saw: by state, reason and exit status."""

import json

import pytest

from cotarget.config import RigConfig
from cotarget.evaluation import true_calibration
from cotarget.geometry import pose
from cotarget.sim.world import SimWorld
from tests.support.commands import call
from tests.support.rigs import with_zoom_head

RIG = """
[sim]
scene = "indoor"
targets = ["book"]
[sim.fixed]
rate_hz = 12.5
[sim.zoom]
rate_hz = 12.5
"""
# The indoor book is 0.234 m wide.
LARGE_BOOK = '[targets.book]\nsize = 2.3\ndimension = "width"\nwanted_px = 160\ndetector = "colour"\n'


@pytest.mark.render
@pytest.mark.parametrize("wrong", ["size", pytest.param("calibration", marks=pytest.mark.slow)])
def test_target_missing_in_the_close_up_is_unconfirmed(tmp_path, capsys, wrong):
    """The book is found at once, the lens needs a second, and 3 s without a sight are unconfirmed."""
    calibration = true_calibration(SimWorld(RigConfig(), rendered=()))
    if wrong == "calibration":
        calibration = with_zoom_head(calibration, T_zoom0_fixed=pose([0.3, 0.1, 0.1], [-2, 2, 1]))
    (tmp_path / "rig.toml").write_text(RIG + (LARGE_BOOK if wrong == "size" else ""))
    calibration.save(tmp_path / "c.json")
    command = ("follow", "--rig", tmp_path / "rig.toml", "--calibration", tmp_path / "c.json", "--target", "book")
    status, out, err = call(capsys, *command, "--seconds", 5.0, "--insist")
    assert status == 3
    assert json.loads(out)["states"]["unconfirmed"] > 3
    assert "not found where the zoom camera should show it" in err
    assert len(err.splitlines()) == 1
