"""Calibration: boards and corners, intrinsics, stereo (Gamma), hand-eye (T), capture sessions and the file."""
