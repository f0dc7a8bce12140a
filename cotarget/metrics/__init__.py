"""The field's figures: of a target that was held, by the truth, and of tracks on a film, by labels."""

from cotarget.metrics.closeup import SERVED_S, WHOLLY_VISIBLE, Closeup
from cotarget.metrics.held import Score, false_tracks, id_switches, score
from cotarget.metrics.rows import Row, read_rows, write_rows
from cotarget.metrics.tracked import Label, Tracked, TrackScore, read_labels, read_tracks, score_tracks

__all__ = [
    "SERVED_S",
    "WHOLLY_VISIBLE",
    "Closeup",
    "Label",
    "Row",
    "Score",
    "TrackScore",
    "Tracked",
    "false_tracks",
    "id_switches",
    "read_labels",
    "read_rows",
    "read_tracks",
    "score",
    "score_tracks",
    "write_rows",
]
