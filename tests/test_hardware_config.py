"""The [hardware] tables of rig.toml: what they may say."""

import tomllib

import pytest

from cotarget.backends import check, describe
from cotarget.config import HardwareConfig, parse_config
from cotarget.drivers.board import socket_address
from cotarget.drivers.rig import devices
from cotarget.errors import ConfigError

MISTAKES = [
    ("hardware.head.port = 3", "hardware.head.port: 3 is not a text"),
    ("hardware.head.baud = 9601", "hardware.head.baud: 9601 is not one of: 600, 1200"),
    ("hardware.head.pan_sign = 2", "hardware.head.pan_sign: 2 is not one of: -1, 1"),
    ("hardware.head.pan_sign = true", "hardware.head.pan_sign: True is not one of: -1, 1"),
    ("hardware.head.tilt_deg = [30, -40]", "hardware.head.tilt_deg: [30.0, -40.0] is not [lowest, highest]"),
    ("hardware.head.step_deg = 0", "hardware.head.step_deg: 0 is not greater than zero"),
    ("hardware.fixed.url = '192.168.0.90'", "hardware.fixed.url: '192.168.0.90' is not like http://192.168.0.90"),
    ("hardware.fixed.url = 'http://[::1'", "hardware.fixed.url: 'http://[::1' is not like http://192.168.0.90"),
    ("hardware.fixed.url = 'http://host:port'", "hardware.fixed.url: 'http://host:port' is not like"),
    ("hardware.fixed.compression = 101", "hardware.fixed.compression: 101 is not within 0 to 100"),
    ("hardware.fixed.latency_s = -0.1", "hardware.fixed.latency_s: -0.1 is negative"),
    (
        "hardware.zoom.lens = [[0, 6.0]]",
        "hardware.zoom.lens: needs two or more [position, mm], both of them increasing",
    ),
    ("hardware.zoom.lens = [[0, 6.0], [9, 5.0]]", "hardware.zoom.lens: needs two or more"),
    ("hardware.zoom.lens = [[0, 0.0], [9, 5.0]]", "hardware.zoom.lens: 0 is not greater than zero"),
    ("hardware.board.presenter = 'nobody'", "hardware.board.presenter: 'nobody' is neither person nor like socket://"),
    (
        "hardware.head.buad = 9600",
        "unknown key 'hardware.head.buad'; valid here: baud, command_delay_s, driver, pan_deg",
    ),
    ("hardware.fixed.driver = 'axes'", "hardware.fixed.driver: 'axes' is neither module:name nor one of: axis"),
    ("hardware.fixed.driver = 3", "hardware.fixed.driver: 3 is neither module:name nor one of: axis"),
    ("hardware.camera.url = ''", "unknown key 'hardware.camera'; valid here: board, fixed, head, zoom"),
]


@pytest.mark.parametrize(("text", "message"), MISTAKES)
def test_each_mistake_names_its_key(text, message):
    with pytest.raises(ConfigError) as error:
        check(parse_config(tomllib.loads(text)))
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(
    ("url", "address"),
    [
        ("socket://10.0.0.2:4000", ("10.0.0.2", 4000)),
        ("socket://ptu.local:4000/", ("ptu.local", 4000)),
        ("socket://[::1]:80", ("::1", 80)),
        ("/dev/ttyUSB0", None),
        ("socket://host", None),
        ("socket://host:port", None),
    ],
)
def test_socket_addresses(url, address):
    assert socket_address(url) == address


def test_a_head_of_which_nothing_is_said_counts_as_the_makers_manual_has_it():
    """Positive pan of a PTU-D46 turns left, where a rig's turns right; positive tilt goes up for both."""
    head = devices(HardwareConfig())["head"].settings
    assert (head.pan_sign, head.tilt_sign) == (-1, 1)


def test_the_drivers_describe_their_devices():
    """Half the S5 IS's viewfinder width is 160 px of 17.94 um: at 6 mm its focal length is 334.4 px."""
    spec = describe(parse_config(tomllib.loads('backend = "hardware"\nhardware.head.pan_deg = [-90, 90]')))
    assert spec.zoom.focal_range == pytest.approx((6 / 0.01794, 72 / 0.01794))
    assert (spec.fixed.size, spec.zoom.size) == ((704, 576), (320, 240))
    assert spec.head.limits.pan == pytest.approx((-1.5707963, 1.5707963))
