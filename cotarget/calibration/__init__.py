"""Calibration: boards and corners, intrinsics, stereo (Gamma), hand-eye (T), capture sessions and the file.

Arguments that mean the same in all functions here:

- points: the board's corners in its frame [m], (N, 3)
- views: corners that were seen, with what the devices reported; see `View`
- model: geometry of the rig, with the boards' poses where views are predicted; see `BundleModel`
- free: blocks of parameters that a fit determines; see `Block`
- sizes: image sizes (width, height) of "fixed" and "zoom" [px]
- nominal, nominal_px: nominal focal length of the zoom lens, or one for each zoom sample [px]
- progress: called with the number done, the total, and a text
"""

from cotarget.board import draw_board
from cotarget.calibration.calibrate import calibrate_captures, calibrate_photos, calibrate_views
from cotarget.calibration.corners import find_corners
from cotarget.calibration.file import Calibration
from cotarget.calibration.handeye import HandEye, solve_hand_eye, solve_hand_eye_from_motions
from cotarget.calibration.model import Capture, Covariance, HeldOut, Options, Rejected, Residuals, View
from cotarget.calibration.observability import Observability, name_directions, weak_directions
from cotarget.calibration.uncertainty import line_of_sight_covariance, predicted_pointing

__all__ = [
    "Calibration",
    "Capture",
    "Covariance",
    "HandEye",
    "HeldOut",
    "Observability",
    "Options",
    "Rejected",
    "Residuals",
    "View",
    "calibrate_captures",
    "calibrate_photos",
    "calibrate_views",
    "draw_board",
    "find_corners",
    "line_of_sight_covariance",
    "name_directions",
    "predicted_pointing",
    "solve_hand_eye",
    "solve_hand_eye_from_motions",
    "weak_directions",
]
