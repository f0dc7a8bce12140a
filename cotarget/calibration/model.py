"""Data of a calibration: captures, views, options, the model of a fit, residuals and covariance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from annotated_types import Ge

from cotarget.camera import Intrinsics
from cotarget.geometry import Array, RigidTransform
from cotarget.rig import Image
from cotarget.rig_geometry import FixedCamera, ZoomHead
from cotarget.schema import NotNegative, model

CameraName = Literal["fixed", "zoom"]
CAMERAS: tuple[CameraName, ...] = ("fixed", "zoom")
Count = Annotated[int, Ge(0)]


@dataclass(frozen=True, eq=False)
class View:
    """Corners of the board in one capture; see `Capture` for the other attributes."""

    camera: CameraName
    # all inner corners, row by row from the board's first, (N, 2) [px]; nan for corners that are not seen
    corners_px: Array
    board: int
    pan: float = 0.0
    tilt: float = 0.0
    focal_px: float | None = None
    t: float = 0.0
    source: str | None = None

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """True for corners that are seen, (N,)."""
        return np.isfinite(self.corners_px[:, 0])

    def scaled(self, factor: float) -> "View":
        """Return the view in an image scaled by a factor."""
        if factor == 1.0:
            return self
        focal_px = self.focal_px and self.focal_px * factor
        return replace(self, corners_px=(self.corners_px + 0.5) * factor - 0.5, focal_px=focal_px)

    @property
    def name(self) -> str:
        """Name of the view in messages: its file, or its camera, placement and time."""
        return self.source or f"{self.camera} view of placement {self.board} at t = {self.t:.2f} s"


def unseen(count: int) -> Array:
    """Make the corners of a view in which none is seen, (count, 2), all nan."""
    return np.full((count, 2), np.nan)


@dataclass(frozen=True)
class Capture:
    """One image of a calibration board with the state that the devices reported."""

    image: Image  # image, (H, W, 3) BGR
    camera: CameraName  # camera that took it
    board: int  # number of the board's placement; images with the same number show the board in the same place
    pan: float = 0.0  # reported pan [rad]
    tilt: float = 0.0  # reported tilt [rad]
    focal_px: float | None = None  # nominal focal length of the zoom camera [px]; None for the fixed camera
    t: float = 0.0  # middle of the exposure on the rig's clock [s]
    source: str | None = None  # name of the image's file, or None

    def view(self, corners_px: Array) -> View:
        """Make the view of the capture from the corners found in it, (N, 2) [px]."""
        return View(self.camera, corners_px, self.board, self.pan, self.tilt, self.focal_px, self.t, self.source)


@model
class Rejected:
    """Name of an image or view that was not used, with the reason."""

    name: str
    reason: str


@dataclass(frozen=True)
class Options:
    """Options of a calibration."""

    method: str = "joint"  # "joint", one fit of everything; or "sequential", the paper's method, for comparison
    encoders: bool = False  # joint only: True to fit the encoders' scales and zeros too, with a prior near 1 and 0
    # joint only: True to give undetermined directions a weak prior, so that the calibration goes on with an
    # uncertainty to match; False to refuse them
    regularize: bool = False
    # joint only: number of parts into which the placements are split for the held-out check; 0 for no check
    folds: int = 5


DEFAULT_OPTIONS = Options()


@model
class Residuals:
    """Residuals of a calibration: root mean square distance per point, over all corners of all views used [px]."""

    fixed_rms_px: NotNegative  # rms of the fixed camera's views, each board pose free
    zoom_rms_px: NotNegative  # rms of the zoom camera's views, each board pose free
    # rms of pairs at home over both cameras' points, one board pose per pair; None without pairs
    stereo_rms_px: NotNegative | None
    handeye_rms_px: NotNegative | None  # rms of all zoom views through the head's kinematics; None without a head
    fixed_views: Count  # number of views of the fixed camera used
    zoom_views: Count  # number of views of the zoom camera used
    pairs: Count  # number of placements that both cameras see at home
    outliers: Count = 0  # number of single corners left out of the last fit
    rejected: tuple[Rejected, ...] = ()  # images and views that were not used


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of a calibration's parameters; parameters held in the fit are left out.

        fixed.fx .fy .cx .cy                 [px], of the image size calibrated
        fixed.k1 .k2 .p1 .p2                 without unit; and .k3, where it is significant
        zoom[i].fx ... zoom[i].p2            the same for zoom sample i, counted from 0
        zoom[i].pupil                        [m], for all zoom samples but the first
        T_zoom0_fixed.rx .ry .rz .tx .ty .tz     [rad] and [m]
        T_head_zoom.rx .ry .rz .tx .ty .tz       [rad] and [m]
        head.axis_offset .squareness         [m] and [rad]
        head.pan_scale .tilt_scale           without unit, where they are fitted or considered
        head.pan_zero .tilt_zero             [rad], where they are fitted
        board.warp_x .warp_y                 [m], see `Calibration.board_warp`

    An error (w, d) of a transform (R, t) = T_a_b means exp(w) R and t + d: w turns about the axes of frame a, and t
    changes by d alone.

    Attributes:
        parameters: names of the n parameters.
        matrix: covariance (n, n), in products of the units above.
    """

    parameters: tuple[str, ...]
    matrix: Array

    def scaled(self, factors: Mapping[str, float]) -> "Covariance":
        """Return the covariance after the named parameters are multiplied by factors."""
        by = np.array([factors.get(name, 1.0) for name in self.parameters])
        return Covariance(self.parameters, self.matrix * np.outer(by, by))

    def sigma(self, name: str) -> float:
        """Return the standard deviation of one parameter, in its unit."""
        i = self.parameters.index(name)
        return float(np.sqrt(self.matrix[i, i]))


@model
class HeldOut:
    """Result of the held-out check: how well placements kept out of the fit are predicted.

    The board's pose comes from the fixed camera's view alone, and the mean of its corners in the zoom image is
    predicted. That is what pointing at a target does.
    """

    views: Count  # number of zoom views predicted
    # rms distance between predicted and seen mean, scaled from each view's focal length to the shortest
    measured_px: NotNegative
    predicted_px: NotNegative  # rms distance that the covariance, the jitter and the corners' noise let expect
    corners_rms_px: NotNegative  # rms of single corners of the views kept out, with only the boards' poses fitted
    ratio: NotNegative  # rms of the distances, each over its expected value; 1 for a consistent covariance
    # factor by which the standard deviations were widened, because the measured distance exceeds the predicted
    # one beyond chance; 1 where they agree
    widened: Annotated[float, Ge(1)] = 1.0


@dataclass(frozen=True, eq=False)
class BundleModel:
    """Parameters of a bundle adjustment: the rig's geometry and the boards, which predict the corners of every view."""

    boards: Mapping[int, RigidTransform]  # T_fixed_board by the number of the placement
    fixed: FixedCamera  # fixed camera
    # zoom camera on its head; None while only the fixed camera is modelled. Its T_head_zoom is the identity until
    # it is estimated, and where the head never moves.
    zoom_head: ZoomHead | None = None
    # height of the board's middle above its edges, towards its z, by the bend along x and along y [m]
    warp: tuple[float, float] = (0.0, 0.0)

    @property
    def head(self) -> ZoomHead:
        """`zoom_head` of a model of both cameras."""
        assert self.zoom_head is not None
        return self.zoom_head

    def with_zoom_head(self, **changes: Any) -> "BundleModel":
        """Return the model with fields of its `ZoomHead` replaced."""
        return replace(self, zoom_head=replace(self.head, **changes))

    @property
    def stops(self) -> int:
        """Number of zoom samples."""
        return 0 if self.zoom_head is None else len(self.zoom_head.lens.stops)

    @property
    def lenses(self) -> dict[str, Intrinsics]:
        """Every lens, by the prefix of its parameters' names ("fixed", "zoom[0]")."""
        return {"fixed": self.fixed.lens} | {f"zoom[{i}]": stop for i, stop in enumerate(self.head.lens.stops)}

    def stop_of(self, view: View) -> int | None:
        """Find the zoom sample of a view; None for the fixed camera's."""
        return None if view.camera == "fixed" else stop_of(self.head.lens.nominal_px, view)

    def lens_of(self, view: View) -> Intrinsics:
        """Select the intrinsics with which a view was taken."""
        stop = self.stop_of(view)
        return self.fixed.lens if stop is None else self.head.lens.stops[stop]


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a calibration method."""

    model: BundleModel
    residuals: Residuals
    views: tuple[View, ...]  # views that it used
    has_head: bool  # False if the head never moved, so that T is unknown
    covariance: Covariance | None = None
    jitter: float = 0.0  # standard deviation of the head's true angles about the reported ones [rad]
    held_out: HeldOut | None = None


def stop_of(nominal_px: Sequence[float], view: View) -> int:
    """Find the zoom sample nearest to a view's nominal focal length; the first where the view has none."""
    if view.focal_px is None or not nominal_px:
        return 0
    return int(np.argmin(np.abs(np.log(np.array(nominal_px) / view.focal_px))))
