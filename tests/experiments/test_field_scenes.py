"""The scenes in which targets are held: what issue and docstrings promise, told by the simulation's truth."""

import itertools

import numpy as np
import pytest

from cotarget.errors import ConfigError
from cotarget.sim.targets.random_paths import SECONDS
from cotarget.sim.targets.target import marker_of
from cotarget.sim.world import SimWorld
from experiments.following.field import five_targets_config, hold_config

SEEDS = (0, 1, 2, 100, 101)
STEP = 0.04
TIMES = np.arange(0.0, SECONDS + STEP / 2, STEP)
MOUNT = np.array([0.0, 0.0, 1.6])
SAMPLING = 0.02  # relative: speeds and radii from differences of samples


def blind(config):
    return SimWorld(config, rendered=())


def track(name, seed):
    with (w := blind(hold_config(name, seed))).rig:
        truth = w.truth()
        return np.array([truth.center(name, t) for t in TIMES]), truth


def seen_wholly(truth, name, times):
    """Whether the whole target is within the wide picture, at each time."""
    boxes = [truth.box(name, "fixed", t) for t in times]
    return np.array([b is not None and (b[0] > -0.5).all() and (b[1] < [639.5, 479.5]).all() for b in boxes])


def speeds(x):
    return np.linalg.norm(np.diff(x, axis=0), axis=1) / STEP


def test_the_book_is_put_elsewhere_once():
    for seed in SEEDS:
        x, truth = track("book", seed)
        distance = np.linalg.norm(x - MOUNT, axis=1)
        assert distance.min() > 9.5
        assert distance.max() < 10.5
        moving = speeds(x) > 0.05  # the spline through the knots trembles less than that
        assert np.count_nonzero(np.diff(moving.astype(int))) == 2  # sets out once, arrives once
        assert 0.8 < moving.sum() * STEP < 1.7
        assert 1.4 < np.linalg.norm(x[-1] - x[0]) < 4.1
        assert seen_wholly(truth, "book", TIMES[::10]).all()


def test_the_bird_flies_fast_wide_turns_and_stays_in_view():
    for seed in SEEDS:
        x, truth = track("bird", seed)
        v, a = np.gradient(x, STEP, axis=0), np.gradient(np.gradient(x, STEP, axis=0), STEP, axis=0)
        speed = np.linalg.norm(v, axis=1)
        assert (np.abs(speed[2:-2] / 10 - 1) <= 0.2).all()
        radius = speed**3 / np.maximum(np.linalg.norm(np.cross(v, a), axis=1), 1e-9)
        assert radius[3:-3].min() > 10 * (1 - SAMPLING)
        assert seen_wholly(truth, "bird", TIMES).all()
        distance = np.linalg.norm(x - MOUNT, axis=1)
        assert np.mean(x[:, 1]) == pytest.approx(25, abs=4)  # rounds of 10 m are not over in 20 s
        assert np.median(distance) == pytest.approx(26, abs=5)
        assert distance.min() > 14
        assert distance.max() < 39
        assert abs(truth.targets["bird"].size - 1) <= 0.15


@pytest.mark.parametrize("kind", [pytest.param("person", marks=pytest.mark.slow), "bird"])
def test_five_at_once_cross_and_are_told_apart(kind):
    for seed in SEEDS[:3]:
        config = five_targets_config(seed, kind)
        names = config.sim.targets
        assert names == (kind, *(f"{kind}{i}" for i in range(2, 6)))
        assert len({marker_of(name) for name in names}) == 5
        with (w := blind(config)).rig:
            truth = w.truth()
            seen = np.array([seen_wholly(truth, name, TIMES[::5]) for name in names])
            x = np.array([[truth.center(name, t) for t in TIMES[::5]] for name in names])
        assert (seen.sum(axis=0) == 5).sum() * 5 * STEP > 0.5  # all at once for a while
        assert (seen.sum(axis=1) * 5 * STEP > 2.0).all()  # each long enough for a close-up
        assert not seen[:, TIMES[::5] < 1.0].any()
        assert not seen[:, -1].all()
        across = x[:, :, 0] / x[:, :, 1]
        swapped = [(np.diff(np.sign(across[i] - across[j])) != 0).any() for i, j in itertools.combinations(range(5), 2)]
        assert sum(swapped) >= 4  # lines of sight cross


def test_other_names_are_refused():
    with pytest.raises(ConfigError, match="the scenes to hold are: bird, book, person"):
        hold_config("dragon", 0)
    with pytest.raises(ConfigError, match="five at once there are of: bird, person"):
        five_targets_config(0, "book")
