"""The emulated ONVIF dome: its messages by hand, its users, and what each profile does otherwise."""

import base64
import hashlib
import itertools
import time
from datetime import UTC, datetime
from xml.etree.ElementTree import fromstring

import pytest

from cotarget.emulators.onvif import BLOCK, TDS, TPTZ, TT, envelope
from tests.support.onvif_dome import STEP_DEG, OnvifUnit
from tests.support.plants import PASSWORD, USER, wait_for

pytestmark = pytest.mark.wire
NEAR = 1e-3
TOKEN = "<ProfileToken>profile_1</ProfileToken>"


def asked(unit, message, inner="", namespace=TPTZ, header=""):
    """Status of HTTP, and the answer's root."""
    body = f'<{message} xmlns="{namespace}" xmlns:t="{TT}">{inner}</{message}>'
    data = envelope(body).replace("<s:Body>", f"{header}<s:Body>", 1).encode()
    status, said = unit.server.answer(data)
    return status, fromstring(envelope(said))


def done(unit, message, inner=""):
    status, root = asked(unit, message, TOKEN + inner)
    assert status == 200, [each.text for each in root.iter()]
    return root


def fault(unit, message, inner=""):
    status, root = asked(unit, message, TOKEN + inner)
    assert status in (400, 500)
    return [value.text for value in root.iter("{http://www.w3.org/2003/05/soap-envelope}Value")]


def turned(name, pan, tilt):
    return f'<{name}><t:PanTilt x="{pan}" y="{tilt}"/></{name}>'


def position(unit):
    status = done(unit, "GetStatus").find(".//{*}PanTilt")
    return float(status.get("x")), float(status.get("y"))


def rest(unit):
    wait_for(lambda: not unit.turning())
    return unit.pan.degrees(), unit.tilt.degrees()


def dome(*profiles):
    return OnvifUnit(*profiles, login=False)


def test_an_absolute_move_goes_to_numbers_and_the_status_says_them():
    """From -1 to 1 is from -150 to 170 and from -30 to 90 degrees."""
    with dome() as unit:
        done(unit, "AbsoluteMove", turned("Position", 0.1, 0.5))
        assert rest(unit) == pytest.approx((26.0, 60.0), abs=STEP_DEG)
        assert position(unit) == pytest.approx((0.1, 0.5), abs=NEAR)
        assert fault(unit, "AbsoluteMove", turned("Position", 1.5, 0.5))[-1] == "ter:InvalidPosition"
        assert fault(unit, "AbsoluteMove", turned("Position", "nan", 0.5))[-1] == "ter:InvalidArgVal"
        assert rest(unit) == pytest.approx((26.0, 60.0), abs=STEP_DEG)


def test_a_continuous_move_ends_by_a_stop_or_by_its_timeout():
    with dome() as unit:
        done(unit, "ContinuousMove", turned("Velocity", 0.1, 0) + "<Timeout>PT0.5S</Timeout>")
        time.sleep(0.2)
        assert unit.turning()
        pan, tilt = rest(unit)
        assert pan == pytest.approx(5.0, abs=2.0)
        assert tilt == 0.0
        done(unit, "ContinuousMove", turned("Velocity", -0.1, 0))
        wait_for(lambda: unit.pan.degrees() < pan - 1.0)
        done(unit, "Stop", "<PanTilt>true</PanTilt>")
        assert rest(unit)[0] > pan - 10.0


@pytest.mark.parametrize(("profile", "message", "inner", "code"), [
    ("stop-fault", "Stop", "", "ter:ActionNotSupported"),
    ("timeout-fault", "ContinuousMove", "<Timeout>PT1S</Timeout>", "ter:TimeoutNotSupported"),
    ("no-absolute", "AbsoluteMove", turned("Position", 0, 0), "ter:ActionNotSupported"),
    ("continuous-only", "RelativeMove", turned("Translation", 0, 0), "ter:ActionNotSupported"),
    ("presets-only", "ContinuousMove", turned("Velocity", 0.1, 0), "ter:ActionNotSupported"),
    ("no-ptz", "GetStatus", "", "ter:ActionNotSupported"),
])  # fmt: skip
def test_what_a_profile_lacks_is_a_fault(profile, message, inner, code):
    with dome(profile) as unit:
        assert fault(unit, message, inner)[-1] == code
        assert not unit.turning()


@pytest.mark.parametrize(("profile", "where"), [
    ("absolute-ignored", (0.0, 0.0)),
    ("pan-reversed", (-6.0, 60.0)),  # 10 degrees are in the middle: 0.1 is 16 to the other side
    ("tilt-reversed", (26.0, 0.0)),
    ("rounded", (26.0, 60.0)),
])  # fmt: skip
def test_profiles_change_where_an_absolute_move_goes(profile, where):
    with dome(profile) as unit:
        done(unit, "AbsoluteMove", turned("Position", 0.1, 0.5))
        assert rest(unit) == pytest.approx(where, abs=STEP_DEG)


def test_positions_are_rounded():
    with dome("rounded") as unit:
        done(unit, "AbsoluteMove", turned("Position", 0.104, 0.506))
        assert rest(unit) == pytest.approx((26.0, 60.6), abs=STEP_DEG)  # 0.1, and 0.51


def test_a_missing_axis_is_zero():
    with dome("missing-is-zero") as unit:
        done(unit, "AbsoluteMove", turned("Position", 0.1, 0.5))
        rest(unit)
        done(unit, "AbsoluteMove", '<Position><t:Zoom x="0.5"/></Position>')
        assert rest(unit) == pytest.approx((10.0, 30.0), abs=STEP_DEG)


def test_a_pan_alone_is_ignored():
    with dome("pan-alone-ignored") as unit:
        done(unit, "ContinuousMove", turned("Velocity", 0.1, 0))
        assert not unit.turning()
        done(unit, "ContinuousMove", turned("Velocity", 0.1, 0.1))
        assert unit.turning()


def test_only_the_sign_of_a_velocity_counts():
    with dome("signs-only") as unit:
        done(unit, "ContinuousMove", turned("Velocity", 0.01, 0))
        wait_for(lambda: unit.pan.degrees() > 20.0, 1.5)


def test_its_lowest_speed_is_1_5_degrees_a_second():
    with dome("lowest-speed") as unit:
        done(unit, "ContinuousMove", turned("Velocity", 0.001, 0))
        wait_for(lambda: unit.pan.degrees() > 0.75, 1.0)


@pytest.mark.parametrize(("profile", "late_s"), [("slow-stop", 0.4), ("slower-stop", 1.1)])
def test_it_turns_on_after_a_stop(profile, late_s):
    with dome(profile) as unit:
        done(unit, "ContinuousMove", turned("Velocity", 0.1, 0))
        wait_for(lambda: unit.pan.degrees() > 2.0)
        begin = time.monotonic()
        done(unit, "Stop")
        rest(unit)
        assert time.monotonic() - begin > late_s


def test_a_second_stop_does_not_delay_the_first():
    with dome("slower-stop") as unit:
        done(unit, "ContinuousMove", turned("Velocity", 0.1, 0))
        wait_for(lambda: unit.pan.degrees() > 2.0)
        begin = time.monotonic()
        done(unit, "Stop")
        time.sleep(0.7)
        done(unit, "Stop")
        rest(unit)
        assert 1.1 < time.monotonic() - begin < 1.1 + 0.6


def test_a_stop_is_ignored_and_a_velocity_of_zero_is_not():
    with dome("stop-ignored") as unit:
        done(unit, "ContinuousMove", turned("Velocity", 0.1, 0))
        done(unit, "Stop")
        time.sleep(0.3)
        assert unit.turning()
        done(unit, "ContinuousMove", turned("Velocity", 0, 0))
        rest(unit)


def test_the_zoom_limits_the_speed():
    with dome("capped-by-zoom") as unit:
        assert unit.camera.highest_speed() == 100.0
        done(unit, "AbsoluteMove", '<Position><t:Zoom x="1"/></Position>')
        assert unit.camera.highest_speed() == 1.5


@pytest.mark.parametrize(("profile", "said"), [
    ("no-status", (None, None)), ("zoom-status", (None, "0.000000")), (None, ("0.", "0.000000")),
])  # fmt: skip
def test_a_status_lacks_positions(profile, said):
    with dome(*filter(None, [profile])) as unit:
        position = done(unit, "GetStatus").find(".//{*}Position")
        found = position.find("{*}PanTilt"), position.find("{*}Zoom")
        assert [each is None for each in found] == [text is None for text in said]


def test_a_stale_status_is_of_half_a_second_ago():
    with dome("stale-status") as unit:
        end = time.monotonic() + 1.0
        done(unit, "AbsoluteMove", turned("Position", 0.5, 0.5))
        while time.monotonic() < end:
            late = position(unit)[0] * 160 + 10
            time.sleep(0.05)
        assert late < 90.0
        wait_for(lambda: position(unit)[0] == pytest.approx(0.5, abs=NEAR))


def test_presets_are_kept():
    with dome("presets-only") as unit:
        token = done(unit, "SetPreset").find(".//{*}PresetToken").text
        assert [each.get("token") for each in done(unit, "GetPresets").iter(f"{{{TPTZ}}}Preset")] == [token]
        done(unit, "GotoPreset", f"<PresetToken>{token}</PresetToken>")
        assert fault(unit, "GotoPreset", "<PresetToken>other</PresetToken>")[-1] == "ter:NoToken"


# Users


def token(user=USER, password=PASSWORD, created=None, nonce=b"nonce"):
    stamp = (created or datetime.now(UTC)).strftime("%Y-%m-%dT%H:%M:%SZ")
    digest = base64.b64encode(hashlib.sha1(nonce + stamp.encode() + password.encode()).digest()).decode()
    return (
        f"<s:Header><Security><UsernameToken><Username>{user}</Username><Password Type='x#PasswordDigest'>{digest}"
        f"</Password><Nonce>{base64.b64encode(nonce).decode()}</Nonce><Created>{stamp}</Created></UsernameToken>"
        "</Security></s:Header>"
    )


@pytest.mark.parametrize(("header", "profile", "status"), [
    (token(), None, 200), ("", None, 400), (token(password="wrong"), None, 400), (token(user="other"), None, 400),
    (token(created=datetime(2026, 1, 1, tzinfo=UTC)), None, 400), (token(), "clock-10h", 400),
    (token(), "clock-20s", 400), (token(), "unauthorized", 400), (token().replace("Nonce", "Once"), None, 400),
])  # fmt: skip
def test_a_token_has_to_be_the_users_and_of_now(header, profile, status):
    header = header.replace("<Security>", "<Security xmlns='y'>")
    with OnvifUnit(*filter(None, [profile])) as unit:
        fresh = token().replace("<Security>", "<Security xmlns='y'>") if header and status == 200 else header
        assert asked(unit, "GetDeviceInformation", namespace=TDS, header=fresh)[0] == status
        wanted = 400 if profile == "unauthorized" else 200
        assert asked(unit, "GetSystemDateAndTime", namespace=TDS)[0] == wanted


@pytest.mark.parametrize("data", [b"", b"<a/>", b"\0\xff", b"<!DOCTYPE a><a/>", b"<a", envelope("").encode()])
def test_what_is_no_message_is_a_fault(data):
    with dome() as unit:
        status, said = unit.server.answer(data)
        assert status == 400
        assert "WellFormed" in said


def test_the_lens_magnifies_as_it_is_told():
    table = BLOCK.lens_table(12.0)
    assert table[0] == [0.0, 1.0]
    assert table[-1] == [1.0, pytest.approx(12.0)]
    assert all(b[0] > a[0] and b[1] > a[1] for a, b in itertools.pairwise(table))
