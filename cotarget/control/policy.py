"""What a learnt policy sees and what its actions mean, on the scale of the task.

Angles are counted in half-widths of the present close-up, and focal lengths in logarithms. So the same numbers mean the
same at every focal length and distance, and on every rig. All of it follows from what the controller has too: the aim,
the head's motion when a command given now takes effect, and the lens.

The functions work on one rig, or on many at once along the last axis.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cotarget.control.head import HeadSettings
from cotarget.errors import ConfigError, install_extra
from cotarget.geometry import Array
from cotarget.rig import PanTiltLimits

ZOOM_UNIT = 0.1  # change of the logarithm of the focal length that a unit of an action commands in a frame
FARTHEST = 5.0  # offset beyond which a feature is clipped: the head is then at full speed [half-widths]
FASTEST = 4.0  # the same for speeds [half-widths a frame]
ZOOMED = 4.0  # the same for logarithms of focal lengths
LONGEST_UNSEEN_S = 1.0
LONGEST_REASON = 200  # of what onnxruntime says of a file [characters]

# Features of the task with their ranges. Offsets, rates and the command are 0 without a confirmed track.
TASK_FEATURES = {
    "known": (0.0, 1.0),  # whether there is a confirmed track
    "unseen_s": (0.0, LONGEST_UNSEEN_S),  # time since its last detection
    "pan_off": (-FARTHEST, FARTHEST),  # aim less the head, when a command given now takes effect [half-widths]
    "tilt_off": (-FARTHEST, FARTHEST),
    "zoom_off": (-ZOOMED, ZOOMED),  # logarithm of the aim's focal length over the commanded one
    "pan_rate": (-FASTEST, FASTEST),  # rate of the aim [half-widths a frame]
    "tilt_rate": (-FASTEST, FASTEST),
    "zoom_rate": (-1.0, 1.0),  # rate of the logarithm of the aim's focal length [1/frame]
    "pan_speed": (-FASTEST, FASTEST),  # speed of the head, when a command given now takes effect [half-widths a frame]
    "tilt_speed": (-FASTEST, FASTEST),
    "zoom_left": (-ZOOMED, ZOOMED),  # logarithm of the commanded focal length over the lens's
    "pan": (-1.0, 1.0),  # the aim as an absolute action
    "tilt": (-1.0, 1.0),
    "focal": (-1.0, 1.0),
}
Numbers = npt.NDArray[Any]  # features or actions, of any precision
OF_TRACK = [name not in ("pan_speed", "tilt_speed", "zoom_left") for name in TASK_FEATURES]
LOWEST, HIGHEST = np.array(list(TASK_FEATURES.values()), dtype=np.float32).T
PAN_OFF, PAN_RATE = (list(TASK_FEATURES).index(name) for name in ("pan_off", "pan_rate"))
OFF, RATE = slice(PAN_OFF, PAN_OFF + 3), slice(PAN_RATE, PAN_RATE + 3)


@dataclass(frozen=True)
class Situation:
    """Head and lens as a command given now finds them.

    Attributes:
        pan_tilt: pan and tilt when it takes effect [rad], (2, ...).
        speeds: rates of these [rad/s], (2, ...).
        commanded: logarithm of the last commanded focal length [px], (...).
        focal: logarithm of the lens's focal length [px], (...).
        half_width: half the horizontal angle of view, as an angle per pixel times pixels [rad], (...).
        interval: time between frames [s].
    """

    pan_tilt: Array
    speeds: Array
    commanded: Array
    focal: Array
    half_width: Array
    interval: float


def task_features(
    aim: Array, then: Array, command: Array, known: Array, unseen_s: Array, now: Situation
) -> npt.NDArray[np.float32]:
    """Compute the TASK_FEATURES, (..., 14).

    Args:
        aim: pan, tilt [rad] and logarithm of the focal length [px] that show the target centred and as large as wanted
            when a command given now takes effect, (3, ...); anything where it is not known.
        then: the same a frame later.
        command: the aim as an absolute action, (3, ...).
        known: whether there is a confirmed track, (...).
        unseen_s: time since its last detection [s], (...).
        now: head and lens.
    """
    off, rate = aim - np.stack([*now.pan_tilt, now.commanded]), then - aim
    off[:2] /= now.half_width
    rate[:2] /= now.half_width
    speeds = now.speeds * (now.interval / now.half_width)
    rows = [known, unseen_s, *off, *rate, *speeds, now.commanded - now.focal, *command]
    found = np.stack(rows, axis=-1)
    if not np.all(known):
        found = np.where(np.logical_or(np.asarray(known, bool)[..., None], np.logical_not(OF_TRACK)), found, 0.0)
    return np.minimum(np.maximum(found.astype(np.float32), LOWEST), HIGHEST)


# Part of the offset that the proportional controller corrects in a frame; the comparison: docs/design-notes.md.
GAIN = 0.25


def proportional(features: Numbers) -> Array:
    """Follow the aim at its rate, correct a part of the offset a frame, and zoom to the wanted size.

    Args:
        features: TASK_FEATURES, (..., 14). Without a track those of the aim are 0, so that head and lens stand.

    Returns:
        Actions "rates", (..., 3).
    """
    action = features[..., RATE] + GAIN * features[..., OFF]
    action[..., 2] = features[..., OFF][..., 2] / ZOOM_UNIT
    return np.clip(action, -1.0, 1.0)


def moved_aim(features: Numbers, action: Numbers) -> Array:
    """Move the aim by an action, in half-widths and zoom units, and follow it by the proportional controller."""
    moved = np.array(features)
    moved[..., OFF] += np.clip(action, -1.0, 1.0) * (1.0, 1.0, ZOOM_UNIT)
    return proportional(moved)


def rates_of(action: Numbers, half_width: Array, interval: float) -> Array:
    """Rates of pan and tilt [rad/s], (2, ...), of actions (..., 3); a unit is half a close-up's width a frame."""
    pan_tilt = np.clip(np.moveaxis(np.asarray(action, dtype=float), -1, 0)[:2], -1.0, 1.0)
    return pan_tilt * (half_width / interval)


def zoomed(action: Numbers, focal: Array | float, shortest: float, longest: float) -> Array:
    """Change the logarithm of a commanded focal length by an action (..., 3), within the lens's range [px]."""
    wanted = focal + ZOOM_UNIT * np.clip(np.asarray(action, dtype=float)[..., 2], -1.0, 1.0)
    return np.clip(wanted, math.log(shortest), math.log(longest))


def ahead_s(limits: PanTiltLimits, interval: float) -> float:
    """How long the head goes on at a rate if no further command comes [s]; one that jumps goes a frame at a time."""
    if any(math.isinf(axis.speed) for axis in limits.axes):
        return interval
    return max(HeadSettings.ahead_s, HeadSettings.frames_ahead * interval)


ENVIRONMENT = "cotarget/Follow-v1"
FILE_ACTIONS = ("rates", "residual")  # actions that a policy's file may have


class OnnxPolicy:
    """A learnt policy as an ONNX file, from TASK_FEATURES to actions.

    The file has one input (n, 14) and one output (n, 3), both float32, its normalisation inside, and the metadata
    `environment` and `action`.

    Attributes:
        path: the file.
        action: what its actions mean, "rates" or "residual".
    """

    def __init__(self, path: Path) -> None:
        """Load a file and run it once.

        Raises:
            ConfigError: there is no such file, it is no such policy, or onnxruntime is not installed.
        """
        if not path.is_file():
            raise ConfigError(f"{path}: no such file; give a policy as an ONNX file")
        try:
            import onnxruntime  # type: ignore[import-untyped,unused-ignore]
        except ImportError:
            raise ConfigError(f"{path}: needs onnxruntime: {install_extra('onnx')}") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # the network is small
        options.log_severity_level = 4  # errors are raised as well
        try:
            self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ConfigError(f"{path}: is no ONNX file: {' '.join(str(error).split())[:LONGEST_REASON]}") from None
        about = self._session.get_modelmeta().custom_metadata_map
        self.path, self.action = path, about.get("action", "")
        if about.get("environment") != ENVIRONMENT or self.action not in FILE_ACTIONS:
            raise ConfigError(
                f"{path}: is no policy of {ENVIRONMENT}: its metadata need environment = {ENVIRONMENT} and action = "
                f"{' or '.join(FILE_ACTIONS)}, as experiments.learning.train writes them"
            )
        try:
            fits = self(np.zeros(len(TASK_FEATURES))).shape == (3,)
        except Exception:
            fits = False
        if not fits:
            raise ConfigError(f"{path}: does not turn {len(TASK_FEATURES)} features into 3 numbers, in float32")

    def __call__(self, features: Numbers) -> Numbers:
        """Give the actions (..., 3) of features (..., 14)."""
        rows = np.asarray(features, np.float32).reshape(-1, len(TASK_FEATURES))
        (found,) = self._session.run(None, {self._session.get_inputs()[0].name: rows})
        return np.asarray(found).reshape(*np.shape(features)[:-1], -1)

    def rates(self, features: Numbers) -> Numbers:
        """Give actions "rates" for features."""
        action = self(features)
        return moved_aim(features, action) if self.action == "residual" else action
