"""Films without targets are drawn the same for a seed, and every track in them is false."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.following import empty

SHORT = replace(empty.SETTINGS, seconds=3.5, scenes=("rain",), targets=("bird",))


@pytest.mark.parametrize("scene", list(empty.SCENES))
def test_a_scene_moves_and_is_a_function_of_its_seed(scene):
    first, again, other = (list(empty.film(scene, replace(SHORT, seconds=0.4), seed)) for seed in (0, 0, 1))
    assert all((a.image == b.image).all() for a, b in zip(first, again, strict=True))
    assert (first[0].image != other[0].image).any()
    moved = np.abs(first[-1].image.astype(int) - first[0].image).mean()
    assert moved > 0.5


def test_tracks_of_the_mixture_are_false():
    rows = empty.one(SHORT, 0)
    assert {row["way"] for row in rows} == {"bird, speck", "bird, mog2"}
    summary = empty.summarise(rows)
    assert summary["bird, mog2"]["all"] == summary["bird, mog2"]["rain"] > 60
    assert empty.missed(summary)[-1].startswith("bird, mog2: ")
