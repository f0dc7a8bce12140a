"""VISCA's bytes, worked by hand from the manuals of EVI-D70, BirdDog P100, PTZOptics and SRG-300H."""

import pytest

from cotarget.drivers import visca_protocol as protocol
from cotarget.drivers.link_errors import ReplyError
from cotarget.drivers.visca import FAMILIES, ViscaSettings
from cotarget.drivers.visca_protocol import Answer, Packet

COUNT = 0.5  # half a count, by which a rounded angle may be off


@pytest.mark.parametrize(("value", "width", "data"), [
    (-2266, 4, "0F 07 02 06"),  # F726: -170 degrees of a P100
    (2267, 4, "00 08 0D 0B"),  # 08DB: the EVI-D70's right end
    (-400, 4, "0F 0E 07 00"),  # FE70: its lower end
    (0, 4, "00 00 00 00"),
    (-1, 5, "0F 0F 0F 0F 0F"),
    (-8, 5, "0F 0F 0F 0F 08"),
    (50000, 5, "00 0C 03 05 00"),  # beyond what four nibbles hold
])  # fmt: skip
def test_a_position_is_spread_over_nibbles_in_twos_complement_of_their_width(value, width, data):
    assert protocol.nibbles(value, width) == bytes.fromhex(data)
    assert protocol.number(bytes.fromhex(data)) == value


@pytest.mark.parametrize(("value", "width"), [(1 << 16, 4), (-(1 << 15) - 1, 4), (1 << 20, 5)])
def test_a_position_that_does_not_fit_is_refused(value, width):
    with pytest.raises(ValueError, match="does not fit"):
        protocol.nibbles(value, width)


def test_orders():
    move = protocol.absolute((-2267, 1200), (0x18, 0x14), (4, 4))
    assert move == bytes.fromhex("81 01 06 02 18 14 0F 07 02 05 00 04 0B 00 FF")
    wide = protocol.absolute((-1, 1), (1, 2), (5, 4))
    assert wide == bytes.fromhex("81 01 06 02 01 02 0F 0F 0F 0F 0F 00 00 00 01 FF")
    assert protocol.zoom_to(0x362C) == bytes.fromhex("81 01 04 47 03 06 02 0C FF")
    assert bytes.fromhex("81 01 06 01 01 01 03 03 FF") == protocol.STOP
    assert bytes.fromhex("81 01 04 06 03 FF") == protocol.DIGITAL_ZOOM_OFF


@pytest.mark.parametrize(("message", "answer"), [
    ("90 41 FF", Answer(4, 1)),
    ("90 52 FF", Answer(5, 2)),
    ("90 60 02 FF", Answer(6, 0, b"\x02")),
    ("90 61 41 FF", Answer(6, 1, b"\x41")),
    ("A0 50 02 FF", Answer(5, 0, b"\x02")),  # from camera 2
    ("90 50 0F 07 02 06 0F 0E 07 08 FF", Answer(5, 0, bytes.fromhex("0F 07 02 06 0F 0E 07 08"))),
    ("90 38 FF", None),  # the network changes
    ("81 41 FF", None),  # our own
    ("90 41", None),
    ("90 60 FF", None),
    ("48 54 54 50 FF", None),
    ("FF", None),
])  # fmt: skip
def test_answers(message, answer):
    assert protocol.parse(bytes.fromhex(message)) == answer


def test_the_length_says_how_wide_pan_is():
    assert protocol.pan_tilt(bytes.fromhex("0F 07 02 06 0F 0E 07 08")) == (-2266, -392)
    assert protocol.pan_tilt(bytes.fromhex("0F 0D 01 02 00 0F 0F 0F 0F")) == (-0x2EE0, -1)
    for data, said in (
        ("0F 07 02", "in 3 nibbles"),
        ("00 " * 10, "in 10 nibbles"),
        ("1F 07 02 06 0F 0E 07 08", "no ni"),
    ):
        with pytest.raises(ReplyError, match=said):
            protocol.pan_tilt(bytes.fromhex(data))


def test_sonys_header_has_type_length_and_number():
    inquiry = bytes.fromhex("01 10 00 05 00 00 01 02 81 09 06 12 FF")
    assert protocol.pack(protocol.INQUIRY, 0x102, protocol.PAN_TILT) == inquiry
    assert protocol.pack(protocol.CONTROL, 0, protocol.RESET) == bytes.fromhex("02 00 00 01 00 00 00 00 01")
    reply = bytes.fromhex("01 11 00 03 00 00 00 07 90 41 FF")
    assert protocol.unpack(reply) == Packet(protocol.REPLY, 7, bytes.fromhex("90 41 FF"))
    for wrong in (b"", reply[:8], reply[:-1], bytes.fromhex("90 41 FF"), inquiry):
        assert protocol.unpack(wrong) is None


@pytest.mark.parametrize(("units", "pan", "degrees"), [
    ("ptzoptics", 0x0990, 170.0),
    ("ptzoptics", 0xF868 - 0x10000, -135.0),
    ("evi_d70", 0x08DB, 170.0),
    ("evi_d70", 0x04B0, 90.0),
    ("evi_d80", 0x1E1B, 170.0),
    ("evi_d80", 0xE1E5 - 0x10000, -170.0),
    ("evi_d80", 0x0FF0, 90.0),
])  # fmt: skip
def test_counts_of_each_family(units, pan, degrees):
    step = FAMILIES[units].step_deg
    assert pan * step == pytest.approx(degrees, abs=COUNT * step)


@pytest.mark.parametrize(("units", "pan", "tilt"), [
    ("ptzoptics", (-2448, 2448), (-432, 1296)),  # F670 to 0990, FE50 to 0510
    ("evi_d70", (-2267, 2267), (-400, 1200)),  # F725 to 08DB, FE70 to 04B0
    ("evi_d80", (-7707, 7707), (-1360, 4080)),  # E1E5 to 1E1B, and 0FF0 above
])  # fmt: skip
def test_the_usual_range_in_counts_of_each_family(units, pan, tilt):
    for axis, (low, high) in zip(ViscaSettings(units=units).axes, (pan, tilt), strict=False):
        assert (axis.lowest, axis.highest) == (pytest.approx(low, abs=1), pytest.approx(high, abs=1))


def test_a_measured_step_replaces_that_of_the_units_and_a_sign_turns_the_range():
    settings = ViscaSettings(step_deg=(0.1, 0.2), pan_deg=(-10.0, 90.0), pan_sign=-1)
    pan, tilt, lens = settings.axes
    assert (pan.lowest, pan.highest, tilt.lowest, tilt.highest) == (-900, 100, -150, 450)
    assert (lens.lowest, lens.highest) == (0, 0x4000)  # what is beyond is digital
