"""The experiments on simpler models: hand-worked rigs, on which each model's error is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cotarget.geometry import RigidTransform, pose
from experiments.calibration.synthetic.aims import looking_off
from experiments.calibration.synthetic.rig import Lens, Truth
from experiments.following import depth_error, models, shortcut
from experiments.following.mounted import at, exact_calibration, idealised, mounted
from experiments.following.simpler import (
    CRUDE_OFFSET,
    FULL,
    IGNORED,
    MODELS,
    PARALLEL,
    PLANAR,
    PLANAR_TURNED,
    TABLE,
    TURNED,
    ZEROED,
    Centring,
    Crude,
    models_of,
)

STILL = RigidTransform.identity()
PLAIN = Lens(500.0, 500.0, 319.5, 239.5)
B = 0.5  # baseline [m]
# The zoom camera beside the fixed one, on the axes of its head, all axes parallel.
BESIDE = Truth(fixed=PLAIN, zoom=PLAIN, gamma=pose([-B, 0, 0], [0, 0, 0]), hand=STILL, dz=0.0, eps=0.0)
MIDDLE = np.array([[319.5, 239.5]])
ANYWHERE = np.array([[40.0, 30.0], [600.0, 100.0], [300.0, 450.0], [500.0, 400.0]])
ROUNDING = 1e-9  # [rad]; Newton's iteration ends within 1e-10
NO_SCATTER = (Crude(0.0, 0.0, 0.0), Centring(scatter=0.0))


def errors(truth, pixels, depth, crude=NO_SCATTER[0], centring=NO_SCATTER[1]):
    """Of every model, which know the rig exactly but for what they leave out [rad]."""
    found = models_of(truth, exact_calibration(truth), np.random.default_rng(0), crude, centring)
    depths = np.full(len(pixels), depth)
    poses = found.poses(pixels, depths)
    return {name: looking_off(truth, at(truth, pixels, depth), poses[name]) for name in MODELS}


@pytest.mark.parametrize("depth", [5.0, 20.0])
def test_ignoring_the_offset_errs_by_the_baseline_over_the_depth(depth):
    assert errors(BESIDE, MIDDLE, depth)[IGNORED][0] == pytest.approx(math.atan(B / depth), abs=ROUNDING)


def test_models_are_exact_on_the_rigs_that_they_assume():
    parallel_and_in_plane = errors(BESIDE, ANYWHERE, 7.0)
    for name in (FULL, PARALLEL, PLANAR, PLANAR_TURNED, CRUDE_OFFSET):
        assert parallel_and_in_plane[name] == pytest.approx(0.0, abs=ROUNDING), name
    turn = pose([0, 0, 0], [2.0, 10.0, 3.0])
    turned = errors(replace(BESIDE, gamma=turn * BESIDE.gamma), ANYWHERE, 7.0)
    assert turned[PLANAR_TURNED] == pytest.approx(0.0, abs=ROUNDING)
    assert (np.degrees(turned[PLANAR]) > 5.0).all()  # what it takes for parallel is turned by more than that
    ahead = errors(replace(BESIDE, gamma=pose([-B, 0, -B], [0, 0, 0])), ANYWHERE, 7.0)
    assert ahead[PARALLEL] == pytest.approx(0.0, abs=ROUNDING)
    assert (ahead[PLANAR] > 1e-3).all()
    nowhere = replace(BESIDE, gamma=turn, hand=pose([0, 0, 0], [1.0, -2.0, 1.0]))
    assert errors(nowhere, ANYWHERE, 7.0)[IGNORED] == pytest.approx(0.0, abs=ROUNDING)


def test_the_look_up_table_is_exact_at_its_own_depth_and_pixels():
    centring = Centring(grid=(5, 5), depth=8.0, scatter=0.0)
    corners = np.array([[0.0, 0.0], [639.0, 479.0], [319.5, 239.5]])
    truth = mounted(np.random.default_rng(3), B)
    assert errors(truth, corners, 8.0, centring=centring)[TABLE] == pytest.approx(0.0, abs=ROUNDING)
    # Elsewhere it is off by the angle between both depths, as seen from the zoom camera.
    off = errors(BESIDE, MIDDLE, 32.0, centring=centring)[TABLE][0]
    assert off == pytest.approx(math.atan(B / 8.0) - math.atan(B / 32.0), abs=ROUNDING)


def test_zeros_set_on_one_target_make_every_model_right_there():
    truth, there = mounted(np.random.default_rng(3), B), Centring(zero_depth=8.0, scatter=0.0)
    crude = Crude()
    right, wrong = (errors(truth, MIDDLE, depth, crude, there) for depth in (8.0, 32.0))
    for name in TURNED:
        assert right[ZEROED[name]] == pytest.approx(0.0, abs=ROUNDING), name
        assert right[name] > 1e-3, name
    # Elsewhere the offset is seen at another angle.
    assert wrong[ZEROED[IGNORED]][0] > 0.5 * B * (1 / 8 - 1 / 32)
    beside = errors(BESIDE, MIDDLE, 32.0, centring=there)[ZEROED[IGNORED]][0]
    assert beside == pytest.approx(math.atan(B / 8.0) - math.atan(B / 32.0), abs=ROUNDING)
    scattered = errors(BESIDE, MIDDLE, 8.0, centring=Centring(zero_depth=8.0, scatter=1e-3))[ZEROED[IGNORED]][0]
    assert 1e-5 < scattered < 5e-3


def error_rows(ratios, baseline=1.0):
    """Of one seed, who ignores the offset so many times worse than the full model at each depth over a baseline [m]."""
    return [
        {"seed": 0, "depth_m": depth, "baseline_m": baseline, "model": name, "reach": depth / baseline}
        | {f"{c}_{key}": error for c in models.CONDITIONS for key in ("deg", "width")}
        for depth, ratio in ratios.items()
        for name in MODELS
        for error in [0.01 * (ratio if name in models.OPPONENTS else 1.0)]
    ]


def test_the_regime_reaches_as_far_as_the_full_model_is_five_times_better():
    rows = error_rows({5.0: 40.0, 10.0: 20.0, 50.0: 5.0, 100.0: 4.9, 200.0: 6.0})
    assert models.regime(rows, "seen") == (5.0, 50.0)
    summary = models.summarise(rows)
    assert models.missed(summary) == []
    none = models.missed(models.summarise(error_rows({5.0: 4.0, 10.0: 20.0})))
    assert none == [f"{c}: full model 5 times better than {o}" for c in models.CONDITIONS for o in models.OPPONENTS]


def test_a_depth_error_turns_the_line_of_sight_by_the_baseline_over_the_depth():
    x = np.array([[0.0, 0.0, 10.0]])
    calibration = exact_calibration(BESIDE)
    arm = depth_error.turned_by(calibration, BESIDE, x)[0]
    assert arm == pytest.approx(10.0 * B / (10.0**2 + B**2))
    # And it is the derivative of what really happens.
    off = looking_off(BESIDE, x, depth_error.aim(calibration, x * 1.001))[0]
    assert off == pytest.approx(1e-3 * arm, rel=2e-3)


def test_the_worked_examples_rig_errs_as_the_worked_example_does():
    """Its book, 5.4 degrees off the axis: 33.5 and 2.6 px at 7155 px."""
    truth = idealised(shortcut.rig_of(shortcut.PAPERS, 0, 0.4))
    x = np.array([shortcut.X_FIXED_MM]) / 1000
    assert truth.gamma.apply(x)[0] == pytest.approx([0.811, 0.563, 10.464])
    reach = shortcut.Reach(shortcut.ANYWHERE, shortcut.ANYWHERE, (693.0, 7155.0))
    for method, px in (("paper-table", 33.5), ("paper-example", 2.6)):
        q = np.array([shortcut.aimed(exact_calibration(truth), x[0], reach, method)])
        assert 7155 * math.tan(looking_off(truth, x, q)[0]) == pytest.approx(px, abs=0.1)
