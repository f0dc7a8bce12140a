"""Disturbances: what the wall hides, what a nudge does to a picture, and that each case is as its name says."""

import math

import cv2
import numpy as np
import pytest

from cotarget.camera import Intrinsics
from cotarget.geometry import Rotation
from cotarget.rig import Frame
from cotarget.sim.world import SimWorld
from experiments.following.disturbed import CASES, NUDGED_S, DisturbedCamera

SECONDS = 9.0
SIZE, FOCAL = (640, 480), 668.0


class Dot:
    """Camera that shows a dot in the middle of its image."""

    size = SIZE

    def __init__(self, t):
        self.t, self.newer_than = t, None

    def read(self, newer_than=None, timeout=1.0):
        self.newer_than = newer_than
        image = np.zeros((*SIZE[::-1], 3), np.uint8)
        cv2.circle(image, (320, 240), 3, (255, 255, 255), -1)
        return Frame(image, self.t)


def test_a_nudge_moves_the_picture_from_its_time_on_and_stamps_are_late():
    lens = Intrinsics(SIZE, (FOCAL, FOCAL), (319.5, 239.5), (0.0,) * 5)
    turn = Rotation.from_rotvec([0.0, math.radians(1.0), 0.0])
    for t, by_px in ((NUDGED_S - 0.1, 0.0), (NUDGED_S, FOCAL * math.tan(math.radians(1.0)))):
        inner = Dot(t)
        frame = DisturbedCamera(inner, lens, turn, 0.06).read(newer_than=5.0)
        assert frame.t == pytest.approx(t + 0.06)
        assert inner.newer_than == pytest.approx(5.0 - 0.06)
        u = np.average(np.arange(SIZE[0]), weights=frame.image[..., 0].sum(axis=0).astype(float))
        assert abs(u - 320.0) == pytest.approx(by_px, abs=0.2)  # the dot's edge is rounded to whole grey levels


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.walled])
def test_a_wall_hides_who_passes_for_two_seconds_once(name, tmp_path):
    case = CASES[name]
    world = SimWorld(case.config(3, SECONDS, tmp_path), rendered=())
    truth, times = world.truth(), np.arange(2.6, SECONDS, 0.1)
    with world.rig as rig:
        rig.clock.sleep_until(SECONDS)
        hidden = np.array([truth.silhouette(case.target, "fixed", t).unhidden < 0.5 for t in times])
    assert 1.6 < 0.1 * np.count_nonzero(hidden) < 2.4
    assert np.count_nonzero(np.diff(hidden.astype(int)) == 1) == 1


def test_a_bird_comes_from_60_m_to_6_m(tmp_path):
    case = CASES["bird, 60 m to 6 m"]
    truth = SimWorld(case.config(3, SECONDS, tmp_path), rendered=()).truth()
    depths = [float(truth.T_world_fixed.inv().apply(truth.center("bird", t))[2]) for t in (0.0, SECONDS)]
    assert depths == pytest.approx([60.0, 6.0], abs=3.0)


def test_cases_at_10_hz_have_two_cameras_of_10_hz(tmp_path):
    sim = CASES["bird, 10 Hz"].config(3, SECONDS, tmp_path).sim
    assert (sim.fixed.rate_hz, sim.zoom.rate_hz) == (10.0, 10.0)
