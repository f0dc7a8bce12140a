"""Accuracy must not get worse: the experiments' quick runs against committed bounds.

The bounds in experiments/expected are what the quick runs gave when they were committed, and only tighten. Seeds and
corners are fixed, so that nothing but the calibration can change a figure.
"""

from dataclasses import replace

import pytest

from benchmarks import speed
from experiments.calibration import chain, hand_eye, honesty, mismatch, random_rigs
from experiments.engine.bounds import compare
from experiments.engine.workers import here

EXPERIMENTS = {
    module.EXPERIMENT.name: module.EXPERIMENT for module in (chain, hand_eye, honesty, mismatch, random_rigs)
}
SLOW = ("chain", "honesty", "mismatch", "random_rigs")


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in EXPERIMENTS])
def test_no_figure_gets_worse(name):
    experiment = EXPERIMENTS[name]
    summary = experiment.summarise(experiment.run(experiment.quick, engine=here))
    bounds = compare(experiment, summary)
    assert bounds
    for bound in bounds:
        assert bound.kept, f"{name}: {bound.name} is {bound.reached}, not {bound.text}"
    assert experiment.describe(experiment.quick, summary)


def test_a_board_is_looked_at_from_as_many_poses_as_are_asked_for(monkeypatch):
    """Of the poses that are drawn at a time, some 60 to 80 see it."""
    seen = []
    monkeypatch.setattr(hand_eye, "fit", lambda start, views, *_: seen.append(len(views)) or 1 / 0)
    for poses in (20, 200):
        with pytest.raises(ZeroDivisionError):  # the solving is not what this is about
            hand_eye.one(None, replace(hand_eye.SETTINGS, poses=poses), 0)
    assert seen == [20, 200]


@pytest.mark.slow
def test_the_joint_fits_time_is_told_beside_opencvs():
    summary = speed.EXPERIMENT.summarise(speed.EXPERIMENT.run(speed.EXPERIMENT.quick))
    assert summary[speed.JOINT]["seconds"] > 0
    assert speed.EXPERIMENT.describe(speed.EXPERIMENT.quick, summary)
