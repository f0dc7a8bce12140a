"""Plausibility of a calibration: find wrong units, exchanged transforms, impossible lenses, and another rig's file.

The limits are far outside of what any rig is built like, so that only mistakes exceed them.
"""

import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from cotarget.board import board_points
from cotarget.calibration.bundle import predict_pixels
from cotarget.calibration.file import Calibration
from cotarget.calibration.initialization import at_home, by_placement, place_boards
from cotarget.calibration.model import BundleModel, View
from cotarget.calibration.uncertainty import model_of
from cotarget.errors import CalibrationError
from cotarget.rig import RigSpec

# Largest lengths [m]. Cameras farther apart do not see one board; a lever or a pupil's way this long carries no camera.
# Given in millimetres, what usual rigs have is beyond all of them: a baseline of 0.4 m, a lever of 30 mm.
LARGEST_M = {
    "T_zoom0_fixed": (20.0, "the cameras are {:.3g} m apart"),
    "T_head_zoom": (3.0, "the zoom camera is {:.3g} m from the head's axes"),
    "head.axis_offset": (1.0, "the head's axes are {:.3g} m apart"),
    "board.square": (2.0, "the board's squares are {:.3g} m large"),
}
LARGEST_PUPIL_M = 1.0
# Focal length over the image's width: from 150 degrees of view to a thousandth of a degree.
FOCAL_WIDTHS = (0.13, 3e4)
LARGEST_ASPECT = 3.0  # of fx and fy; fields of video have 2
# A camera on an arm this long that is longer than the baseline is a baseline that stands in the wrong key.
LONGEST_ARM = 0.3  # [m]
# Typical angle between the corners seen and those predicted [rad]: calibrations leave some thousandths of a degree, and
# with a head that misses by the most that a calibration accepts, two degrees.
USUAL, UNEXPLAINED = math.radians(0.1), math.radians(3.0)
# With T and Gamma exchanged, corners come this many times closer.
BETTER_EXCHANGED = 5.0
CHECKED_PLACEMENTS = 5  # placements whose views are predicted
OTHER_LENS = 1.25  # ratio of focal lengths beyond which a lens is another one


def check_plausible(
    calibration: Calibration, spec: RigSpec | None = None, *, insist: bool = False, where: object = "calibration"
) -> None:
    """Refuse a calibration that no rig has, or that belongs to another rig than the one in use; accept it on insist.

    Raises:
        CalibrationError: it is implausible; the message names ``where`` it is from, and the key in calibration.json.
        ConfigError: a stream has another aspect ratio than that calibrated.
    """
    if not insist and (text := implausibility(calibration, spec)):
        raise CalibrationError(f"{where}: {text}; insist=True uses it all the same")


def implausibility(calibration: Calibration, spec: RigSpec | None = None) -> str:
    """Describe what is implausible about a calibration; empty where nothing is. See `check_plausible`."""
    return (
        _impossible_lens(calibration)
        or _impossible_length(calibration)
        or _contradiction(calibration)
        or ("" if spec is None else _another_rig(calibration, spec))
    )


def _impossible_lens(calibration: Calibration) -> str:
    lenses = {"fixed": calibration.fixed.lens}
    lenses |= {f"zoom.stops[{i}]": stop for i, stop in enumerate(calibration.zoom_head.lens.stops)}
    low, high = FOCAL_WIDTHS
    for where, lens in lenses.items():
        fx, fy = lens.focal_px
        width = lens.size[0]
        if not low * width <= fx <= high * width:
            return (
                f"{where}.fx: {fx:.4g} px in an image {width} px wide is a field of view of "
                f"{math.degrees(2 * math.atan(width / 2 / fx)):.3g} degrees; focal lengths are in pixels"
            )
        if not 1 / LARGEST_ASPECT <= fy / fx <= LARGEST_ASPECT:
            return f"{where}.fy: {fy:.4g} px is far from fx, {fx:.4g} px; both are focal lengths in pixels"
    return ""


def _impossible_length(calibration: Calibration) -> str:
    head = calibration.zoom_head
    lengths = {
        "T_zoom0_fixed": float(np.linalg.norm(head.T_zoom0_fixed.translation)),
        "head.axis_offset": abs(head.axes.axis_offset),
    }
    if head.T_head_zoom is not None:
        lengths["T_head_zoom"] = float(np.linalg.norm(head.T_head_zoom.translation))
    if calibration.board is not None:
        lengths["board.square"] = calibration.board.square
    for where, length in lengths.items():
        largest, what = LARGEST_M[where]
        if length > largest:
            return f"{where}: {what.format(length)}; lengths are in metres: is {length / 1000:.3g} m meant?"
    for i, pupil in enumerate(head.lens.pupil):
        if abs(pupil) > LARGEST_PUPIL_M:
            return f"zoom.stops[{i}].pupil: the entrance pupil moves by {pupil:.3g} m; lengths are in metres"
    return ""


def _contradiction(calibration: Calibration) -> str:
    """Describe how T and Gamma contradict the views that the calibration holds, or a usual rig where it holds none."""
    head = calibration.zoom_head
    if head.T_head_zoom is None:
        return ""
    arm, baseline = (float(np.linalg.norm(T.translation)) for T in (head.T_head_zoom, head.T_zoom0_fixed))
    views = _checked_views(calibration.views)
    if not views:
        if arm > max(LONGEST_ARM, baseline):
            return (
                f"T_head_zoom: the zoom camera is {arm:.2g} m from the head's axes, and {baseline:.2g} m from the "
                "fixed camera; are T_head_zoom and T_zoom0_fixed exchanged?"
            )
        return ""
    model = model_of(calibration)
    off = _typical_angle(calibration, model, views)
    if off <= USUAL:
        return ""
    exchanged = model.with_zoom_head(T_zoom0_fixed=model.head.hand_eye(), T_head_zoom=model.head.T_zoom0_fixed)
    are_exchanged = BETTER_EXCHANGED * _typical_angle(calibration, exchanged, views) < off
    if not are_exchanged and off <= UNEXPLAINED:
        return ""
    return (
        f"T_head_zoom, T_zoom0_fixed: they miss the corners that they come from by {math.degrees(off):.2g} degrees; "
        f"{'are they exchanged?' if are_exchanged else 'calibrate again'}"
    )


def _checked_views(views: Sequence[View]) -> list[View]:
    """Select the views of a few placements that the fixed camera sees, and the zoom camera with the head turned."""
    shown = [[v for v in same if v.camera == "fixed" or not at_home(v)] for same in by_placement(views).values()]
    both = [same for same in shown if {view.camera for view in same} == {"fixed", "zoom"}]
    return [view for same in both[:: max(len(both) // CHECKED_PLACEMENTS, 1)][:CHECKED_PLACEMENTS] for view in same]


def _typical_angle(calibration: Calibration, model: BundleModel, views: Sequence[View]) -> float:
    """Compute the median angle between corners seen and predicted, in the worse of both cameras [rad]."""
    assert calibration.board is not None
    points = board_points(calibration.board)
    placed = place_boards(model, views, points)
    pixels = predict_pixels(placed, views, points)
    angles: dict[str, list[float]] = defaultdict(list)
    for predicted, view in zip(pixels, views, strict=True):
        off_px = np.linalg.norm(predicted - view.corners_px, axis=-1)[view.seen]
        mean_px = float(np.mean(off_px)) if np.isfinite(off_px).all() else math.inf
        angles[view.camera].append(math.atan(mean_px / model.lens_of(view).focal_px[0]))
    return max(float(np.median(each)) for each in angles.values())


def _another_rig(calibration: Calibration, spec: RigSpec) -> str:
    """Describe by which focal lengths a calibration is of another zoom lens than the rig's."""
    fitting = calibration.for_streams(spec.fixed.size, spec.zoom.size)
    of_rig = shortest, longest = spec.zoom.focal_range
    match calibration.provenance.get("focal_range_px"):
        case [int() | float() as low, int() | float() as high] if low > 0 and high > 0:
            factor = spec.zoom.size[0] / calibration.zoom_head.lens.size[0]
            calibrated = low * factor, high * factor
            is_other = any(max(a / b, b / a) > OTHER_LENS for a, b in zip(calibrated, of_rig, strict=True))
        case _:  # captures of unknown origin: they need not cover the lens's range, but lie in it
            nominal_px = fitting.zoom_head.lens.nominal_px
            calibrated = nominal_px[0], nominal_px[-1]
            is_other = calibrated[0] > longest * OTHER_LENS or calibrated[1] * OTHER_LENS < shortest
    if not is_other:
        return ""
    return (
        f"is of a lens of {calibrated[0]:.0f} to {calibrated[1]:.0f} px, where the rig's has {shortest:.0f} to "
        f"{longest:.0f} px; is it another rig's?"
    )
