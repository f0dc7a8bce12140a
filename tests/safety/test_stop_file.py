"""The stop file: its path, its reason, and files that cannot be read or written."""

import os
from pathlib import Path

import pytest

from cotarget.backends import load_config
from cotarget.config import SafetyConfig
from cotarget.drivers.interlock import PositionLostMarker
from cotarget.errors import ConfigError, DeviceError, EmergencyStopError
from cotarget.safety.stop_file import clear_stop_file, find_stop_file, refuse_if_stopped, stop_reason, write_stop_file
from tests.support.rigs import guarded
from tests.support.safety_rigs import SimulatedDevices

HARDWARE = 'backend = "hardware"\n'
NAMED = '[safety]\nstop_file = "run/halt"\n'
WITHOUT = "[safety]\nstop_file = false\n"


@pytest.mark.parametrize(("text", "file"), [
    (HARDWARE, "roof.stop"), (HARDWARE + NAMED, "run/halt"), (HARDWARE + WITHOUT, None), ("", None),
    (NAMED, "run/halt"),
])  # fmt: skip
def test_configuration_and_stop_commands_find_the_same_file(tmp_path, text, file):
    rig = tmp_path / "roof.toml"
    rig.write_text(text)
    wanted = None if file is None else tmp_path / file
    assert load_config(rig).safety.stop_file == wanted
    for broken in ("", "[sim\n"):  # stopping works with an invalid rig.toml
        rig.write_text(text + broken)
        if wanted is not None:
            assert find_stop_file(rig) == wanted
        else:
            with pytest.raises(ConfigError, match=f"^{rig}: "):
                find_stop_file(rig)


def test_a_link_to_a_rig_has_the_stop_file_of_the_rig(tmp_path):
    (tmp_path / "roof.toml").write_text(HARDWARE)
    link = tmp_path / "calib.toml"
    link.symlink_to(tmp_path / "roof.toml")
    assert load_config(link).safety.stop_file == find_stop_file(link) == find_stop_file(tmp_path / "roof.toml")


def test_a_change_of_the_working_directory_changes_neither_stop_file_nor_marker(tmp_path, monkeypatch):
    """As a notebook or a user's driver may do."""
    monkeypatch.chdir(tmp_path)
    Path("elsewhere").mkdir()
    Path("roof.toml").write_text(HARDWARE)
    config = load_config("roof.toml")
    made = SafetyConfig(stop_file=Path("made.stop"))
    lost = PositionLostMarker("/dev/pts/7", made.stop_file)
    with guarded(SimulatedDevices(), made) as by_hand:
        monkeypatch.chdir("elsewhere")
        lost.note("it stalled")
        assert (tmp_path / "made.stop.dev-pts-7.position-lost").exists()
        with guarded(SimulatedDevices(), config.safety) as read:  # opened elsewhere than the file was read
            for rig, name in ((read, "roof.stop"), (by_hand, "made.stop")):
                (tmp_path / name).write_text("on the roof")
                assert rig.stopped == "on the roof"
                with pytest.raises(EmergencyStopError):
                    rig.head.move(0.1, 0.0)


def test_an_incomplete_stop_file_line_is_refused(tmp_path):
    """By the default path a stop would be made that no rig watches."""
    (tmp_path / "roof.toml").write_text(HARDWARE + '[safety]\nstop_file = "run/halt\n')
    with pytest.raises(ConfigError, match="TOML"):
        find_stop_file(tmp_path / "roof.toml")


@pytest.mark.parametrize("value", ["true", "5", '["stop"]'])
def test_a_stop_file_that_is_no_text_is_refused(tmp_path, value):
    rig = tmp_path / "roof.toml"
    rig.write_text(f"{HARDWARE}[safety]\nstop_file = {value}\n")
    for find in (load_config, find_stop_file):
        with pytest.raises(ConfigError, match=rf"^{rig}: safety\.stop_file: "):
            find(rig)


def test_a_rig_whose_stop_file_cannot_be_written_is_refused(tmp_path, monkeypatch):
    """As on a file system that became read-only; root ignores a folder's mode."""
    path = tmp_path / "roof.stop"
    refuse_if_stopped(path)
    monkeypatch.setattr("cotarget.safety.stop_file.os.access", lambda folder, mode: Path(folder) != tmp_path)
    with pytest.raises(ConfigError, match=f"^{path}: "):
        refuse_if_stopped(path)
    monkeypatch.undo()
    write_stop_file(path, "a cat")
    with pytest.raises(EmergencyStopError, match="a cat"):
        refuse_if_stopped(path)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "stop"


def names(folder):
    return [path.name for path in folder.iterdir()]


@pytest.mark.parametrize(("content", "reason"), [
    (b"smoke\n", "smoke"),
    (b"", "no reason given"),
    (b" \n\n", "no reason given"),
    (b"smoke\nand fire\n", "smoke"),
    (b"\x1b[31msmoke\x00", "[31msmoke"),
    (b"\xff\xfe", "\ufffd\ufffd"),
    ("Rauch überm Dach".encode(), "Rauch überm Dach"),
    (b"x" * 100_000, "x" * 200),
])  # fmt: skip
def test_any_content_stops_and_gives_one_printable_line(file, content, reason):
    file.write_bytes(content)
    assert stop_reason(file) == reason
    with pytest.raises(EmergencyStopError) as caught:
        refuse_if_stopped(file)
    assert str(caught.value).isprintable()


def test_no_file_is_no_stop(file):
    assert stop_reason(None) is None
    assert stop_reason(file) is None
    assert stop_reason(file / "below" / "it") is None
    file.write_text("x")
    assert stop_reason(file / "below") is None
    assert clear_stop_file(file.parent / "other") is None


def test_an_unreadable_stop_file_is_a_stop(file):
    file.mkdir()
    assert "Is a directory" in stop_reason(file)
    with pytest.raises(DeviceError, match=f"^{file}: "):
        clear_stop_file(file)
    loop = file.parent / "loop"
    loop.symlink_to(loop)
    assert stop_reason(loop) is not None


def test_the_newest_stop_holds_and_leaves_no_other_file(tmp_path):
    file = tmp_path / "stop"
    write_stop_file(file, "smoke")
    write_stop_file(file, "fire")
    assert stop_reason(file) == "fire"
    assert names(tmp_path) == ["stop"]
    assert clear_stop_file(file) == "fire"
    assert names(tmp_path) == []
    assert clear_stop_file(file) is None


def test_a_full_disk_stops_without_a_reason(file, monkeypatch):
    def full(number):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    write_stop_file(file, "smoke")
    assert names(file.parent) == ["stop"]
    assert stop_reason(file) == "no reason given"


def test_a_stop_that_cannot_be_written_is_an_error(tmp_path):
    name = "x" * 300  # longer than file systems take
    with pytest.raises(DeviceError, match="NOT stopped"):
        write_stop_file(tmp_path / name, "smoke")


@pytest.mark.parametrize("folder", ["mistyped", "mistyped/twice", "a file"])
def test_a_stop_file_without_its_folder_is_refused_and_no_folder_is_made(tmp_path, folder):
    (tmp_path / "a file").touch()
    file = tmp_path / folder / "stop"
    with pytest.raises(DeviceError, match=rf"{folder}.*NOT stopped"):
        write_stop_file(file, "smoke")
    rig = SimulatedDevices()
    with pytest.raises(ConfigError, match=f"^{file}: "):
        guarded(rig, SafetyConfig(stop_file=file))
    assert rig.closed
    assert names(tmp_path) == ["a file"]
