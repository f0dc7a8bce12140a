"""An emulated dome in another process, with RTSP pictures: commands aim it, follow with it and stop it."""

import math
import signal

import numpy as np
import pytest

from cotarget.backends import describe, load_config
from cotarget.calibration import Calibration
from cotarget.targeting import Reach, WantedSize, aim
from tests.emulators.test_whole_rig import (
    BOOK_M,
    DEADLINE_S,
    LOOKED_AT_DEG,
    MOUNT_M,
    PASSWORD,
    PATIENT,
    RESTS_S,
    ROOM,
    RUNS,
    Watch,
    emulated,
    follow,
    program,
    run,
    wait_until_it_rests,
    wait_until_it_turns,
)

pytestmark = [pytest.mark.wire, pytest.mark.render]
TABLES = {
    "sim": ROOM | {"paths": {"book": [[0.0, *BOOK_M], [900.0, *BOOK_M]]}},
    "safety": PATIENT | {"speed_deg_s": 30.0},
}
# A dome with some of the lies that domes in the field tell, none of which needs a word in rig.toml.
LIES = "always-moving,stop-ignored,clock-10h,behind-nat"


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    options = ["--fixed", "rtsp", "--ptz", "onvif", "--profile", LIES, "--user", "viewer"]
    with emulated(tmp_path_factory.mktemp("dome"), TABLES, *options) as found:
        yield found


@pytest.fixture(autouse=True)
def _user(monkeypatch):
    monkeypatch.setenv("COTARGET_PASSWORD", PASSWORD)


def test_a_book_is_aimed_at(rig, capsys):
    """The book's place by the file, independent of any measurement; on a busy machine one run of some."""
    config, (x, y, z) = load_config(rig.hardware_toml), BOOK_M
    book, spec = config.target("book"), describe(config)
    calibration = Calibration.load(rig.calibration).for_streams(spec.fixed.size, spec.zoom.size)
    reach = Reach(spec.head.limits.pan.range, spec.head.limits.tilt.range, spec.zoom.focal_range)
    there = aim(calibration, np.array([x, MOUNT_M - z, y]), reach, wanted_size=WantedSize(book.size, book.wanted_px))
    wanted = math.degrees(there.pan), math.degrees(there.tilt)
    for _ in range(RUNS):
        status, _, err = run(capsys, *follow(rig, "--seconds", "5"))
        assert status == 0, err
        truth = rig.truth()
        if (truth["pan_deg"], truth["tilt_deg"]) == pytest.approx(wanted, abs=LOOKED_AT_DEG):
            break
    assert (truth["pan_deg"], truth["tilt_deg"]) == pytest.approx(wanted, abs=LOOKED_AT_DEG)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_halts_the_dome(rig, capsys, number):
    assert run(capsys, "point", "--rig", rig.hardware_toml, "--pan-deg", "-60", "--tilt-deg", "0")[0] == 0
    turn = ["point", "--rig", rig.hardware_toml, "--pan-deg", "140", "--tilt-deg", "0"]
    with Watch(rig) as watch, program(*turn) as process:
        wait_until_it_turns(rig)
        at = rig.truth()["t"]
        process.send_signal(number)
        _, err = process.communicate(timeout=DEADLINE_S)
        wait_until_it_rests(rig)
    assert "Traceback" not in err
    assert rig.truth()["pan_deg"] < 130.0
    assert watch.rests_since() - at < RESTS_S
