"""Find small targets, moving or hovering, by contrast and change, with a fixed camera that may shake.

Movement alone cannot find a bird that hovers, and contrast alone finds every sign and chimney. The score multiplies
both: the contrast in standard deviations of the surroundings, and the part of it that was not there before, in units of
what air, codec and camera shake change of a thing that stands. Unless the camera pans, the difference from earlier
images is searched too, which finds a bird in front of foliage or beside a roof's edge.

It is the half of `cotarget.detection.auto` that finds small targets. Measurements: docs/design-notes.md.
"""

from cotarget.detection.small_target.camera_motion import CameraMotion
from cotarget.detection.small_target.contrast import SmallTarget, find_small_targets
from cotarget.detection.small_target.finder import SmallTargetFinder
from cotarget.detection.small_target.score import WEIGHTS, Weights, evidence

__all__ = ["WEIGHTS", "CameraMotion", "SmallTarget", "SmallTargetFinder", "Weights", "evidence", "find_small_targets"]
