"""The experiments on simpler models: hand-worked rigs, on which each model's error is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from cotarget.geometry import RigidTransform, pose
from cotarget.schema import validate
from experiments.calibration import calibration_budget
from experiments.calibration.synthetic.aims import looking_off
from experiments.calibration.synthetic.rig import Lens, Truth
from experiments.following import depth_error, models, shortcut
from experiments.following.mounted import (
    MOUNTED_DEG,
    at,
    exact_calibration,
    idealised,
    mounted,
    off_px,
    wanted_focal_px,
)
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
    scattered,
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


def test_every_model_is_there():
    found = models_of(BESIDE, exact_calibration(BESIDE), np.random.default_rng(0))
    assert set(found.poses(MIDDLE, np.array([10.0]))) == set(MODELS)


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


def test_scatter_has_the_given_standard_deviation():
    rng = np.random.default_rng(1)
    off = [scattered(BESIDE.gamma, 0.02, np.radians(1.0), rng) for _ in range(500)]  # which tell it to 3 %
    shifts = np.array([T.translation - BESIDE.gamma.translation for T in off])
    turns = np.degrees([(T.rotation * BESIDE.gamma.rotation.inv()).as_rotvec() for T in off])
    assert shifts.std(axis=0) == pytest.approx([0.02] * 3, rel=0.12)
    assert turns.std(axis=0) == pytest.approx([1.0] * 3, rel=0.12)
    many = errors(BESIDE, ANYWHERE, 1000.0, centring=Centring(depth=1000.0, scatter=1e-3))[TABLE]
    assert 2e-4 < np.sqrt(np.mean(many**2)) < 4e-3


def test_mounted_rigs_have_the_given_baseline_and_angles():
    rigs = [mounted(np.random.default_rng(seed), 1.5) for seed in range(100)]
    baselines = np.array([np.linalg.norm(rig.gamma.inv().translation) for rig in rigs])
    assert baselines == pytest.approx(1.5)
    angles = np.degrees([rig.gamma.rotation.as_rotvec() for rig in rigs])
    assert angles.std(axis=0) == pytest.approx([MOUNTED_DEG] * 3, rel=0.25)  # 100 tell it to 7 %
    plain = idealised(rigs[0])
    assert (plain.dz, plain.eps, plain.zoom.cx, plain.zoom.cy) == (0.0, 0.0, 319.5, 239.5)


def test_an_error_in_the_close_up():
    x = np.array([[B, 0.0, 8.0], [B, 0.0, 1.0], [B, 0.0, 100.0]])  # 8 m before the zoom camera, too near, too far
    assert wanted_focal_px(BESIDE, x, size=0.8, wanted_px=160.0) == pytest.approx([1600.0, 500.0, 7155.0])
    assert off_px(np.array([math.atan(0.1)]), np.array([2000.0])) == pytest.approx([200.0])


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


def test_targets_at_the_depth_of_the_zeros_alone_leave_a_picture():
    """Zeroed, no offset is seen there: their reach is infinite, and not to be drawn."""
    far = [row | {"reach": math.inf} if row["model"] in ZEROED.values() else row for row in error_rows({50.0: 9.0})]
    models.plot(far, figure := Figure())
    ignored, zeroed = figure.axes[2], figure.axes[5]
    assert [bars.get_label() for bars in ignored.containers] == list(models.CONDITIONS)
    assert zeroed.containers == []


@pytest.mark.parametrize("first", [True, False])
def test_of_depths_and_baselines_with_the_same_reach_the_worst_counts(first):
    good, bad = error_rows({5.0: 40.0, 10.0: 20.0, 20.0: 9.0}), error_rows({20.0: 4.0}, baseline=2.0)
    rows = good + bad if first else bad + good
    assert models.regime(rows, "exact") == (5.0, 5.0)
    assert [float(v[0]) for v in models.ratios(rows, "exact").values()] == pytest.approx([40.0, 4.0, 9.0])


def test_reach_is_depth_over_baseline_or_from_the_zeros_depth():
    assert models.reach(20.0, 0.4) == pytest.approx(50.0)
    assert models.reach(20.0, 0.4, 50.0) == pytest.approx(1 / (0.4 * 0.03))
    assert models.reach(50.0, 0.4, 50.0) == math.inf


def test_a_depth_error_turns_the_line_of_sight_by_the_baseline_over_the_depth():
    x = np.array([[0.0, 0.0, 10.0]])
    calibration = exact_calibration(BESIDE)
    arm = depth_error.turned_by(calibration, BESIDE, x)[0]
    assert arm == pytest.approx(10.0 * B / (10.0**2 + B**2))
    # And it is the derivative of what really happens.
    off = looking_off(BESIDE, x, depth_error.aim(calibration, x * 1.001))[0]
    assert off == pytest.approx(1e-3 * arm, rel=2e-3)


def test_depths_are_measured_by_the_size():
    x = np.array([[0.0, 0.0, 10.0], [1.0, 0.5, 10.0]])
    px, sizes = PLAIN.project(x), np.full(2, depth_error.TARGET.size)
    calibration = exact_calibration(BESIDE)
    exact = depth_error.measured_depths(calibration, BESIDE, px, x, sizes, np.zeros(2))
    assert exact == pytest.approx([10.0, 10.0])
    smaller = depth_error.measured_depths(calibration, BESIDE, px, x, sizes / 1.1, np.zeros(2))
    assert smaller == pytest.approx([11.0, 11.0])
    # 0.8 m at 10 m is 40 px: one more is 1/41 nearer.
    noisy = depth_error.measured_depths(calibration, BESIDE, px, x, sizes, np.ones(2))
    assert noisy == pytest.approx([10.0 * 40 / 41] * 2)


def test_the_nearest_targets_all_have_a_depth():
    settings = replace(depth_error.SETTINGS, depths=(depth_error.NEAREST_M,), baselines=(0.4,))
    rows = [row for seed in range(10) for row in depth_error.one(settings, seed)]
    assert all(math.isfinite(row["width"]) for row in rows)


def test_first_order_agrees_with_monte_carlo():
    settings = replace(depth_error.SETTINGS, baselines=(0.4,), depths=(10.0,), targets=100, scatter=0.02, wrong=0.01)
    rows = {row["cause"]: row for row in depth_error.one(settings, 0)}
    for cause in depth_error.CAUSES:  # 100 normal numbers tell their rms to 7 %
        assert rows[cause]["reached_deg"] == pytest.approx(rows[cause]["first_order_deg"], rel=0.25), cause
    summary = depth_error.summarise(list(rows.values()))
    assert depth_error.missed(summary) == []
    for row in rows.values():
        row["reached_deg"] *= 2
    assert len(depth_error.missed(depth_error.summarise(list(rows.values())))) == len(depth_error.CAUSES)


def test_the_exact_range_is_exact_and_the_shortcut_worse_the_farther_off_the_axis():
    settings = replace(shortcut.SETTINGS, depths=(10.0,), grid=(5, 3), near=8, rigs=("mounted",))
    rows = shortcut.one(settings, 0)
    assert len(rows) == 15 + 8
    assert max(row["exact_deg"] for row in rows) < shortcut.ROUNDING_DEG
    by_angle = sorted(rows, key=lambda row: row["off_axis_deg"])
    for method in ("paper-table", "paper-example"):
        assert by_angle[0][f"{method}_deg"] < 0.2 < 1.0 < by_angle[-1][f"{method}_deg"]
    summary = shortcut.summarise(rows)
    assert shortcut.missed(summary) == []
    found = summary["mounted"]["paper-table"]
    assert found["near the axis"]["10 m"]["deg"] < found["whole view"]["10 m"]["deg"]
    wrong = shortcut.missed(
        shortcut.summarise([*rows, rows[0] | {"exact_deg": 0.1}, rows[0] | {"exact_deg": math.nan}])
    )
    assert len(wrong) == 2


def test_a_grid_without_targets_at_20_degrees_gives_nan_there():
    """Its corners are 25 degrees and more off the axis."""
    settings = replace(shortcut.SETTINGS, depths=(10.0,), grid=(2, 2), near=8, rigs=("mounted",))
    rows = shortcut.one(settings, 0)
    summary = shortcut.summarise(rows)
    found = summary["mounted"]["paper-table"]
    assert math.isnan(found["at 20 degrees"]["all"]["deg"])
    assert found["whole view"]["10 m"]["deg"] > 1.0
    assert shortcut.missed(summary) == []
    shortcut.plot(rows, Figure())


def test_targets_near_the_axis_are_all_over_its_disc():
    truth = mounted(np.random.default_rng(0), 1.5)
    x = shortcut.near_axis(truth, 7.0, 400, np.random.default_rng(1))
    assert x[:, 2] == pytest.approx(7.0)
    x_zoom0 = truth.gamma.apply(x)
    off = np.hypot(x_zoom0[:, 0], x_zoom0[:, 1]) / x_zoom0[:, 2] / math.tan(math.radians(shortcut.NEAR_DEG))
    assert off.max() < 1
    assert np.mean(off < math.sqrt(0.5)) == pytest.approx(0.5, abs=0.1)  # half of a disc; 400 tell it to 0.025


def test_the_worked_examples_rig_errs_as_the_worked_example_does():
    """Its book, 5.4 degrees off the axis: 33.5 and 2.6 px at 7155 px."""
    truth = idealised(shortcut.rig_of(shortcut.PAPERS, 0, 0.4))
    x = np.array([shortcut.X_FIXED_MM]) / 1000
    assert truth.gamma.apply(x)[0] == pytest.approx([0.811, 0.563, 10.464])
    reach = shortcut.Reach(shortcut.ANYWHERE, shortcut.ANYWHERE, (693.0, 7155.0))
    for method, px in (("paper-table", 33.5), ("paper-example", 2.6)):
        q = np.array([shortcut.aimed(exact_calibration(truth), x[0], reach, method)])
        assert 7155 * math.tan(looking_off(truth, x, q)[0]) == pytest.approx(px, abs=0.1)


def test_exponents_are_fitted_to_the_rows():
    rows = [
        {"noise_px": noise, "placements": n, "reached_px": 3.0 * noise * n**-0.5}
        for noise in (0.02, 0.1, 0.5)
        for n in (6, 12, 48)
    ]
    assert calibration_budget.exponents(rows) == pytest.approx((1.0, -0.5))
    of_one_noise = [row for row in rows if row["noise_px"] == 0.1]
    assert calibration_budget.exponents(of_one_noise) == pytest.approx((math.nan, -0.5), nan_ok=True)
    of_one_number = [row for row in rows if row["placements"] == 6]
    assert calibration_budget.exponents(of_one_number) == pytest.approx((1.0, math.nan), nan_ok=True)


def test_missed_compares_errors_with_theory_and_prediction():
    right = {"exponent_noise": 1.0, "exponent_placements": -0.6, "reached_over_predicted": 1.0}
    assert calibration_budget.missed(right) == []
    said = calibration_budget.missed(right | {"exponent_noise": 0.5})
    assert [text.partition(":")[0] for text in said] == ["exponent_noise"]
    assert calibration_budget.missed(right | {"exponent_noise": math.nan}) == []  # one noise tells of none


@pytest.mark.slow
def test_a_calibration_of_less_noise_points_better():
    settings = validate(
        calibration_budget.BudgetSettings,
        {"noises_px": [0.02, 0.5], "placements": [6]},
        "",
        base=replace(calibration_budget.SETTINGS, targets=20),
    )
    fine, coarse = calibration_budget.one(settings, 0)
    assert fine["reached_px"] < 0.2 * coarse["reached_px"]
    assert (fine["placements"], fine["poses"]) == (6, 24)
