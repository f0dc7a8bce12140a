"""Score a region by its contrast, its change and the texture beside it."""

import math
from collections.abc import Sequence

import numpy as np

# Change of things that stand, after each of AGES_S, not exceeded nine times in ten; measured on films of the collection
# that tests/detection/test_real_clips.py names, each seen through air and a codec.
STANDING_CHANGE = (0.05, 0.08, 0.15, 0.20)
# Added to a change before its logarithm is taken: smaller changes cannot be measured.
LEAST_CHANGE = 0.02
# The score is the logistic function of these times the logarithms of signal, change and texture beside the target, plus
# the last. They were fitted to 41 labelled films, with target and others taken as equally likely in every film.
Weights = tuple[float, float, float, float]
WEIGHTS: Weights = (2.57, 3.14, -1.44, -3.52)
# Largest signal that counts: a stronger one does not make up for a lack of change.
CLEAR_SIGNAL = 30.0


def small_target_score(signal: float, since: Sequence[float], beside: float, weights: Weights = WEIGHTS) -> float:
    """Probability that a region is a target and not a standing thing, 0 to 1.

    Args:
        signal: contrast in standard deviations of the surroundings.
        since: change since each of AGES_S, nan if unknown.
        beside: largest texture beside the region [grey levels].
        weights: of the logarithms of signal, change and texture, and the constant.
    """
    found = evidence(signal, since, beside)
    return 0.0 if found is None else 1 / (1 + math.exp(-float(np.dot(weights, (*found, 1.0)))))


def evidence(signal: float, since: Sequence[float], beside: float) -> tuple[float, float, float] | None:
    """Logarithms of signal, change and texture; None without any change. Arguments as for `small_target_score`."""
    ratios = [
        math.log((c + LEAST_CHANGE) / (usual + LEAST_CHANGE))
        for c, usual in zip(since, STANDING_CHANGE, strict=True)
        if not math.isnan(c)
    ]
    if not ratios:
        return None
    return math.log(min(signal, CLEAR_SIGNAL)), sum(ratios) / len(ratios), math.log1p(beside)
