"""Drivers and detectors of a user, which rig.toml names."""

import colorsys
import json
import math

import numpy as np
import pytest

from cotarget.backends import check, describe, load_config, open_rig
from cotarget.cli.main import main
from cotarget.config import parse_config
from cotarget.detection import make_detector
from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.rig import Frame

DEVICES = """
from dataclasses import dataclass, field

import numpy as np

from helper import GREY
from cotarget.errors import ConfigError
from cotarget.rig import CameraSpec, Frame, HeadSpec, PanTiltLimits, PanTiltState, UnitSpec, ZoomSpec, ZoomState
from tests.support.rigs import alike

LIMITS = alike((-1.0, 1.0), (-0.5, 0.5), 2.0, 4.0, 0.0)


@dataclass(frozen=True)
class CameraSettings:
    size: tuple[int, int] = (64, 48)
    rate_hz: float = 100.0
    colour: str = "grey"

    @property
    def spec(self):
        return CameraSpec(self.size, self.rate_hz, 0.0)


@dataclass(frozen=True)
class ZoomSettings(CameraSettings):
    @property
    def spec(self):
        return ZoomSpec(self.size, self.rate_hz, 0.0, (100.0, 400.0), 0.01, self.size, 0.0)


@dataclass(frozen=True)
class HeadSettings:
    @property
    def spec(self):
        return HeadSpec(LIMITS, 0.0)


class Camera:
    Settings = CameraSettings

    def __init__(self, settings, clock):
        self.size, self.still_size, self.clock, self.settings = settings.size, settings.size, clock, settings

    @staticmethod
    def probe(settings):
        return f"a {settings.colour} wall"

    def read(self, newer_than=None, timeout=1.0):
        if self.settings.colour == "pink":
            return {}["no such"]
        self.clock.sleep_until(self.clock.now() + 0.01)
        return Frame(np.full((*self.size[::-1], 3), GREY, np.uint8), self.clock.now())

    def close(self):
        pass


class Zoom(Camera):
    Settings, focal_range = ZoomSettings, (100.0, 400.0)

    def zoom(self, focal_px):
        return focal_px

    def state(self):
        return ZoomState(100.0, False, self.clock.now())

    def capture(self):
        return self.read()


class Head:
    Settings, limits = HeadSettings, LIMITS

    def __init__(self, settings, clock, safety):
        self.at, self.clock, self.safety = (0.0, 0.0), clock, safety

    def state(self):
        return PanTiltState(*self.at, False, self.clock.now())

    def move(self, pan, tilt, speed=None, wait=False):
        self.at = (pan, tilt)
        return self.at

    def halt(self):
        pass

    def close(self):
        pass


@dataclass(frozen=True)
class DomeSettings(ZoomSettings):
    host: str = "dome"
    step_deg: float = 0.1

    @property
    def spec(self):
        return UnitSpec(ZoomSettings().spec, HeadSpec(LIMITS, 0.02))


class Part:
    def __init__(self, device):
        self.device = device

    def __getattr__(self, name):
        if name == "close":
            raise AttributeError(name)  # the unit closes it
        return getattr(self.device, name)


class Dome:
    Settings = DomeSettings

    def __init__(self, settings, clock, safety):
        if settings.step_deg != 0.1:
            raise ConfigError("hardware.head.step_deg: its steps are 0.1 degrees")
        self.zoom, self.head = Part(Zoom(settings, clock)), Part(Head(settings, clock, safety))

    @staticmethod
    def probe(settings):
        return f"a dome at {settings.host}"

    def close(self):
        pass


class Headless(Dome):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        del self.head


class Lensless(Dome):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.zoom = object()


class Limitless(Head):
    @property
    def limits(self):
        return 1 / 0


class Broken:
    Settings = CameraSettings

    def __init__(self, settings, clock):
        raise RuntimeError("the lens cap is on")


class Unset:
    pass


class Wrong(Camera):
    Settings = HeadSettings


class Short:
    Settings = CameraSettings

    def __init__(self, settings, clock):
        self.size = settings.size


def boxes(image):
    return [(2, 3, 4, 5)] if image.mean() > 0 else {}["dark"]
"""
RIG = """
backend = "hardware"
board.square = 0.025
[hardware.fixed]
driver = "devices:Camera"
colour = "green"
[hardware.zoom]
driver = "devices:Zoom"
[hardware.head]
driver = "devices:Head"
[targets.wall]
size = 2.0
dimension = "width"
wanted_px = 40
detector = "devices:boxes"
"""


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "helper.py").write_text("GREY = 128\n")
    (tmp_path / "devices.py").write_text(DEVICES)
    (tmp_path / "rig.toml").write_text(RIG)
    return tmp_path / "rig.toml"


def test_rig_of_own_devices_is_opened_from_rig_toml(rig, monkeypatch):
    monkeypatch.chdir("/")
    config = load_config(rig)
    assert describe(config).zoom.focal_range == (100.0, 400.0)
    with open_rig(rig) as opened:
        assert opened.fixed.read().image[0, 0].tolist() == [128] * 3
        assert opened.head.move(math.radians(10), 0.0, wait=True)[0] == pytest.approx(math.radians(10))
        assert opened.spec.head.limits.pan.range == (-1.0, 1.0)


def test_commands_and_doctor_use_own_devices(rig, capsys, monkeypatch):
    monkeypatch.chdir("/")
    assert main(["point", "--rig", str(rig), "--pan-deg", "5"]) == 0
    assert json.loads(capsys.readouterr().out)["pan_deg"] == pytest.approx(5)
    assert main(["doctor", "--rig", str(rig)]) == ("MISSING" in (out := capsys.readouterr().out))
    assert "ok       hardware.fixed: a green wall\n" in out
    assert "unknown  hardware.head: is not asked: its driver has no probe\n" in out
    assert "ok       targets.wall.detector: " in out


def test_own_detector_beside_rig_toml_is_found(rig, monkeypatch):
    monkeypatch.chdir("/")
    detector = make_detector(load_config(rig).target("wall"), 25.0)
    [found] = detector.detect(Frame(np.full((48, 64, 3), 9, np.uint8), 0.0)).boxes
    assert found.size_px.tolist() == [4.0, 5.0]
    with pytest.raises(CotargetError, match=r"^detector '.*devices\.py:boxes': .*devices\.py:\d+: KeyError: 'dark'$"):
        detector.detect(Frame(np.zeros((48, 64, 3), np.uint8), 0.0))


@pytest.mark.parametrize(("change", "said"), [
    ('"devices:Camera"\ncolor = "red"', "unknown key 'hardware.fixed.color'; valid here: colour, driver, rate_hz, "),
    ('"devices:Camera"\nrate_hz = "9"', "hardware.fixed.rate_hz: '9'"),
    ('"device:Camera"', "hardware.fixed.driver: there is no module 'device'"),
    # Imported names are not offered.
    ('"devices:Camer"', "hardware.fixed.driver: {folder}/devices.py has no 'Camer'; it has: Broken, Camera, CameraSet"),
    ('"devices:Unset"', "hardware.fixed.driver: {folder}/devices.py:Unset has no Settings"),
    ('"devices:Wrong"', "hardware.fixed.driver: spec of its Settings is no CameraSpec"),
    ('"devices"', "hardware.fixed.driver: 'devices' is neither module:name nor one of: axis"),
    ('"syntax:Camera"', "hardware.fixed.driver: {folder}/syntax.py:2: SyntaxError"),
    ('"failing:Camera"', "hardware.fixed.driver: {folder}/failing.py:3: ZeroDivisionError"),
    ('"needs:Camera"', "hardware.fixed.driver: {folder}/needs.py:1: ModuleNotFoundError: No module named 'no_such"),
])  # fmt: skip
def test_each_mistake_is_one_line_that_names_it(rig, change, said):
    (rig.parent / "syntax.py").write_text("x = 1\nclass Camera(:\n")
    (rig.parent / "failing.py").write_text("x = 1\n\n1 / 0\n")
    (rig.parent / "needs.py").write_text("import no_such_library\n")
    rig.write_text(RIG.replace('"devices:Camera"\ncolour = "green"', change))
    with pytest.raises(ConfigError) as caught:
        load_config(rig)
    assert str(caught.value).startswith(f"{rig}: {said.format(folder=rig.parent)}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("wrong", "error", "said"), [
    (("devices:Camera", "devices:Broken"), DeviceError, r"hardware\.fixed: .*devices\.py:\d+: RuntimeError: the lens "),
    (("devices:Camera", "devices:Short"), ConfigError, r"hardware\.fixed\.driver: Short has no read; docs/drivers\.md"),
    (("devices:Head", "devices:Limitless"), DeviceError, r"hardware\.head: .*devices\.py:\d+: ZeroDivisionError: "),
    (('"green"', '"pink"'), DeviceError, r"hardware\.fixed: .*devices\.py:\d+: KeyError"),
])  # fmt: skip
def test_an_error_of_a_device_is_one_line_that_names_file_and_line(rig, wrong, error, said):
    rig.write_text(RIG.replace(*wrong))
    with pytest.raises(error, match=f"^{said}"), open_rig(rig) as opened:
        opened.fixed.read()


DOME = RIG.replace(
    '[hardware.zoom]\ndriver = "devices:Zoom"\n[hardware.head]\ndriver = "devices:Head"\n',
    """
[hardware.ptz]
driver = "devices:Dome"
""",
)


def test_zoom_camera_and_head_in_one_housing(rig):
    rig.write_text(DOME)
    config = load_config(rig)
    assert describe(config).head.delay_s == 0.02
    with open_rig(config) as opened:
        assert opened.head.move(0.1, 0.2, wait=True) == (0.1, 0.2)
        assert opened.zoom.capture().image.shape == (48, 64, 3)
        assert opened.spec.zoom.focal_range == (100.0, 400.0)
        with (
            pytest.raises(DeviceError, match="the rig with the pan-tilt unit at dome is open already"),
            open_rig(config),
        ):
            pass


@pytest.mark.parametrize(("was", "now", "said"), [
    ("[hardware.ptz]", "[hardware.head]\n[hardware.ptz]\n", None),
    ("[hardware.ptz]", '[hardware.head]\nport = "a"\n[hardware.ptz]\n', "hardware.head: .hardware.ptz. is zoom"),
    ('driver = "devices:Dome"', 'host = "dome"', r"hardware\.ptz\.driver: is missing; give "),
    ('"devices:Dome"', '"devices:Headless"', r"hardware\.ptz\.driver: Headless has no head; "),
    ('"devices:Dome"', '"devices:Lensless"', r"hardware\.ptz\.driver: Lensless\.zoom has no size; "),
    ('"devices:Dome"', '"devices:Head"', r"hardware\.ptz\.driver: spec of its Settings is no UnitSpec"),
    ('"devices:Dome"', '"devices:Dome"\nstep_deg = 1.0', r"hardware\.ptz\.step_deg: its steps are 0\.1 degrees"),
])  # fmt: skip
def test_a_housing_that_is_none_is_refused(rig, was, now, said):
    rig.write_text(DOME.replace(was, now, 1))
    if said is None:  # a table without keys says nothing
        open_rig(rig).close()
        return
    with pytest.raises(ConfigError, match=said), open_rig(rig):
        pass


KINDS = {"head": "Head", "zoom": "Zoom", "fixed": "Camera"}


def with_other(rig, device, body):
    """Replace a device by a subclass with the given body."""
    kind = KINDS[device]
    (rig.parent / "devices.py").write_text(f"{DEVICES}\n\nclass Other({kind}):\n{body}")
    rig.write_text(RIG.replace(f'"devices:{kind}"', '"devices:Other"'))


@pytest.mark.parametrize(("device", "method", "answer", "wanted"), [
    ("head", "state", "(0.1, 0.2)", "a PanTiltState"),
    ("zoom", "state", "ZoomState(float('nan'), False, 0.0)", "a ZoomState"),
    ("zoom", "zoom", "float('nan')", "the focal length that the lens will "),
    ("head", "move", "None", "pan and tilt as commanded [rad]"),
    ("zoom", "capture", "np.zeros((48, 64, 3), np.uint8)", ""),
    ("fixed", "read", "Frame(np.zeros((48, 64), np.uint8), 0.0)", ""),
])  # fmt: skip
def test_wrong_return_value_is_named_by_device_and_method(rig, device, method, answer, wanted):
    with_other(rig, device, f"    def {method}(self, *a, **k):\n        return {answer}\n")
    arguments = {"move": (0.1, 0.2), "zoom": (200.0,)}.get(method, ())
    with pytest.raises(DeviceError) as caught, open_rig(rig) as opened:
        getattr(getattr(opened, device), method)(*arguments)
    assert str(caught.value).startswith(f"hardware.{device}: {method} returned ")
    assert f"it has to return {wanted}" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("device", "name", "wrong"), [
    ("head", "limits", "((-1.0, 1.0), (-0.5, 0.5))"), ("fixed", "size", "None"), ("fixed", "size", "[64, 48]"),
    ("zoom", "size", "(64.0, 48.0)"), ("zoom", "still_size", "(0, 48)"), ("zoom", "focal_range", "(400.0, 100.0)"),
])  # fmt: skip
def test_wrong_attribute_is_named_and_the_device_closed(rig, device, name, wrong):
    body = f"""
    def __setattr__(self, name, value):
        if name != {name!r}:
            super().__setattr__(name, value)

    @property
    def {name}(self):
        return {wrong}

    def close(self):
        open({str(rig.parent / "closed")!r}, "w").close()
"""
    with_other(rig, device, body)
    with pytest.raises(DeviceError) as caught:
        open_rig(rig)
    assert str(caught.value).startswith(f"hardware.{device}: {name} is {wrong}; it has to be ")
    assert "\n" not in str(caught.value)
    assert (rig.parent / "closed").exists()


def test_a_device_may_delegate_to_another_and_may_have_slots(rig):
    other = """

class Delegating:
    Settings = CameraSettings
    __slots__ = ("inner",)

    def __init__(self, settings, clock):
        self.inner = Camera(settings, clock)

    def __getattr__(self, name):
        return getattr(self.inner, name)
"""
    (rig.parent / "devices.py").write_text(DEVICES + other)
    rig.write_text(RIG.replace("devices:Camera", "devices:Delegating"))
    with open_rig(rig, guarded=False) as opened:
        assert opened.fixed.size == (64, 48)
        assert opened.fixed.read().image[0, 0].tolist() == [128] * 3
        assert not hasattr(opened.fixed, "no_such")


def test_an_own_file_may_have_the_name_of_another_module(rig):
    """The name of a module of Python that it imports, or of another own file in the same process."""
    other = rig.parent / "other"
    other.mkdir()
    text = f"from __future__ import annotations\n\nfrom colorsys import rgb_to_hls\n{DEVICES}"
    for folder, name, kind in (
        (rig.parent, "colorsys", "Hz"),
        (rig.parent, "webcam", "Rate"),
        (other, "webcam", "Fps"),
    ):
        own = text.replace("rate_hz: float", f"rate_hz: {kind}") + f"\n\n{kind} = float\n"
        (folder / f"{name}.py").write_text(own)
        (folder / "rig.toml").write_text(RIG.replace("devices:", f"{name}:"))
        assert describe(load_config(folder / "rig.toml")).fixed.rate_hz == 100.0
    assert colorsys.rgb_to_hls(0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)


def test_module_on_pythons_path_is_found(rig, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(rig.parent))
    check(parse_config({"hardware": {"fixed": {"driver": "devices:Camera", "colour": "blue"}}}))
