"""Own shapes: a drawing is where its box says, its labels stay in the film, and recall is that of all scenes."""

import numpy as np
import pytest

from cotarget.rig import Frame
from cotarget.track_metrics import Label
from experiments.following.films import LabelledFilm
from experiments.following.own_shapes import SHAPES, composite, draw_shape, missed, summarise

EDGE_PX = 0.7  # the lens blurs edges by as much


@pytest.mark.parametrize("length", [60.0, -60.0])
@pytest.mark.parametrize("name", SHAPES)
def test_a_drawing_is_where_its_box_says_and_looks_ahead(name, length):
    image = np.full((120, 160, 3), 128, np.uint8)
    box = draw_shape(image, SHAPES[name], np.array([70.4, 60.7]), length)
    v, u = np.nonzero(np.abs(image.astype(int) - 128).max(axis=2) > 40)
    low, high = np.array([u.min(), v.min()]) - 0.5, np.array([u.max(), v.max()]) + 0.5
    np.testing.assert_allclose(box.center_px, (low + high) / 2, atol=EDGE_PX)
    np.testing.assert_allclose(box.size_px, high - low, atol=2 * EDGE_PX)
    # Each is higher in front or behind: cabin, head or mast.
    higher = {"car": -1, "dog": 1, "boat": 1}[name]
    assert np.sign(u[v == v.min()].mean() - 70.4) == higher * np.sign(length)


def test_a_composite_crosses_its_film_far_from_labels():
    frames = [Frame(np.full((240, 320, 3), 128, np.uint8), i / 25) for i in range(250)]
    taken = {i: [Label(np.array([160.0, 60.0]), np.array([10.0, 10.0]))] for i in range(250)}
    clip = composite(LabelledFilm("wall", frames, 25.0, taken, {}), SHAPES["car"], 3, 240)
    made, labels = clip.frames, clip.labels
    assert (len(made), clip.rate_hz) == (240, 25.0)
    assert min(labels) > 0  # it comes in
    for i, (label,) in labels.items():
        low, high = label.center_px - label.size_px / 2, label.center_px + label.size_px / 2
        assert low.min() >= -0.5
        assert (high <= (319.5, 239.5)).all()
        assert abs(label.center_px[1] - 60) > 90
        u, v = np.rint(label.center_px).astype(int)
        assert np.abs(made[i].image[v, u].astype(int) - 128).max() > 40
    assert np.abs(labels[max(labels)][0].center_px[0] - labels[min(labels)][0].center_px[0]) > label.size_px[0]


def test_recall_is_over_the_boxes_of_all_scenes():
    """By hand: 90 of 100 and 100 of 100 are 0.95, which is enough; 18 of 20 is not."""
    row = {"source": "simulated", "shape": "car", "boxes": 100, "side_px": 50.0}
    rows = [
        {**row, "found": 90},
        {**row, "found": 100, "side_px": 80.0},
        {**row, "source": "composite", "boxes": 20, "found": 18},
    ]
    summary = summarise(rows)
    assert summary["simulated: car"] == {"boxes": 200, "recall": 0.95, "least_px": 50.0, "largest_px": 80.0}
    assert missed(summary) == ["composite: car: recall 0.900, not 0.95 or more"]
