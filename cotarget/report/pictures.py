"""All pictures of a report, with what they show in words."""

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from cotarget.calibration.model import Calibration
from cotarget.report import figures, pointingfigures
from cotarget.report.evidence import Evidence
from cotarget.report.lenscurves import lens_curves
from cotarget.report.markup import Picture
from cotarget.report.pointing import AtFocal
from cotarget.report.wording import count, digits

NAMES = (
    "pointing_map",
    "pointing_depth",
    "pointing_focal",
    "residuals",
    "histogram",
    "coverage",
    "situation",
    "lens",
)
Add = Callable[[str, Figure, str, str], None]  # name, figure, alt, caption
# Those with many marks are embedded as PNG; thousands of arrows at a lower resolution, so that the page stays small.
DENSE = {"pointing_map": figures.PNG_DPI, "residuals": 140, "coverage": figures.PNG_DPI}


def draw(
    calibration: Calibration, at: tuple[AtFocal, ...], between: tuple[AtFocal, ...], evidence: Evidence | None
) -> dict[str, Picture]:
    """Draw what the calibration has the data for, by the names of `NAMES`."""
    made: dict[str, Picture] = {}

    def add(name: str, figure: Figure, alt: str, caption: str) -> None:
        dense = name in DENSE
        png = figures.as_bytes(figure, "png", DENSE.get(name, figures.PNG_DPI))
        made[name] = Picture(name, png, None if dense else figures.as_bytes(figure, "svg"), alt, caption)

    if at and np.isfinite(at[-1].rms):
        _pointing(calibration, at, between, evidence, add)
    if evidence is not None:
        _corners(calibration, evidence, add)
    if len(calibration.zoom.stops) > 1:
        bands = "" if calibration.covariance is None else " The bands are one standard deviation."
        add(
            "lens",
            figures.lens_figure(lens_curves(calibration)),
            "Curves of focal length ratio, principal point, distortion and entrance pupil over focal length",
            f"What the zoom lens does over its range; the dots are the stops, and splines lead from one to the next."
            f"{bands} κ₁ = k1 (n₀/n)² is the distortion as it appears in the image. The entrance pupil moves forward.",
        )
    return made


def _pointing(
    calibration: Calibration,
    at: tuple[AtFocal, ...],
    between: tuple[AtFocal, ...],
    evidence: Evidence | None,
    add: Add,
) -> None:
    last = at[-1]
    add(
        "pointing_map",
        pointingfigures.map_figure(calibration, last),
        f"Heat maps of the predicted pointing error over the wide view at three depths; {digits(np.degrees(last.rms))} "
        f"degrees on average",
        "The wide view with targets at three depths; lines join places of equal error, written in degrees. The error "
        "grows where no board reached, and with distance where boards were near only.",
    )
    add(
        "pointing_depth",
        pointingfigures.depth_figure(calibration, last, None if evidence is None else evidence.distances),
        "Curves of the predicted pointing error over depth, for the middle and the worst corner of the wide view",
        "Over depth, for a target in the middle of the wide view and in the worst of its four corners. The marks on "
        "the axis are the boards of the calibration.",
    )
    if len(at) > 1:
        add(
            "pointing_focal",
            pointingfigures.focal_figure(at, between),
            "Curves of the predicted pointing error over the focal length, in degrees and in pixels of the zoom image",
            "Over focal length, rms over the wide view and the depths; the dots are the calibrated stops. Between "
            "them the lens is interpolated, and what that leaves in doubt is counted.",
        )


def _corners(calibration: Calibration, evidence: Evidence, add: Add) -> None:
    add(
        "residuals",
        figures.residual_figure(evidence),
        "Images of both cameras with the residual of every corner as an arrow, and the averages over small cells",
        "Left: every corner, the arrow leading from where it was seen to where it is predicted, magnified as stated. "
        "Noise points everywhere. Right: averages over cells, magnified more; red ones are larger than chance makes "
        "them, and many of these in a row are what the model of the lens leaves out.",
    )
    add(
        "histogram",
        figures.histogram_figure(evidence),
        "Histograms of the residuals of both cameras against Gaussians",
        "Residuals against the Gaussian of their own standard deviation. Long tails are corners found wrongly.",
    )
    add(
        "coverage",
        figures.coverage_figure(evidence),
        "Where corners were seen in the images of both cameras",
        "Every corner that was used, over the number in each cell; no corner was seen in the pink cells.",
    )
    add(
        "situation",
        figures.situation_figure(evidence, calibration.zoom.nominal_px, calibration.T_head_zoom is not None),
        f"Histograms of the distances and the slants of {count(len(evidence.distances), 'board')}, head poses",
        "How far the boards were from the fixed camera, how they were turned from facing it, and where the head was. "
        "Near and far, turned to all sides, and both axes moved is what determines a rig.",
    )
