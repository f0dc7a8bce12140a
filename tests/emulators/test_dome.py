"""The whole rig with a dome over the wire: commands drive an emulated rig in another process."""

import json
import math

import pytest

from experiments.wire.process import EmulatedRig
from tests.support.commands import call, refused

pytestmark = [pytest.mark.wire, pytest.mark.render]
SCENE = {"scene": "indoor", "targets": ["book"], "fixed": {"rate_hz": 10.0}, "zoom": {"rate_hz": 5.0}}


@pytest.fixture(scope="module")
def dome(tmp_path_factory):
    with EmulatedRig(tmp_path_factory.mktemp("dome"), {"sim": SCENE}, "--ptz", "visca") as rig:
        yield rig
        assert rig.errors() == ""


def test_commands_move_it_and_doctor_names_it(dome, capsys):
    rig = ("--rig", dome.hardware_toml)
    status, _, err = call(capsys, "point", *rig, "--pan-deg", 12, "--tilt-deg", -4, "--focal-px", 1500)
    assert (status, err) == (0, "")
    truth = dome.truth()
    assert (truth["pan_deg"], truth["tilt_deg"]) == (pytest.approx(12, abs=0.2), pytest.approx(-4, abs=0.2))
    said = json.loads(call(capsys, "where", *rig)[1])
    assert not said["moving"]
    assert said["focal_px"] == pytest.approx(1500, rel=0.01)
    assert said["focal_mm"] is None
    assert "ok       hardware.ptz: VISCA at 127.0.0.1 (UDP " in call(capsys, "doctor", *rig)[1]


def test_a_camera_in_standby_is_one_line_and_nothing_moves(dome, capsys):
    before = dome.truth()
    dome.switch("ptz.standby")
    try:
        said = refused(capsys, "point", "--rig", dome.hardware_toml, "--pan-deg", 50)
    finally:
        dome.switch("ptz.standby", False)
    assert "is in standby: switch it on" in said
    assert math.isclose(dome.truth()["pan_deg"], before["pan_deg"])
