"""Predicted accuracy of a session, against the calibration's covariance and against views really taken."""

from dataclasses import replace

import numpy as np
import pytest

from cotarget.board import board_points
from cotarget.calibration import Calibration, Options, calibrate_views, predicted_pointing
from cotarget.calibration.bundle import ALL_BLOCKS, fit
from cotarget.calibration.initialization import place_boards
from cotarget.calibration.planning import ACCURACY_GRID, BORDER, DEPTHS_SQUARES, planned_views, predict_accuracy
from cotarget.calibration.uncertainty import covariance_of, model_of
from cotarget.config import BoardConfig
from experiments.calibration.synthetic.rig import SIZE, SIZES, Truth
from experiments.calibration.synthetic.views import Placing, spread_views, synthetic_views

BOARD = BoardConfig()
POINTS = board_points(BOARD)
NOISE_PX = 0.1
BOARDS = 8
ROUNDING = 1e-6  # relative: normal matrices of ten orders of magnitude, inverted in two ways


def drawn(seed, noise_px=NOISE_PX, boards=BOARDS):
    return spread_views(Truth(), POINTS, np.random.default_rng((seed, 3)), noise_px, Placing(boards=boards, looks=3))


@pytest.fixture(scope="module")
def views():
    return drawn(0)


@pytest.fixture(scope="module")
def start(views):
    return model_of(calibrate_views(views, BOARD, SIZES, options=Options(folds=0)))


@pytest.fixture(scope="module")
def found(views, start):
    return fitted(start, views)


@pytest.fixture(scope="module")
def predicted(found):
    return predict_accuracy(found, BOARD.square)


def fitted(start, views):
    return fit(place_boards(start, views, POINTS), views, POINTS, ALL_BLOCKS)


def test_predicted_accuracy_is_that_of_the_calibration(found, predicted):
    model = found.model
    calibration = Calibration(model.fixed, model.zoom_head, covariance=covariance_of(found))
    across, down = (np.linspace(BORDER, 1 - BORDER, count) for count in ACCURACY_GRID)
    pixels = np.array([(u, v) for u in across for v in down]) * (np.array(SIZE) - 1)
    errors = [predicted_pointing(calibration, pixels, depth * BOARD.square) for depth in DEPTHS_SQUARES]
    assert predicted.error() == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=ROUNDING)


# Corners of 16 placements determine their noise to 1 %, and where the fit ends up moves the prediction by a few more.
REAL_TOLERANCE = 0.1


def test_predicted_accuracy_of_planned_views_is_reached(start, found, predicted):
    """Really taken twice, with other noise; and one placement more, really taken."""
    exact, rng = drawn(0, noise_px=0.0), np.random.default_rng(1)
    more = [
        replace(v, corners_px=v.corners_px + rng.normal(0, NOISE_PX, v.corners_px.shape), board=v.board + BOARDS)
        for v in exact
    ]
    twice = predict_accuracy(fitted(start, [*found.views, *more]), BOARD.square)
    assert twice.error() == pytest.approx(predicted.error() / np.sqrt(2), rel=REAL_TOLERANCE)
    number = BOARDS - 1
    fewer = predict_accuracy(fitted(start, [v for v in found.views if v.board != number]), BOARD.square)
    turns = [(v.pan, v.tilt) for v in found.views if v.board == number and v.camera == "zoom"]
    planned = planned_views(number, turns, len(POINTS))
    promised = fewer.error(fewer.worth(planned, {number: found.model.boards[number]}, POINTS))
    assert promised == pytest.approx(predicted.error(), rel=REAL_TOLERANCE)


HOPELESS = np.radians(10.0)


def test_undetermined_rig_has_a_large_predicted_error(start, predicted):
    assert replace(predicted, normal=np.zeros_like(predicted.normal)).error() == np.inf
    only_pan = synthetic_views(Truth(), POINTS, np.random.default_rng(0), boards=BOARDS, tilt_range=0.0)
    assert predict_accuracy(fitted(start, only_pan), BOARD.square).error() > HOPELESS
    nothing_left = fitted(start, drawn(0, boards=3))
    assert predict_accuracy(replace(nothing_left, variance=None), BOARD.square) is None
