"""The experiment that compares detectors: its shake, how it judges, and its figures."""

import numpy as np
import pytest

from cotarget.detection import Detections
from cotarget.rig import Detection, Frame
from cotarget.sim.truth import Silhouette
from experiments.following.detectors import SHAKES, STANDS, Watch
from experiments.following.field import five_targets_config

FRAMES, RATE = 100, 25.0
SIDE = np.array([20.0, 20.0])


class Seer:
    """Finds what it is given."""

    def __init__(self, found):
        self.found = found

    def detect(self, frame, held=()):
        return Detections([Detection(center, SIDE, 0.9, False) for center in self.found(frame.t)])


def watch(found, shift=(0.0, 0.0), camera=STANDS):
    """Two targets that go to the right, one above the other, from a second after the start until four seconds."""
    config = five_targets_config(0, "bird")
    watching = Watch("bird", "motion", camera, config.target("bird"), config, Seer(found))
    for i in range(FRAMES):
        t = i / RATE
        outlines = {
            name: Silhouette(at(name, t) - SIDE / 2, at(name, t) + SIDE / 2, 1.0, SIDE, 1.0) for name in ("a", "b")
        }
        watching.see(Frame(np.zeros((480, 640, 3), np.uint8), t), np.array(shift), outlines)
    return watching.row(7)


def at(name, t):
    return np.array([100 + 60 * t, 100.0 if name == "a" else 300.0])


def test_tracks_are_judged_by_the_truth():
    both = watch(lambda t: [at("a", t), at("b", t)])
    assert both["found"] == 1.0
    assert both["false_per_min"] == both["switches_per_min"] == 0
    assert (both["scene"], both["detector"], both["camera"], both["seed"]) == ("five birds", "motion", STANDS, 7)
    assert watch(lambda t: [at("a", t)])["found"] == 0.5
    off = watch(lambda t: [at("a", t), at("b", t) + np.array([0.0, 90.0])])
    assert off["found"] == 0.5
    assert off["false_per_min"] == pytest.approx(60 / 1.96, rel=0.01)  # one, from 2 s to 3.96 s


def test_a_shaken_camera_is_judged_as_if_it_stood():
    shift = np.array([40.0, 0.0])
    assert watch(lambda t: [at("a", t) + shift, at("b", t) + shift], shift, SHAKES)["found"] == 1.0
    assert watch(lambda t: [at("a", t) + shift, at("b", t) + shift], camera=SHAKES)["found"] == 0.0
