"""Weighted normalised correlation against its definition, and resampling against ramps."""

import math

import numpy as np
import pytest

from cotarget.estimation.correlation import correlate, resample, summit


def naive(image, inside, template, weight, row, column):
    """Compute correlation and visible part by definition: weighted covariances of the samples inside, all colours."""
    h, w = weight.shape
    here = weight * inside[row : row + h, column : column + w]
    n = here.sum()
    a, b = template.astype(float), image[row : row + h, column : column + w].astype(float)
    a, b = (each - np.einsum("ij,ijk->k", here, each) / n for each in (a, b))
    covariance, own, other = (np.einsum("ij,ijk,ijk->", here, x, y) for x, y in ((a, b), (a, a), (b, b)))
    noise = 0.1 * n
    return covariance / math.sqrt((own + noise) * (other + noise)), n / weight.sum()


@pytest.mark.parametrize("cut", [False, True])
def test_correlation_follows_its_definition(cut):
    rng = np.random.default_rng(3)
    image, template = rng.normal(5, 2, (21, 24, 3)).astype(np.float32), rng.normal(3, 1, (7, 9, 3)).astype(np.float32)
    weight = rng.uniform(0, 1, (7, 9)).astype(np.float32)
    inside = np.ones((21, 24), np.float32)
    if cut:
        inside[:, :6] = 0
    scores, seen = correlate(image, inside if cut else None, template, weight)
    for at in ((0, 3), (7, 8), (14, 15)):
        expected = naive(image, inside, template, weight, *at)
        assert (scores[at], seen[at]) == pytest.approx(expected, abs=1e-4)  # float32


def test_a_summit_is_that_of_a_parabola():
    v, u = np.mgrid[0:9, 0:11]
    score = 1 - 0.02 * (u - 4.3) ** 2 - 0.03 * (v - 5.2) ** 2
    assert summit(score, (5, 4)) == pytest.approx([4.3, 5.2])
    assert summit(score, (4, 5)) == pytest.approx([4.3, 5.2])  # a neighbour leads to it
    assert summit(score, (0, 4)) is None
    assert summit(score, (2, 8)) is None  # the score still rises at the border


@pytest.mark.parametrize("pitch", [0.3, 1.0, 1.7, 4.0, 11.3])
def test_samples_are_taken_at_the_mapped_pixels(pitch):
    """Averaging leaves a ramp as it is, so each sample is the coordinate where it is taken."""
    v, u = np.mgrid[0:480, 0:640].astype(np.float32)
    A = np.array([[pitch, 0.1 * pitch, 150.3], [-0.1 * pitch, pitch, 140.8]])
    for plane, row in ((u, 0), (v, 1)):
        samples, inside = resample(plane, A, (20, 17))
        j, i = np.mgrid[0:17, 0:20]
        assert inside is None
        # Linear interpolation in steps of 1/32 of a pixel of the reduced image.
        assert np.abs(samples - (A[row, 0] * i + A[row, 1] * j + A[row, 2])).max() < max(pitch, 1.0) / 16
    left = 3.2 * pitch
    _, inside = resample(u, np.array([[pitch, 0.0, -left], [0.0, pitch, 100.0]]), (20, 17))
    there = pitch * np.arange(20) - left >= -0.5  # a pixel is half a pixel wide to each side
    assert (inside == there).all()
