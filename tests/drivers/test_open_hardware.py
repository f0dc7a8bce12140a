"""Opening the real devices as one rig: in which order, and what is left when one of them is missing."""

import dataclasses
import os
import subprocess
import sys

import pytest

from cotarget.backends import open_rig
from cotarget.config import HardwareConfig, RigConfig, parse_config
from cotarget.drivers import DRIVERS
from cotarget.drivers import rig as rig_module
from cotarget.drivers.axis import AxisSettings
from cotarget.drivers.board import BoardSettings
from cotarget.drivers.gphoto_camera import GphotoSettings
from cotarget.drivers.interlock import addresses_of, rig_lock
from cotarget.drivers.link_errors import InUseError
from cotarget.drivers.ptu_d46 import D46Settings
from cotarget.drivers.rig import device_of, open_hardware
from cotarget.errors import ConfigError, DeviceError
from cotarget.plugins import load
from tests.support.rigs import alike

ORDER = ("board", "fixed", "zoom", "head")
CONFIG = parse_config(
    {
        "backend": "hardware",
        "hardware": {
            "head": {"port": "/dev/null/head"},
            "fixed": {"url": "http://192.0.2.1"},
            "zoom": {"port": "usb:"},
        },
    }
)


LIMITS = alike((-2.0, 2.0), (-0.5, 0.5), 2.0, 3.0, 0.001)


@pytest.fixture
def devices(monkeypatch):
    """Devices that note what happens to them; name one in ``missing`` to have it fail."""
    log, missing, stuck = [], [], []

    def maker(name):
        class Device:
            size, still_size, focal_range, limits = (640, 480), (3264, 2448), (300.0, 4000.0), LIMITS

            def __init__(self, *arguments):
                if name in missing:
                    log.append(f"no {name}")
                    raise DeviceError(f"{name}: is not there")
                log.append(f"open {name}")
                self.arguments = arguments

            def close(self):
                log.append(f"close {name}")
                if name in stuck:
                    raise DeviceError(f"{name}: does not close")

        return Device

    found = {}
    for name in ("fixed", "zoom", "head"):
        found[name] = maker(name)
        found[name].Settings = load(next(iter(DRIVERS[name].values())), name).Settings
    monkeypatch.setattr(rig_module, "load", lambda _, where: found[where.split(".")[1]])
    monkeypatch.setattr(rig_module, "make_board", maker("board"))
    return log, missing, stuck


@pytest.mark.parametrize(("table", "key"), [("head", "port"), ("fixed", "url"), ("zoom", "port")])
def test_a_missing_key_is_named_before_a_device_is_opened(devices, table, key):
    log, *_ = devices
    nameless = {**getattr(CONFIG.hardware, table), key: ""}
    config = dataclasses.replace(CONFIG, hardware=dataclasses.replace(CONFIG.hardware, **{table: nameless}))
    with pytest.raises(ConfigError, match=rf"^hardware\.{table}\.{key}: "):
        open_hardware(config)
    assert log == []


def test_a_rig_toml_with_a_sim_section_only_is_no_real_rig():
    with pytest.raises(ConfigError, match=r"^hardware\.head\.port: "):
        open_rig(RigConfig(backend="hardware", hardware=HardwareConfig()), guarded=False)


def test_the_head_is_opened_last_and_closed_first(devices):
    log, *_ = devices
    with open_rig(CONFIG, guarded=False) as rig:
        assert log == [f"open {name}" for name in ORDER]
        assert rig.spec.real_time
        assert (rig.spec.zoom.still_size, rig.spec.zoom.focal_range) == ((3264, 2448), (300.0, 4000.0))
        assert (rig.spec.head.limits, rig.spec.zoom.delay_s) == (LIMITS, GphotoSettings().command_delay_s)
        assert rig.head.arguments == (D46Settings(port="/dev/null/head"), rig.clock, CONFIG.safety)
        assert rig.fixed.arguments == (AxisSettings(url="http://192.0.2.1"), rig.clock)
        assert rig.zoom.arguments == (GphotoSettings(port="usb:"), rig.clock)
        assert rig.board.arguments == (BoardSettings(),)
        log.clear()
    assert log == [f"close {name}" for name in reversed(ORDER)]
    rig.close()
    assert len(log) == len(ORDER)


@pytest.mark.parametrize("there", ["fixed", "zoom", "head"])
def test_one_device_may_be_opened_alone(devices, there):
    log, *_ = devices
    config = parse_config({"backend": "hardware", "hardware": {there: getattr(CONFIG.hardware, there)}})
    with pytest.raises(ConfigError, match="is missing"):
        open_rig(config, guarded=False)
    with open_rig(config, guarded=False, partial=True) as rig:
        assert [entry for entry in log if "board" not in entry] == [f"open {there}"]
        assert rig.missing == {"fixed", "zoom", "head"} - {there}
        for role, call in {"fixed": "read", "zoom": "state", "head": "state"}.items():
            if role in rig.missing:
                with pytest.raises(ConfigError, match=rf"^hardware\.{role}\."):
                    getattr(getattr(rig, role), call)()
        rig.head.halt() if there != "head" else None


def test_opening_shortens_the_thread_switch_interval(devices):
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-3)  # Python's default
    try:
        with open_hardware(CONFIG):
            assert sys.getswitchinterval() < 1e-3
    finally:
        sys.setswitchinterval(before)


@pytest.mark.parametrize("missing", ORDER)
def test_a_missing_device_closes_the_others_and_leaves_the_head_alone(devices, missing):
    log, lacking, _ = devices
    lacking.append(missing)
    with pytest.raises(DeviceError, match=f"{missing}: is not there"):
        open_hardware(CONFIG)
    there = ORDER[: ORDER.index(missing)]
    assert log == [*(f"open {name}" for name in there), f"no {missing}", *(f"close {name}" for name in reversed(there))]


@pytest.fixture
def port():
    ends = os.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the devices have to refuse a second program")
@pytest.mark.parametrize("by", ["its name", "another name", "a URL", "a name of this machine", "its default address"])
def test_a_rig_in_use_is_refused_before_a_device_is_opened(devices, port, tmp_path, by):
    """Within one process as well; and the claim ends with the rig."""
    log, missing, _ = devices
    (tmp_path / "link").symlink_to(port)
    address = f"socket://192.0.2.1:{os.getpid()}"  # of no other test's process
    names = {
        "its name": (port, port),
        "another name": (port, str(tmp_path / "link")),
        "a URL": (address, address),
        "a name of this machine": (f"socket://localhost:{os.getpid()}", f"socket://127.0.0.1:{os.getpid()}"),
        "its default address": (f"socket://0.0.0.0:{os.getpid()}", f"socket://LocalHost:{os.getpid()}/"),
    }[by]
    first, second = (
        dataclasses.replace(CONFIG, hardware=dataclasses.replace(CONFIG.hardware, head={"port": name}))
        for name in names
    )
    with open_hardware(first):
        log.clear()
        with pytest.raises(InUseError):
            open_hardware(second)
        assert log == []
    missing.append("zoom")
    with pytest.raises(DeviceError, match="zoom: is not there"):
        open_hardware(second)
    missing.clear()
    open_hardware(second).close()


OWN_HEAD = """
import dataclasses
from cotarget.rig import AxisLimits, HeadSpec, PanTiltLimits

@dataclasses.dataclass(frozen=True)
class Settings:
    host: str = ""
    port: int = 0
    dome_url: str = ""
    at: str = ""
    spec = HeadSpec(PanTiltLimits(*[AxisLimits((-1.0, 1.0), 1.0)] * 2), 0.0)

class Head:
    def probe(settings):
        return "asked"

Head.Settings = Settings
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the devices have to refuse a second program")
@pytest.mark.parametrize(("table", "other"), [
    ({"host": "192.0.2.1"}, {"host": "192.0.2.1", "port": 80}),
    ({"host": "127.0.0.1", "port": 4001}, {"host": "localhost", "port": 4001}),
    ({"dome_url": "http://192.0.2.1/ptz"}, {"dome_url": "http://192.0.2.1:80/ptz/"}),
    ({"at": "192.0.2.7", "port": 4001}, {"at": "192.0.2.7", "port": 4001}),
    ({"at": "::1", "port": 4001}, {"host": "localhost", "port": 4001}),
    ({"at": "/dev/null"}, {"at": "/dev/null"}),
])  # fmt: skip
def test_a_head_of_ones_own_is_locked_by_its_address_whatever_the_key(tmp_path, table, other):
    (tmp_path / "own.py").write_text(OWN_HEAD)
    driver = {"driver": f"{tmp_path}/own.py:Head"}
    first, second = (device_of("head", driver | each) for each in (table, other))
    with rig_lock(*addresses_of(first.settings)):
        with pytest.raises(InUseError):
            second.probe()
        assert device_of("head", driver | {"host": "192.0.2.1", "port": 4002}).probe() == "asked"
    assert second.probe() == "asked"


def test_a_head_derived_from_a_drivers_class_is_asked_and_reset_like_it(tmp_path, monkeypatch):
    """It takes no second lock of its own address."""
    (tmp_path / "own.py").write_text("from cotarget.drivers.ptu_d46 import D46Head\n\nclass Head(D46Head):\n    pass\n")
    with pytest.raises(DeviceError, match="no port"):
        device_of("head", {"driver": f"{tmp_path}/own.py:Head", "port": "/dev/none"}).probe()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the devices have to refuse a second program")
def test_one_rig_toml_is_opened_once(devices, tmp_path, monkeypatch):
    """Whatever its head says of its address, and however the file is named."""
    log, *_ = devices
    (tmp_path / "rig.toml").write_text(
        'backend = "hardware"\n[hardware]\nhead.port = "/dev/null/head"\nfixed.url = "http://192.0.2.1"\n'
        'zoom.port = "usb:"\n'
    )
    (tmp_path / "link.toml").symlink_to("rig.toml")
    with open_rig(tmp_path / "rig.toml", guarded=False):
        log.clear()
        with pytest.raises(InUseError, match=r"link\.toml"):
            open_rig(tmp_path / "link.toml", guarded=False)
        assert log == []
    open_rig(str(tmp_path / "link.toml"), guarded=False).close()


@pytest.mark.parametrize("which", ORDER)
def test_a_device_that_does_not_close_does_not_keep_the_others(devices, which):
    log, _, stuck = devices
    rig = open_hardware(CONFIG)
    stuck.append(which)
    log.clear()
    with pytest.raises(DeviceError, match=f"{which}: does not close"):
        rig.close()
    assert log == [f"close {name}" for name in reversed(ORDER)]
    rig.close()


def test_ctrl_c_while_a_device_opens_closes_the_others(devices, monkeypatch):
    log, *_ = devices

    def interrupted(*_):
        raise KeyboardInterrupt

    interrupted.Settings, before = D46Settings, rig_module.load
    monkeypatch.setattr(rig_module, "load", lambda name, where: interrupted if "head" in where else before(name, where))
    with pytest.raises(KeyboardInterrupt):
        open_hardware(CONFIG)
    assert log[-3:] == ["close zoom", "close fixed", "close board"]


def test_a_driver_is_imported_without_its_devices_library():
    """So that every command can check a rig.toml on a machine that lacks it."""
    program = (
        "import sys; sys.modules.update(dict.fromkeys(('serial', 'httpx', 'gphoto2', 'simplejpeg')))\n"
        "from cotarget.drivers import DRIVERS; from cotarget.drivers.rig import device_of\n"
        "print(*(device_of(role, {'driver': name}).spec for role in DRIVERS for name in DRIVERS[role]), sep='\\n')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    specs = ["CameraSpec", "CameraSpec", "ZoomSpec", "HeadSpec", "UnitSpec", "UnitSpec"]
    assert [line.partition("(")[0] for line in done.stdout.splitlines()] == specs
