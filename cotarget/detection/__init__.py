"""Finding a target in a single frame of the wide view: by its colour (the book) or by its motion (person, bird)."""

import cv2
import numpy as np

from cotarget.config import TargetConfig
from cotarget.detection.base import Detection, Detector
from cotarget.detection.colour import ColourDetector
from cotarget.detection.motion import BIRD, PERSON, MotionDetector, MotionSettings
from cotarget.errors import ConfigError
from cotarget.rig import Image

__all__ = [
    "BIRD",
    "PERSON",
    "ColourDetector",
    "Detection",
    "Detector",
    "MotionDetector",
    "MotionSettings",
    "make_detector",
]


def make_detector(target: TargetConfig, rate_hz: float, template: Image | None = None) -> Detector:
    """Make the detector that a target's configuration asks for.

    Args:
        target: the target.
        rate_hz: the camera's nominal frames a second.
        template: (h, w, 3) BGR picture of the target, for one that is found by its colour; the configured
            picture by default.

    Raises:
        ConfigError: a colour target without a usable template.
    """
    if target.detector == "motion":
        return MotionDetector(BIRD if target.dimension == "wingspan" else PERSON, rate_hz)
    if template is None:
        if target.template is None:
            raise ConfigError('a target with detector = "colour" needs a template, a picture of the target')
        read = cv2.imread(str(target.template), cv2.IMREAD_COLOR) if target.template.is_file() else None
        if read is None:
            raise ConfigError(f"{target.template}: is not a picture; a target's template is a PNG or JPEG of it")
        template = np.asarray(read, dtype=np.uint8)
    return ColourDetector(template)
