"""A rig made of numbers: its truth, what its cameras see of a board, and how far off a calibration of it points.

Nothing here uses the package's camera or head model: corners come from OpenCV's projections and written-out matrices.
The truth can have what a model lacks: lenses of other kinds, a head that sags, lags, scatters or counts wrongly, a
lever that gives way.
"""

from experiments.calibration.synthetic.aims import (
    TARGET_DEPTHS,
    aim,
    aimed,
    draw_targets,
    looking_off,
    misses,
    pointing_errors,
)
from experiments.calibration.synthetic.rig import (
    LONGEST_PX,
    NOMINAL_PX,
    SIZE,
    SIZES,
    Lens,
    Stop,
    Truth,
    middle_of,
    other_rig,
    truth_of,
    undistorted,
    with_lever_shifted,
)
from experiments.calibration.synthetic.views import (
    BOARD_DEPTHS,
    HEAD_LIMITS,
    Placing,
    noisy,
    placed,
    seen_from,
    spread_views,
    synthetic_views,
    views_at_stops,
    zoom_view,
)

__all__ = [
    "BOARD_DEPTHS",
    "HEAD_LIMITS",
    "LONGEST_PX",
    "NOMINAL_PX",
    "SIZE",
    "SIZES",
    "TARGET_DEPTHS",
    "Lens",
    "Placing",
    "Stop",
    "Truth",
    "aim",
    "aimed",
    "draw_targets",
    "looking_off",
    "middle_of",
    "misses",
    "noisy",
    "other_rig",
    "placed",
    "pointing_errors",
    "seen_from",
    "spread_views",
    "synthetic_views",
    "truth_of",
    "undistorted",
    "views_at_stops",
    "with_lever_shifted",
    "zoom_view",
]
