"""Folds of the score: the fit takes targets and others as equally likely, and figures are over all films."""

import numpy as np
import pytest

from cotarget.rig import Frame
from cotarget.track_metrics import Box, Label
from experiments.following.films import LabelledFilm
from experiments.following.score_folds import ALL, OTHERS, examined, fit, folds, missed, summarise

RATE = 25.0


def test_targets_and_others_are_equally_likely_in_every_film():
    """Normal clouds around +1 and -1 with variance 1: by hand, the balanced log odds are 2 (x + y + z)."""
    rng = np.random.default_rng(1)

    def film(targets, others):
        cloud = rng.normal(0, 1, (targets + others, 3))
        on = np.arange(targets + others) < targets
        return cloud + np.where(on, 1.0, -1.0)[:, None], on

    weights = fit([film(1000, 20000), film(20000, 2000), (np.ones((5, 3)), np.ones(5, bool))])
    assert weights == pytest.approx((2, 2, 2, 0), abs=0.25)


def test_films_of_one_place_are_in_one_fold():
    names = ["V_BIRD_006", "V_BIRD_007", "V_BIRD_002", "V_DRONE_008", "V_BIRD_021", "V_BIRD_022", "one", "two"]
    found = folds(names)
    assert sorted(i for fold in found for i in fold) == list(range(8))
    assert sorted(len(fold) for fold in found) == [1, 1, 2, 2, 2]
    for one, other in ((0, 1), (2, 3), (4, 5)):
        assert any(one in fold and other in fold for fold in found)


def test_regions_on_labels_are_targets_and_those_on_other_flyers_are_left_out():
    rng = np.random.default_rng(2)
    frames, labels, flyers = [], {}, {}
    for i in range(50):
        picture = 170 + rng.normal(0, 2, (120, 160))
        for at, v in ((20 + 2 * i, 30), (120 - 2 * i, 60), (20 + 2 * i, 90)):
            picture[v : v + 6, at : at + 8] = 60
        frames.append(Frame(np.repeat(picture.astype(np.uint8)[..., None], 3, axis=2), i / RATE))
        labels[i] = [Label(np.array([23.5 + 2 * i, 32.5]), np.array([8.0, 6.0]))]
        flyers[i] = [Box(np.array([123.5 - 2 * i, 62.5]), np.array([8.0, 6.0]))]
    evidence, on = examined(LabelledFilm("made", frames, RATE, labels, flyers))
    assert evidence.shape == (len(on), 3)
    assert on.sum() == pytest.approx(20, abs=2)  # one in each frame from 30 on
    assert (~on).sum() == pytest.approx(20, abs=2)


def test_recall_on_films_that_were_not_fitted_is_near_that_on_fitted_ones():
    """By hand: 90 + 50 of 200 boxes are 0.7."""
    weights = {"signal": 2.0, "change": 3.0, "texture": -1.0, "constant": -3.0}
    row = {"boxes": 100, "false_tracks": 1, "no_flyer": 0, "minutes": 0.5} | weights
    rows = [{**row, "way": way, "found": found} for way in (ALL, OTHERS) for found in (90, 50)]
    rows[-1] |= {"signal": 2.5}
    summary = summarise(rows)
    assert summary[OTHERS]["recall"] == 0.7
    assert summary[OTHERS]["false tracks a minute"] == 2.0
    assert (summary[OTHERS]["least signal"], summary[OTHERS]["largest signal"]) == (2.0, 2.5)
    assert missed(summary) == []
    rows[-1] |= {"found": 40}
    assert missed(summarise(rows)) == [f"recall 0.650 {OTHERS}, 0.700 {ALL}"]
