"""A dome is characterized by its picture: a textured sphere in simulated time, and facts that are drawn by seed."""

import math

import numpy as np
import pytest

from cotarget.characterization import (
    characterize,
    fit_pictures,
    growth_of,
    orientation_of,
    room_of,
    start_of_turns,
    time_turns,
)
from tests.support.rigs import rig_of
from tests.support.textured_dome import LATENCY_S, LONGEST, SIZE, WIDE_PX, TexturedDome

SAME_SCALE = 0.01
SAME_FOCAL = 0.02
SAME_DELAY_S, SAME_STOP_S = 0.02, 0.03
SAME_GROWTH = 0.02
SAME_SPEED = 0.05
BRAKING_S = 6.0 / 800 / 2  # half of the time to the speed of slow turns


def grey(dome, pan_deg, tilt_deg, focal=WIDE_PX):
    return dome.picture(math.radians(pan_deg), math.radians(tilt_deg), focal)[:, :, 0]


def characterized(dome):
    rig = rig_of(dome)
    return characterize(rig, room_of(rig), lambda line: None)


def drawn(seed):
    """A dome that lies in many ways."""
    random = np.random.default_rng(seed)
    return TexturedDome(
        seed,
        scale=tuple(random.choice([-1, 1], 2) * random.uniform(0.8, 1.25, 2)),
        upside_down=bool(random.integers(2)),
        mirrored=bool(random.integers(2)),
        delay_s=random.uniform(0.03, 0.3),
        late_s=float(random.choice([0.0, 0.5])),
        stop_s=random.uniform(0.0, 1.1),
        round_deg=float(random.choice([0.0, 0.4])),
        curve=random.uniform(-0.4, 0.4),
        turns_at_zoom=bool(random.integers(2)),
        cap_deg_s=random.uniform(2.0, 20.0),
        steps=seed % 2 == 0,
    )


# The whole of it is 40 s of pictures; one seed runs always.
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 9))])
def test_what_a_dome_does_is_measured_in_its_picture(seed):
    dome = drawn(seed)
    found = characterized(dome)
    assert found.moves
    words = (["upside down"] if dome.upside_down else []) + (["mirrored"] if dome.mirrored else [])
    assert found.orientation == (" and ".join(words) or "upright")
    assert found.scale == pytest.approx(dome.scale, rel=SAME_SCALE)
    assert found.focal_px == pytest.approx(WIDE_PX, rel=SAME_FOCAL)
    assert found.light_s == pytest.approx(dome.delay_s + LATENCY_S + BRAKING_S, abs=SAME_DELAY_S)
    assert found.report_s == pytest.approx(LATENCY_S - dome.late_s, abs=SAME_DELAY_S)
    assert found.stop_s == pytest.approx(dome.stop_s, abs=SAME_STOP_S)
    assert found.turns_at_zoom == dome.turns_at_zoom
    assert found.is_whole
    for nominal, times in found.growths:
        share = math.log(nominal / WIDE_PX) / math.log(LONGEST)
        assert times == pytest.approx(LONGEST ** (share + dome.curve * share * (1 - share)), rel=SAME_GROWTH)
    for times, speed in found.speeds:
        if times > LONGEST**0.65:
            assert math.degrees(speed) == pytest.approx(dome.cap_deg_s, rel=SAME_SPEED)
        elif times < LONGEST**0.35:
            assert math.degrees(speed) > 20.0
    assert len(found.speeds) == 6
    assert found.missed_deg <= dome.round_deg / 2 + 1e-9
    lens = dome.zoom.state()
    assert (lens.focal_px, lens.moving) == (WIDE_PX, False)


@pytest.mark.slow
def test_a_dome_that_swings_about_its_goal_is_halted_and_measured():
    """By 0.07 degrees, as one that is steered and of which nobody knows that it stops late by 1.1 s."""
    dome = TexturedDome(swing_deg=0.07, scale=(-1.1, 0.9), delay_s=0.1, stop_s=1.1)
    begin = dome.t
    found = characterized(dome)
    assert found.scale == pytest.approx(dome.scale, rel=SAME_SCALE)
    assert found.light_s == pytest.approx(dome.delay_s + LATENCY_S + BRAKING_S, abs=SAME_DELAY_S)
    assert found.stop_s == pytest.approx(dome.stop_s, abs=2 * SAME_STOP_S)
    assert dome.t < begin + 600.0


def test_times_of_a_dome_that_slows_down_long_before_its_goal():
    """As one that is steered by velocities and stops late; its goals in slow turns are 18 degrees away.

    It looks at tiles, and the second turn is refused.
    """
    dome = TexturedDome(steered=True, scale=(-1.2, 1.1), delay_s=0.1, stop_s=1.1, known_s=1.1, tiles=True)
    rig, move, slow = rig_of(dome), dome.head.move, []

    def refuse_second(pan, tilt, speed=None, wait=False):
        if isinstance(speed, tuple):
            slow.append(speed)
        return (pan, tilt) if speed in slow and len(slow) == 2 else move(pan, tilt, speed, wait)

    dome.head.move = refuse_second
    light_s, report_s, stop_s = time_turns(rig, room_of(rig), WIDE_PX, 1.2)
    assert light_s == pytest.approx(dome.delay_s + LATENCY_S + BRAKING_S, abs=SAME_DELAY_S)
    assert report_s == pytest.approx(LATENCY_S, abs=SAME_DELAY_S)
    assert stop_s == pytest.approx(dome.stop_s, abs=SAME_STOP_S)


@pytest.mark.slow
def test_a_steered_dome_of_which_nothing_is_known_is_measured():
    """It stops late by 1.1 s, and its positions are half a second late."""
    dome = TexturedDome(steered=True, scale=(-1.2, 1.1), delay_s=0.1, stop_s=1.1, late_s=0.5)
    begin = dome.t
    found = characterized(dome)
    assert found.scale == pytest.approx(dome.scale, rel=SAME_SCALE)
    assert found.light_s == pytest.approx(dome.delay_s + LATENCY_S + BRAKING_S, abs=SAME_DELAY_S)
    assert found.report_s == pytest.approx(LATENCY_S - dome.late_s, abs=SAME_DELAY_S)
    assert found.stop_s == pytest.approx(dome.stop_s, abs=SAME_STOP_S)
    assert dome.t < begin + 400.0


def test_a_dome_that_does_not_move_is_found_out():
    assert not characterized(TexturedDome(obeys=False)).moves


def test_the_focal_length_is_seen():
    dome = TexturedDome()
    places = [(0, 0), (9, 4), (-12, 6), (14, -7), (-8, -9), (3, 10)]
    focal_px, turns, used = fit_pictures([grey(dome, *place) for place in places], 1.2 * WIDE_PX, SIZE)
    assert used == [1, 2, 3, 4, 5]
    assert focal_px == pytest.approx(WIDE_PX, rel=SAME_FOCAL)
    angles = np.degrees([turn.magnitude() for turn in turns])
    assert angles == pytest.approx([math.hypot(*place) for place in places[1:]], rel=0.02)


def test_growth_and_orientation():
    dome = TexturedDome()
    before, after = grey(dome, 0, 0), grey(dome, 1.0, 0, 1.4 * WIDE_PX)
    times, moved_px = growth_of(before, after)
    assert times == pytest.approx(1.4, rel=SAME_GROWTH)
    assert moved_px == pytest.approx(1.4 * WIDE_PX * math.tan(math.radians(1.0)), abs=1.0)
    fixed = dome.picture(0.1, 0.0, WIDE_PX)
    turned = {"upright": before, "upside down": before[::-1, ::-1], "mirrored": before[:, ::-1]}
    for said, image in turned.items():
        assert orientation_of([np.ascontiguousarray(image)], fixed) == said
    assert orientation_of([np.full(SIZE[::-1], 90, np.uint8)], fixed) == ""


@pytest.mark.parametrize("takes", [0.02, 0.7])
def test_the_start_of_turns_lies_between_frames(takes):
    """Frames every 0.1 s of turns that begin 0.23 s after their commands, at once or slowly."""
    turns = []
    for phase in (0.0, 0.03, 0.06, 0.01, 0.05, 0.08):
        times = np.arange(-phase, 2.0, 0.1)
        turns.append((times, np.clip((times - 0.23) / takes, 0.0, 1.0)))
    start, rate = start_of_turns(turns)
    assert start == pytest.approx(0.23, abs=0.015)
    if takes > 0.1:
        assert rate == pytest.approx(1 / takes, rel=0.02)
