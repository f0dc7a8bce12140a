"""Several targets of a kind: names, paths, sizes and markers of their own."""

import cv2
import numpy as np
import pytest

from cotarget.config import DEFAULT_TARGETS, RigConfig, SimConfig
from cotarget.errors import ConfigError
from cotarget.sim.targets import KINDS
from cotarget.sim.targets.target import kind_of, marker_of
from cotarget.sim.world import SimWorld

NEAR = 2.4  # where a marker decodes in the wide view [m]


def world(paths, **sim):
    targets = dict(DEFAULT_TARGETS) | {name: DEFAULT_TARGETS[kind_of(name).name] for name in paths}
    sim = SimConfig(scene="indoor", targets=tuple(paths), paths={n: p for n, p in paths.items() if p}, **sim)
    return SimWorld(RigConfig(sim=sim, targets=targets))


def test_names_have_a_kind_and_a_marker():
    assert [kind_of(name).name for name in ("bird", "bird2", "person13", "book5")] == ["bird", "bird", "person", "book"]
    assert [marker_of(name) for name in KINDS] == [1, 2, 3]  # as drawn in sim_assets
    names = [f"{kind}{i}" for kind in ("person", "bird") for i in ("", 2, 3, 4, 5)]
    assert len({marker_of(name) for name in names}) == len(names)
    assert max(map(marker_of, names)) < 50  # of DICT_4X4_50
    assert marker_of("book3") == marker_of("book")


@pytest.mark.parametrize("name", ["dragon", "bird1", "bird0", "bird02", "birds", "2bird", "bird 2"])
def test_other_names_are_refused(name):
    with pytest.raises(ConfigError, match="unknown target"):
        kind_of(name)


def test_each_goes_its_own_way():
    """By default at another speed on another path; the first of a kind as if it were alone."""
    w, alone = world({"bird": (), "bird2": (), "person": ()}), world({"bird": ()})
    truth = w.truth()
    assert np.linalg.norm(truth.center("bird", 6.0) - truth.center("bird2", 6.0)) > 0.1
    np.testing.assert_array_equal(truth.center("bird", 6.0), alone.truth().center("bird", 6.0))
    assert truth.targets["bird"].size == alone.truth().targets["bird"].size != truth.targets["bird2"].size
    boxes = [truth.box(name, "fixed", 6.0) for name in truth.targets]
    assert not np.allclose(boxes[0], boxes[1], atol=1.0)
    for camera in (w, alone):
        camera.rig.close()


@pytest.mark.render
def test_each_shows_its_own_marker():
    """Two persons who face the camera, and two birds that pass it, all near."""
    stand = {name: ((0.0, x, NEAR, 1.25), (9.0, x, NEAR, 1.25)) for name, x in (("person", -0.5), ("person4", 0.5))}
    fly = {name: ((0.0, x - 3, NEAR, 1.7), (6.0, x + 3, NEAR, 1.7)) for name, x in (("bird2", -0.45), ("bird5", 0.45))}
    finder = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    for paths in (stand, fly):
        with (w := world(paths)).rig:
            seen = {}
            for t in (2.9, 3.0, 3.1):  # a wing may hide a marker for some of its beat
                image = w.render("fixed", w.truth().fixed_lens, t)
                corners, found, _ = finder.detectMarkers(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
                for i, c in zip([] if found is None else found.ravel(), corners, strict=True):
                    seen[int(i)] = c.reshape(4, 2).mean(axis=0), t
            for name in paths:
                middle, t = seen[marker_of(name)]
                low, high = w.truth().box(name, "fixed", t)
                assert (middle > low).all()
                assert (middle < high).all()
