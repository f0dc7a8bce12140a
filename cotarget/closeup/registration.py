"""Registering the wide view's patch of a target in a zoom image, whose scale and turn there are known."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cotarget.closeup.matching import Likeness, correlate, resample, summit
from cotarget.closeup.template import Sight
from cotarget.geometry import Array
from cotarget.rig import Image

# The target is looked for where it is expected, within this many standard deviations.
GATE_SIGMAS = 3.0
# First with few samples along its larger side, everywhere; then with more, around what was found.
COARSE_SAMPLES, FINE_SAMPLES = 14.0, 40.0
# No finer than this many samples a pixel of the wide view: there is no more in it.
FINEST = 4.0
# How far to search to each side, at most, in coarse samples; and in fine ones, beside half a coarse one.
WIDEST_SEARCH, FINE_SEARCH = 48, 1
# What the wide view's lens, pixels and coding blur together, one standard deviation [px]; chosen on rendered books.
WIDE_BLUR_PX = 0.7
# The best place leads the next best by this much, and no more of the target is out of view.
LEAST_LEAD, LEAST_SEEN = 0.12, 0.6
# Both cameras show it with a similar contrast.
LOWEST_GAIN, HIGHEST_GAIN = 0.25, 4.0
# A place away from the expected one counts as less alike, by this times its squared distance in standard deviations.
PRIOR_WEIGHT = 0.01
# Two places that are apart by less than this part of the target's box are one.
ONE_PLACE = 0.5
# Standard deviation of a registration, in pixels of the wide view and in samples, where likeness is lacking by as much
# as is usual; measured on the simulated targets.
SIGMA_PX, SIGMA_SAMPLES = 0.08, 0.08
USUAL_LACK, LEAST_LACK = 0.1, 0.04  # 1 - score


@dataclass(frozen=True)
class View:
    """How the wide view's surroundings of the target appear in a zoom frame.

    Attributes:
        center_px: where the target is expected, (2,).
        covariance: of that [px^2], (2, 2).
        J: zoom pixels a wide pixel at the target's depth, (2, 2).
    """

    center_px: Array
    covariance: Array
    J: Array

    @property
    def scale(self) -> float:
        """Zoom pixels a wide pixel."""
        return math.sqrt(abs(float(np.linalg.det(self.J))))


@dataclass(frozen=True)
class Place:
    """The best place of a search.

    Attributes:
        center_px: where the sight's middle is in the zoom frame, (2,).
        score: how alike both are there, -1 to 1.
        lead: by how much more than elsewhere.
        seen: the part of the target that is inside the zoom frame, 0 to 1.
        sigma_px: standard deviation of the place along u and v each [px].
    """

    center_px: Array
    score: float
    lead: float
    seen: float
    sigma_px: float = math.nan


def register(image: Image, sight: Sight, view: View) -> Place | None:
    """Find the place in a zoom image that is most alike to a sight of the target: first coarsely, then finely.

    Returns:
        None where nothing is alike, two places are, or what is alike goes on beyond the gate.
    """
    finest = max(1 / FINEST, 1 / view.scale)
    coarse, fine = (max(sight.side_px / samples, finest) for samples in (COARSE_SAMPLES, FINE_SAMPLES))
    place = _search(image, sight, view, coarse, view.center_px, None)
    if place is None or place.lead < LEAST_LEAD:
        return None
    place = _search(image, sight, view, fine, place.center_px, FINE_SEARCH + math.ceil(coarse / fine / 2))
    if place is None:
        return None
    lack = max(1 - place.score, LEAST_LACK) / USUAL_LACK
    return replace(place, sigma_px=(SIGMA_PX + SIGMA_SAMPLES * fine) * math.sqrt(lack) * view.scale)


def _search(image: Image, sight: Sight, view: View, pitch: float, around_px: Array, reach: int | None) -> Place | None:
    """Find the place in a zoom image that is most alike to a sight, sampled every ``pitch`` wide pixels.

    Args:
        image: the zoom frame's.
        sight: the target.
        view: how the wide view appears in the zoom frame.
        pitch: [px of the wide view].
        around_px: middle of the search in the zoom frame, (2,).
        reach: how many samples to each side; None for all of the gate, which alone then counts.
    """
    template, weight, middle = sight.at_pitch(pitch)
    step = view.J * pitch  # zoom pixels a sample
    back = np.linalg.inv(step)
    spread = back @ view.covariance @ back.T + np.diag((sight.body_sigma_px / pitch) ** 2)
    sides = np.full(2, WIDEST_SEARCH if reach is None else reach)
    if reach is None:
        sides = np.minimum(np.ceil(GATE_SIGMAS * np.sqrt(np.diag(spread))).astype(int) + 1, sides)
    A = np.column_stack([step, around_px - step @ (middle + sides)])
    width, height = (np.array(weight.shape[::-1]) + 2 * sides).tolist()
    samples, inside = resample(image, A, (width, height))
    if pitch < 1:  # the wide view's blur, in samples, where they show it
        samples = cv2.GaussianBlur(samples, (0, 0), WIDE_BLUR_PX / pitch)
    mix = sight.whitening
    likeness = correlate(cv2.transform(samples, mix), inside, cv2.transform(template, mix), weight)
    v, u = np.mgrid[-sides[1] : sides[1] + 1, -sides[0] : sides[0] + 1]
    inverse = np.linalg.inv(spread)
    distance = inverse[0, 0] * u * u + 2 * inverse[0, 1] * u * v + inverse[1, 1] * v * v
    if reach is not None:
        distance = np.zeros_like(distance)
    return _best(likeness, distance, ONE_PLACE * sight.size_px / pitch, around_px - step @ sides, step)


def _best(likeness: Likeness, distance: Array, apart: Array, origin_px: Array, step: Array) -> Place | None:
    """The best place of a search, if it is one.

    Args:
        likeness: at every place.
        distance: squared, of every place from the expected one, in standard deviations.
        apart: two places so far apart along u or v are two, (2,) [samples].
        origin_px: where the first place is in the zoom frame, (2,).
        step: from one place to the next, (2, 2) [px].
    """
    allowed = (likeness.gain > LOWEST_GAIN) & (likeness.gain < HIGHEST_GAIN)
    allowed &= (likeness.seen >= LEAST_SEEN) & (distance <= GATE_SIGMAS**2)
    score = np.where(allowed, likeness.score - PRIOR_WEIGHT * distance, -1.0)
    row, column = (int(i) for i in np.unravel_index(int(np.argmax(score)), score.shape))
    # The expectation may have drawn it one sample aside; what goes on rising, beyond the gate, is something else.
    top = summit(likeness.score, (row, column))
    if not allowed[row, column] or top is None:
        return None
    low = np.maximum(np.ceil([column - apart[0], row - apart[1]]), 0).astype(int)
    high = np.floor([column + apart[0], row + apart[1]]).astype(int) + 1
    best = float(score[row, column])
    score[low[1] : high[1], low[0] : high[0]] = -1.0
    return Place(
        center_px=origin_px + step @ top,
        score=float(likeness.score[row, column]),
        lead=best - max(float(score.max()), 0.0),
        seen=float(likeness.seen[row, column]),
    )
