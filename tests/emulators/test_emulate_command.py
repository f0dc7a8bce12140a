"""What `cotarget emulate` puts in front of the cameras, and what `follow` says where nothing was there."""

import json
import sys

import pytest

from cotarget.backends import load_config
from cotarget.calibration import save_calibration
from cotarget.config import RigConfig
from tests.support.commands import call, true_calibration


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LP_NUM_THREADS", "1")  # emulate sets it, and how long threads take turns, for its process
    turns = sys.getswitchinterval()
    (tmp_path / "empty.toml").write_text("[sim]\n")
    (tmp_path / "marked.toml").write_text('\ufeffsim = { targets = ["bird"] }\n')
    (tmp_path / "person.toml").write_text('[sim]\ntargets = ["person"]\n')
    save_calibration(tmp_path / "true.json", true_calibration(RigConfig()))
    yield tmp_path
    sys.setswitchinterval(turns)


@pytest.mark.wire
@pytest.mark.render
@pytest.mark.parametrize(("rig", "there"), [
    ([], "person"),
    (["--rig", "marked.toml"], "bird"),
    (["--rig", "empty.toml"], 'none; [sim] targets = ["person"] has one to follow'),
])  # fmt: skip
def test_it_tells_who_is_there_to_be_followed(folder, capsys, rig, there):
    status, out, err = call(capsys, "emulate", *rig, "--write", "hw.toml", "--seconds", "0.01")
    assert (status, err) == (0, "")
    assert f"\ntargets  {there}\n" in out


@pytest.mark.wire
@pytest.mark.render
def test_a_rig_toml_of_the_same_name_is_kept(folder, capsys):
    (folder / "mine.toml").write_text("[sim]\n")
    status, _, err = call(capsys, "emulate", "--write", "mine.toml", "--seconds", "0.01")
    assert status == 0
    assert err == "mine.toml: the one of before is kept as mine.previous-1.toml\n"
    assert (folder / "mine.previous-1.toml").read_text() == "[sim]\n"
    written = load_config(folder / "mine.toml")
    assert (written.backend, written.board) == ("hardware", RigConfig().board)


@pytest.mark.slow
@pytest.mark.render
def test_a_run_that_saw_nothing_says_what_would_be_right(folder, capsys):
    """Nobody is in the wide view in the first seconds of a person's way."""
    wanted = ("follow", "--rig", "person.toml", "--calibration", "true.json", "--target", "person", "--seconds", "0.3")
    status, out, err = call(capsys, *wanted)
    assert status == 4
    told = json.loads(out)
    assert told["states"]["searching"] == told["steps"] > 0
    assert err.startswith(f"cotarget follow: no person was seen in {told['steps']} frames; what --target names has to ")
    assert len(err.splitlines()) == 1
