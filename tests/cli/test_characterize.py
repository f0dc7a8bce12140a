"""The command that characterizes a dome: its question, and what it prints."""

import tomllib

import pytest

from cotarget import characterization
from cotarget.characterization import ZOOM_STEPS, Characteristics
from tests.support.commands import HARDWARE, call
from tests.support.onvif_dome import OnvifUnit
from tests.support.plants import FEED_SIZE, PASSWORD, USER

pytestmark = pytest.mark.wire


@pytest.fixture
def dome(tmp_path, monkeypatch):
    monkeypatch.setenv("COTARGET_PASSWORD", PASSWORD)
    with OnvifUnit() as unit:
        (tmp_path / "rig.toml").write_text(f"""
backend = "hardware"
[hardware.fixed]
driver = "stream"
url = "{unit.stream.url}"
user = "{USER}"
size = {list(FEED_SIZE)}
[hardware.ptz]
driver = "onvif"
host = "{unit.server.host}"
port = {unit.server.port}
user = "{USER}"
size = {list(FEED_SIZE)}
pan_deg = [-150, 170]
tilt_deg = [-30, 90]
wide_deg = 60
lens = [[0, 1], [1, 10]]
""")
        unit.file = tmp_path / "rig.toml"
        yield unit


def test_what_was_measured_becomes_keys(dome, capsys, monkeypatch):
    """By hand: pan counts the other way and 1.2 times as far; 320 px over 2 x 200 px are 77.3 degrees."""
    growths = tuple((277.13 * 10 ** (i / ZOOM_STEPS), 8.0 ** (i / ZOOM_STEPS)) for i in range(ZOOM_STEPS + 1))
    found = Characteristics(
        moves=True,
        orientation="upright",
        scale=(-1.2, 1.01),
        focal_px=200.0,
        missed_deg=0.5,
        light_s=0.3,
        report_s=0.24,
        stop_s=0.4,
        turns_at_zoom=True,
        growths=growths,
        speeds=((1.0, 1.0), (1.5, 0.9), (2.5, 0.3), (4.0, 0.29), (6.0, 0.1)),
    )
    monkeypatch.setattr(characterization, "characterize", lambda *arguments: found)
    status, out, err = call(capsys, "characterize", "--rig", dome.file, "--yes")
    assert status == 0, err
    keys = tomllib.loads(out)["hardware"]["ptz"]
    assert keys["pan_sign"] == -1
    assert keys["pan_deg"] == [-204.0, 180.0]
    assert not {"tilt_sign", "tilt_deg"} & keys.keys()  # to 1 % as rig.toml has it
    assert keys["wide_deg"] == 77.3
    assert (keys["latency_s"], keys["command_delay_s"]) == (0.24, 0.06)
    assert keys["slack_deg"] >= 0.5
    assert keys["all_axes"] is True
    assert keys["stop_delay_s"] == 0.4
    assert keys["zoomed_speeds"] == [[1.5, 17.2], [4.0, 5.7]]  # 0.3 and 0.1 rad/s
    assert keys["lens"][0] == [0.0, 1.0]
    assert keys["lens"][-1] == [1.0, 8.0]
    assert "turns on for 0.46 s after a halt" in err


@pytest.mark.parametrize("answer", [None, "no\n"])
def test_nothing_moves_without_consent(dome, capsys, monkeypatch, tmp_path, answer):
    (tmp_path / "answer").write_text(answer or "")
    with (tmp_path / "answer").open() as said:
        monkeypatch.setattr("sys.stdin", said)
        status, out, err = call(capsys, "characterize", "--rig", dome.file)
    assert (status, out) == (1, "")  # stdout is for the keys
    assert "nothing was turned; it needs the answer yes, or --yes" in err
    assert "degrees of pan" in err
    assert "AbsoluteMove" not in dome.moves


def test_a_dome_whose_picture_does_not_move_is_named(dome, capsys, monkeypatch):
    monkeypatch.setattr(characterization, "characterize", lambda *arguments: Characteristics(moves=False))
    status, out, err = call(capsys, "characterize", "--rig", dome.file, "--yes")
    assert (status, out) == (1, "")
    assert "write absolute = false into [hardware.ptz]" in err


def test_a_head_that_is_no_dome_is_refused(tmp_path, capsys):
    (tmp_path / "rig.toml").write_text(HARDWARE)
    status, _, err = call(capsys, "characterize", "--rig", tmp_path / "rig.toml", "--yes")
    assert status == 1
    assert "cotarget latency" in err
