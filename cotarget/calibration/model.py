"""What a calibration takes and gives: captures, views (the corners of one image), and the calibration itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig
from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt import IDEAL_HEAD, HeadGeometry
from cotarget.rig import Image

CameraName = Literal["fixed", "zoom"]


@dataclass(frozen=True)
class Capture:
    """One image of a calibration board and what the devices said when it was taken.

    Attributes:
        image: (H, W, 3) BGR.
        camera: which camera took it.
        board: number of the board's placement; images with the same number show the board in the same place.
        pan: the head's pan [rad].
        tilt: the head's tilt [rad].
        focal_px: nominal focal length of the zoom camera [px]; None for the fixed camera.
        t: middle of the exposure on the rig's clock [s].
        source: name of the image's file, or None.
    """

    image: Image
    camera: CameraName
    board: int
    pan: float = 0.0
    tilt: float = 0.0
    focal_px: float | None = None
    t: float = 0.0
    source: str | None = None


@dataclass(frozen=True, eq=False)
class View:
    """The board's corners in one image; see `Capture` for the other attributes.

    Attributes:
        corners_px: all inner corners, row by row from the board's first, (N, 2) [px].
    """

    camera: CameraName
    corners_px: Array
    board: int
    pan: float = 0.0
    tilt: float = 0.0
    focal_px: float | None = None
    t: float = 0.0
    source: str | None = None

    @property
    def name(self) -> str:
        """How to speak of this view: its file, or its camera, placement and pose."""
        return self.source or f"{self.camera} view of placement {self.board} at t = {self.t:.2f} s"


@dataclass(frozen=True)
class Rejected:
    """An image, or a view, that was not used, by name, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Residuals:
    """How well the corners are explained: root mean square distance per point, all corners of all views used [px].

    Attributes:
        fixed_rms_px: the fixed camera's views, each board pose free.
        zoom_rms_px: the zoom camera's views, each board pose free.
        stereo_rms_px: pairs at home, one board pose a pair, over both cameras' points.
        handeye_rms_px: every view of the zoom camera through the head; None without a head.
        fixed_views: how many views of the fixed camera were used.
        zoom_views: how many views of the zoom camera were used.
        pairs: how many placements were seen by both cameras at home.
        rejected: what was not used.
    """

    fixed_rms_px: float
    zoom_rms_px: float
    stereo_rms_px: float
    handeye_rms_px: float | None
    fixed_views: int
    zoom_views: int
    pairs: int
    rejected: tuple[Rejected, ...] = ()


@dataclass(frozen=True, eq=False)
class Covariance:
    """What the corners' noise leaves uncertain: names of the parameters, n of them, and their covariance (n, n)."""

    parameters: tuple[str, ...]
    matrix: Array


@dataclass(frozen=True, eq=False)
class Calibration:
    """All that targeting needs to know of a rig, and what it was found from.

    Attributes:
        fixed: the fixed camera.
        zoom: the zoom camera over its focal lengths.
        T_zoom0_fixed: the paper's Gamma, at the shortest focal length.
        T_head_zoom: the paper's T, at the shortest focal length; None where there was no head to calibrate.
        head: the pan-tilt unit's own geometry.
        pitch_mm: size of a pixel of the zoom camera [mm], where it is known; only for focal lengths in millimetres.
        residuals: how well the corners are explained, and what was rejected.
        covariance: None where the method gives none.
        board: the board, None for a calibration that comes from no board.
        views: the corners themselves, so that the calibration can be checked and refitted.
        provenance: versions, method, when, from which captures; JSON values only.
    """

    fixed: Intrinsics
    zoom: ZoomLens
    T_zoom0_fixed: RigidTransform
    T_head_zoom: RigidTransform | None
    head: HeadGeometry = IDEAL_HEAD
    pitch_mm: float | None = None
    residuals: Residuals | None = None
    covariance: Covariance | None = None
    board: BoardConfig | None = None
    views: tuple[View, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def for_streams(self, fixed_size: tuple[int, int], zoom_size: tuple[int, int]) -> "Calibration":
        """The same calibration for streams (width, height) [px] that are scaled.

        Raises:
            ConfigError: a stream has another aspect ratio than was calibrated.
        """
        return replace(self, fixed=self.fixed.resized(fixed_size), zoom=self.zoom.resized(zoom_size))
