"""Own shapes: a drawing is where its box says, its labels stay in the film, and recall is that of all scenes."""

import numpy as np
import pytest

from cotarget.track_metrics import LEARNING_FRAMES
from cotarget.video import FilmWriter
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


def test_a_composite_moves_in_its_film_and_turns_round_at_the_border(tmp_path):
    with FilmWriter(tmp_path / "wall.mp4", 25.0) as film:
        for i in range(200):
            film.write(np.full((240, 320, 3), 128, np.uint8), i / 25)
    frames, labels, rate = composite(tmp_path / "wall.mp4", SHAPES["car"], 3, 200)
    assert (len(frames), len(labels), rate) == (200, 200, 25.0)
    low = np.array([label.center_px - label.size_px / 2 for (label,) in labels.values()])
    high = np.array([label.center_px + label.size_px / 2 for (label,) in labels.values()])
    assert low.min() >= -0.5
    assert (high <= (319.5, 239.5)).all()
    assert np.ptp(low[:, 0]) > labels[0][0].size_px[0]
    for i in (0, LEARNING_FRAMES, 199):
        u, v = np.rint(labels[i][0].center_px).astype(int)
        assert np.abs(frames[i].image[v, u].astype(int) - 128).max() > 40


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
