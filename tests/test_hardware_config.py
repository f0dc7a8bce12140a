"""The [hardware] tables of rig.toml."""

import tomllib

import pytest

from cotarget.backends import check, describe
from cotarget.config import parse_config
from cotarget.drivers.board import socket_address
from cotarget.errors import ConfigError

# Values that a key of [hardware] refuses.
REFUSED = {
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


def refusal(text):
    with pytest.raises(ConfigError) as error:
        check(parse_config(tomllib.loads(text)))
    return str(error.value)


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in REFUSED.items() for value in values])
def test_refused_value_is_named_by_its_key(key, value):
    assert refusal(f"hardware.{key} = {value}").startswith((f"hardware.{key}: ", f"hardware.{key}["))


def test_an_unknown_driver_is_refused_with_the_valid_ones():
    assert refusal("hardware.fixed.driver = 'axes'").endswith(": axis")


@pytest.mark.parametrize("backend", ["hardware", "sim"])
@pytest.mark.parametrize("camera", ["fixed", "zoom"])
def test_latency_above_the_frame_age_limit_is_refused(backend, camera):
    text = f"backend = '{backend}'\nsafety.max_frame_age_s = 2.0\n{backend}.{camera}.latency_s = "
    check(parse_config(tomllib.loads(f"{text}1.9")))
    assert refusal(f"{text}20").startswith(f"{backend}.{camera}.latency_s: ")


@pytest.mark.parametrize(("url", "address"), [
    ("socket://10.0.0.2:4000", ("10.0.0.2", 4000)),
    ("socket://ptu.local:4000/", ("ptu.local", 4000)),
    ("socket://[::1]:80", ("::1", 80)),
    ("/dev/ttyUSB0", None),
    ("socket://host", None),
    ("socket://host:port", None),
])  # fmt: skip
def test_socket_addresses(url, address):
    assert socket_address(url) == address


def test_the_drivers_describe_their_devices():
    """Half the S5 IS's viewfinder width is 160 px of 17.94 um: at 6 mm its focal length is 334.4 px."""
    spec = describe(parse_config(tomllib.loads('backend = "hardware"\nhardware.head.pan_deg = [-90, 90]')))
    assert spec.zoom.focal_range == pytest.approx((6 / 0.01794, 72 / 0.01794))
    assert (spec.fixed.size, spec.zoom.size) == ((704, 576), (320, 240))
    assert spec.head.limits.pan.range == pytest.approx((-1.5707963, 1.5707963))
