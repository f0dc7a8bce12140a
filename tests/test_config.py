"""rig.toml: defaults, every section, and one clear line for each mistake."""

import re
import tomllib
from pathlib import Path

import pytest

from cotarget.backends import check, describe, load_config
from cotarget.config import SimEffects, config_of, parse_config
from cotarget.drivers.board import socket_address
from cotarget.errors import ConfigError

DOG = "[targets.dog]\nsize = 0.6\ndimension = 'height'\nwanted_px = 200\ndetector = 'motion'\n"


# Values that a key refuses; each message begins with the key.
REFUSED = {
    "board.corners": ["'9x6'", "[2, 6]", "[201, 400]", "[8, 6]"],
    "hardware.zoom.lens": ["[6, 72]"],
    "follow.ignored": [
        "0.5",
        "[[[0, 0], [1, 1]]]",  # two points
        "[[0.1, 0.1], [0.2, 0.1], [0.2, 0.2]]",  # one polygon, and not a list of them
        "[[[0, 0], [320, 0], [320, 240]]]",  # pixels
        "[[[0, 0], [0.5, -0.1], [1, 1]]]",
        "[[[0, 0], [0.5, 0, 1], [1, 1]]]",
        "[[[0, 0], ['a', 0], [1, 1]]]",
        "[[[0, 0], [true, 0], [1, 1]]]",
    ],
    "safety.max_frame_age_s": ["1000"],
    "safety.stop_file": ["''", "'.'", "'run/..'", "1"],
    "safety.tilt_deg": ["30"],
    "safety.watchdog_s": ["0", "350", "inf", "0.04"],  # a frame comes each 0.04 s
    "sim.effects.all": ["0"],
    "sim.fixed.center_px": ["[700, 239]"],
    "sim.fixed.distortion": ["[-0.5, 0, 0, 0, 0]"],  # folds back inside the image
    "sim.fixed.focal_px": ["[0, 1]"],
    "sim.fixed.jpeg_quality": ["0"],
    "sim.fixed.noise": ["'much'", "-1"],
    "sim.fixed.size": ["[640]", "[640, 480.5]", "640"],
    "sim.head.pan_deg": ["[10, -10]", "90"],
    "sim.head.squareness_deg": ["-90"],
    "sim.paths": ["{ boook = [[0, 0, 0, 0], [1, 0, 0, 0]] }"],
    "sim.paths.bird": ["3", "[0, 0, 20, 5]", "[[1, 0, 0, 0], [1, 1, 0, 0]]"],
    "sim.T_head_zoom": ["3", "{ translation = 1, rotvec_deg = [0, 0, 0] }", "{ translation = [0, 0, 0] }"],
    "sim.T_zoom0_fixed.rotvec_deg": ["[1e308, 1e308, 0]\nsim.T_zoom0_fixed.translation = [0, 0, 0]"],
    "sim.T_zoom0_fixed.translation": ["[1e300, 0, 0]\nsim.T_zoom0_fixed.rotvec_deg = [0, 0, 0]"],
    "sim.targets": ["['cow']", "['dog']", "['bird', 'bird2', 'bird']", "'bird'"],
    "sim.zoom.center_drift_px": ["[[1, 2]]", "[1, 2]", "[[0], [480]]"],
    "sim.zoom.center_px": ["[326, -1]"],
    "sim.zoom.distortion_drift": ["[-0.5]"],
    "sim.zoom.exposure_s": ["10"],  # longer than from one frame to the next
    "sim.zoom.focal_curve": ["[0.1, nan]", "[-0.95]", "[1e308, 1e308]"],
    "sim.zoom.pupil": ["-0.08", "[-80]"],
    "targets.bird.size": ["0"],
    "targets.cow": ["{ size = 2.0 }"],
}


def refusal(path, text):
    """The line that refuses a rig.toml of a text, without the file's name."""
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    return said.removeprefix(f"{path}: ")


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in REFUSED.items() for value in values])
def test_refused_value_is_named_by_its_key(tmp_path, key, value):
    dog = "\n" + DOG if "dog" in value else ""  # a target without a model, which the scene cannot have
    assert re.match(rf"{re.escape(key)}[:.\[]", refusal(tmp_path / "rig.toml", f"{key} = {value}{dog}"))


def test_byte_order_mark_is_accepted(tmp_path):
    """Some editors on Windows put it before a text in UTF-8."""
    (tmp_path / "rig.toml").write_text('backend = "sim"\n[sim]\nseed = 7\n', encoding="utf-8-sig")
    assert load_config(tmp_path / "rig.toml").sim.seed == 7


def test_paths_are_relative_to_rig_toml(tmp_path):
    (tmp_path / "own.xml").write_text("<mujoco/>")
    text = """
        recording = "run"
        [sim]
        scene = "own.xml"
        models.dog = "dog.obj"
        [targets.book]
        template = "/covers/mine.png"
        [targets.dog]
        size = 0.6
        dimension = "height"
        wanted_px = 200
        detector = "colour"
        template = "dog.png"
        """
    config = config_of(text, tmp_path / "rig.toml")
    assert config.sim.scene == str(tmp_path / "own.xml")
    assert (config.recording, config.sim.models["dog"]) == (tmp_path / "run", tmp_path / "dog.obj")
    assert (config.targets["dog"].template, config.targets["book"].template) == (
        tmp_path / "dog.png",
        Path("/covers/mine.png"),
    )


def test_zoom_curves_are_checked_only_with_the_optics_effect():
    curves = {"focal_curve": [-0.95], "center_drift_px": [[], [1, 2.5]], "pupil": []}
    zoom = parse_config({"sim": {"zoom": curves, "effects": {"optics": False}}}).sim.zoom
    assert (zoom.focal_curve, zoom.center_drift_px, zoom.pupil) == ((-0.95,), ((), (1.0, 2.5)), ())
    assert not parse_config({"sim": {"effects": {"all": False}}}).sim.effects.optics
    assert SimEffects().optics
    with pytest.raises(ConfigError, match="does not grow"):
        check(parse_config({"sim": {"zoom": curves}}))


@pytest.mark.parametrize(("size", "by"), [([1280, 960], 2), ([320, 240], 0.5), ([1280, 720], 2)])
def test_another_image_size_shows_the_same_view(size, by):
    """The pixel at the left border and the true centre are in the same directions as before."""
    before = parse_config({}).sim
    after = parse_config({"sim": {"fixed": {"size": size}, "zoom": {"size": size}}}).sim
    for old, new in ((before.fixed, after.fixed), (before.zoom, after.zoom)):
        assert new.focal_px == pytest.approx((by * old.focal_px[0], by * old.focal_px[1]))
        assert (-0.5 - new.center_px[0]) / new.focal_px[0] == pytest.approx((-0.5 - old.center_px[0]) / old.focal_px[0])
        middle = (size[1] - 1) / 2
        assert new.center_px[1] - middle == pytest.approx(by * (old.center_px[1] - 239.5))
    # The device reports focal lengths in pixels of its stream, and the centre drifts as far on the sensor.
    assert 6.0 / after.zoom.pitch_mm / after.zoom.focal_px[0] == pytest.approx(6.0 / 0.009 / 692)
    assert after.zoom.center_drift_px[0][0] == pytest.approx(27.0 * by)


def test_given_intrinsics_are_not_scaled_with_the_image_size():
    camera = {"size": [1280, 960], "focal_px": [1200, 1201], "center_px": [600, 500]}
    sim = parse_config(
        {"sim": {"fixed": camera, "zoom": camera | {"pitch_mm": 0.01, "center_drift_px": [[1], []]}}}
    ).sim
    for found in (sim.fixed, sim.zoom):
        assert (found.focal_px, found.center_px) == ((1200.0, 1201.0), (600.0, 500.0))
    assert (sim.zoom.pitch_mm, sim.zoom.center_drift_px) == (0.01, ((1.0,), ()))


@pytest.mark.parametrize("said", [
    {"size": [320, 240], "focal_px": [692, 693], "center_px": [160, 115]},  # a crop
    {"size": [1280, 720], "focal_px": [692, 693]},
    {"size": [320, 240], "focal_px": [500, 501]},
    {"focal_px": [1384, 1386]},
    {"size": [640, 480], "focal_px": [346, 346.5]},
])  # fmt: skip
def test_reported_focal_length_scales_with_the_true_one(said):
    """At any image size, 6 mm give the same ratio of reported to true focal length, and the centre drifts as far."""
    plain, zoom = parse_config({}).sim.zoom, parse_config({"sim": {"zoom": said}}).sim.zoom
    assert zoom.focal_px == tuple(map(float, said["focal_px"]))
    by = zoom.focal_px[0] / plain.focal_px[0]
    assert zoom.focal_mm[0] / zoom.pitch_mm == pytest.approx(by * 6.0 / 0.009)
    for curve, before in zip(zoom.center_drift_px, plain.center_drift_px, strict=True):
        assert curve == pytest.approx([by * c for c in before])


@pytest.mark.parametrize("said", [
    {"focal_mm": [4.7, 94.0], "pitch_mm": 0.0048},  # 20x
    {"focal_mm": [4.7, 94.0], "pitch_mm": 0.0048, "size": [1280, 720]},
    {"focal_mm": [4.7, 94.0]},
    {"focal_mm": [4.7, 94.0], "focal_px": [900, 901]},
    {"pitch_mm": 0.0048},
    {"pitch_mm": 0.0048, "focal_px": [900, 901]},
])  # fmt: skip
def test_of_true_and_nominal_focal_length_what_is_not_given_follows(said):
    """Given values stay, and the true focal length is 692 px for each 6 mm over 0.009 mm."""
    zoom = parse_config({"sim": {"zoom": said}}).sim.zoom
    assert said == {key: value if key == "pitch_mm" else list(value) for key, value in
                    ((key, getattr(zoom, key)) for key in said)}  # fmt: skip
    assert zoom.focal_px[0] * zoom.pitch_mm / zoom.focal_mm[0] == pytest.approx(692 * 0.009 / 6)
    assert zoom.focal_px[1] / zoom.focal_px[0] == pytest.approx(693 / 692, rel=1e-3)


@pytest.mark.parametrize(("table", "named"), [
    ({"zoom": {"focal_px": [692, 693], "focal_mm": [4.7, 94], "pitch_mm": 0.0048}},
     "sim.zoom.focal_px: 692 px contradict the nominal 979.2 px, sim.zoom.focal_mm / pitch_mm; .* pitch_mm = 0.006792"),
    ({"T_zoom0_fixed": {"translation": [-400, 30, 60], "rotvec_deg": [0, 0, 0]}},
     "sim.T_zoom0_fixed.translation: 405.586 m is too large; is 0.405586 m meant?"),
    ({"T_head_zoom": {"translation": [20, -80, 50], "rotvec_deg": [0, 0, 0]}}, "sim.T_head_zoom.translation: 96.4"),
])  # fmt: skip
def test_a_simulated_rig_that_contradicts_itself_or_is_in_millimetres_is_refused(table, named):
    with pytest.raises(ConfigError, match=named):
        check(parse_config({"sim": table}))


def test_crop_keeps_the_offset_of_the_principal_point():
    fixed = parse_config({"sim": {"fixed": {"size": [320, 240], "focal_px": [686, 684]}}}).sim.fixed
    assert fixed.center_px == pytest.approx((159.5 + 325 - 319.5, 119.5 + 239 - 239.5))


def test_all_false_switches_every_effect_off():
    effects = parse_config({"sim": {"effects": {"all": False}}}).sim.effects
    assert effects == SimEffects(**dict.fromkeys(SimEffects.__dataclass_fields__, False) | {"multisampling": True})


@pytest.mark.parametrize("order", [1, -1])
def test_a_numbered_target_of_ones_own_has_the_settings_of_its_kind_in_any_order(order):
    car = {"dimension": "width", "size": 4.5, "wanted_px": 200.0}
    tables = list({"car": car, "car2": {"wanted_px": 99.0}}.items())[::order]
    config = parse_config({"targets": dict(tables)})
    assert (config.target("car2").size, config.target("car2").wanted_px) == (4.5, 99.0)


def test_numbered_target_defaults_to_its_kind():
    config = parse_config(
        {
            "sim": {"targets": ["bird", "bird2", "bird3"], "paths": {"bird3": [[0, 0, 10, 1.6], [9, 0, 10, 1.6]]}},
            "targets": {"bird": {"wanted_px": 99.0}, "bird3": {"size": 0.5}},
        }
    )
    assert config.target("bird2") == config.target("bird")
    assert (config.target("bird3").wanted_px, config.target("bird3").size) == (99.0, 0.5)
    assert config.target("bird12").wanted_px == 99.0
    for name in ("bird1", "bird02", "bird2x", "2", "cow2"):
        with pytest.raises(ConfigError, match=f"unknown target '{name}'; the targets are: bird, bird3, book, person"):
            config.target(name)


# Values that a key of [hardware] refuses.
REFUSED_HARDWARE = {
    "head.port": ["3"],
    "head.baud": ["9601"],
    "head.pan_sign": ["2", "true"],
    "head.tilt_deg": ["[30, -40]"],
    "head.step_deg": ["0"],
    "fixed.url": ["'192.168.0.90'", "'http://[::1'", "'http://host:port'"],
    "fixed.compression": ["101"],
    "fixed.latency_s": ["-0.1"],
    "fixed.driver": ["3"],
    "zoom.lens": ["[[0, 6.0]]", "[[0, 6.0], [9, 5.0]]", "[[0, 0.0], [9, 5.0]]"],
    "board.presenter": ["'nobody'"],
}


def refused_hardware(text):
    with pytest.raises(ConfigError) as error:
        check(parse_config(tomllib.loads(text)))
    return str(error.value)


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key, values in REFUSED_HARDWARE.items() for value in values]
)
def test_refused_value_of_hardware_is_named_by_its_key(key, value):
    assert refused_hardware(f"hardware.{key} = {value}").startswith((f"hardware.{key}: ", f"hardware.{key}["))


def test_an_unknown_driver_is_refused_with_the_valid_ones():
    assert refused_hardware("hardware.fixed.driver = 'axes'").endswith(": axis, stream")


@pytest.mark.parametrize("backend", ["hardware", "sim"])
@pytest.mark.parametrize("camera", ["fixed", "zoom"])
def test_latency_above_the_frame_age_limit_is_refused(backend, camera):
    text = f"backend = '{backend}'\nsafety.max_frame_age_s = 2.0\n{backend}.{camera}.latency_s = "
    check(parse_config(tomllib.loads(f"{text}1.9")))
    assert refused_hardware(f"{text}20").startswith(f"{backend}.{camera}.latency_s: ")


def test_the_latency_of_a_dome_is_named_by_its_table():
    text = "backend = 'hardware'\nhardware.ptz.driver = 'onvif'\nhardware.ptz.latency_s = 20"
    assert refused_hardware(text).startswith("hardware.ptz.latency_s: ")


@pytest.mark.parametrize(("url", "address"), [
    ("socket://10.0.0.2:4000", ("10.0.0.2", 4000)), ("socket://ptu.local:4000/", ("ptu.local", 4000)),
    ("socket://[::1]:80", ("::1", 80)), ("/dev/ttyUSB0", None), ("socket://host", None), ("socket://host:port", None),
])  # fmt: skip
def test_socket_addresses(url, address):
    assert socket_address(url) == address


def test_the_drivers_describe_their_devices():
    """Half the S5 IS's viewfinder width is 160 px of 17.94 um: at 6 mm its focal length is 334.4 px."""
    spec = describe(parse_config(tomllib.loads('backend = "hardware"\nhardware.head.pan_deg = [-90, 90]')))
    assert spec.zoom.focal_range == pytest.approx((6 / 0.01794, 72 / 0.01794))
    assert (spec.fixed.size, spec.zoom.size) == ((704, 576), (320, 240))
    assert spec.head.limits.pan.range == pytest.approx((-1.5707963, 1.5707963))
