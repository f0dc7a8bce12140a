"""Accuracy must not get worse: the experiments' quick runs against committed bounds.

The bounds in experiments/expected are what the quick runs gave when they were committed, and only tighten. Seeds and
corners are fixed, so that nothing but the calibration can change a figure.
"""

import json

import pytest

from experiments import chain, hand_eye, honesty, mismatch, random_rigs, speed
from experiments.harness import EXPECTED

EXPERIMENTS = {
    module.EXPERIMENT.name: module.EXPERIMENT for module in (chain, hand_eye, honesty, mismatch, random_rigs)
}
SLOW = ("chain", "mismatch", "random_rigs")
WORSE = 1.10  # times the bound


def leaves(tree, path=()):
    """Every number of nested dictionaries, and its path."""
    if not isinstance(tree, dict):
        yield path, tree
        return
    for key, value in tree.items():
        yield from leaves(value, (*path, key))


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in EXPERIMENTS])
def test_no_figure_gets_worse(name):
    experiment = EXPERIMENTS[name]
    summary = experiment.summarise(experiment.run(experiment.quick))
    bounds = list(leaves(json.loads((EXPECTED / f"{name}.json").read_text())))
    assert bounds
    for path, bound in bounds:
        found = summary
        for key in path:
            found = found[key]
        assert found <= WORSE * bound, f"{name}: {' / '.join(path)} is {found:.4g}, where {bound:.4g} was reached"
    assert experiment.describe(experiment.quick, summary)


@pytest.mark.slow
def test_the_joint_fits_time_is_told_beside_opencvs():
    summary = speed.EXPERIMENT.summarise(speed.run(speed.EXPERIMENT.quick))
    assert summary[speed.JOINT]["seconds"] > 0
    assert speed.EXPERIMENT.describe(speed.EXPERIMENT.quick, summary)
