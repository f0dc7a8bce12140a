"""The comparison of simulation and film: its strata, fitted boxes, made flyers, scores and summary."""

import numpy as np
import pytest

from cotarget.track_metrics import Label
from experiments.following import sim_to_real
from experiments.following.sim_to_real import appearance, fitted, stratum

SHAPE = (120, 160)
NOISE = 2.0
# A fitted box covers whole pixels, and what is fainter than a fifth of the peak is none of it.
FITTED_PX = 1.0
STRATUM = "up to 12 px, clear, slow, sky"


def sky(level=150.0):
    return np.random.default_rng(0).normal(level, NOISE, SHAPE)


def grey(scene):
    return np.rint(scene).clip(0, 255).astype(np.uint8)


def label(u, v, width, height, target=1):
    return Label(np.array([u, v]), np.array([width, height], dtype=float), target)


@pytest.mark.parametrize(("side", "contrast", "texture", "speed", "expected"), [
    (12.0, 4.9, 8.0, 23.9, "up to 12 px, faint, slow, sky"), (12.1, 5.0, 8.1, 24.2, "12-24 px, clear, fast, trees"),
    (60.0, 9.0, 3.0, 0.0, "24-60 px, clear, slow, sky"), (61.0, 0.0, 30.0, 500.0, "over 60 px, faint, fast, trees"),
])  # fmt: skip
def test_a_box_belongs_to_the_stratum_of_its_figures(side, contrast, texture, speed, expected):
    assert stratum(side, contrast, texture, speed) == expected
    assert expected in sim_to_real.STRATA


def test_contrast_is_the_difference_to_the_ring_over_its_standard_deviation():
    scene = sky()
    scene[50:60, 70:80] -= 30
    contrast, texture = appearance(grey(scene), label(74.5, 54.5, 10, 10))
    assert texture == pytest.approx(NOISE, rel=0.1)
    assert contrast == pytest.approx(30 / NOISE, rel=0.1)


def test_a_label_that_is_too_large_is_fitted_to_the_blob_in_it():
    scene = sky()
    scene[40:46, 100:112] += 40  # 12 x 6 px around (105.5, 42.5)
    scene[80:84, 100:104] += 40  # outside of the label
    box = fitted(grey(scene), label(101.0, 40.0, 50, 30, 5))
    assert box.target == 5
    assert box.center_px == pytest.approx([105.5, 42.5], abs=FITTED_PX)
    assert box.size_px == pytest.approx([12, 6], abs=FITTED_PX)


def rows(kind, boxes, found, error_px, stratum=STRATUM):
    """Rows of one film; all detectors find the same."""
    same = {"kind": kind, "stratum": stratum, "boxes": boxes, "found": found, "error_px": error_px}
    return [{"detector": way, **same} for way in sim_to_real.WAYS]


def test_boxes_are_summed_over_films_and_errors_weighted_by_them():
    given = [*rows("fitted", 100, 90, 0.5), *rows("fitted", 200, 30, 2.0), *rows("fitted", 100, 0, None)]
    given += rows("real", 7, 0, None, "over 60 px, clear, slow, sky")
    found = sim_to_real.summarise(given)
    assert list(found) == [STRATUM, "over 60 px, clear, slow, sky"]
    assert found[STRATUM]["fitted"]["frames"] == 400
    assert found[STRATUM]["fitted"]["recall KNN"] == 120 / 400
    assert found[STRATUM]["fitted"]["error_px auto"] == 0.5
    assert np.isnan(found["over 60 px, clear, slow, sky"]["real"]["error_px auto"])


def test_strata_with_enough_frames_must_agree():
    film = rows("fitted", 200, 180, 0.5)
    assert not sim_to_real.missed(sim_to_real.summarise(film))
    assert not sim_to_real.missed(sim_to_real.summarise([*film, *rows("simulation", 199, 0, None)]))
    assert not sim_to_real.missed(sim_to_real.summarise([*film, *rows("simulation", 1000, 880, 0.7)]))
    far = sim_to_real.missed(sim_to_real.summarise([*film, *rows("simulation", 1000, 850, 0.9)]))
    assert [text.split(": ")[1].split(" 0")[0] for text in far] == [
        "recall auto", "error_px auto", "error_px MOG2", "error_px KNN",
    ]  # fmt: skip
