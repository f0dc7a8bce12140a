"""Foliage, clouds, shadows and light: as much as asked for, where asked for, and a function of seed and time alone."""

import itertools

import cv2
import numpy as np
import pytest

from cotarget.config import parse_config
from cotarget.sim.world import SimWorld

pytestmark = pytest.mark.render
# Plain frame differencing: levels by which a pixel changed, and pixels that make a blob.
THRESHOLD, SMALLEST_PX = 25, 4
ASKED_A_MINUTE = 10
FRAMES = 12  # of which the rate is told
RATE_HZ = 25.0
ALIKE = 0.9  # correlation of the ways of one treetop; in the same wind it is 1


def world(scene="outdoor", **sim):
    return SimWorld(parse_config({"sim": {"scene": scene, **sim}}))


def false_blobs_a_minute(w, start):
    """What plain frame differencing finds in a scene without a target."""
    images = [w.expose("fixed", k, start + k / RATE_HZ) for k in range(FRAMES + 1)]
    count = 0
    for a, b in itertools.pairwise(images):
        changed = (cv2.absdiff(a, b).max(axis=2) > THRESHOLD).astype(np.uint8)
        _, _, stats, _ = cv2.connectedComponentsWithStats(changed, connectivity=8)
        count += int((stats[1:, cv2.CC_STAT_AREA] >= SMALLEST_PX).sum())
    return count * 60 * RATE_HZ / FRAMES


@pytest.mark.parametrize("seed", [0, pytest.param(100, marks=pytest.mark.slow)])
def test_plain_frame_differencing_finds_false_blobs(seed):
    with (w := world(seed=seed, effects={"clutter": True})).rig:
        rate = false_blobs_a_minute(w, 3.0)
    print(f"seed {seed}: {rate:.0f} false blobs a minute")
    assert rate >= ASKED_A_MINUTE


@pytest.mark.parametrize(("scene", "clutter"), [("outdoor", False), ("indoor", True)])
def test_without_clutter_and_indoors_nothing_moves(scene, clutter):
    with (w := world(scene, effects={"clutter": clutter})).rig:
        assert false_blobs_a_minute(w, 3.0) == 0


def test_sky_treetops_meadow_and_light_all_change():
    """Sky, treetops and meadow each look different two seconds later, and the whole picture's light changes."""
    with (w := world(effects={"all": False, "clutter": True})).rig:
        lens = w.truth().fixed_lens
        a, b = (w.render("fixed", lens, t).astype(float) for t in (0.0, 2.0))
        for rows in (slice(0, 190), slice(230, 330), slice(380, 480)):
            assert (np.abs(a[rows] - b[rows]).max(axis=2) > 8).sum() > 50
        walls = [w.render("fixed", lens, t)[300:360].mean() for t in np.arange(0.0, 13.0, 1.0)]
        assert np.ptp(walls) > 5


def test_frames_are_a_function_of_seed_and_time_alone():
    effects = {"clutter": True}
    with (w := world(seed=3, effects=effects)).rig, (other := world(seed=3, effects=effects)).rig:
        w.expose("fixed", 1, 1.0)
        w.expose("zoom", 7, 0.3)
        image = w.expose("fixed", 5, 4.0)
        np.testing.assert_array_equal(image, other.expose("fixed", 5, 4.0))
    with (third := world(seed=4, effects=effects)).rig:
        assert (third.expose("fixed", 5, 4.0) != image).mean() > 0.1


def test_another_seed_gives_another_wind():
    """Noise and the trees are others too: only when the treetops go to and fro tells of the wind."""
    ways = []
    for seed in (3, 4):
        with (w := world(seed=seed, effects={"clutter": True})).rig:
            truth = w.truth()
            crowns = [g for g in range(truth.model.ngeom) if truth.model.geom(g).name.startswith("clutter/crown_")]
            ways.append(np.array([truth.set_state(t).geom_xpos[crowns, 0] for t in np.arange(0.0, 20.0, 0.25)]).T)
    alike = [np.corrcoef(one, other)[0, 1] for one, other in zip(*ways, strict=True)]
    assert max(alike) < ALIKE


def test_foliage_stands_where_it_is_though_only_the_target_was_asked_for_before():
    config = parse_config({"sim": {"scene": "outdoor", "targets": ["bird"], "effects": {"clutter": True}}})
    asked, plain = (SimWorld(config, rendered=()).truth() for _ in range(2))
    places = []
    for t in (1.0, 4.0):
        assert np.isfinite(asked.pixel("fixed", asked.center("bird", t), t)).all()  # needs no foliage
        places.append(asked.set_state(t).geom_xpos.copy())
        np.testing.assert_array_equal(places[-1], plain.set_state(t).geom_xpos)
    crowns = [g for g in range(asked.model.ngeom) if asked.model.geom(g).name.startswith("clutter/crown_")]
    assert np.abs(places[1] - places[0])[crowns].max() > 1e-3


def test_crowns_of_a_users_scene_sway(tmp_path):
    scene = tmp_path / "own.xml"
    scene.write_text(
        """<mujoco><statistic extent="40" center="0 25 1"/><visual><map znear="0.00125" zfar="6"/></visual>
        <worldbody><light pos="0 0 5"/>
        <geom name="crown_1" type="sphere" size="1" pos="0 12 2" rgba=".2 .5 .2 1" contype="0" conaffinity="0"/>
        <geom name="rock" type="sphere" size="1" pos="4 12 1" rgba=".5 .5 .5 1" contype="0" conaffinity="0"/>
        <site name="fixed_mount" pos="0 0 1.5" euler="90 0 0"/></worldbody></mujoco>"""
    )
    with (w := world(str(scene), effects={"all": False, "clutter": True})).rig:
        model, state = w.truth().model, w.truth().set_state
        crown, rock = (
            np.array([state(t).geom(name).xpos.copy() for t in (0.0, 1.0, 2.0)]) for name in ("crown_1", "rock")
        )
        assert np.ptp(crown[:, 0]) > 0.002
        assert np.ptp(rock, axis=0).max() == 0
        assert any(model.geom(g).name.startswith("clutter/cloud") for g in range(model.ngeom))
