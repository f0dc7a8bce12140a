"""Calibration: boards and corners, intrinsics, stereo (Gamma), hand-eye (T), capture sessions and the file."""

from cotarget.board import draw_board
from cotarget.calibration.calibrate import calibrate_captures, calibrate_photos, calibrate_views
from cotarget.calibration.corners import find_corners
from cotarget.calibration.file import Calibration, load_calibration, save_calibration
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
    "load_calibration",
    "name_directions",
    "predicted_pointing",
    "save_calibration",
    "solve_hand_eye",
    "solve_hand_eye_from_motions",
    "weak_directions",
]
