"""The scores of tracks are those of trackeval, in an environment of its own: it needs another build of OpenCV."""

import json
import subprocess
import venv
from pathlib import Path

import numpy as np
import pytest

from cotarget.track_metrics import Criterion, Tracked, read_labels, score_tracks

DATA = Path(__file__).parent / "data"


@pytest.mark.foreign
@pytest.mark.timeout(600)
def test_trackeval_agrees(tmp_path):
    """Both score random tracks of the people in vtest.txt by overlap; numbers are swapped, lost and invented."""
    rng, number = np.random.default_rng(4), {}
    labels = {
        frame: [each for each in boxes if each.counts] for frame, boxes in read_labels(DATA / "vtest.txt").items()
    }
    tracks = []
    for frame, boxes in labels.items():
        found = {99: Tracked(rng.uniform(0, 700, 2), np.array([30.0, 80.0]), frame, frame / 10, 99)}
        for label in boxes:
            if rng.random() < 0.1:
                number[label.target] = int(rng.integers(1, 25))
            track = number.setdefault(label.target, label.target)
            if rng.random() < 0.85 and track not in found:
                size = label.size_px * np.exp(rng.normal(0, 0.1, 2))
                found[track] = Tracked(label.center_px + rng.normal(0, 5, 2), size, frame, frame / 10, track)
        tracks += found.values()
    score = score_tracks(tracks, labels, 10.0, 800, 0, Criterion(0.5, 0.0))

    def box(each):
        return [*(each.center_px - each.size_px / 2).tolist(), *each.size_px.tolist()]

    frames = [
        [[[a.target, box(a)] for a in boxes], [[b.track, box(b)] for b in tracks if b.frame == frame]]
        for frame, boxes in labels.items()
    ]
    (tmp_path / "frames.json").write_text(json.dumps(frames))
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", "trackeval==1.3.0"], check=True, timeout=500)
    command = [python, DATA / "trackeval_scores.py", tmp_path / "frames.json"]
    theirs = json.loads(subprocess.run(command, check=True, capture_output=True, text=True, timeout=100).stdout)
    assert theirs["id_switches"] > 10
    assert theirs == pytest.approx({name: getattr(score, name) for name in theirs}, rel=1e-12)
