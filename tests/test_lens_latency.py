"""How late a lens obeys: of pictures whose scale is known, and of the simulation, whose delay its config says."""

import cv2
import numpy as np
import pytest

from cotarget.config import parse_config
from cotarget.errors import CalibrationError
from cotarget.latency import began, measure_lens, scales
from cotarget.sim.world import SimWorld
from tests.test_latency import LateCamera, Wrapped

SMALL = {"size": [320, 240], "rate_hz": 15.0}  # a quarter of the rendering
CLOSE = 0.01  # [s], with 15 frames a second


def scene():
    noise = np.random.default_rng(0).uniform(0, 255, (240, 320, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3)


def test_a_picture_that_grows_tells_its_scale():
    wanted = np.array([0.0, 0.0, 0.06, 0.12, 0.12, 0.02])
    pictures = [cv2.warpAffine(scene(), cv2.getRotationMatrix2D((160, 120), 0, np.exp(s)), (320, 240)) for s in wanted]
    np.testing.assert_allclose(scales(pictures), wanted, atol=0.003)


def test_a_picture_without_structure_tells_nothing():
    assert np.isnan(scales([np.full((60, 80, 3), 128, np.uint8)] * 3)[1:]).all()


@pytest.mark.parametrize("began_at", [0.5, 0.52, 0.569])
def test_an_even_way_began_where_it_leads_back_to(began_at):
    times = np.arange(0.0, 1.5, 0.07)
    assert began(times, np.clip((times - began_at) / 0.4, 0.0, 1.0)) == pytest.approx(began_at, abs=1e-6)


def test_a_way_between_two_frames_began_between_them():
    assert began(np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.0, 0.0, 1.0, 1.0])) == pytest.approx(0.15)


@pytest.mark.render
@pytest.mark.parametrize("late", [pytest.param(0.0, marks=pytest.mark.slow), 0.045])
def test_the_simulated_lens(late):
    config = parse_config({"sim": {"zoom": SMALL, "head": {"command_delay_s": 0.12}}})
    with SimWorld(config).rig as rig:
        found = measure_lens(Wrapped(rig, zoom=LateCamera(rig.zoom, late)), late)
        assert found.command == pytest.approx(0.12, abs=CLOSE)
        assert found.spread < CLOSE
        assert rig.zoom.state().focal_px == pytest.approx(rig.zoom.focal_range[0])


@pytest.mark.render
def test_a_picture_that_does_not_grow_is_no_measurement():
    config = parse_config({"sim": {"zoom": SMALL}})
    with SimWorld(config).rig as rig:
        frame = rig.zoom.read()

        class Frozen(LateCamera):
            def read(self, newer_than=None, timeout=1.0):
                return type(frame)(frame.image, super().read(newer_than, timeout).t)

        with pytest.raises(
            CalibrationError, match=r"picture grows 1\.00 times where the lens tells of [12]\.\d\d times"
        ):
            measure_lens(Wrapped(rig, zoom=Frozen(rig.zoom, 0.0)))


def test_a_lens_that_hardly_zooms_is_told():
    config = parse_config({"sim": {"zoom": {"focal_mm": [6.0, 6.3]}, "effects": {"optics": False}}})
    with SimWorld(config, rendered=()).rig as rig, pytest.raises(CalibrationError, match=r"zooms by 1\.05 times"):
        measure_lens(rig)
