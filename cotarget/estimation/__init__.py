"""Estimate targets in 3D: one filter per target, fed by both cameras, each measurement at its own time.

The comparison of motion models: docs/design-notes.md.
"""

from cotarget.estimation.measurement_model import Appearance, Estimate
from cotarget.estimation.motion_model import FilterSettings, MotionSettings, filter_settings
from cotarget.estimation.target_filter import TargetFilter

__all__ = [
    "Appearance",
    "Estimate",
    "FilterSettings",
    "MotionSettings",
    "TargetFilter",
    "filter_settings",
]
