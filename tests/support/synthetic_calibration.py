"""Views, fits and calibrations of synthetic rigs with the default board."""

import numpy as np

from cotarget.board import board_points
from cotarget.calibration import Options, View, calibrate_views, predicted_pointing
from cotarget.calibration.bundle import ALL_BLOCKS, fit
from cotarget.calibration.initialization import place_boards
from cotarget.config import BoardConfig
from experiments.calibration.synthetic.aims import aimed, draw_targets, misses
from experiments.calibration.synthetic.rig import SIZES
from experiments.calibration.synthetic.views import Placing, noisy, placed, spread_views, zoom_view

BOARD = BoardConfig()
POINTS = board_points(BOARD)
NOISE_PX = 0.1
FEWEST_CORNERS = 12  # least corners of a board in partial view, at a longer focal length
TARGETS = 40
# One calibration's pointing error is one draw of the few directions of the parameters that matter.
POINTING_FACTOR = 3.0


def drawn(truth, seed=0, boards=10, looks=3, noise_px=NOISE_PX):
    """Views of placements all over both images."""
    placing = Placing(boards=boards, looks=looks)
    return spread_views(truth, POINTS, np.random.default_rng((seed, 3)), noise_px, placing)


def views_at_stops(truth, placements, rng, noise_px=NOISE_PX, looks=2):
    """Views at the further zoom samples of boards (N, 3) in the fixed camera's frame, perhaps in part."""
    views, before = [], np.zeros(2)
    for stop in truth.stops:
        for number, x_fixed in enumerate(placements):
            for _ in range(looks):
                reported = aimed(truth, x_fixed[rng.integers(len(x_fixed))][None], np.array([0.0, 0.0, 1.0]))[0]
                view = zoom_view(truth, x_fixed, number, reported, before, noise_px, rng, stop)
                if np.isfinite(reported).all() and view.seen.sum() >= FEWEST_CORNERS:
                    views.append(view)
                    before = reported
    return views


def drawn_at_stops(truth, rng, placing, **looks):
    """Views of placements at the shortest focal length and at the further zoom samples, of the same boards."""
    views, corners, home = [], [], np.zeros(2)
    for number in range(placing.boards):
        x_fixed, poses = placed(truth, POINTS, rng, placing, number)
        corners.append(x_fixed)
        views.append(View("fixed", noisy(truth.fixed.project(x_fixed), NOISE_PX, rng), number))
        views += [zoom_view(truth, x_fixed, number, pose, home, NOISE_PX, rng) for pose in poses]
    return views + views_at_stops(truth, corners, rng, NOISE_PX, **looks)


def calibrated(views, method="joint", folds=0, sizes=SIZES, **options):
    """The calibration from views; without a held-out check, to be quick."""
    return calibrate_views(views, BOARD, sizes, options=Options(method, folds=folds, **options))


def fitted(start, views, prior=None):
    """The fit of all usual parameters at one focal length."""
    return fit(place_boards(start, views, POINTS), views, POINTS, ALL_BLOCKS, prior=prior)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def pointing(calibration, truth, seed=4, rng=None):
    """Measured and predicted rms pointing error on the same targets [rad]."""
    targets = draw_targets(np.random.default_rng(seed), TARGETS)
    return rms(misses(calibration, truth, *targets, rng)), rms(predicted_pointing(calibration, *targets))
