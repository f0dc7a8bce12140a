"""What is remembered of a unit whose position may be lost: files that anybody can read, and remove."""

import pytest

from cotarget.drivers.interlock import PositionLostMarker
from cotarget.errors import DeviceError

USB = "/dev/serial/by-id/usb-FTDI_FT232R-if00"


@pytest.fixture(autouse=True)
def _state(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def stop_file(tmp_path):
    return tmp_path / "made when needed" / "stop"


def refused(lost):
    """Why a marker refuses a head; empty if it does not."""
    try:
        lost.refuse()
    except DeviceError as error:
        return str(error)
    return ""


# Where a marker was noted, where it is asked for, and whether it counts there: port and name of the stop file.
CASES = [
    (USB, "calib.stop", USB, "follow.stop", True),  # a unit may stand in several rig files, each with its stop file
    (USB, "calib.stop", USB, None, True),
    (USB, None, USB, "follow.stop", True),  # version 0.1 had no default stop file
    (USB, None, "/dev/ttyS1", "follow.stop", False),  # that rig is not that of every unit of this user
    (USB, None, "/dev/ttyS1", None, True),
    ("/dev/ttyUSB0", "stop", "/dev/ttyUSB1", "stop", True),  # a unit may come back at another port
    ("/dev/ttyUSB0", "stop", "/dev/ttyUSB1", "other", False),
    ("socket://127.0.0.1:4000", "one.stop", "socket://localhost:4000", "two.stop", True),
    ("/dev/pts/3", "one.stop", "/dev/pts/3", "two.stop", False),  # another emulator gets a pseudo-terminal's name
    ("/dev/pts/3", "one.stop", "/dev/pts/3", "one.stop", True),
]


@pytest.mark.parametrize(("port", "noted", "other", "asked", "counts"), CASES)
def test_a_marker_counts_for_its_rig_and_for_its_port(stop_file, port, noted, other, asked, counts):
    first, second = (
        PositionLostMarker(each, name and stop_file.with_name(name)) for each, name in ((port, noted), (other, asked))
    )
    first.note("lost long ago")
    assert refused(second).startswith("lost long ago") == counts
    if port != other and "socket" not in port:
        second.forget()  # the reset of one head says nothing of another
        assert bool(refused(second)) == counts
    first.forget()
    assert not refused(second)


@pytest.mark.parametrize("content", [b"", b"\n", b"\xff\x00\n\x1b[31m\nmany\nlines", b"x" * 100_000])
def test_any_content_of_a_marker_refuses_in_one_line(stop_file, content):
    lost = PositionLostMarker(USB, stop_file)
    stop_file.parent.mkdir()
    lost.file.write_bytes(content)
    said = refused(lost)
    assert said.isprintable()
    assert len(said) < 1000
    assert str(lost.file) in said


def test_a_marker_that_cannot_be_read_refuses_too(stop_file):
    lost = PositionLostMarker(USB, stop_file)
    lost.file.mkdir(parents=True)
    assert "cotarget reset-head" in refused(lost)


def test_the_stop_file_itself_is_no_lost_position(stop_file):
    stop_file.parent.mkdir()
    stop_file.touch()
    stop_file.with_name("stop.old").touch()
    assert not refused(PositionLostMarker(USB, stop_file))


def test_a_marker_that_cannot_be_written_or_read_is_reported(tmp_path, caplog):
    (tmp_path / "file").touch()
    lost = PositionLostMarker(USB, tmp_path / "file" / "stop")
    assert not refused(lost)
    lost.note("it fell off the roof")
    assert "it fell off the roof" in caplog.text
    lost.forget()
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for call in (PositionLostMarker(USB, loop / "stop").refuse, PositionLostMarker(USB, loop / "stop").forget):
        with pytest.raises(DeviceError, match=str(loop)):
            call()


def test_without_a_stop_file_it_is_in_the_users_state_folder(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    file = PositionLostMarker("/dev/ttyS0", None).file
    assert file == tmp_path / ".local/state/cotarget/head.dev-ttyS0.position-lost"
