"""Synthetic rig: its true geometry, its cameras' views of a board, and the pointing error of a calibration.

The package's camera and head models are not used: corners come from OpenCV's projections and explicit matrices. The
truth can have what a model lacks: lenses of other kinds, a head that sags, lags, scatters or has a wrong scale, and a
lever that bends.
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
