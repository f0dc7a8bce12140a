"""`follow` says whether the close-up showed what the fixed camera saw: by state, reason and exit status."""

import json

import numpy as np
import pytest

from cotarget.calibration import save_calibration
from cotarget.config import RigConfig
from cotarget.evaluation import true_calibration
from cotarget.geometry import pose
from cotarget.sim.world import SimWorld
from tests.support.commands import call
from tests.support.rigs import with_zoom_head

SECONDS = 5.0  # the book is found at once, the lens needs a second, and 3 s without a sight are unconfirmed
SHORT_S = 2.5  # enough to follow it
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


def millimetres(T):
    return pose(1000 * np.asarray(T.translation), np.degrees(T.rotation.as_rotvec()))


@pytest.fixture(scope="module")
def true():
    return true_calibration(SimWorld(RigConfig(), rendered=()))


def follow(folder, capsys, calibration, *more, rig=RIG, seconds=SECONDS):
    (folder / "rig.toml").write_text(rig)
    save_calibration(folder / "c.json", calibration)
    command = ("follow", "--rig", folder / "rig.toml", "--calibration", folder / "c.json", "--target", "book")
    return call(capsys, *command, "--seconds", seconds, *more)


@pytest.mark.render
def test_target_in_both_views_is_followed(tmp_path, capsys, true):
    status, out, err = follow(tmp_path, capsys, true, seconds=SHORT_S)
    assert (status, err) == (0, "")
    states = json.loads(out)["states"]
    assert {name for name, count in states.items() if count} == {"searching", "following"}
    assert states["following"] > 20


@pytest.mark.render
@pytest.mark.parametrize(
    "wrong", ["size", *(pytest.param(each, marks=pytest.mark.slow) for each in ("millimetres", "another rig"))]
)
def test_target_missing_in_the_close_up_is_unconfirmed(tmp_path, capsys, true, wrong):
    calibration = {
        "millimetres": with_zoom_head(true, T_zoom0_fixed=millimetres(true.zoom_head.T_zoom0_fixed)),
        "another rig": with_zoom_head(true, T_zoom0_fixed=pose([0.3, 0.1, 0.1], [-2, 2, 1])),
        "size": true,
    }[wrong]
    rig = RIG + (LARGE_BOOK if wrong == "size" else "")
    status, out, err = follow(tmp_path, capsys, calibration, "--insist", rig=rig)
    assert status == 3
    states = json.loads(out)["states"]
    assert states["unconfirmed"] > 3
    assert "not found where the zoom camera should show it" in err
    assert len(err.splitlines()) == 1


BEYOND = {
    "targets.book.size: 23.4": LARGE_BOOK.replace("2.3", "23.4"),
    "targets.book.wanted_px: 5000": LARGE_BOOK.replace("160", "5000"),
}


@pytest.mark.parametrize("named", BEYOND)
def test_follow_refuses_an_implausible_target(tmp_path, capsys, true, named):
    status, out, err = follow(tmp_path, capsys, true, rig=RIG + BEYOND[named])
    assert (status, out) == (1, "")
    [line] = err.splitlines()
    assert line.startswith(f"cotarget follow: {tmp_path / 'rig.toml'}: {named}")
    assert "--insist" in line
