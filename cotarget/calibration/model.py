"""What a calibration takes and gives: captures, views (the corners of one image), and the calibration itself."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from cotarget.camera import Intrinsics, ZoomLens
from cotarget.errors import CalibrationError
from cotarget.geometry import Array, RigidTransform
from cotarget.pantilt import IDEAL_HEAD, HeadGeometry
from cotarget.rig import Image

STILL = RigidTransform.identity()


CameraName = Literal["fixed", "zoom"]
Progress = Callable[[int, int, str], None]  # done, total, text


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
        corners_px: all inner corners, row by row from the board's first, (N, 2) [px]; nan for those not seen.
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
    def seen(self) -> npt.NDArray[np.bool_]:
        """Which corners are seen, (N,)."""
        return np.isfinite(self.corners_px[:, 0])

    @property
    def name(self) -> str:
        """How to speak of this view: its file, or its camera, placement and pose."""
        return self.source or f"{self.camera} view of placement {self.board} at t = {self.t:.2f} s"


def unseen(count: int) -> Array:
    """The corners of a view in which none is seen, (count, 2)."""
    return np.full((count, 2), np.nan)


@dataclass(frozen=True)
class Rejected:
    """An image, or a view, that was not used, by name, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    Attributes:
        method: "joint", one fit of everything; or "sequential", the paper's, to be compared with.
        encoders: joint only: whether to find the encoders' scales and zeros too, near 1 and 0 by prior knowledge.
        regularize: joint only: whether to go on where the motions leave something open, with an uncertainty that says
        so.
        folds: joint only: into how many parts the placements are split, each kept out once and predicted; 0 for none.
    """

    method: str = "joint"
    encoders: bool = False
    regularize: bool = False
    folds: int = 5


DEFAULT_OPTIONS = Options()


@dataclass(frozen=True)
class Residuals:
    """How well the corners are explained: root mean square distance per point, all corners of all views used [px].

    Attributes:
        fixed_rms_px: the fixed camera's views, each board pose free.
        zoom_rms_px: the zoom camera's views, each board pose free.
        stereo_rms_px: pairs at home, one board pose a pair, over both cameras' points; None without pairs.
        handeye_rms_px: every view of the zoom camera through the head; None without a head.
        outliers: how many single corners were left out of the last fit.
        fixed_views: how many views of the fixed camera were used.
        zoom_views: how many views of the zoom camera were used.
        pairs: how many placements were seen by both cameras at home.
        rejected: what was not used.
    """

    fixed_rms_px: float
    zoom_rms_px: float
    stereo_rms_px: float | None
    handeye_rms_px: float | None
    fixed_views: int
    zoom_views: int
    pairs: int
    outliers: int = 0
    rejected: tuple[Rejected, ...] = ()


@dataclass(frozen=True, eq=False)
class Covariance:
    """What is left uncertain.

    The truth differs from what was found by an error of this covariance. Parameters that were held are left out.

        fixed.fx .fy .cx .cy                 [px], of the image size calibrated
        fixed.k1 .k2 .p1 .p2                 without unit; and .k3, where the corners ask for it
        zoom[i].fx ... zoom[i].p2            the same of the zoom lens's stop i, counted from 0
        zoom[i].pupil                        [m], of all stops but the first
        T_zoom0_fixed.rx .ry .rz .tx .ty .tz     [rad] and [m]; T_head_zoom.* likewise
        head.axis_offset .squareness         [m] and [rad]
        head.pan_scale .tilt_scale           without unit, where they were asked for
        head.pan_zero .tilt_zero             [rad], where they were asked for
        board.warp_x .warp_y                 [m], see `Calibration.board_warp`

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

    def sigma(self, name: str) -> float:
        """Standard deviation of one parameter."""
        i = self.parameters.index(name)
        return float(np.sqrt(self.matrix[i, i]))


@dataclass(frozen=True)
class HeldOut:
    """How well placements that were kept out of the fit are predicted, each of some folds in its turn.

    The board's place comes from the fixed camera's view alone; where it then appears to the zoom camera, on average
    over its corners, is what pointing at a target means.

    Attributes:
        views: how many views of the zoom camera were predicted.
        measured_px: rms distance between predicted and seen, at each view's own focal length brought to the shortest.
        predicted_px: what the covariance, the jitter and the corners' noise let expect of that.
        corners_rms_px: rms of single corners of all views kept out, with only their board's pose fitted.
        ratio: rms of every distance over what was expected of it; 1 where the uncertainty is honest.
        widened: factor by which the standard deviations were widened, because the measured distance was larger than
            predicted beyond chance; 1 where they agree.
    """

    views: int
    measured_px: float
    predicted_px: float
    corners_rms_px: float
    ratio: float
    widened: float = 1.0


@dataclass(frozen=True, eq=False)
class RigModel:
    """Everything that determines where corners appear.

    Attributes:
        fixed: the fixed camera, None while only the zoom camera is looked at.
        zoom: the zoom camera, None while only the fixed camera is looked at.
        gamma: T_zoom0_fixed, at the first stop.
        hand: T_head_zoom, at the first stop.
        head: the pan-tilt unit's geometry.
        boards: T_fixed_board by the number of the placement.
        warp: by how much the board's middle stands out towards its z from its edges along x, and along y [m].
    """

    boards: Mapping[int, RigidTransform]
    fixed: Intrinsics | None = None
    zoom: ZoomLens | None = None
    gamma: RigidTransform = STILL
    hand: RigidTransform = STILL
    head: HeadGeometry = IDEAL_HEAD
    warp: tuple[float, float] = (0.0, 0.0)

    @property
    def stops(self) -> int:
        """How many stops the zoom lens has here."""
        return 0 if self.zoom is None else len(self.zoom.stops)

    @property
    def focal_px(self) -> dict[str, float]:
        """Focal length of every lens [px], by how the names of its parameters begin."""
        found = {} if self.fixed is None else {"fixed": self.fixed.focal_px[0]}
        stops = () if self.zoom is None else self.zoom.stops
        return found | {f"zoom[{i}]": stop.focal_px[0] for i, stop in enumerate(stops)}

    def lens_of(self, view: View) -> Intrinsics:
        """The intrinsics with which a view was taken.

        Raises:
            CalibrationError: there is no model of its camera.
        """
        if view.camera == "fixed" and self.fixed is not None:
            return self.fixed
        if view.camera == "zoom" and self.zoom is not None:
            return self.zoom.stops[stop_of(self.zoom.nominal_px, view)]
        raise CalibrationError(f"there are views of the {view.camera} camera, but no model of it")


@dataclass(frozen=True, eq=False)
class Solution:
    """What a method found: the model (every placement's board in it), residuals, and the views it used."""

    model: RigModel
    residuals: Residuals
    views: tuple[View, ...]
    has_head: bool
    covariance: Covariance | None = None
    jitter: float = 0.0
    held_out: HeldOut | None = None


def stop_of(nominal_px: Sequence[float], view: View) -> int:
    """The stop that is nearest to a view's nominal focal length; the first where none was told."""
    if view.focal_px is None or not nominal_px:
        return 0
    return int(np.argmin(np.abs(np.log(np.array(nominal_px) / view.focal_px))))
