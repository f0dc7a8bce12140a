"""Which of several targets a command follows, as its options say."""

import argparse
import json
from types import SimpleNamespace

import numpy as np
import pytest

import cotarget.cli as cli
from cotarget.calibration import save_calibration
from cotarget.cli.common import POLICIES, Selection, add_selection
from cotarget.config import RigConfig
from cotarget.control import selection as selectors
from cotarget.control.selection import Candidate
from cotarget.errors import ConfigError
from cotarget.evaluation import true_calibration
from cotarget.rig import PanTiltLimits
from cotarget.sim.world import SimWorld
from cotarget.tracking.track import Track

SIZE = (640, 480)
LIMITS = PanTiltLimits((-2.8, 2.8), (-0.8, 0.5), 2.6, 3.6, 0.0)


def chosen(*arguments):
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_selection(parser)
    return Selection(parser.parse_args(arguments), SIZE)


def track(number, center, confirmed=True):
    center, size = np.array(center, float), np.array([20.0, 30.0])
    return Track(number, 0.0, confirmed, 0, center, np.zeros(2), size, 30.0, np.eye(4), 1.0, None)


def pick(selection, seen=(0.0, 0.0, 0.0)):
    """Of three: one to the left that stays, one in the middle that leaves in 9 s, one to the right, in 5 s."""
    places = {2: (100, 200), 3: (320, 200), 5: (600, 200)}
    leaves = (np.inf, 9.0, 5.0)
    candidates = [
        Candidate(track(number, at), lambda _, at=at: np.array([(at[0] - 320) / 686, 0.0]), end, done)
        for (number, at), end, done in zip(places.items(), leaves, seen, strict=True)
    ]
    selection.selector.start(SIZE)
    return selection.selector.select(candidates, np.zeros(2), LIMITS)


def test_the_names_are_those_of_the_policies():
    assert set(POLICIES) == set(selectors.POLICIES)
    assert POLICIES[0] == "first-come"


def test_whom_the_options_mean():
    assert pick(chosen()) == 2
    assert pick(chosen("--policy", "first-come")) == 2
    assert pick(chosen("--policy", "nearest-deadline")) == 5
    assert pick(chosen("--policy", "most-served"), seen=(0.0, 2.0, 2.0)) == 2
    assert pick(chosen("--click", "325", "210")) == 3
    assert pick(chosen("--click", "325", "400")) is None
    assert pick(chosen("--track", "5")) == 5
    assert pick(chosen("--track", "4")) is None


def test_what_was_never_there_is_told():
    selection = chosen("--track", "4")
    selection.see(SimpleNamespace(target=None, tracks=[track(2, (1, 1)), track(3, (9, 9), confirmed=False)]))
    assert selection.unmet == "--track: there was no track 4; the tracks were: 2"
    selection.see(SimpleNamespace(target=track(4, (1, 1)), tracks=[]))
    assert selection.unmet == ""
    assert chosen("--click", "3", "4").unmet == ""  # nothing was there at all
    assert chosen().unmet == ""


def test_what_a_recording_says_is_not_called_an_option():
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_selection(parser)
    plain = parser.parse_args([])
    with pytest.raises(
        ConfigError, match=r"^the recorded click: \(640, 3\) is not in the fixed camera's 640x480 image"
    ):
        Selection(plain, SIZE, {"click": [640.0, 3.0]})
    for table, said in (
        ({"click": [3.0, 4.0]}, "the recorded click: no track came near (3, 4)"),
        ({"track": 9}, "the recorded track: there was no track 9"),
    ):
        selection = Selection(plain, SIZE, table)
        selection.see(SimpleNamespace(target=None, tracks=[track(2, (1, 1))]))
        assert selection.unmet == f"{said}; the tracks were: 2"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text('[sim]\nscene = "indoor"\ntargets = ["book"]\n')
    save_calibration(tmp_path / "good.json", true_calibration(SimWorld(RigConfig(), rendered=())))
    return tmp_path


def follow(capsys, *arguments):
    command = ["follow", "--rig", "rig.toml", "--calibration", "good.json", "--target", "book", "--seconds", "0.3"]
    try:
        status = cli.main([*command, *arguments])
    except SystemExit as left:
        status = left.code
    said = capsys.readouterr()
    return status, said.out, said.err


@pytest.mark.parametrize(("arguments", "part"), [
    (("--policy", "best"), "invalid choice: 'best'"),
    (("--click", "640", "3"), "--click: (640, 3) is not in the fixed camera's 640x480 image"),
    (("--click", "-1", "3"), "--click: (-1, 3) is not in the fixed camera's 640x480 image"),
    (("--click", "3", "nan"), "nan is not a finite number"),
    (("--click", "3"), "expected 2 arguments"),
    (("--track", "0"), "'0' is not a whole number from 1"),
    (("--track", "1", "--policy", "first-come"), "not allowed with argument"),
])  # fmt: skip
def test_a_mistake_ends_in_one_line(folder, capsys, arguments, part):
    status, out, err = follow(capsys, *arguments)
    assert status != 0
    assert out == ""
    assert part in err
    assert len(err.splitlines()) == 1


DOG = "[targets.dog]\nsize = 0.6\ndimension = 'height'\nwanted_px = 200\ndetector = 'motion'\n"


@pytest.mark.parametrize(("name", "part"), [
    ("dog", "a simulated dog cannot be, whatever [targets.dog] says; the simulation has: bird, book, person, and"),
    ("bird2", 'rig.toml: the simulated scene has no bird2; add it: [sim] targets = ["book", "bird2"]'),
])  # fmt: skip
def test_what_the_simulation_does_not_show_is_not_followed(folder, capsys, name, part):
    with (folder / "rig.toml").open("a") as file:
        file.write(DOG)
    status, out, err = follow(capsys, "--target", name)
    assert (status, out) == (1, "")
    assert part in err
    assert len(err.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.render
def test_follow_follows_what_was_chosen(folder, capsys):
    for arguments, state in ((("--track", "1"), "following"), (("--track", "9"), "searching")):
        status, out, err = follow(capsys, *arguments)
        told = json.loads(out)
        assert status == (0 if state == "following" else 4)
        assert told["states"][state] >= told["steps"] - 4  # a track needs four detections
        assert err == ("" if state == "following" else "--track: there was no track 9; the tracks were: 1\n")
