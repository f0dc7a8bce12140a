"""Simulated targets: pose, gait, path and model."""
