"""Calls of gphoto2: ports, the search for a camera, and what libgphoto2 must not do to this process and its user."""

import os
import subprocess
import sys
import types
from pathlib import Path

import pytest

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.gphoto import GphotoLink, LinkError, cameras, full_port
from cotarget.drivers.gphoto_camera import GphotoCamera, GphotoSettings
from cotarget.errors import ConfigError, DeviceError, MissingPackageError
from tests.support.plants import s5is_process

DEADLINE_S = 20.0  # for whatever should happen at once: only a hang takes as long
ROOT = Path(__file__).parents[2]
CLAIM = -53


def probe(port, model=""):
    return GphotoCamera.probe(GphotoSettings(port=port, model=model))


@pytest.mark.parametrize(
    ("port", "full"),
    [
        ("usb:", "usb:"),
        ("usb:001,005", "usb:001,005"),
        ("ptpip:127.0.0.1", "ptpip:127.0.0.1:15740:15740"),
        ("ptpip:127.0.0.1:4000", "ptpip:127.0.0.1:4000:4000"),
        ("ptpip:127.0.0.1:4000:4001", "ptpip:127.0.0.1:4000:4001"),
        ("ptpip:localhost:4000:4000", "ptpip:127.0.0.1:4000:4000"),
    ],
)
def test_ports_are_completed(port, full):
    assert full_port(port) == full


NO_PORTS = ["", "usb", "usb:5", "/dev/video0", "ptpip:", "ptpip:a:b", "serial:/dev/ttyS0", "ptpip:127.0.0.1:70000"]
NO_HOSTS = ["ptpip:no.host.invalid:4000", f"ptpip:{70 * 'a'}:4000"]


@pytest.mark.parametrize("port", [*NO_PORTS, *NO_HOSTS])
def test_other_ports_are_refused(port):
    for call in (probe, lambda port: GphotoCamera(GphotoSettings(port=port), MonotonicClock())):
        with pytest.raises(ConfigError, match=r"^hardware\.zoom\.port: "):
            call(port)


def test_without_gphoto2_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    for call in (cameras, lambda: probe("usb:"), GphotoLink("usb:", "").open):
        with pytest.raises(MissingPackageError, match=r"extra hardware has it: .+ -m pip install 'gphoto2>="):
            call()


class FakeGphoto(types.ModuleType):
    """As much of the module as looks for cameras."""

    GPhoto2Error = type("GPhoto2Error", (Exception,), {"code": CLAIM, "string": "Could not claim the USB device"})

    def __init__(self, found, models=("Canon S5", "Nikon Z")):
        super().__init__("gphoto2")
        self.opened, self.init, self.load = [], lambda: None, lambda: None
        entries = types.SimpleNamespace(
            load=lambda: self.load(),
            count=lambda: len(models),
            get_abilities=lambda i: types.SimpleNamespace(model=models[i]),
            lookup_model=models.index,
            detect=lambda ports: dict(found),
            get_info=lambda path: path,
            lookup_path=lambda path: path,
        )
        self.PortInfoList = self.CameraAbilitiesList = lambda: entries
        self.Camera = lambda: types.SimpleNamespace(
            set_abilities=lambda abilities: self.opened.append(abilities.model),
            set_port_info=self.opened.append,
            init=lambda: self.init(),
        )
        self.Camera.autodetect = lambda: self.load() or dict(found)

    def refuse(self):
        raise self.GPhoto2Error


@pytest.fixture
def gphoto2(monkeypatch):
    """Puts a module in the place of gphoto2."""
    monkeypatch.setattr("cotarget.drivers.gphoto.keep_settings_in_memory", lambda: None)

    def put(*found):
        module = FakeGphoto(found)
        monkeypatch.setitem(sys.modules, "gphoto2", module)
        return module

    return put


CANON, NIKON = ("Canon S5", "usb:001,005"), ("Nikon Z", "usb:002,003")


def test_the_only_camera_is_found(gphoto2):
    module = gphoto2(CANON, ("Mass Storage Camera", "disk:/media/card"))
    assert GphotoLink("usb:", "").open() == "Canon S5"
    assert module.opened == ["Canon S5", "usb:001,005"]
    assert cameras() == ["Canon S5 at usb:001,005", "Mass Storage Camera at disk:/media/card"]
    assert probe("usb:") == "Canon S5 at usb:001,005"


def test_one_of_two_cameras_is_chosen_by_its_port(gphoto2):
    module = gphoto2(CANON, NIKON)
    assert GphotoLink("usb:002,003", "").open() == "Nikon Z"
    assert module.opened == ["Nikon Z", "usb:002,003"]
    assert GphotoLink("usb:002,003", "Canon S5").open() == "Canon S5"


@pytest.mark.parametrize(
    ("port", "model", "found", "key", "choices"),
    [
        ("usb:", "", (), "port", ()),
        ("usb:", "", (CANON, NIKON), "port", ("usb:001,005 (Canon S5)", "usb:002,003 (Nikon Z)")),
        ("usb:001,006", "", (CANON,), "port", ("usb:001,005 (Canon S5)",)),
        ("usb:", "canon", (CANON, NIKON), "model", ("Canon S5", "Nikon Z")),
    ],
)
def test_an_error_lists_the_cameras_that_are_there(gphoto2, port, model, found, key, choices):
    gphoto2(*found)
    for call in (GphotoLink(port, model).open, lambda: probe(port, model)):
        with pytest.raises((ConfigError, DeviceError), match=rf"^hardware\.zoom\.{key}: ") as error:
            call()
        assert all(choice in str(error.value) for choice in choices)


def test_a_camera_of_another_program_is_an_error_with_the_remedy(gphoto2):
    module = gphoto2(CANON)
    module.init = module.refuse
    with pytest.raises(LinkError, match="unmount it") as error:
        GphotoLink("usb:", "").open()
    assert error.value.code == CLAIM


def test_a_camera_of_another_user_is_an_error_with_the_remedy(gphoto2, monkeypatch):
    gphoto2(CANON)
    monkeypatch.setattr(Path, "is_char_device", lambda path: path == Path("/dev/bus/usb/001/005"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    for call in (GphotoLink("usb:", "").open, lambda: probe("usb:")):
        with pytest.raises(DeviceError, match=r"/dev/bus/usb/001/005; add yourself to its group"):
            call()


def test_opening_keeps_descriptor_0_which_libgphoto2_closes(gphoto2):
    gphoto2(CANON).init = lambda: os.close(0)
    kept, before = os.dup(0), os.fstat(0)
    try:
        GphotoLink("usb:", "").open()
        assert os.path.samestat(os.fstat(0), before)
    finally:
        os.dup2(kept, 0)
        os.close(kept)


def test_a_search_that_fails_is_an_error_of_the_device(gphoto2):
    module = gphoto2(CANON)
    module.load = module.refuse
    for call in (cameras, lambda: probe("usb:")):
        with pytest.raises(DeviceError, match=r"\[-53\]"):
            call()


# libgphoto2 has a camera of its own on a USB port of its own, if that is asked for before it is loaded.
VIRTUAL = """
from cotarget.errors import ConfigError
from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.gphoto import cameras
from cotarget.drivers.gphoto_camera import GphotoCamera, GphotoSettings

print(cameras())
print(GphotoCamera.probe(GphotoSettings(port="usb:")))
try:
    GphotoCamera(GphotoSettings(port="usb:"), MonotonicClock())
except ConfigError as error:
    print(error)
"""


def test_libgphoto2s_own_virtual_camera_cannot_be_zoomed(tmp_path):
    """A DSLR whose lens is turned by hand, found on USB by libgphoto2 itself; nothing is left in the user's home."""
    pytest.importorskip("gphoto2")
    home, card = tmp_path / "home", tmp_path / "card"
    card.mkdir()
    (home / ".config").mkdir(parents=True)  # where libgphoto2 would write its own settings
    folders = {"PYTHONPATH": str(ROOT), "HOME": str(home), "XDG_CONFIG_HOME": "", "VCAMERADIR": str(card)}
    done = subprocess.run(
        [sys.executable, "-c", VIRTUAL], env=os.environ | folders, stdout=subprocess.PIPE, text=True, timeout=DEADLINE_S
    )
    found, probed, error = done.stdout.splitlines()
    assert (found, probed) == ("['Nikon DSC D750 at usb:001,001']", "Nikon DSC D750 at usb:001,001")
    assert error.startswith("hardware.zoom: the Nikon DSC D750 has no setting 'zoom'")
    assert [path.name for path in home.rglob("*")] == [".config"]


@pytest.mark.wire
def test_a_network_port_needs_a_listener():
    with s5is_process() as process:
        assert probe(process.port) == f"something listens at {full_port(process.port)}"
        with pytest.raises(ConfigError, match=r"^hardware\.zoom\.model: "):
            probe(process.port, "S5")
    unused = "ptpip:127.0.0.1:1"
    for call in (probe, lambda port: GphotoCamera(GphotoSettings(port=port), MonotonicClock())):
        with pytest.raises(DeviceError, match=r"^hardware\.zoom\.port: no camera listens"):
            call(unused)
