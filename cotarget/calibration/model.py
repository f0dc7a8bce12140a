"""What a calibration takes and gives: captures, views (the corners of one image), and the calibration itself."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from cotarget.camera import Intrinsics, ZoomLens
from cotarget.config import BoardConfig
from cotarget.errors import CalibrationError
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
    """What the corners' noise leaves uncertain.

    The truth differs from what was found by an error of this covariance. Parameters that were held (k3) are left out.

        fixed.fx .fy .cx .cy                 [px], of the image size calibrated; zoom.* likewise, at the shortest
        fixed.k1 .k2 .p1 .p2                 without unit                        focal length calibrated
        T_zoom0_fixed.rx .ry .rz .tx .ty .tz     [rad] and [m]; T_head_zoom.* likewise
        head.axis_offset head.squareness     [m] and [rad]

    An error (w, d) of a transform (R, t) means exp(w) R and t + d: w turns about the axes of the frame that the
    transform leads to, and leaves t as it is.

    Attributes:
        parameters: names, n of them.
        matrix: (n, n), in products of the units above.
    """

    parameters: tuple[str, ...]
    matrix: Array

    def scaled(self, factors: Mapping[str, float]) -> "Covariance":
        """The same where the parameters named are multiplied by factors."""
        by = np.array([factors.get(name, 1.0) for name in self.parameters])
        return Covariance(self.parameters, self.matrix * np.outer(by, by))


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

    def hand_eye(self) -> RigidTransform:
        """T_head_zoom, for those who cannot do without.

        Raises:
            CalibrationError: there was no head to calibrate.
        """
        if self.T_head_zoom is None:
            raise CalibrationError("this calibration has no T_head_zoom; calibrate on a rig, whose head moves")
        return self.T_head_zoom

    def for_streams(self, fixed_size: tuple[int, int], zoom_size: tuple[int, int]) -> "Calibration":
        """The same calibration for streams (width, height) [px] that are scaled.

        Raises:
            ConfigError: a stream has another aspect ratio than was calibrated.
        """
        covariance = self.covariance
        if covariance is not None:
            s_fixed, s_zoom = fixed_size[0] / self.fixed.size[0], zoom_size[0] / self.zoom.size[0]
            in_pixels = ("fx", "fy", "cx", "cy")
            covariance = covariance.scaled(
                {f"fixed.{k}": s_fixed for k in in_pixels} | {f"zoom.{k}": s_zoom for k in in_pixels}
            )
        pitch_mm = self.pitch_mm and self.pitch_mm * self.zoom.size[0] / zoom_size[0]  # a larger pixel, where binned
        return replace(
            self,
            fixed=self.fixed.resized(fixed_size),
            zoom=self.zoom.resized(zoom_size),
            covariance=covariance,
            pitch_mm=pitch_mm,
        )
