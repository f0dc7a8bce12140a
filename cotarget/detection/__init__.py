"""Finding targets in the wide view: by colour (the book), by motion (a person), as a speck that changes (a bird).

`make_detector` knows four by name: "colour"; "mog2", the paper's adaptive Gaussian mixture, its foreground cleaned and
joined to pieces of a target's size; "motion", the same with what foliage and light need; and "speck", for small targets
that may hover, seen by a camera that may shake. `ExternalDetector` makes a fifth of any function from a picture to
boxes.
"""

import cv2
import numpy as np

from cotarget.config import TargetConfig
from cotarget.detection.background import BIRD, PERSON, BackgroundDetector, BackgroundSettings, plain
from cotarget.detection.base import Detection, Detector, ExternalDetector
from cotarget.detection.color_template import ColorTemplateDetector
from cotarget.detection.small_target import SmallTargetDetector
from cotarget.errors import ConfigError
from cotarget.rig import Image

__all__ = [
    "BIRD",
    "PERSON",
    "BackgroundDetector",
    "BackgroundSettings",
    "ColorTemplateDetector",
    "Detection",
    "Detector",
    "ExternalDetector",
    "SmallTargetDetector",
    "make_detector",
    "plain",
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
    kind: str = target.detector
    if kind == "speck":
        return SmallTargetDetector()
    if kind in ("motion", "mog2"):
        settings = BIRD if target.dimension == "wingspan" else PERSON
        return BackgroundDetector(plain(settings) if kind == "mog2" else settings, rate_hz)
    if template is None:
        if target.template is None:
            raise ConfigError('a target with detector = "colour" needs a template, a picture of the target')
        if not target.template.exists():
            raise ConfigError(f"{target.template}: no such file; a target's template is a PNG or JPEG of it")
        read = cv2.imread(str(target.template), cv2.IMREAD_COLOR) if target.template.is_file() else None
        if read is None:
            raise ConfigError(f"{target.template}: is not a picture; a target's template is a PNG or JPEG of it")
        template = np.asarray(read, dtype=np.uint8)
    return ColorTemplateDetector(template)
