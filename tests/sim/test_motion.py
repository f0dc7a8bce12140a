"""Head and lens motion against numerical integration and hand-worked moves."""

import math
import tracemalloc

import numpy as np
import pytest

from cotarget.config import RigConfig, SimCamera, SimConfig, SimEffects, SimHead, SimZoomCamera
from cotarget.geometry import pose
from cotarget.sim import motion
from cotarget.sim.devices import SimClock, SimPanTilt, SimStream, SimZoomStream, head_drive, lens_drive, rig_spec
from cotarget.sim.motion import HISTORY_S, Axis, trapezoid
from cotarget.sim.world import SimWorld

ROUNDING = 1e-9
AGED = 1.05  # memory after six minutes over that after two; the history's length varies by a command or two


@pytest.mark.parametrize("seed", range(5))
def test_random_replans_keep_position_speed_and_limits(seed):
    """However often the goal changes: no jump, no overspeed, no more acceleration than allowed, at rest in the end."""
    rng = np.random.default_rng(seed)
    axis, speed, acceleration, dt = Axis(2.0, 5.0), 2.0, 5.0, 1e-3
    t, goal = 0.0, 0.0
    times, positions = [], []
    for _ in range(20):
        goal = rng.uniform(-2, 2)
        rest = axis.command(t, goal)
        until = t + rng.uniform(0.01, 1.0)
        times.extend(np.arange(t, until, dt))
        t = until
    times.extend(np.arange(t, rest + 0.1, dt))
    positions = np.array([axis.motor(s)[0] for s in times])
    speeds = np.array([axis.motor(s)[1] for s in times])
    gaps = np.diff(times)
    assert np.abs(np.diff(positions) / gaps).max() <= speed * (1 + 1e-6)
    assert np.abs(np.diff(speeds)).max() <= acceleration * gaps.max() + ROUNDING
    np.testing.assert_allclose(np.cumsum(speeds[:-1] * gaps) + positions[0], positions[1:], atol=0.02)
    assert positions[-1] == pytest.approx(goal)
    assert speeds[-1] == 0


def test_hand_worked_moves():
    # 1 rad at 1 rad/s and 2 rad/s^2: 0.5 s up, 0.5 s even, 0.5 s down.
    assert trapezoid(0, 0, 0, 1, 1, 2)[-1] == pytest.approx((1.5, 1, 0, 0))
    # 0.5 rad never reaches full speed: 2 sqrt(0.5 / 2) = 1 s.
    assert trapezoid(0, 0, 0, -0.5, 5, 2)[-1] == pytest.approx((1.0, -0.5, 0, 0))
    # Already there.
    assert trapezoid(3, 1, 0, 1, 1, 2)[-1] == pytest.approx((3, 1, 0, 0))
    # Running away from the goal: 0.5 s to stop 0.25 beyond, then back 0.25 in 2 sqrt(0.125) s.
    assert trapezoid(0, 0, 1, 0, 5, 2)[-1][0] == pytest.approx(0.5 + 2 * math.sqrt(0.125))
    # Faster than a new limit, either way: 1 s and 1.5 rad to slow down to it, 8 s even, 1 s and 0.5 rad to brake.
    for way in (1, -1):
        assert trapezoid(0, 0, 2 * way, 10 * way, 1, 1)[-1] == pytest.approx((10.0, 10 * way, 0, 0))


def test_backlash_is_a_hysteresis():
    axis = Axis(1.0, 10.0, backlash=0.1)
    axis.command(axis.command(0.0, 1.0), 0.98)
    assert axis.driven(100.0) == pytest.approx(0.95)  # went up to 1 - 0.05; the way back is within the play
    axis.command(100.0, 0.5)
    assert axis.driven(200.0) == pytest.approx(0.55)


def test_a_command_takes_effect_after_its_delay():
    clock, config = SimClock(), RigConfig(sim=SimConfig(head=SimHead(command_delay_s=0.04)))
    drive = head_drive(config.sim.head, config.sim.effects)
    unit = SimPanTilt(rig_spec(config).head, clock, drive)
    unit.move(0.5, 0.0)
    assert unit.state().moving
    clock.sleep_until(0.039)
    assert drive.angles_at(clock.now()) == (0, 0)
    clock.sleep_until(0.06)
    assert drive.angles_at(clock.now())[0] > 0


@pytest.mark.parametrize("delay_s", [0.0, 0.04])
def test_the_lens_starts_after_the_heads_command_delay(delay_s):
    config = RigConfig(sim=SimConfig(scene="indoor", targets=(), head=SimHead(command_delay_s=delay_s)))
    world = SimWorld(config, rendered=())
    with world.rig as rig:
        assert rig.spec.zoom.delay_s == rig.spec.head.delay_s == delay_s
        shortest = rig.zoom.focal_range[0]
        rig.zoom.zoom(3 * shortest)
        rig.clock.sleep_until(0.039)
        assert (rig.zoom.state().focal_px > shortest) == (delay_s == 0.0)
        rig.clock.sleep_until(0.1)
        assert rig.zoom.state().focal_px > shortest


def test_a_board_swings_about_its_pose_from_the_command_on():
    """By 0.15 m along its x axis, with a period of 1.7 s."""
    world = SimWorld(RigConfig(sim=SimConfig(scene="indoor", targets=())), rendered=())
    with world.rig as rig:
        rig.clock.sleep_until(1.3)
        rig.board.swing(pose([0.2, -0.1, 3.0], [0, 0, 0]))
        rig.clock.sleep_until(4.0)
        truth = world.truth()
        for part, aside in ((0.0, 0.0), (0.25, 0.15), (0.5, 0.0), (0.75, -0.15)):
            x_world = truth.set_bodies(1.3 + part * 1.7).body("rig/board").xpos
            assert truth.T_world_fixed.inv().apply(x_world) == pytest.approx([0.2 + aside, -0.1, 3.0])


def stream(**changes):
    clock = SimClock()
    image = np.zeros((4, 6, 3), dtype=np.uint8)
    return SimStream(SimCamera(**changes), SimEffects(), clock, lambda k, t: np.full_like(image, k)), clock


def test_frames_are_stamped_at_exposure_and_arrive_late():
    camera, clock = stream(rate_hz=25.0, latency_s=0.06)
    first = camera.read()
    assert (first.t, clock.now()) == (0.0, 0.06)
    second = camera.read(newer_than=first.t)
    assert (second.t, clock.now()) == pytest.approx((0.04, 0.10))
    clock.sleep_until(1.0)
    assert camera.read().t == pytest.approx(0.92)  # exposed at 0.92, here at 0.98; the next comes at 1.02
    assert camera.read(newer_than=0.92).t == pytest.approx(0.96)


def test_a_frame_cannot_arrive_before_its_exposure_ends():
    camera, clock = stream(latency_s=0.001, exposure_s=0.03)
    assert camera.read().t == 0.0
    assert clock.now() == 0.015


def test_the_same_frame_is_the_same_image():
    camera, _ = stream()
    assert camera.read() is camera.read()


def test_the_lens_steps_and_takes_its_time():
    clock = SimClock()
    camera, effects = SimZoomCamera(), SimEffects()
    drive = lens_drive(camera, effects)
    lens = SimZoomStream(camera, effects, clock, lambda k, t: np.zeros((2, 2, 3), np.uint8), drive, delay=0.0)
    shortest, longest = lens.focal_range
    assert (shortest, longest) == pytest.approx((6 / 0.009, 72 / 0.009))
    assert lens.zoom(1e9) == pytest.approx(longest)
    clock.sleep_until(0.5)
    assert lens.state().moving
    assert lens.state().focal_px == pytest.approx(math.sqrt(shortest * longest), rel=0.02)  # half way: 0.5 s of 1 s
    clock.sleep_until(1.1)
    assert not lens.state().moving
    step = (longest / shortest) ** (1 / 128)
    said = lens.zoom(3000.0)
    assert said == pytest.approx(3000.0, rel=step - 1)
    assert math.log(said / shortest, step) == pytest.approx(round(math.log(said / shortest, step)))


@pytest.mark.parametrize("limits", [(1.0, 10.0), (1.0, math.inf)])
def test_an_axis_that_forgets_stands_where_one_that_remembers_stands(limits, monkeypatch):
    """Bit by bit, where play hangs on all of the way that it came, and motions are replaced before they begin."""

    def positions():
        rng, axis, t = np.random.default_rng(1), Axis(*limits, backlash=0.05), 0.0
        for _ in range(200):
            t += rng.choice([0.01, 0.04, 2.0])
            axis.command(t + 0.04, rng.uniform(-0.2, 0.2))
            for age in (0.0, 0.02, 0.5):
                yield *axis.motor(t - age), axis.driven(t - age)
        assert t > 2 * HISTORY_S
        yield axis

    *found, axis = positions()
    with pytest.raises(ValueError, match="the motion at 1 s is forgotten"):
        axis.driven(1.0)
    monkeypatch.setattr(motion, "HISTORY_S", math.inf)
    *whole, axis = positions()
    assert found == whole
    axis.driven(1.0)


def test_the_memory_of_an_axis_does_not_grow_with_its_age():
    """Commands and readings at 25 Hz, for two minutes and for six."""
    axis, held = Axis(1.0, 10.0, backlash=0.01), []
    tracemalloc.start()
    try:
        for i in range(6 * 60 * 25):
            axis.command(i / 25 + 0.04, float(i % 2))
            axis.driven(i / 25)
            if i in (2 * 60 * 25, 6 * 60 * 25 - 1):
                held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert held[1] <= AGED * held[0]
