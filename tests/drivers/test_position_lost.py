"""What is remembered of a unit whose position may be lost: files that anybody can read, and remove."""

import pytest

from cotarget.drivers.interlock import PositionLostError, PositionLostMarker
from cotarget.errors import DeviceError

USB = "/dev/serial/by-id/usb-FTDI_FT232R-if00"


@pytest.fixture(autouse=True)
def _state(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def stop_file(tmp_path):
    return tmp_path / "made when needed" / "stop"


def test_each_rig_remembers_its_own_heads(stop_file):
    lost, other = PositionLostMarker(USB, stop_file), PositionLostMarker("/dev/ttyUSB1", stop_file.with_name("other"))
    lost.refuse()
    lost.note(str(PositionLostError(USB, "fell off the roof")))
    assert lost.file.name == "stop.dev-serial-by-id-usb-FTDI-FT232R-if00.position-lost"
    with pytest.raises(DeviceError, match=rf"^the pan-tilt unit at {USB} fell off the roof; see that it is free, then"):
        lost.refuse()
    other.refuse()
    lost.forget()
    lost.refuse()
    lost.forget()


def test_a_lost_unit_is_refused_by_every_rig_file_that_names_its_port(stop_file):
    """The default stop file has the name of rig.toml, and a unit may stand in several of them."""
    PositionLostMarker(USB, stop_file.with_name("calib.stop")).note("lost")
    for another in (stop_file.with_name("follow.stop"), None):
        with pytest.raises(DeviceError, match=r"^lost \(or, where no unit"):
            PositionLostMarker(USB, another).refuse()
    PositionLostMarker(USB, stop_file.with_name("calib.stop")).forget()
    PositionLostMarker(USB, stop_file.with_name("follow.stop")).refuse()


def test_a_pseudo_terminal_whose_name_another_emulator_gets_is_remembered_by_its_rig_alone(stop_file):
    PositionLostMarker("/dev/pts/3", stop_file.with_name("one.stop")).note("lost")
    PositionLostMarker("/dev/pts/3", stop_file.with_name("two.stop")).refuse()


def test_the_reset_of_one_head_says_nothing_of_another(stop_file):
    """Two heads may share a stop file; a unit may come back at another port, which nobody can tell from that."""
    first, second = PositionLostMarker("/dev/ttyUSB0", stop_file), PositionLostMarker("/dev/ttyUSB1", stop_file)
    first.note("lost")
    second.forget()
    with pytest.raises(DeviceError, match=rf"^lost \(or, where no unit is at that port any more, remove {first.file}"):
        second.refuse()


@pytest.mark.parametrize("content", [b"", b"\n", b"\xff\x00\n\x1b[31m\nmany\nlines", b"x" * 100_000])
def test_whatever_is_in_the_file_it_refuses_in_one_line(stop_file, content):
    lost = PositionLostMarker(USB, stop_file)
    stop_file.parent.mkdir()
    lost.file.write_bytes(content)
    with pytest.raises(DeviceError) as caught:
        lost.refuse()
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 1000
    assert str(lost.file) in str(caught.value)


def test_the_stop_file_itself_is_no_lost_position(stop_file):
    stop_file.parent.mkdir()
    stop_file.touch()
    stop_file.with_name("stop.old").touch()
    PositionLostMarker(USB, stop_file).refuse()


def test_what_cannot_be_written_or_read_is_told(tmp_path, caplog):
    (tmp_path / "file").touch()
    lost = PositionLostMarker(USB, tmp_path / "file" / "stop")
    lost.refuse()
    lost.note("it fell off the roof")
    assert "nobody will remember: it fell off the roof" in caplog.text
    lost.forget()
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(DeviceError, match="cannot be read, where it would say that the head's position is lost"):
        PositionLostMarker(USB, loop / "stop").refuse()
    with pytest.raises(DeviceError, match="cannot be removed, though the unit was reset"):
        PositionLostMarker(USB, loop / "stop").forget()


def test_without_a_stop_file_it_is_in_the_users_state_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert (
        PositionLostMarker("/dev/ttyS0", None).file == tmp_path / ".local/state/cotarget/head.dev-ttyS0.position-lost"
    )


def test_a_marker_of_a_rig_that_had_no_stop_file_is_found_beside_one(tmp_path, monkeypatch, stop_file):
    """Version 0.1 had no default stop file; its markers must not be lost by the update."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    PositionLostMarker("/dev/ttyS0", None).note("lost long ago")
    now, another = PositionLostMarker("/dev/ttyS0", stop_file), PositionLostMarker("/dev/ttyS1", stop_file)
    with pytest.raises(DeviceError, match=r"^lost long ago"):
        now.refuse()
    another.refuse()  # a stop file's rig is not that of every unit of this user
    now.forget()
    now.refuse()
    PositionLostMarker("/dev/ttyS0", None).refuse()
