"""Read rig.toml into frozen dataclasses; unknown keys are refused with the valid ones named.

Values keep the units of the file, because people edit it: metres and degrees, and millimetres if a name says so. The
defaults of [sim] are the rig for which the project's figures are stated; those of [hardware] are a PTU-D46-17.5 as it
leaves the factory, an Axis 241Q, and a Canon PowerShot S5 IS.

The types of the fields say what a value may be, see `cotarget.schema`. `check_config` then refuses combinations of
values that make no sense.
"""

import math
import re
import tomllib
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from annotated_types import Ge, Gt, Interval, Le

from cotarget.errors import ConfigError, choices, naming
from cotarget.files import assets_dir
from cotarget.geometry import pose
from cotarget.plugins import FORM, is_own, locate
from cotarget.safety.stop_file import locate_stop_file
from cotarget.schema import (
    ASCENDING,
    Check,
    FilePath,
    InFolder,
    Limits,
    NotEmptyPath,
    NotNegative,
    Pair,
    Pose,
    Positive,
    Size,
    as_table,
    model,
    validate,
)
from cotarget.sim.targets import KINDS

LARGEST_SQUARE_M = 2.0  # a larger one is in millimetres
FEWEST_CORNERS, MOST_CORNERS = 3, 100  # corners along a side of a board


def check_config(config: "RigConfig") -> None:
    """Check a configuration that was made in Python as one that is read from a file.

    Raises:
        ConfigError: a value is refused; the message names the key.
    """
    validate(RigConfig, as_table(config), "")
    check_corners(config.board)


def check_square(square: float, where: str) -> None:
    """Refuse the side of a board's square [m] that was given in millimetres.

    Raises:
        ConfigError: the side is refused; the message names the option or key ``where``.
    """
    if square > LARGEST_SQUARE_M:
        raise ConfigError(f"{where}: {square:g} m is too large for a board's square; 25 mm are 0.025")


def check_corners(board: "BoardConfig") -> None:
    """Refuse a board with too few or too many corners, and a chessboard that looks the same upside down.

    Raises:
        ConfigError: the board is refused; the message names the key.
    """
    columns, rows = board.corners
    if min(columns, rows) < FEWEST_CORNERS:
        raise ConfigError(f"board.corners: {columns}x{rows} has fewer than {FEWEST_CORNERS} corners a side")
    if max(columns, rows) > MOST_CORNERS:
        raise ConfigError(f"board.corners: {columns}x{rows} has more than {MOST_CORNERS} corners a side")
    if board.kind == "chessboard" and (columns + rows) % 2 == 0:
        raise ConfigError(
            f"board.corners: {columns}x{rows} looks the same upside down; "
            f"one count must be odd and the other even, like {columns}x{rows + 1}"
        )


# The [sim] tables

# Largest values [mm, degrees, Hz, grey levels]; beyond them another unit was meant.
MOST_AXIS_OFFSET_MM, MOST_SQUARENESS_DEG, MOST_RATE_HZ, MOST_NOISE = 1000.0, 45.0, 1000.0, 255.0
Focal = Annotated[tuple[Positive, Positive], "[fx, fy]"]
Center = Annotated[Pair, "[u, v]"]
Distortion = Annotated[tuple[float, float, float, float, float], "[k1, k2, p1, p2, k3]"]
Waypoint = Annotated[tuple[float, float, float, float], "[t, x, y, z]"]
# Coefficients of s, s^2, s^3 ...: a curve that is 0 at the shortest focal length.
Curve = Annotated[tuple[float, ...], "[of s, of s^2, ...]"]


@model
class SimCamera:
    """The simulated fixed camera: true intrinsics, sensor and link.

    Attributes:
        size: image size; the field of view stays the same where ``focal_px`` is not given [px].
        focal_px: true focal length; by default it grows with the image's width [px].
        center_px: true principal point; by default it keeps its place relative to the image's centre [px].
        distortion: true Brown-Conrady coefficients in OpenCV's order.
        noise: standard deviation of the sensor's noise [grey levels].
        rate_hz: frames per second.
        latency_s: time from light to frame [s].
        exposure_s: exposure time, during which motion blurs the image; 0 for an instant [s].
        jpeg_quality: JPEG quality.
    """

    size: Size = (640, 480)
    focal_px: Focal = (686.0, 684.0)
    center_px: Center = (325.0, 239.0)
    distortion: Distortion = (-0.2, 0.0, 0.0, 0.0, 0.0)
    noise: Annotated[NotNegative, Le(MOST_NOISE)] = 2.0
    rate_hz: Annotated[Positive, Le(MOST_RATE_HZ)] = 25.0
    latency_s: NotNegative = 0.06
    exposure_s: NotNegative = 0.0
    jpeg_quality: Annotated[int, Interval(ge=1, le=100)] = 90

    def fitted(self, size: Size, focal_px: Focal | None) -> dict[str, Any]:
        """Scale focal length and principal point to an image size [px]; without a focal length, keep the view."""
        by = self._gain(size, focal_px)
        return {
            "focal_px": tuple(by * focal for focal in self.focal_px),
            "center_px": tuple(
                (new - 1) / 2 + by * (at - (old - 1) / 2)
                for at, old, new in zip(self.center_px, self.size, size, strict=True)
            ),
        }

    def _gain(self, size: Size, focal_px: Focal | None) -> float:
        """Ratio of pixels per angle to those of the default; more or fewer pixels at the sides do not change it."""
        return size[0] / self.size[0] if focal_px is None else focal_px[0] / self.focal_px[0]


@model
class SimZoomCamera(SimCamera):
    """The simulated zoom camera; ``focal_px``, ``center_px`` and ``distortion`` hold at the shortest focal length.

    The effect "optics" adds the four curves. A curve [c1, c2, ...] is the polynomial c1 s + c2 s^2 + ... in
    s = ln(nominal / shortest) / ln(longest / shortest), which runs from 0 to 1. The defaults are as large as those of a
    12x consumer zoom, and no cubic fits them.

    Attributes:
        focal_px: true focal length; by default it grows with the image's width, and with focal_mm / pitch_mm [px].
        focal_mm: shortest and longest nominal focal length; by default it grows with ``pitch_mm`` [mm].
        pitch_mm: nominal size of a pixel; focal_mm / pitch_mm is what the device reports; by default it fits
            ``focal_px`` [mm].
        lens_steps: number of lens positions, evenly spaced in the logarithm of the focal length.
        lens_speed: lens positions per second.
        focal_curve: relative change of the ratio of true to nominal focal length.
        center_drift_px: curves by which the principal point's u and v move [px].
        distortion_drift: change of k1 in the image, in tangents at the shortest focal length.
        pupil: forward movement of the entrance pupil along the optical axis [m].
    """

    focal_px: Focal = (692.0, 693.0)
    center_px: Center = (326.0, 235.0)
    distortion: Distortion = (-0.1, 0.0, 0.0, 0.0, 0.0)
    focal_mm: Annotated[tuple[Positive, Positive], "[lowest, highest]", ASCENDING] = (6.0, 72.0)
    pitch_mm: Positive = 0.009
    lens_steps: Annotated[int, Ge(2)] = 129
    lens_speed: Positive = 129.0
    focal_curve: Curve = (0.13, 0.14, -1.76, 2.39, -0.91)
    center_drift_px: tuple[Curve, Curve] = ((27.0, 85.0, -322.0, 268.0, -62.0), (-7.0, -4.0, -92.0, 195.0, -102.0))
    distortion_drift: Curve = (0.4, 0.04, -0.88, 0.62, -0.05)
    pupil: Curve = (0.03, 0.06, -0.9, 1.17, -0.44)

    def fitted(self, size: Size, focal_px: Focal | None) -> dict[str, Any]:
        """Scale to an image size, with pixel pitch and drift of the principal point: more pixels are smaller ones."""
        by = self._gain(size, focal_px)
        return {
            **super().fitted(size, focal_px),
            "pitch_mm": self.pitch_mm / by,
            "center_drift_px": tuple(tuple(by * c for c in curve) for curve in self.center_drift_px),
        }


@model
class SimHead:
    """The simulated pan-tilt head; the defaults are a stock PTU-D46-17.5 with the geometry of a real, imperfect unit.

    Attributes:
        step_deg: step size; 0 for a continuous head [degrees].
        pan_deg: range of pan [degrees].
        tilt_deg: range of tilt [degrees].
        speed_deg_s: highest speed [degrees/s].
        accel_deg_s2: acceleration [degrees/s^2].
        command_delay_s: time from a command to the start of motion [s].
        axis_offset_mm: dz, distance between the axes along the pan frame's z [mm].
        squareness_deg: eps, deviation of the angle between the axes from 90 degrees [degrees].
        backlash_deg: play of each axis [degrees].
    """

    step_deg: NotNegative = 0.0514286
    pan_deg: Limits = (-158.9, 158.9)
    tilt_deg: Limits = (-46.6, 31.1)
    speed_deg_s: Positive = 149.0
    accel_deg_s2: Positive = 206.0
    command_delay_s: NotNegative = 0.04
    axis_offset_mm: Annotated[float, Interval(ge=-MOST_AXIS_OFFSET_MM, le=MOST_AXIS_OFFSET_MM)] = 5.0
    squareness_deg: Annotated[float, Interval(ge=-MOST_SQUARENESS_DEG, le=MOST_SQUARENESS_DEG)] = 0.1
    backlash_deg: NotNegative = 0.0


@model
class SimEffects:
    """Switches of the effects by which the simulation departs from an ideal rig.

    ``all = true`` or ``all = false`` sets every switch that is not named, except ``shadows`` and ``multisampling``.

    Attributes:
        noise: sensor noise.
        jpeg: JPEG compression.
        distortion: lens distortion of both cameras.
        latency: time from light to frame.
        blur: motion blur during the exposure.
        command_delay: time from a command to the start of motion.
        profile: finite speed and acceleration of the head.
        steps: step size of the head.
        axes: axis offset and non-squareness of the head.
        backlash: play of the head's axes.
        lens: positions and travel time of the zoom lens.
        optics: curves of focal length, principal point, distortion and entrance pupil over the zoom range. Without them
            the distortion coefficients are constant, so that the image's distortion vanishes as the field narrows.
        scatter: true sizes that differ from the nominal sizes.
        shadows: cast shadows; rendering takes two to four times as long.
        multisampling: antialiasing with 4 samples.
        clutter: swaying foliage, drifting clouds, moving shadows and changing light in the outdoor scene.
    """

    noise: bool = True
    jpeg: bool = True
    distortion: bool = True
    latency: bool = True
    blur: bool = True
    command_delay: bool = True
    profile: bool = True
    steps: bool = True
    axes: bool = True
    backlash: bool = True
    lens: bool = True
    optics: bool = True
    scatter: bool = True
    shadows: bool = False
    multisampling: bool = True
    clutter: bool = False


# Offsets like those of the paper's rig: cameras 0.4 m apart, a few degrees between them, and the zoom camera mounted on
# the unit with a lever of some ten centimetres.
DEFAULT_GAMMA = pose([-0.40, 0.03, 0.06], [0.8, -1.9, 0.6])
DEFAULT_T = pose([0.02, -0.08, 0.05], [0.7, -1.4, 0.5])


def _scene(name: str, folder: Path) -> str:
    """Complete the path of a scene's file; the name of a built-in scene stays."""
    return str(folder / name) if (folder / name).is_file() else name


@model
class SimConfig:
    """The simulated world.

    Attributes:
        scene: "outdoor", "indoor", or the path of an MJCF file with a site ``fixed_mount``; relative to rig.toml.
        seed: seed of everything random.
        targets: targets in the scene: "book", "person", "bird", names of ``[sim.models]``, and further ones of a kind
            with a number from 2 on, such as "bird2".
        T_zoom0_fixed: the true Gamma of the paper, at the shortest focal length.
        T_head_zoom: the true T of the paper, at the shortest focal length.
        fixed: the fixed camera.
        zoom: the zoom camera.
        head: the pan-tilt head.
        effects: switches of effects.
        models: models of own targets: a mesh in metres (.obj, .stl; x forward, z up) or an MJCF file (.xml) with one
            body; relative to rig.toml.
        paths: path of a target in place of the built-in one: waypoints of the body's centre, in seconds and metres of
            the world, joined by a smooth curve.
    """

    scene: Annotated[str, InFolder(_scene)] = "outdoor"
    seed: Annotated[int, Ge(0)] = 0
    targets: tuple[str, ...] = ()
    T_zoom0_fixed: Pose = DEFAULT_GAMMA
    T_head_zoom: Pose = DEFAULT_T
    fixed: SimCamera = SimCamera()
    zoom: SimZoomCamera = SimZoomCamera()
    head: SimHead = SimHead()
    effects: SimEffects = SimEffects()
    models: Mapping[str, FilePath] = field(default_factory=dict)
    paths: Mapping[str, tuple[Waypoint, ...]] = field(default_factory=dict)


# Switches of the rendering's quality, which are no effects of a real rig and which `all` does not set.
QUALITY = ("multisampling", "shadows")
ALL = "all"


def _expand_all(effects: Mapping[str, Any]) -> dict[str, Any]:
    """Expand ``all`` to every switch of [sim.effects] that is not named; refuse an unknown switch."""
    switches = {f.name for f in fields(SimEffects)}
    if unknown := sorted(set(effects) - switches - {ALL}):
        raise ConfigError(f"unknown key 'sim.effects.{unknown[0]}'; valid here: {choices({*switches, ALL})}")
    named = dict(effects)
    every = named.pop(ALL, None)
    if every is None:
        return named
    if not isinstance(every, bool):
        raise ConfigError(f"sim.effects.all: {every!r} is not true or false")
    return {f.name: every for f in fields(SimEffects) if f.name not in QUALITY} | named


def _fit_sizes(sim: SimConfig, given: Mapping[str, Any]) -> SimConfig:
    """Scale the cameras' defaults to the image size or focal length of a [sim] table; keys given there stay."""
    cameras: dict[str, SimCamera] = {}
    for name, camera in (("fixed", sim.fixed), ("zoom", sim.zoom)):
        keys = given.get(name, {})
        # Nothing changes if size and focal length are the defaults.
        scaled = type(camera)().fitted(camera.size, camera.focal_px if "focal_px" in keys else None)
        if isinstance(camera, SimZoomCamera):
            scaled |= _fit_focal(camera, scaled, keys)
        cameras[name] = replace(camera, **{key: value for key, value in scaled.items() if key not in keys})
    return replace(sim, **cameras)  # type: ignore[arg-type]


def _fit_focal(zoom: SimZoomCamera, scaled: Mapping[str, Any], given: Iterable[str]) -> dict[str, Any]:
    """Fit what is not given of focal_px, focal_mm and pitch_mm, so that focal_px is near focal_mm / pitch_mm."""
    larger = zoom.pitch_mm / scaled["pitch_mm"] if "pitch_mm" in given else 1.0
    if "focal_mm" not in given:
        return {"focal_mm": tuple(larger * focal for focal in zoom.focal_mm)}
    longer = zoom.focal_mm[0] / SimZoomCamera.focal_mm[0]
    if "focal_px" not in given:
        return {"focal_px": tuple(longer / larger * focal for focal in scaled["focal_px"])}
    return {"pitch_mm": longer * scaled["pitch_mm"]}


def split_name(name: str) -> tuple[str, int]:
    """Split a target's name into kind and number: ("bird", 1) for ``bird``, ("bird", 2) for ``bird2``."""
    number = re.search(r"(?<=\D)([2-9]|[1-9]\d+)\Z", name)
    return (name, 1) if number is None else (name[: number.start()], int(number[0]))


def known_targets(own: Iterable[str] = ()) -> str:
    """Format the names of the simulation's targets and of [sim.models], for messages."""
    return (
        f"the simulation has: {choices([*KINDS, *own])}, and further ones with a number, as 'bird2'; others need a "
        "model: [sim.models]"
    )


# The [hardware] tables


def _located(device: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    """Replace the module of a user's own driver by its file, where that is in the folder."""
    driver = device.get("driver")
    return {**device, "driver": locate(driver, folder)} if isinstance(driver, str) else device


Table = Annotated[Mapping[str, Any], InFolder(_located)]


@model
class HardwareConfig:
    """The real devices. The tables hold what rig.toml says; a device's driver says what it may be.

    Attributes:
        head: the pan-tilt head.
        fixed: the fixed camera.
        zoom: the zoom camera on the head.
        ptz: zoom camera and head in one housing, in place of `head` and `zoom`.
        board: how the calibration board is presented.
    """

    head: Table = field(default_factory=dict)
    fixed: Table = field(default_factory=dict)
    zoom: Table = field(default_factory=dict)
    ptz: Table = field(default_factory=dict)
    board: Table = field(default_factory=dict)


ENCODING = "utf-8-sig"  # UTF-8 with or without the byte order mark that some editors write


BoardKind = Literal["chessboard", "charuco"]
BoardCorners = Annotated[tuple[int, int], "[columns, rows]"]


@model
class BoardConfig:
    """The calibration board.

    Attributes:
        kind: a plain chessboard, or a ChArUco board, which is also found where only a part of it is visible.
        corners: number of inner corners; of a chessboard one number is odd and the other even, so that its orientation
            is unique.
        square: side of a square, as measured on the print [m].
    """

    kind: BoardKind = "chessboard"
    corners: BoardCorners = (9, 6)
    square: Positive = 0.1


@model
class WrittenBoard:
    """A board as the program writes it; a default in place of a lost key would change the scale of a calibration."""

    kind: BoardKind
    corners: BoardCorners
    square: Positive

    def config(self) -> BoardConfig:
        """Return the board."""
        return BoardConfig(self.kind, self.corners, self.square)


DETECTORS = ("auto", "colour", "motion", "speck", "mog2", "onnx")


def _detector(name: str) -> str:
    if name not in DETECTORS and not is_own(name):
        raise ValueError(f"{name!r} is neither {FORM} nor one of: {choices(DETECTORS)}")
    return name


DetectorName = Annotated[
    str, '"auto", "colour", "motion", "speck", "mog2", "onnx" or "module:function"', Check(_detector), InFolder(locate)
]


@model
class NetworkConfig:
    """A neural network that finds targets.

    Attributes:
        model: ONNX file with an input of 1 x 3 x height x width, RGB; relative to rig.toml.
        layout: how it writes boxes: "yolo" (YOLOv8 and later), "yolov5" (with objectness), "yolov10"
            (corners, score and class), "ssd" (boxes, labels and scores), "detr", or "rtdetr" (no logit for no target).
        input_px: size of its input [px]; that of the file by default.
        classes: numbers of the classes that are the target; all by default.
        least_score: least score of a detection.
        tiled: whether images larger than the input are also searched in tiles at full resolution, for small targets.
        mean: mean of each channel, subtracted from the pixel values, red first.
        std: standard deviation of each channel, by which the difference is divided.
    """

    model: Annotated[NotEmptyPath, InFolder(lambda path, folder: (folder / path).absolute())]
    layout: Literal["yolo", "yolov5", "yolov10", "ssd", "detr", "rtdetr"] = "yolo"
    input_px: Size | None = None
    classes: tuple[Annotated[int, Ge(0)], ...] = ()
    least_score: Annotated[float, Gt(0), Le(1)] = 0.25
    tiled: bool = False
    mean: Annotated[tuple[float, float, float], "[red, green, blue]"] = (0.0, 0.0, 0.0)
    std: Annotated[tuple[Positive, Positive, Positive], "[red, green, blue]"] = (255.0, 255.0, 255.0)


# Largest roll that boxes do not show [rad]: it makes a slim one a tenth wider, and a stride half as wide again.
LEVEL = math.radians(10.0)
GOOD_SIZE = (0.8, 1.25)  # of `wanted_px`: range in which a close-up counts as of the wanted size


@model
class TargetProfile:
    """What is known of a target before it is seen.

    Attributes:
        size: true size of the dimension below [m].
        dimension: the dimension that ``size`` gives; a wingspan is the larger side of the target's box.
        wanted_px: size of that dimension in the close-up [px].
        detector: how the fixed camera's images are searched: "auto" finds what moves or stands out, from 3 px to half
            the image's width, "motion" the same for targets of at least 24 px in an image 640 px wide, "speck" the same
            without a background model, "colour" matches a template, "mog2" is the paper's plain background subtraction,
            "onnx" is a neural network; or a function of your own from an image to boxes, in a module beside rig.toml or
            on Python's path.
        template: picture of the target, cut to its outline, for the detector "colour"; relative to rig.toml.
        motion: motion model; "general" covers anything that moves by itself.
        shape: expected width over height of the target's box; none if it is unknown or changes.
        network: the network of the detector "onnx".
    """

    size: Positive
    dimension: Literal["width", "height", "wingspan"]
    wanted_px: Positive
    detector: DetectorName = "auto"
    template: FilePath | None = None
    motion: Literal["standing", "walking", "flying", "general"] = "general"
    shape: Positive | None = None
    network: NetworkConfig | None = None

    @property
    def matcher(self) -> Literal["box", "upright", "outline"]:
        """What gives the point of the body that both cameras measure: the detector's box or the target's outline.

        The box of a matched template is exact. Of an upright target, narrower than high, the outline gives the middle
        across and the box the middle in height; of any other target, the outline gives both.
        """
        if self.detector == "colour":
            return "box"
        return "upright" if self.shape is not None and self.shape < 1 else "outline"

    @property
    def largest_over_time(self) -> bool:
        """Whether the dimension shows as the largest size over some time, as a wingspan does over a wing beat."""
        return self.dimension == "wingspan"

    def is_vertical(self) -> bool:
        """Whether the dimension is a height, along the vertical, and not across it."""
        return self.dimension == "height"

    def turn(self, width: float, height: float, roll: float) -> float:
        """Find the angle from the image's v axis to the target's own vertical axis, by the shape of its box [rad].

        The axis lies between the v axis and the head's pan axis, because either may be the vertical: a camera may be
        mounted sideways, or the head. The box of an ellipse of the usual shape says where, from a roll of `LEVEL` on;
        below, it is the v axis. Without a usual shape, and for a template, whose box does not turn with it, it is the
        pan axis.

        Args:
            width: width of the box, above 0.
            height: height of the box, in the same unit, above 0.
            roll: angle from the v axis to the pan axis, as the image shows it, within a quarter turn [rad].
        """
        if self._slimness is None:
            return roll
        if abs(roll) < LEVEL:
            return 0.0
        box, usual, slim = (width / height) ** 2, self._slimness**2, math.copysign(1.0, 1 - self._slimness)
        over, under = slim * (box - usual), slim * (1 - box * usual)
        turned = 0.0 if over <= 0 else math.atan2(math.sqrt(over), math.sqrt(max(under, 0.0)))
        return math.copysign(min(turned, abs(roll)), roll)

    def length(self, width: float, height: float, roll: float = 0.0) -> float:
        """Measure the dimension along the target's own axis, by its box; arguments as for `turn`.

        A wingspan is the larger side in any camera: over a wing beat, a box of spread wings is as large across.
        """
        if self.dimension == "wingspan":
            return max(width, height)
        turn = self.turn(width, height, roll)
        c, s = math.cos(turn), abs(math.sin(turn))
        along, other = (height, width) if self.is_vertical() else (width, height)
        nearest, c, s = (along, c, s) if c >= s else (other, s, c)
        if self._slimness is None:
            return nearest
        across = self._slimness if self.is_vertical() else 1 / self._slimness
        return nearest / math.hypot(c, across * s)

    @property
    def _slimness(self) -> float | None:
        """Usual width over height of an elliptic outline; None where boxes show no roll."""
        return None if self.matcher == "box" or self.shape == 1 else self.shape

    def sides(self, shape: float, roll: float = 0.0) -> tuple[float, float]:
        """Width and height of a box of a given width over height, relative to the dimension; roll as for `turn`."""
        length = self.length(shape, 1.0, roll)
        return shape / length, 1.0 / length

    def turned(self, sides: Pair, turn: Sequence[Sequence[float]]) -> tuple[float, float]:
        """Width and height of the box of the same outline, turned in the image by a matrix, (2, 2)."""
        across, down = sides
        if self.matcher == "box":  # corners
            width, height = (abs(a) * across + abs(b) * down for a, b in turn)
        else:
            width, height = (math.hypot(a * across, b * down) for a, b in turn)
        return width, height


DEFAULT_TARGETS: Mapping[str, TargetProfile] = types.MappingProxyType(
    {
        "book": TargetProfile(
            0.234, "width", 160.0, "colour", assets_dir() / "textures" / "book_front.png", "standing", 1.38
        ),
        "person": TargetProfile(1.75, "height", 300.0, "motion", motion="walking", shape=0.4),
        "bird": TargetProfile(0.8, "wingspan", 160.0, "speck", motion="flying"),
    }
)


def _file_name(path: Path) -> Path:
    if path.name in ("", ".."):
        raise ValueError(f"'{path}' is a folder; name a file in it, as 'stop'")
    return path


# A head that moves without a frame for longer is not watched; milliseconds were meant for seconds [s].
LONGEST_UNSEEN_S = 60.0


@model
class SafetyConfig:
    """Soft limits of the head, within the device's own, and when the head is halted.

    Attributes:
        pan_deg: range of pan; the device's own by default [degrees].
        tilt_deg: range of tilt; the device's own by default [degrees].
        speed_deg_s: highest speed; the device's own by default [degrees/s].
        max_frame_age_s: a frame older than this is not acted on [s].
        watchdog_s: a head that may be moving is halted after this time without a new frame or command; braking comes on
            top [s].
        stop_file: while this file exists, the head does not move; relative to rig.toml. By default, RIG.stop beside
            RIG.toml for real devices and none for any other rig; ``false`` to do without.
    """

    pan_deg: Limits | None = None
    tilt_deg: Limits | None = None
    speed_deg_s: Positive | None = None
    max_frame_age_s: Annotated[Positive, Le(LONGEST_UNSEEN_S)] = 1.0
    watchdog_s: Annotated[Positive, Le(LONGEST_UNSEEN_S)] = 0.35
    stop_file: Annotated[NotEmptyPath, Check(_file_name)] | None = None


FEWEST_POINTS = 3  # of a polygon


def _point(value: Any) -> Any:
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 2 or not all(type(each) in (int, float) and 0 <= each <= 1 for each in numbers):
        raise ValueError(f"{value!r} is no point; give [u, v] in parts of the image's width and height, from 0 to 1")
    return tuple(numbers)


def _polygon(points: tuple[Pair, ...]) -> tuple[Pair, ...]:
    if len(points) < FEWEST_POINTS:
        raise ValueError(f"{len(points)} points enclose nothing; give three or more, each [u, v]")
    return points


Polygon = Annotated[tuple[Annotated[Pair, Check(_point, before=True)], ...], "[[u, v], ...]", Check(_polygon)]


@model
class FollowConfig:
    """What `cotarget follow` takes where its options do not say, and where it looks for no target.

    Attributes:
        target: name of the target; by default the only one of a simulated scene.
        calibration: the rig's calibration, relative to rig.toml; calibration.json beside rig.toml by default.
        ignored: regions of the fixed camera's image in which nothing is detected, such as a clock, a flag or a road:
            polygons of three or more points, in parts of the image from 0 to 1, u to the right and v down.
        when_idle: what a head that is steered from a page does after nothing was followed for `idle_s`: wait for the
            next target where it is; stand until an order to follow; or go home once, and stand there.
        idle_s: that time [s].
        unattended: whether a head goes on following when the last page closes, or stands.
    """

    target: str | None = None
    calibration: FilePath | None = None
    ignored: tuple[Polygon, ...] = ()
    when_idle: Literal["wait", "stand", "home"] = "wait"
    idle_s: Positive = 30.0
    unattended: Literal["follow", "stand"] = "follow"


@model
class _IgnoredFile:
    """A file of ignored regions alone, see `FollowConfig`."""

    ignored: tuple[Polygon, ...]


def read_ignored(path: Path) -> tuple[Polygon, ...]:
    """Read ignored regions from a file with the one key `ignored`, or from [follow] of a rig.toml.

    Raises:
        ConfigError: the file is missing, is not TOML, holds no region, or has an unknown key or an impossible value.
    """
    tables = read_tables(path)
    if tables.keys() & {each.name for each in fields(RigConfig)}:
        found = config_of(read_text(path), path).follow.ignored
    else:
        with naming(path):
            found = validate(_IgnoredFile, tables, "").ignored
    if not found:
        raise ConfigError(f"{path}: holds no region; give ignored = [[[u, v], [u, v], [u, v]]], or [follow] ignored")
    return found


@model
class RigConfig:
    """All tables of rig.toml.

    Attributes:
        backend: the rig to open: the simulation, the real devices, or a recording.
        sim: the simulated rig.
        hardware: the real devices.
        recording: folder of the recording, for the backend "replay"; relative to rig.toml.
        board: the calibration board.
        safety: limits of motion.
        follow: what to follow, and where to look for nothing.
        targets: target profiles by name.
    """

    backend: Literal["sim", "hardware", "replay"] = "sim"
    sim: SimConfig = field(default_factory=SimConfig)
    hardware: HardwareConfig = field(default_factory=HardwareConfig)
    recording: FilePath | None = None
    board: BoardConfig = field(default_factory=BoardConfig)
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    follow: FollowConfig = field(default_factory=FollowConfig)
    targets: Mapping[str, TargetProfile] = field(default_factory=lambda: dict(DEFAULT_TARGETS))

    def target(self, name: str) -> TargetProfile:
        """Look up a target profile by name; a further one of a kind, such as ``bird2``, defaults to that kind's.

        Raises:
            ConfigError: there is no such target.
        """
        found = _of_kind(self.targets, name)
        if found is None:
            raise ConfigError(f"unknown target '{name}'; the targets are: {choices(self.targets)}")
        return found


def config_of(text: str, path: Path) -> RigConfig:
    """Parse the text of a rig.toml.

    Args:
        text: text of the file, see `read_text`.
        path: path of the file; relative paths are relative to its folder, and messages name it. It is not read.

    Raises:
        ConfigError: the text is malformed, or has an unknown key or an impossible value.
    """
    table = tables_of(text, path)
    try:
        config = parse_config(table, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    stop_file = locate_stop_file(path, config.backend, table.get("safety", {}).get("stop_file"))
    return replace(config, safety=replace(config.safety, stop_file=stop_file))


def read_tables(path: Path) -> dict[str, Any]:
    """Read the tables of a rig.toml without checking them.

    Raises:
        ConfigError: the file is missing or is not TOML.
    """
    return tables_of(read_text(path), path)


def read_text(path: Path) -> str:
    """Read the text of a rig.toml.

    Raises:
        ConfigError: the file is missing or is no text.
    """
    try:
        return path.read_text(encoding=ENCODING)
    except FileNotFoundError:
        what = "no such file; give the path of a rig.toml, or make one: cotarget config > rig.toml"
        raise ConfigError(f"{path}: {what}") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: is a directory; give the path of a rig.toml") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is no text in UTF-8: {error.reason}; give the path of a rig.toml") from None


def tables_of(text: str, path: Path) -> dict[str, Any]:
    """Parse the tables of a rig.toml's text without checking them.

    Raises:
        ConfigError: the text is not TOML; the message names the path.
    """
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from None


def parse_config(table: Mapping[str, Any], folder: Path | None = None) -> RigConfig:
    """Build the configuration from TOML's tables; missing keys keep their defaults.

    `cotarget.backends.check` checks what only a backend knows, such as the simulated world.

    Args:
        table: tables as TOML gives them.
        folder: folder of the file, to which its paths and modules are relative; without it they stay as they are.

    Raises:
        ConfigError: an unknown key or an impossible value.
    """
    table = dict(table)
    targets = dict(DEFAULT_TARGETS)
    given = table.pop("targets", {})
    if not isinstance(given, Mapping):
        raise ConfigError(f"targets: {given!r} is not a table")
    # A kind before its numbered targets, which have its settings.
    for name, values in sorted(given.items(), key=lambda each: split_name(each[0])[1] > 1):
        base = _of_kind(targets, name)
        target = validate(TargetProfile, values, f"targets.{name}", base=base, folder=folder)
        if (target.detector == "onnx") != (target.network is not None):
            raise ConfigError(f'targets.{name}: detector = "onnx" and a table [targets.{name}.network] need each other')
        targets[name] = target
    sim_table = table.get("sim")
    if isinstance(sim_table, Mapping) and isinstance(sim_table.get("effects"), Mapping):
        table["sim"] = {**sim_table, "effects": _expand_all(sim_table["effects"])}
    safety = table.get("safety")
    if isinstance(safety, Mapping) and safety.get("stop_file") is False:
        table["safety"] = {key: value for key, value in safety.items() if key != "stop_file"}
    config = validate(RigConfig, table, "", folder=folder)
    config = replace(config, targets=targets, sim=_fit_sizes(config.sim, table.get("sim", {})))
    check_corners(config.board)
    if config.follow.target is not None:
        with naming("follow.target"):
            config.target(config.follow.target)
    return config


def _of_kind(targets: Mapping[str, TargetProfile], name: str) -> TargetProfile | None:
    """Return the target of that name, or of its kind without the number."""
    return targets.get(name) or targets.get(split_name(name)[0])


def config_table(config: RigConfig) -> dict[str, Any]:
    """Convert a configuration to tables that `parse_config` reads.

    Passwords are left out, and so is what would keep a replay from running, such as the stop file, or is not of the
    rig, such as which target to follow.
    """
    table: dict[str, Any] = as_table(replace(config, recording=None))
    table["safety"].pop("stop_file", None)
    table["follow"] = {"ignored": table["follow"]["ignored"]}
    devices = {name: _without_secrets(device) for name, device in table.pop("hardware").items() if device}
    return table | ({"hardware": devices} if devices else {})


# A password in the path or query of an address, as some cameras want it.
SECRET = re.compile(r"((?:pass|pwd|pw)\w*=)[^&]*", re.IGNORECASE)


def _without_secrets(table: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out a device's password, and the login in an address."""
    kept = {key: value for key, value in table.items() if key != "password"}
    return {key: _without_login(value) if isinstance(value, str) else value for key, value in kept.items()}


def _without_login(text: str) -> str:
    try:
        url = urlsplit(text)
    except ValueError:  # no address
        return text
    text = url._replace(netloc=url.netloc.rpartition("@")[2]).geturl() if "@" in url.netloc else text
    return SECRET.sub(r"\1***", text) if url.netloc else text
