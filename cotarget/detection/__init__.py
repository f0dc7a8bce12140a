"""Detect targets in the fixed camera: of any kind, by colour (a book), or by a neural network.

`make_detector` makes one by name: "auto", which finds what moves or stands out, of any size; "motion", the same from a
size on; "speck", the same without a background model; "colour"; "mog2", the paper's adaptive Gaussian mixture; and
"onnx", a neural network. `ExternalDetector` makes a detector of any function from an image to boxes; the name
"module:function" stands for one of a user's own.
"""

import cv2
import numpy as np

from cotarget.config import TargetProfile
from cotarget.detection.auto import AutoDetector
from cotarget.detection.background import LEAST_PART
from cotarget.detection.base import Detections, Detector, ExternalDetector
from cotarget.detection.color_template import ColorTemplateDetector
from cotarget.detection.mog2 import FLYING, ON_THE_GROUND, Mog2Detector
from cotarget.detection.network import Network
from cotarget.errors import ConfigError
from cotarget.plugins import is_own, load, reporting

__all__ = [
    "AutoDetector",
    "ColorTemplateDetector",
    "Detections",
    "Detector",
    "ExternalDetector",
    "Mog2Detector",
    "make_detector",
    "make_network",
]


def make_detector(target: TargetProfile, rate_hz: float) -> Detector:
    """Make the detector that a target profile names.

    Args:
        target: target profile.
        rate_hz: nominal frame rate of the camera [Hz].

    Raises:
        ConfigError: a colour target has no usable template, a network cannot be run, or a detector of the user's own
            cannot be imported.
    """
    kind = target.detector
    if is_own(kind):
        where = f"detector '{kind}'"
        return ExternalDetector(reporting(load(kind, where), where))
    if kind == "onnx":
        return ExternalDetector(make_network(target))
    if kind in ("auto", "motion", "speck"):
        least_part = LEAST_PART if kind == "motion" else 0.0
        return AutoDetector(rate_hz, shape=target.shape, least_part=least_part, background=kind != "speck")
    if kind == "mog2":
        return Mog2Detector(FLYING if target.motion == "flying" else ON_THE_GROUND, rate_hz)
    if target.template is None:
        raise ConfigError('a target with detector = "colour" needs a template, a picture of the target')
    if not target.template.exists():
        raise ConfigError(f"{target.template}: no such file; a target's template is a PNG or JPEG of it")
    how = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # as live images are read
    template = cv2.imread(str(target.template), how) if target.template.is_file() else None
    if template is None:
        raise ConfigError(f"{target.template}: is not a picture; a target's template is a PNG or JPEG of it")
    return ColorTemplateDetector(np.asarray(template, dtype=np.uint8))


def make_network(target: TargetProfile) -> Network:
    """Load the network of a target profile.

    Raises:
        ConfigError: there is none, or it cannot be run.
    """
    if target.network is None:
        raise ConfigError('a target with detector = "onnx" needs a table "network" with model = "network.onnx"')
    return Network(target.network)
