"""Calibration: boards and corners, intrinsics, stereo (Gamma), hand-eye (T), capture sessions and the file."""

from cotarget.calibration.file import load_calibration, save_calibration
from cotarget.calibration.model import Calibration, Capture, Covariance, Rejected, Residuals, View

__all__ = [
    "Calibration",
    "Capture",
    "Covariance",
    "Rejected",
    "Residuals",
    "View",
    "load_calibration",
    "save_calibration",
]
