"""Figures of the calibration report, with their captions: pointing error, residuals, coverage and the zoom lens."""

import base64
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from cotarget.calibration.file import Calibration
from cotarget.calibration.model import CAMERAS
from cotarget.calibration.uncertainty import predicted_pointing
from cotarget.geometry import Array
from cotarget.report.analysis import (
    DEPTHS,
    TITLES,
    Analysis,
    AtFocal,
    Corners,
    Evidence,
    LensCurves,
    averaged,
    counts,
    head_poses,
    lens_curves,
    sample_depths,
)
from cotarget.report.text import count, digits

# Predicted pointing error

MAP_DEPTHS = 3
GRID = (29, 22)  # samples across and down the map
CONTOUR_SHARES = (0.15, 0.4, 0.65, 0.9)  # share of the image, over all depths, inside each contour
TICKS = 5
LOG_RATIO = 8.0  # ratio of largest to smallest error above which the colour scale is logarithmic
CURVE_REACH = 3.0  # factor by which the curve over depth extends beyond `DEPTHS` at both ends
CURVE_POINTS = 60


def map_figure(calibration: Calibration, at: AtFocal) -> Figure:
    """Draw the predicted error over the fixed image at three depths, in degrees and in px at one focal length."""
    width, height = calibration.fixed.size
    u, v = np.linspace(0, width - 1, GRID[0]), np.linspace(0, height - 1, GRID[1])
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    depths = sample_depths(MAP_DEPTHS)
    errors = np.degrees(predicted_pointing(calibration, pixels[None], depths[:, None, None], nominal_px=at.nominal_px))
    limits = float(np.nanmin(errors)) * 0.99, float(np.nanmax(errors)) * 1.01
    is_wide = limits[1] > LOG_RATIO * limits[0]
    norm = (LogNorm if is_wide else Normalize)(*limits)
    levels = np.unique([float(digits(level)) for level in np.nanquantile(errors, CONTOUR_SHARES)])
    with styled(3.3) as figure:
        axes = figure.subplots(1, MAP_DEPTHS, sharey=True)
        for ax, depth, error in zip(axes, depths, errors, strict=True):
            as_image(ax, (width, height))
            drawn = ax.imshow(error, norm=norm, cmap=HEAT, interpolation="bilinear", extent=extent((width, height)))
            inside = levels[(levels > np.nanmin(error)) & (levels < np.nanmax(error))]
            if len(inside):
                lines = ax.contour(u, v, error, inside, colors="white", linewidths=0.8)
                ax.clabel(lines, fontsize=7.5, fmt=digits)
            ax.set_title(f"{depth:.0f} m")
        bar = figure.colorbar(drawn, ax=axes, orientation="horizontal", shrink=0.75, aspect=45, pad=0.06)
        ticks = (np.geomspace if is_wide else np.linspace)(*limits, TICKS)
        two_lines = [f"{digits(t)}°\n{digits(np.radians(t) * at.focal_px)} px" for t in ticks]
        bar.set_ticks(ticks.tolist(), labels=two_lines)
        bar.ax.minorticks_off()
        bar.set_label(f"predicted error, one standard deviation; px at a focal length of {at.focal_px:.0f} px")
        return figure


def depth_figure(calibration: Calibration, at: AtFocal, boards: Array | None) -> Figure:
    """Draw the predicted error over depth in the middle and worst corner of the fixed image, with the boards [m]."""
    depths = np.geomspace(DEPTHS[0] / CURVE_REACH, DEPTHS[1] * CURVE_REACH, CURVE_POINTS)
    width, height = calibration.fixed.size
    corners = np.array([(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)], dtype=float)
    with styled(3.0) as figure:
        ax = figure.subplots()
        pixels = np.vstack([calibration.fixed.lens.image_center_px, corners])
        error = np.degrees(predicted_pointing(calibration, pixels, depths[:, None], nominal_px=at.nominal_px))
        worst = np.fmax.reduce(error[:, 1:], axis=1)  # nan only where no corner is reached
        ax.plot(depths, error[:, 0], color=BLUE, lw=1.6, label="middle of the fixed image")
        ax.plot(depths, worst, color=ORANGE, lw=1.6, label="its worst corner")
        ax.set_ylim(bottom=0)
        ax.axvspan(*DEPTHS, color=BLUE, alpha=0.06, lw=0, label="range of the verdict")
        boards = np.empty(0) if boards is None else boards[(boards > depths[0]) & (boards < depths[-1])]
        if len(boards):
            ax.plot(boards, np.zeros(len(boards)), "|", color=INK, ms=12, clip_on=False, label="boards")
        ax.set(xscale="log", xlabel="depth [m]", ylabel="predicted error [degrees]", xlim=(depths[0], depths[-1]))
        log_ticks(ax, [t for t in (1, 2, 5, 10, 20, 50, 100) if depths[0] <= t <= depths[-1]])
        both_ways = (lambda degrees: np.radians(degrees) * at.focal_px, lambda px: np.degrees(px / at.focal_px))
        px = ax.secondary_yaxis("right", functions=both_ways)
        px.set_ylabel(f"[px] at {at.focal_px:.0f} px")
        ax.legend(ncols=2, fontsize=8)
        return figure


def focal_figure(stops: tuple[AtFocal, ...], between: tuple[AtFocal, ...]) -> Figure:
    """Draw the predicted error over focal length, rms over the fixed image and the depths, in degrees and in px."""
    curve = sorted((*stops, *between), key=lambda at: at.nominal_px)
    with styled(2.7) as figure:
        for ax, unit in zip(figure.subplots(1, 2), ("degrees", "px in the zoom image"), strict=True):
            for those, look in ((curve, "-"), (stops, "o")):
                y = [np.degrees(at.rms) if unit == "degrees" else at.rms_px for at in those]
                ax.plot([at.nominal_px for at in those], y, look, color=BLUE, lw=1.6, ms=4)
            ax.set(xscale="log", xlabel="nominal focal length [px]", ylabel=f"[{unit}]", title="predicted error")
            ax.set_ylim(bottom=0)
            focal_ticks(ax, [stop.nominal_px for stop in stops])
        return figure


@dataclass(frozen=True)
class Plot:
    """Rendered figure for the page and for the folder beside it."""

    png: bytes
    alt: str  # text alternative
    caption: str

    @property
    def data_uri(self) -> str:
        """The figure as a data URI, which an HTML page embeds."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode('ascii')}"


INK, BLUE, ORANGE, RED, GREY, PALE = "#22303c", "#1f6f8b", "#c8702a", "#b5403a", "#8a97a3", "#e3e8ec"
WIDTH = 8.6  # inches: the page's column
PNG_DPI = 170
HEAT = "viridis"
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": PALE,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
}
# Length of a typical arrow over the image's width.
ARROW_SHARE = 0.02
NICE = (1, 2, 5)
HISTOGRAM_SIGMAS = 5.0
BINS = 60


@contextmanager
def styled(height: float, width: float = WIDTH) -> Iterator[Figure]:
    """Make an empty figure of a size in inches, and apply the report's style within the context."""
    with matplotlib.rc_context(STYLE):
        yield Figure(figsize=(width, height), layout="constrained")


def as_png(figure: Figure) -> bytes:
    """Render a figure as PNG, reproducibly to the byte."""
    buffer = io.BytesIO()
    figure.set_dpi(PNG_DPI)
    with matplotlib.rc_context(STYLE):
        # By the canvas itself, because `savefig` draws a figure with a layout twice.
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
    return buffer.getvalue()


def extent(size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Compute where an image of a size (width, height) [px] begins and ends on axes in pixels."""
    return -0.5, size[0] - 0.5, size[1] - 0.5, -0.5


def as_image(ax: Any, size: tuple[int, int]) -> None:
    """Set axes up as an image of a size (width, height) [px]."""
    width, height = size
    left, right, bottom, top = extent(size)
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    ax.grid(visible=False)
    ax.set_xticks([0, width // 2, width])
    ax.set_yticks([0, height // 2, height])
    for spine in ax.spines.values():
        spine.set_visible(True)


def log_ticks(ax: Any, values: Sequence[float] | Array, form: str = "g") -> None:
    """Label a logarithmic axis at some values alone."""
    ax.set_xticks(values, [format(value, form) for value in values])
    ax.minorticks_off()


def arrows(ax: Any, at: Array, vectors: Array, *colour: Array, **style: Any) -> Any:
    """Draw vectors (n, 2) at pixels (n, 2), in the axes' units."""
    # An arrow out of the image does not change the layout.
    return ax.quiver(*at.T, *vectors.T, *colour, angles="xy", scale_units="xy", scale=1, in_layout=False, **style)


def magnification(corners: Corners) -> float:
    """Choose a round factor at which a typical residual makes a visible arrow."""
    if not corners.sigma:
        return 1.0
    wanted = ARROW_SHARE * corners.size[0] / corners.sigma
    power = 10 ** np.floor(np.log10(wanted))
    return float(max(n * power for n in NICE if n * power <= wanted))


def residual_figure(evidence: Evidence) -> Figure:
    """Draw every corner's residual as an arrow, and their averages over cells, for both cameras."""
    shown = [name for name in CAMERAS if len(evidence.corners[name].seen_px)]
    with styled(2.9 * len(shown)) as figure:
        for row, name in zip(figure.subplots(len(shown), 2, squeeze=False), shown, strict=True):
            corners = evidence.corners[name]
            factor = magnification(corners)
            as_image(row[0], corners.size)
            lengths = np.linalg.norm(corners.residuals, axis=-1)
            order = np.argsort(lengths)
            drawn = arrows(
                row[0],
                corners.seen_px[order],
                factor * corners.residuals[order],
                lengths[order],
                width=0.0014,
                cmap="viridis_r",
                alpha=0.75,
                clim=(0, np.percentile(lengths, 99)),
            )
            figure.colorbar(drawn, ax=row[0], label="length [px]", shrink=0.8, pad=0.02)
            row[0].set_title(f"{TITLES[name]}: every corner, ×{factor:g}")
            cells = averaged(corners)
            factor = magnification(corners) * 4
            as_image(row[1], corners.size)
            row[1].scatter(*corners.seen_px.T, s=1.5, color=PALE, lw=0)
            for those, colour in ((~cells.beyond_chance, GREY), (cells.beyond_chance, RED)):
                arrows(row[1], cells.middles[those], factor * cells.means[those], color=colour, width=0.004)
            row[1].set_title(f"{TITLES[name]}: averages, ×{factor:g}")
        return figure


def histogram_figure(evidence: Evidence) -> Figure:
    """Draw histograms of the residuals' coordinates against the Gaussian of their standard deviation."""
    shown = [name for name in CAMERAS if len(evidence.corners[name].residuals)]
    with styled(2.6) as figure:
        for ax, name in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
            corners = evidence.corners[name]
            reach = HISTOGRAM_SIGMAS * corners.sigma
            edges = np.linspace(-reach, reach, BINS + 1)
            x = np.linspace(-reach, reach, 400)
            gauss = np.exp(-(x**2) / 2 / corners.sigma**2) / (corners.sigma * np.sqrt(2 * np.pi))
            width, number = edges[1] - edges[0], len(corners.residuals)
            for k, (label, colour) in enumerate((("across (u)", BLUE), ("down (v)", ORANGE))):
                ax.hist(
                    np.clip(corners.residuals[:, k], -reach, reach),
                    edges,
                    histtype="stepfilled" if k == 0 else "step",
                    color=colour,
                    alpha=0.45 if k == 0 else 1.0,
                    lw=1.3,
                    label=label,
                )
            ax.plot(x, gauss * number * width, color=INK, lw=1.2, label=f"Gaussian, {digits(corners.sigma)} px")
            ax.set(title=TITLES[name], xlabel="residual [px]", ylabel="corners", xlim=(-reach, reach))
            ax.legend(fontsize=8, loc="upper right", handlelength=1.2)
        return figure


def coverage_figure(evidence: Evidence) -> Figure:
    """Draw the corners seen in both images, over their number in each cell."""
    shown = [name for name in CAMERAS if len(evidence.corners[name].seen_px)]
    with styled(3.3) as figure:
        for ax, name in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
            corners = evidence.corners[name]
            as_image(ax, corners.size)
            number = counts(corners)
            drawn = ax.imshow(np.where(number > 0, number, np.nan), cmap="Blues", vmin=0, extent=extent(corners.size))
            ax.set_facecolor("#f6d9d5")
            ax.scatter(*corners.seen_px.T, s=0.8, color=INK, lw=0, alpha=0.5)
            ax.set_title(TITLES[name])
            figure.colorbar(drawn, ax=ax, orientation="horizontal", label="corners in a cell", shrink=0.8, pad=0.03)
        return figure


def situation_figure(evidence: Evidence, nominal_px: tuple[float, ...], has_head: bool) -> Figure:
    """Draw the boards' distances and tilts, the head's poses, and the number of views at each zoom sample."""
    several = len(nominal_px) > 1
    with styled(2.7) as figure:
        axes = figure.subplots(1, 2 + has_head + several, squeeze=False)[0].tolist()
        ax = axes.pop(0)
        edges = np.geomspace(evidence.distances.min() * 0.98, evidence.distances.max() * 1.02, 11)
        ax.hist(evidence.distances, edges, color=BLUE, alpha=0.8)
        ax.set(title="distance of the boards", xlabel="[m]", ylabel="placements", xscale="log")
        log_ticks(ax, np.unique([float(f"{t:.2g}") for t in np.geomspace(edges[0], edges[-1], 4)]))
        ax = axes.pop(0)
        ax.hist(np.degrees(evidence.leanings), np.arange(0, 91, 7.5), color=BLUE, alpha=0.8)
        ax.set(title="turn from facing", xlabel="[degrees]", ylabel="placements", xlim=(0, 90))
        if has_head:
            ax = axes.pop(0)
            ax.scatter(*np.degrees(head_poses(evidence.views)).T, s=12, color=ORANGE, alpha=0.7, lw=0)
            ax.set(title="head poses", xlabel="pan [degrees]", ylabel="tilt [degrees]")
            ax.axis("equal")
        if several:
            ax = axes.pop(0)
            ax.bar(range(len(nominal_px)), evidence.per_stop, color=BLUE, alpha=0.8)
            ax.set_xticks(range(len(nominal_px)), [f"{n:.0f}" for n in nominal_px], rotation=45)
            ax.set(title="zoom samples", xlabel="nominal focal length [px]", ylabel="views")
        return figure


def lens_figure(curves: LensCurves) -> Figure:
    """Draw the zoom lens over its focal range, with one standard deviation about every curve."""
    panels = (
        ("true over nominal focal length", "", {"ratio_x": "across", "ratio_y": "down"}),
        ("principal point from its mean", "[px]", {"cx": "across", "cy": "down"}),
        ("distortion of the image, κ₁", "", {"kappa1": ""}),
        ("entrance pupil", "[mm]", {"pupil_mm": ""}),
    )
    with styled(5.0) as figure:
        for ax, (title, unit, names) in zip(figure.subplots(2, 2, sharex=True).flat, panels, strict=True):
            for (name, label), colour in zip(names.items(), (BLUE, ORANGE), strict=False):
                shift = curves.at_stops[name].mean() if name in ("cx", "cy") else 0.0
                y = curves.values[name] - shift
                text = f"{label} ({digits(shift, 4)} px)" if shift else label
                ax.plot(curves.nominal_px, y, color=colour, lw=1.5, label=text)
                if name in curves.sigmas:
                    s = curves.sigmas[name]
                    ax.fill_between(curves.nominal_px, y - s, y + s, color=colour, alpha=0.2, lw=0)
                stops = np.array(curves.stops_px)
                ax.plot(stops, curves.at_stops[name] - shift, "o", ms=4, color=colour)
            ax.set(title=title, ylabel=unit, xscale="log")
            ax.ticklabel_format(axis="y", useOffset=False)
            focal_ticks(ax, curves.stops_px)
            if len(names) > 1:
                ax.legend(fontsize=8)
        figure.supxlabel("nominal focal length [px]", fontsize=9)
        return figure


def focal_ticks(ax: Any, stops_px: Sequence[float]) -> None:
    """Label zoom samples on a logarithmic axis, as many as there is room for."""
    shown = stops_px if len(stops_px) <= 7 else stops_px[:: -(-len(stops_px) // 6)]
    log_ticks(ax, shown, ".0f")


# All figures with their captions

FIGURE_NAMES = (
    "pointing_map",
    "pointing_depth",
    "pointing_focal",
    "residuals",
    "histogram",
    "coverage",
    "situation",
    "lens",
)
Drawn = tuple[str, Figure, str, str]  # name, figure, alt, caption


def draw(calibration: Calibration, found: Analysis) -> dict[str, Plot]:
    """Draw all figures for which the calibration has data, by the names of `FIGURE_NAMES`."""
    return {name: Plot(as_png(figure), alt, caption) for name, figure, alt, caption in _drawn(calibration, found)}


def _drawn(calibration: Calibration, found: Analysis) -> Iterator[Drawn]:
    """Draw the figures one after the other."""
    if found.at and np.isfinite(found.at[-1].rms):
        yield from _pointing(calibration, found)
    if found.evidence is not None:
        yield from _corners(calibration, found.evidence)
    if len(calibration.zoom_head.lens.stops) > 1:
        bands = "" if calibration.covariance is None else " The bands are one standard deviation."
        yield (
            "lens",
            lens_figure(lens_curves(calibration)),
            "Curves of focal length ratio, principal point, distortion and entrance pupil over focal length",
            f"What the zoom lens does over its range; the dots are the zoom samples, and splines join them."
            f"{bands} κ₁ = k1 (n₀/n)² is the distortion as it appears in the image. The entrance pupil moves forward.",
        )


def _pointing(calibration: Calibration, found: Analysis) -> Iterator[Drawn]:
    last = found.at[-1]
    yield (
        "pointing_map",
        map_figure(calibration, last),
        "Heat maps of the predicted pointing error over the fixed image at three depths; "
        f"{digits(np.degrees(last.rms))} degrees on average",
        "The fixed image with targets at three depths; lines join places of equal error [degrees]. The error grows "
        "where no board was shown, and with distance where boards were near only.",
    )
    yield (
        "pointing_depth",
        depth_figure(calibration, last, None if found.evidence is None else found.evidence.distances),
        "Curves of the predicted pointing error over depth, for the middle and the worst corner of the fixed image",
        "Over depth, for a target in the middle of the fixed image and in the worst of its four corners. The marks on "
        "the axis are the boards of the calibration.",
    )
    if len(found.at) > 1:
        yield (
            "pointing_focal",
            focal_figure(found.at, found.between),
            "Curves of the predicted pointing error over the focal length, in degrees and in pixels of the zoom image",
            "Over focal length, rms over the fixed image and the depths; the dots are the zoom samples. Between "
            "them the lens is interpolated, and what that leaves in doubt is counted.",
        )


def _corners(calibration: Calibration, evidence: Evidence) -> Iterator[Drawn]:
    yield (
        "residuals",
        residual_figure(evidence),
        "Images of both cameras with the residual of every corner as an arrow, and the averages over small cells",
        "Left: every corner, the arrow leading from where it was seen to where it is predicted, magnified as stated. "
        "Noise points everywhere. Right: averages over cells, magnified more; red ones are larger than chance makes "
        "them, and many of these in a row are what the model of the lens leaves out.",
    )
    yield (
        "histogram",
        histogram_figure(evidence),
        "Histograms of the residuals of both cameras against Gaussians",
        "Residuals against the Gaussian of their own standard deviation. Long tails are corners found wrongly.",
    )
    yield (
        "coverage",
        coverage_figure(evidence),
        "Where corners were seen in the images of both cameras",
        "Every corner that was used, over the number in each cell; no corner was seen in the pink cells.",
    )
    yield (
        "situation",
        situation_figure(
            evidence, calibration.zoom_head.lens.nominal_px, calibration.zoom_head.T_head_zoom is not None
        ),
        f"Histograms of the distances and the slants of {count(len(evidence.distances), 'board')}, head poses",
        "How far the boards were from the fixed camera, how they were turned from facing it, and where the head was. "
        "Near and far, turned to all sides, and both axes moved is what determines a rig.",
    )
