"""Where the stop file of a rig.toml is, and a folder in which nobody could make it."""

from pathlib import Path

import pytest

from cotarget.backends import load_config
from cotarget.errors import ConfigError, EmergencyStopError
from cotarget.safety.stop_file import find_stop_file, refuse_if_stopped, write_stop_file

HARDWARE = 'backend = "hardware"\n'
NAMED = '[safety]\nstop_file = "run/halt"\n'
WITHOUT = "[safety]\nstop_file = false\n"


@pytest.mark.parametrize(
    ("text", "file"),
    [
        (HARDWARE, "roof.stop"),
        (HARDWARE + NAMED, "run/halt"),
        (HARDWARE + WITHOUT, None),
        ("", None),
        (NAMED, "run/halt"),
    ],
)
def test_every_reader_of_a_rig_finds_the_same_file(tmp_path, text, file):
    rig = tmp_path / "roof.toml"
    rig.write_text(text)
    wanted = None if file is None else tmp_path / file
    assert load_config(rig).safety.stop_file == wanted
    for broken in ("", "[sim\n"):  # stopping works where the file is TOML no more
        rig.write_text(text + broken)
        if wanted is not None:
            assert find_stop_file(rig) == wanted
        else:
            with pytest.raises(ConfigError, match=r"has no stop file; give one|is not TOML"):
                find_stop_file(rig)


def test_a_link_to_a_rig_has_the_stop_file_of_the_rig(tmp_path):
    (tmp_path / "roof.toml").write_text(HARDWARE)
    link = tmp_path / "calib.toml"
    link.symlink_to(tmp_path / "roof.toml")
    assert load_config(link).safety.stop_file == find_stop_file(link) == find_stop_file(tmp_path / "roof.toml")


def test_a_broken_line_of_the_stop_file_is_not_taken_for_the_default(tmp_path):
    """Else a stop would be made that no rig watches."""
    (tmp_path / "roof.toml").write_text(HARDWARE + '[safety]\nstop_file = "run/halt\n')
    with pytest.raises(ConfigError, match="is not TOML"):
        find_stop_file(tmp_path / "roof.toml")


def test_true_is_no_stop_file(tmp_path):
    (tmp_path / "roof.toml").write_text(HARDWARE + "[safety]\nstop_file = true\n")
    with pytest.raises(ConfigError, match=r"safety\.stop_file: True is not a text"):
        load_config(tmp_path / "roof.toml")


def test_a_folder_that_cannot_be_written_keeps_the_head_from_moving(tmp_path, monkeypatch):
    """As on a file system that became read-only; root may write whatever a folder's mode says."""
    path = tmp_path / "roof.stop"
    refuse_if_stopped(path)
    monkeypatch.setattr("cotarget.safety.stop_file.os.access", lambda folder, mode: Path(folder) != tmp_path)
    with pytest.raises(ConfigError, match=r"nobody could stop the head by this file: .* cannot be written; allow it"):
        refuse_if_stopped(path)
    monkeypatch.undo()
    write_stop_file(path, "a cat")
    with pytest.raises(EmergencyStopError, match="a cat"):
        refuse_if_stopped(path)
