"""The safety layer in front of a head that logs its commands, and of cameras whose frames may be old."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cotarget.config import SafetyConfig
from cotarget.errors import ConfigError, DeviceError, StaleFrameError
from cotarget.rig import Frame, PanTiltState
from tests.support.rigs import alike, guarded, rig_of

STEP = math.radians(0.0514286)
SPEED = math.radians(149.0)
ROUNDING = 1e-12  # degrees to radians and back, and a multiple of a step
LIMITS = alike((math.radians(-158.9), math.radians(158.9)), (math.radians(-46.6), math.radians(31.1)), SPEED, 3.6, STEP)


class Head:
    """A head without limits that rounds to steps, so that only the safety layer keeps it inside."""

    def __init__(self, limits=LIMITS):
        self.limits, self.log, self.pose = limits, [], (0.0, 0.0)

    def state(self):
        return PanTiltState(*self.pose, moving=False, t=0.0)

    def move(self, pan, tilt, speed=None, wait=False):
        step = self.limits.pan.step
        self.pose = tuple(round(q / step) * step if step else q for q in (pan, tilt))
        self.log.append((*self.pose, speed, wait))
        return self.pose

    def halt(self):
        self.log.append("halt")


class Devices:
    """Devices whose fixed camera gives a frame of a certain age."""

    def __init__(self, head=None, age=0.06):
        self.head = head or Head()
        self.closed = False
        self.clock = SimpleNamespace(now=lambda: 5.0, sleep_until=lambda t: None)
        self.zoom = self.board = object()
        frame = Frame(np.zeros((2, 2, 3), np.uint8), 5.0 - age)
        self.asked = []
        self.fixed = SimpleNamespace(size=(2, 2), read=lambda *a: self.asked.append(a) or frame)

    def close(self):
        self.head.log.append("close")
        self.closed = True


def inside(angle, limits):
    return limits[0] - ROUNDING <= angle <= limits[1] + ROUNDING


@pytest.mark.parametrize("step", [STEP, 0.0, math.radians(2.0)])
@pytest.mark.parametrize("soft", [
    SafetyConfig(),
    SafetyConfig(pan_deg=(-20.03, 33.37), tilt_deg=(-5.01, 4.99), speed_deg_s=40.0),
    SafetyConfig(pan_deg=(-500.0, 500.0), tilt_deg=(-40.0, 500.0), speed_deg_s=1000.0),
    SafetyConfig(pan_deg=(10.0, 12.1), tilt_deg=(-30.0, -25.0)),  # home is not among them
])  # fmt: skip
def test_no_command_leaves_the_limits_or_exceeds_the_cap(step, soft):
    rng = np.random.default_rng(1)
    head = Head(alike(LIMITS.pan.range, LIMITS.tilt.range, SPEED, 3.6, step))
    allowed = []
    for wanted, device in ((soft.pan_deg, (-158.9, 158.9)), (soft.tilt_deg, (-46.6, 31.1))):
        low, high = wanted or device
        allowed.append((math.radians(max(low, device[0])), math.radians(min(high, device[1]))))
    cap = math.radians(min(soft.speed_deg_s or 149.0, 149.0))
    safe = guarded(Devices(head), soft).head
    edges = [e + d for limits in allowed for e in limits for d in (-1e-3, -1e-12, 0.0, 1e-12, 1e-3)]
    commands = [*rng.uniform(-7, 7, (3000, 2)), *((p, t) for p in edges for t in edges)]
    for pan, tilt in commands:
        speed = None if rng.random() < 0.3 else rng.uniform(0.01, 10)
        said = safe.move(pan, tilt, speed)
        done = head.log[-1]
        assert inside(done[0], allowed[0]), (pan, done)
        assert inside(done[1], allowed[1]), (tilt, done)
        assert said == done[:2]
        assert done[2] == pytest.approx(cap if speed is None else min(speed, cap), abs=ROUNDING)
    pan, tilt = (np.mean(limits) for limits in allowed)  # what is allowed is done, to a step
    said = safe.move(pan, tilt)
    assert np.allclose(said, (pan, tilt), rtol=0, atol=step / 2 + ROUNDING)
    for shown, limits in zip((safe.limits.pan.range, safe.limits.tilt.range), allowed, strict=True):
        assert np.allclose(shown, limits, rtol=0, atol=ROUNDING)
    assert safe.limits.pan.speed == pytest.approx(cap)


# Every pair of these as angles [rad], with each of the speeds: all directions, edges, and results of arithmetic.
AWKWARD = [
    *(math.radians(d) for d in range(-200, 201, 8)),
    *(e + d for axis in LIMITS.axes for e in axis.range for d in (-STEP, -1e-9, 0.0, 1e-9, STEP)),
    0.0, -0.0, 5e-324, 1e-300, 1e300, -1e300, 1.8e308, math.inf, -math.inf, math.nan,
]  # fmt: skip
SPEEDS = [None, 5e-324, 1e-9, math.radians(40.0), SPEED, 1e300, math.inf, 0.0, -0.0, -1.0, -math.inf, math.nan]


@pytest.mark.parametrize("step", [STEP, 0.0])
def test_every_command_is_done_within_the_limits_or_refused(step):
    head = Head(alike(LIMITS.pan.range, LIMITS.tilt.range, SPEED, 3.6, step))
    safe = guarded(Devices(head), SafetyConfig(pan_deg=(-90.0, 45.0), speed_deg_s=30.0)).head
    pan_limits, cap = (math.radians(-90.0), math.radians(45.0)), math.radians(30.0)
    for pan, tilt in itertools.product(AWKWARD, AWKWARD):
        for speed in SPEEDS:
            head.log.clear()
            good = math.isfinite(pan) and math.isfinite(tilt) and (speed is None or speed > 0)
            if not good:
                with pytest.raises(DeviceError, match="head"):
                    safe.move(pan, tilt, speed)
                assert not head.log
                continue
            safe.move(pan, tilt, speed)
            ((done_pan, done_tilt, done_speed, _),) = head.log
            assert inside(done_pan, pan_limits)
            assert inside(done_tilt, LIMITS.tilt.range)
            assert 0 < done_speed <= cap + ROUNDING


@pytest.mark.parametrize(("change", "key"), [
    ({"range": (math.nan, 1.0)}, r"safety\.tilt_deg"),
    ({"range": (-1.0, math.nan)}, r"safety\.tilt_deg"),
    ({"range": (1.0, -1.0)}, r"safety\.tilt_deg"),
    ({"range": (-math.inf, math.inf)}, r"safety\.tilt_deg"),  # an endless axis needs soft limits
    ({"speed": math.nan}, "tilt a speed of nan"),
    ({"acceleration": math.nan}, "acceleration of nan"),
    ({"step": math.nan}, "step of nan"),
    *(({"slack": slack}, f"slack of {slack}") for slack in (math.nan, math.inf, -1.0)),
])  # fmt: skip
def test_a_head_without_usable_limits_is_refused(change, key):
    rig = Devices(Head(replace(LIMITS, tilt=replace(LIMITS.tilt, **change))))
    with pytest.raises(ConfigError, match=key):
        guarded(rig, SafetyConfig())
    assert rig.closed
    endless = Devices(Head(replace(LIMITS, pan=replace(LIMITS.pan, range=(-math.inf, math.inf)))))
    assert guarded(endless, SafetyConfig(pan_deg=(-90.0, 90.0))).head.limits.pan.range == (-math.pi / 2, math.pi / 2)


@pytest.mark.parametrize("pose", [(math.nan, 0.0), (0.0, math.nan), (0.0, math.inf)])
def test_a_head_that_reports_no_angle_is_an_error(pose):
    rig = Devices()
    rig.head.pose = pose
    with pytest.raises(DeviceError, match="reports that it is at pan"):
        guarded(rig, SafetyConfig()).head.state()


@pytest.mark.parametrize("focal_px", [math.nan, math.inf])
def test_a_focal_length_that_is_not_finite_is_refused(focal_px):
    rig = Devices()
    rig.zoom = SimpleNamespace(size=(2, 2), zoom=lambda focal: pytest.fail("the lens moved"))
    with pytest.raises(DeviceError, match="focal length"):
        guarded(rig, SafetyConfig()).zoom.zoom(focal_px)


@pytest.mark.parametrize("said", [(1.9, 0.0), (0.0, -1.5), (math.nan, 0.0)])
def test_a_head_that_reports_a_goal_beyond_the_limits_is_halted(said):
    rig = Devices()
    rig.head.move = lambda *a: said
    with pytest.raises(DeviceError, match=r"pan 28\.648"):
        guarded(rig, SafetyConfig(pan_deg=(-90.0, 90.0))).head.move(0.5, 0.1)
    assert rig.head.log == ["halt"]


def test_a_head_of_unlimited_speed_gets_no_speed():
    head = Head(alike((-1.0, 1.0), (-1.0, 1.0), math.inf, math.inf, 0.0))
    safe = guarded(Devices(head), SafetyConfig()).head
    safe.move(0.1, 0.1)
    safe.move(0.2, 0.2, wait=True)
    assert head.log == [(0.1, 0.1, None, False), (0.2, 0.2, None, True)]


def test_each_axis_has_the_cap_of_its_own_speed():
    head = Head()
    guarded(Devices(head), SafetyConfig(speed_deg_s=30.0)).head.move(0.0, 0.0, (0.1, 9.0))
    assert head.log[-1][2] == pytest.approx((0.1, math.radians(30.0)))


@pytest.mark.parametrize("camera", ["fixed", "zoom"])
@pytest.mark.parametrize(("t", "newer_than", "named"), [
    (4.51, None, None),  # just fresh enough at 5.0 s
    (4.51, 4.5, None),
    (4.49, None, "0.51 s"),
    (5.2, None, "0.20 s"),
    (9e9, 4.0, "future"),
    (-math.inf, None, "inf s"),
    (math.nan, None, "nan s"),
    (4.9, 4.9, "4.900 s"),
    (4.8, 4.9, "4.800 s"),
])  # fmt: skip
def test_frames_that_are_too_old_or_from_the_future_are_refused(camera, t, newer_than, named):
    rig = Devices()
    reader = SimpleNamespace(size=(2, 2), read=lambda *a: Frame(np.zeros((2, 2, 3), np.uint8), t))
    setattr(rig, camera, reader)
    safe = getattr(guarded(rig, SafetyConfig(max_frame_age_s=0.5)), camera)
    assert safe.size == (2, 2)
    if named is None:
        assert safe.read(newer_than).t == t
        return
    with pytest.raises(StaleFrameError) as caught:
        safe.read(newer_than)
    assert named in str(caught.value)
    assert f"{camera} camera" in str(caught.value)


def test_a_frame_that_waited_while_the_program_was_suspended_is_skipped():
    rig, asked = Devices(), []
    times = iter([3.0, 4.9])
    rig.fixed.read = lambda *a: asked.append(a) or Frame(np.zeros((2, 2, 3), np.uint8), next(times))
    assert guarded(rig, SafetyConfig()).fixed.read(2.9, 0.7).t == 4.9
    assert asked == [(2.9, 0.7), (3.0, 0.7)]


def test_a_still_may_be_old_when_it_arrives_but_not_older_than_its_request():
    rig, now = Devices(), [5.0]
    rig.clock.now = lambda: now[0]

    def capture():
        now[0] += 3.0
        return Frame(np.zeros((2, 2, 3), np.uint8), exposed)

    rig.zoom = SimpleNamespace(capture=capture)
    safe = guarded(rig, SafetyConfig(max_frame_age_s=0.5))
    exposed = 5.4
    assert safe.zoom.capture().t == 5.4
    exposed = 5.4  # 2.6 s before the second request
    with pytest.raises(StaleFrameError, match=r"2\.60 s"):
        safe.zoom.capture()


def test_the_cameras_are_otherwise_unchanged():
    rig, shown = Devices(), []
    rig.zoom = SimpleNamespace(
        size=(320, 240), still_size=(3264, 2448), focal_range=(300.0, 4000.0), state=lambda: "state",
        zoom=lambda f: shown.append(f) or 512.0,
    )  # fmt: skip
    guard = guarded(rig, SafetyConfig())
    safe = guard.zoom
    assert (safe.size, safe.still_size, safe.focal_range) == ((320, 240), (3264, 2448), (300.0, 4000.0))
    assert (safe.state(), safe.zoom(500.0), shown) == ("state", 512.0, [500.0])
    guard.fixed.read(3.0, 0.2)
    assert rig.asked == [(3.0, 0.2)]


@pytest.mark.parametrize("error", [None, ValueError, KeyboardInterrupt, SystemExit])
def test_the_head_halts_before_the_rig_closes_on_every_way_out(error):
    rig = Devices()

    def work():
        with guarded(rig, SafetyConfig()) as safe:
            safe.head.move(0.5, 0.1)
            if error is not None:
                raise error

    if error is None:
        work()
    else:
        with pytest.raises(error):
            work()
    assert rig.head.log[1:] == ["halt", "close"]


def broken(*_):
    raise OSError("the cable is out")


def test_a_head_that_cannot_halt_does_not_keep_the_rig_open():
    rig = Devices()
    rig.head.halt = broken
    with pytest.raises(OSError, match="cable"), guarded(rig, SafetyConfig()):
        pass
    assert rig.closed


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("failing", ["halt", "close"])
def test_a_failure_to_close_does_not_hide_the_first_error(error, failing, caplog):
    rig = Devices()
    setattr(rig.head if failing == "halt" else rig, failing, broken)
    with pytest.raises(error, match="why"), guarded(rig, SafetyConfig()):
        raise error("why")
    assert rig.closed or failing == "close"
    assert "cable" in caplog.text


def test_a_failed_halt_is_repeated_before_the_rig_closes():
    rig, tries = Devices(), iter([broken, lambda: rig.head.log.append("halt")])
    rig.head.halt = lambda: next(tries)()
    guarded(rig, SafetyConfig()).close()
    assert rig.head.log == ["halt", "close"]


def test_a_closed_rig_is_not_closed_again_and_does_not_move():
    rig = Devices()
    with guarded(rig, SafetyConfig()) as safe:
        safe.close()
    assert rig.head.log == ["halt", "close"]
    with pytest.raises(DeviceError, match="the rig is closed"):
        safe.head.move(0.1, 0.1)
    assert rig.head.log == ["halt", "close"]


def test_a_guarded_rigs_spec_has_the_soft_limits():
    spec = guarded(Devices(), SafetyConfig(pan_deg=(-90.0, 45.0), speed_deg_s=30.0)).spec
    assert spec.head.limits.pan.range == pytest.approx((math.radians(-90.0), math.radians(45.0)))
    assert spec.head.limits.tilt.range == LIMITS.tilt.range
    assert [axis.speed for axis in spec.head.limits.axes] == pytest.approx([math.radians(30.0)] * 2)


def test_a_guarded_rig_is_not_guarded_again_and_stays_open():
    devices = Devices()
    with guarded(devices, SafetyConfig()) as safe:
        with pytest.raises(ConfigError, match="guarded already"):
            guarded(replace(safe, zoom=object()), SafetyConfig())
        assert safe.head.move(0.0, 0.0) == (0.0, 0.0)
    assert devices.closed


def test_a_rig_with_another_device_is_stopped_and_closed_with_the_first():
    devices = Devices()
    safe = guarded(devices, SafetyConfig())
    with replace(safe, zoom=object()) as other:
        other.stop("smoke")
        assert (safe.stopped, other.stopped) == ("smoke", "smoke")
        assert (other.clear(), safe.stopped) == ("smoke", None)
    assert devices.head.log == ["halt", "halt", "close"]


def test_stopping_an_unguarded_rig_halts_its_head_and_says_that_it_may_move_again():
    devices = Devices()
    rig = rig_of(devices)
    with pytest.raises(DeviceError, match="the rig is not guarded"):
        rig.stop("smoke")
    assert devices.head.log == ["halt"]
    assert (rig.stopped, rig.clear()) == (None, None)


@pytest.mark.parametrize(("soft", "device"), [
    ({"pan_deg": (160.0, 170.0)}, "[-158.9, 158.9]"),
    ({"tilt_deg": (-90.0, -46.6)}, "[-46.6, 31.1]"),
    ({"pan_deg": (0.01, 0.04)}, "[-158.9, 158.9]"),  # between two steps of the head
])  # fmt: skip
def test_soft_limits_that_leave_nothing_are_refused(soft, device):
    with pytest.raises(ConfigError) as caught:
        guarded(Devices(), SafetyConfig(**soft))
    assert str(caught.value).startswith(f"safety.{next(iter(soft))}: ")
    assert device in str(caught.value)
